//! Straight motions of the tip: sampled, solved pose by pose on one branch, and checked.

use crate::SERVICE;
use crate::leg::{Blocked, Leaving, Scene};
use nalgebra::{Unit, UnitQuaternion, Vector3};
use rover_kinematics::{AxisGoal, closest_solution};
use rover_messages::Fault;
use rover_service::{joints_refusal, reach_refusal};

/// Spacing of the poses that are solved, m.
const SPACING_M: f64 = 0.002;
/// Spacing of the poses that are solved where the axis turns, rad.
const TURN_SPACING_RAD: f64 = 0.01;
/// Largest joint travel between two such poses, rad: more is a jump to another branch, or the
/// neighbourhood of a singularity, where a small motion of the tip needs a large one of a joint.
const MAX_JUMP_RAD: f64 = 0.2;
/// Largest distance of the tip from its line between two such poses, m.
const MAX_BULGE_M: f64 = 5e-4;
/// An axis cannot be turned about an undetermined line: largest turn between two poses, rad.
const MAX_TURN_RAD: f64 = 3.0;

/// A straight motion in joint space.
pub(crate) struct StraightPath {
    /// Joint angles at every pose, rad.
    pub waypoints: Vec<Vec<f64>>,
    /// Length of the tip's path up to each, m.
    pub lengths_m: Vec<f64>,
}

fn fault(name: &str, message: String) -> Fault {
    Fault::new(SERVICE, name, message)
}

/// The path of the tip from its place at `start` (rad) straight through `goals` (arm base frame).
pub(crate) fn straight(
    scene: &Scene,
    start: &[f64],
    goals: &[AxisGoal],
) -> Result<StraightPath, Fault> {
    let robot = scene.model.robot();
    let (arm, tool) = (&robot.arm, &robot.tool);
    let joints = |e| joints_refusal(robot, SERVICE, "the start of the line", &e);
    let mut leaving = Leaving::from(scene, start).map_err(joints)?;
    let mut path = StraightPath {
        waypoints: vec![start.to_vec()],
        lengths_m: vec![0.0],
    };
    let mut from = AxisGoal::at(arm, tool, start).map_err(joints)?;
    let mut before = start.to_vec();
    let mut length = 0.0;
    for (line, to) in goals.iter().enumerate() {
        let turn = from.axis.angle(&to.axis);
        if turn > MAX_TURN_RAD {
            return Err(fault(
                "axis_reversal",
                format!(
                    "pose {line}: the axis turns by {turn:.3} rad, expected at most \
                     {MAX_TURN_RAD} rad in one line"
                ),
            )
            .with("turn_rad", turn));
        }
        let distance = (to.point - from.point).norm();
        let steps = (distance / SPACING_M).max(turn / TURN_SPACING_RAD).ceil() as usize;
        for step in 1..=steps {
            let goal = between(&from, to, step as f64 / steps as f64);
            let travelled = distance * step as f64 / steps as f64;
            let place = format!("pose {line}, {:.1} mm along its line", travelled * 1e3);
            let q = closest_solution(arm, tool, &goal, &before).map_err(|e| {
                reach_refusal(robot, SERVICE, &place, &e).with("along_m", travelled)
            })?;
            check_continuity(scene, &before, &q, &goal, &place)
                .map_err(|f| f.with("along_m", travelled))?;
            let checked = scene.check_leg(&before, &q, &mut leaving).map_err(joints)?;
            checked.map_err(|b| refused(scene, &b, &place).with("along_m", travelled))?;
            path.waypoints.push(q.clone());
            path.lengths_m.push(length + travelled);
            before = q;
        }
        length += distance;
        from = to.clone();
    }
    if path.waypoints.len() == 1 {
        path.waypoints.push(start.to_vec());
        path.lengths_m.push(0.0);
    }
    Ok(path)
}

/// The pose at the fraction `t` of a line: the point linearly, the axis on the great circle.
fn between(from: &AxisGoal, to: &AxisGoal, t: f64) -> AxisGoal {
    let turn = UnitQuaternion::rotation_between_axis(&from.axis, &to.axis)
        .map(|r| r.powf(t))
        .unwrap_or_default();
    AxisGoal {
        point: from.point.lerp(&to.point, t),
        axis: if t >= 1.0 {
            to.axis
        } else {
            Unit::new_normalize(turn * from.axis.into_inner())
        },
    }
}

fn check_continuity(
    scene: &Scene,
    before: &[f64],
    q: &[f64],
    goal: &AxisGoal,
    place: &str,
) -> Result<(), Fault> {
    let robot = scene.model.robot();
    for (joint, (a, b)) in before.iter().zip(q).enumerate() {
        let jump = (b - a).abs();
        if jump > MAX_JUMP_RAD {
            let name = &robot.description().arm.joints[joint].name;
            return Err(fault(
                "branch_change",
                format!(
                    "{place}: joint {joint} `{name}` would jump by {jump:.3} rad (from {a:.4} to \
                     {b:.4} rad), expected at most {MAX_JUMP_RAD} rad between neighbouring poses: \
                     the line leaves its branch or passes a singularity"
                ),
            )
            .with("joint_n", joint as f64)
            .with("jump_rad", jump));
        }
    }
    let tip = |q: &[f64]| -> Result<Vector3<f64>, Fault> {
        let (tip, _) = robot
            .tool
            .at(&robot.arm, q)
            .map_err(|e| joints_refusal(robot, SERVICE, place, &e))?;
        Ok(tip)
    };
    let middle: Vec<f64> = before.iter().zip(q).map(|(a, b)| 0.5 * (a + b)).collect();
    let bulge = (tip(&middle)? - (tip(before)? + goal.point) * 0.5).norm();
    if bulge > MAX_BULGE_M {
        return Err(fault(
            "branch_change",
            format!(
                "{place}: between neighbouring poses the tip would be {:.2} mm off its line, \
                 expected at most {:.2} mm: a singularity is near",
                bulge * 1e3,
                MAX_BULGE_M * 1e3
            ),
        )
        .with("bulge_m", bulge));
    }
    Ok(())
}

/// The fault for a motion that something blocks.
pub(crate) fn refused(scene: &Scene, blocked: &Blocked, place: &str) -> Fault {
    let p = &blocked.proximity;
    let (first, second) = scene.model.names(p.pair);
    fault(
        "no_collision_free_path",
        format!(
            "{place}: {first} would be {:.1} mm from {second} at ({:.3}, {:.3}, {:.3}) m in the \
             rover frame, expected at least {:.1} mm",
            p.distance_m * 1e3,
            p.at.x,
            p.at.y,
            p.at.z,
            p.required_m * 1e3
        ),
    )
    .with("distance_m", p.distance_m)
    .with("required_m", p.required_m)
    .with("at_x_m", p.at.x)
    .with("at_y_m", p.at.y)
    .with("at_z_m", p.at.z)
}
