//! What the planner promises, checked by means other than its own: distances by brute force over
//! points on the robot's capsules, poses by forward kinematics.

#![allow(clippy::unwrap_used, clippy::expect_used, missing_docs)]

use nalgebra::{Point3, Vector3};
use proptest::prelude::*;
use rover_arm_planner::Planner;
use rover_geometry::{Direction, Point};
use rover_kinematics::JointTrajectory;
use rover_messages::planning::{Plan, PlanGoal, PlanRequest, ToolPose};
use rover_robot::{Capsule, Robot};
use std::sync::Arc;

const GROUND_M: f64 = 0.35;

fn bluestreak() -> Arc<Robot> {
    let path = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../scenarios/robots/bluestreak.toml"
    );
    Arc::new(Robot::read(std::path::Path::new(path)).unwrap())
}

fn ask(goal: PlanGoal) -> PlanRequest {
    PlanRequest {
        start_rad: None,
        goal,
        speed_fraction: 1.0,
        max_tip_speed_m_s: None,
        contact_radius_m: 0.0,
    }
}

/// Points of a terrain of the given height over the arm's workspace.
fn terrain(height: impl Fn(f64, f64) -> f64) -> Vec<Vector3<f64>> {
    let grid = (0..110).flat_map(|i| (0..160).map(move |j| (i, j)));
    grid.map(|(i, j)| (0.12 + 0.008 * f64::from(i), -0.64 + 0.008 * f64::from(j)))
        .map(|(x, y)| Vector3::new(x, y, height(x, y)))
        .collect()
}

fn planner_over(robot: &Arc<Robot>, points: &[Vector3<f64>]) -> Planner {
    let planner = Planner::new(robot.clone());
    let map = planner
        .map_of(points, robot.posture("stow").unwrap())
        .unwrap();
    planner.with_terrain(map)
}

fn pose(x: f64, y: f64, z: f64, axis: [f64; 3]) -> ToolPose {
    ToolPose {
        tip_m: Point::new(x, y, z),
        axis: Direction::new(axis.into()).unwrap(),
    }
}

const DOWN: [f64; 3] = [0.0, 0.0, -1.0];

/// Points along a capsule's core line, with its radius.
fn core(capsule: &Capsule) -> Vec<Vector3<f64>> {
    let (from, to) = (Vector3::from(capsule.from_m), Vector3::from(capsule.to_m));
    let n = ((to - from).norm() / 0.005).ceil().max(1.0) as usize;
    (0..=n)
        .map(|i| from.lerp(&to, i as f64 / n as f64))
        .collect()
}

/// Smallest distance (m) between the arm's links, to the body, and to the terrain's points, by
/// brute force; the last link against the terrain only if asked for.
fn brute_clearance(robot: &Robot, points: &[Vector3<f64>], q: &[f64], last_link: bool) -> f64 {
    let base = robot.rover_from_arm_base.isometry;
    let poses = robot.arm.link_poses(q).unwrap();
    let joints = &robot.description().arm.joints;
    let mut links: Vec<(usize, f64, Vec<Vector3<f64>>)> = Vec::new();
    for (i, joint) in joints.iter().enumerate() {
        for capsule in &joint.shape {
            let at = |p: Vector3<f64>| (base * poses[i + 1] * Point3::from(p)).coords;
            links.push((
                i + 1,
                capsule.radius_m,
                core(capsule).into_iter().map(at).collect(),
            ));
        }
    }
    let mut smallest = f64::INFINITY;
    let gap = |a: &[Vector3<f64>], b: &[Vector3<f64>]| {
        let pairs = a.iter().flat_map(|p| b.iter().map(move |q| (p - q).norm()));
        pairs.fold(f64::INFINITY, f64::min)
    };
    for (i, r, a) in &links {
        for (j, s, b) in &links {
            if i + 1 < *j {
                smallest = smallest.min(gap(a, b) - r - s);
            }
        }
        for body in &robot.description().body {
            if *i > 1 {
                smallest = smallest.min(gap(a, &core(body)) - r - body.radius_m);
            }
        }
        if *i < joints.len() || last_link {
            smallest = smallest.min(gap(a, points) - r);
        }
    }
    smallest
}

fn along(trajectory: &JointTrajectory, spacing_s: f64) -> impl Iterator<Item = Vec<f64>> + '_ {
    let n = (trajectory.duration_s() / spacing_s).ceil() as usize;
    (0..=n).map(move |i| trajectory.sample(i as f64 * spacing_s).0)
}

fn assert_sound(robot: &Robot, plan: &Plan, start: &[f64]) {
    plan.trajectory.validate(&robot.arm).unwrap();
    assert_eq!(plan.trajectory.points[0].q_rad, start);
    assert_eq!(plan.trajectory.points.last().unwrap().q_rad, plan.end_rad);
    assert!(
        plan.trajectory
            .points
            .last()
            .unwrap()
            .qd_rad_s
            .iter()
            .all(|v| *v == 0.0)
    );
}

#[test]
fn the_arm_deploys_and_stows_clear_of_itself_the_wall_and_the_ground() {
    let robot = bluestreak();
    let points = terrain(|_, _| GROUND_M);
    let planner = planner_over(&robot, &points);
    for (from, to) in [("stow", "ready"), ("ready", "stow")] {
        let start = robot.posture(from).unwrap();
        let plan = planner
            .plan(&ask(PlanGoal::Posture(to.into())), start)
            .unwrap();
        assert_sound(&robot, &plan, start);
        assert_eq!(plan.end_rad, robot.posture(to).unwrap());
        let brute = along(&plan.trajectory, 0.1)
            .map(|q| brute_clearance(&robot, &points, &q, true))
            .fold(f64::INFINITY, f64::min);
        assert!(brute > 0.0, "{brute}");
        let clearance = plan.clearance_m.unwrap();
        // The map's cells are whole and the brute force knows points only.
        assert!(
            clearance <= brute + 1e-3 && clearance > brute - 0.012,
            "{clearance} {brute}"
        );
    }
}

#[test]
fn a_tool_pose_is_reached_with_the_fiducial_in_view() {
    let robot = bluestreak();
    let planner = planner_over(&robot, &terrain(|_, _| GROUND_M));
    let start = robot.posture("ready").unwrap();
    let body = robot.pair("body").unwrap();
    let mut reached = 0;
    for x in [0.4, 0.5, 0.6] {
        for y in [-0.1, 0.0, 0.1] {
            let pose = pose(x, y, GROUND_M + 0.12, DOWN);
            let goal = PlanGoal::Tool {
                pose,
                visible_to: Some("body".into()),
            };
            let plan = planner.plan(&ask(goal), start).unwrap();
            assert_sound(&robot, &plan, start);
            let end = planner.tool_pose(&plan.end_rad).unwrap();
            assert!(end.tip_m.distance(&pose.tip_m) < 1e-6);
            assert!(end.axis.angle(&pose.axis) < 1e-6);
            let plate =
                robot.rover_from_link(&plan.end_rad).unwrap().isometry * robot.link_from_plate;
            for camera in [&body.cameras.left, &body.cameras.right] {
                let centre = plate.translation.vector;
                let pixel = camera.project(&centre).unwrap();
                assert!(camera.contains(&pixel, 0.0));
                let to_camera = camera.model.cahv()[0] - centre;
                let normal = plate.rotation * Vector3::z();
                assert!(normal.angle(&to_camera).to_degrees() < 65.0);
            }
            reached += 1;
        }
    }
    assert_eq!(reached, 9);
}

#[test]
fn a_pose_that_cannot_be_taken_is_refused_by_name_and_number() {
    let robot = bluestreak();
    let planner = planner_over(&robot, &terrain(|_, _| GROUND_M));
    let start = robot.posture("ready").unwrap();
    let refusal = |goal| planner.plan(&ask(goal), start).unwrap_err();
    let tool = |pose, visible_to: Option<&str>| PlanGoal::Tool {
        pose,
        visible_to: visible_to.map(Into::into),
    };

    let far = refusal(tool(pose(1.5, 0.0, 0.5, DOWN), None));
    assert_eq!(far.name, "target_out_of_reach");
    assert!(far.details["beyond_reach_m"] > 0.4, "{far}");

    let limit = refusal(PlanGoal::Joints(vec![0.0, 0.0, 3.5, 0.0, 0.0]));
    assert_eq!(limit.name, "joint_limit");
    assert!(
        limit.message.contains("`elbow`") && limit.message.contains("3.5"),
        "{limit}"
    );
    assert_eq!(limit.details["upper_rad"], 2.9);

    let hidden = refusal(tool(pose(0.5, 0.35, 0.5, [0.0, 0.6, -0.8]), Some("body")));
    assert_eq!(hidden.name, "fiducial_not_visible");
    assert!(hidden.message.contains("deg"), "{hidden}");

    let buried = refusal(tool(pose(0.5, 0.0, GROUND_M - 0.05, DOWN), None));
    assert_eq!(buried.name, "no_collision_free_path");
    assert!(
        buried.message.contains("`turret`") && buried.message.contains("terrain"),
        "{buried}"
    );
    assert!(buried.details["distance_m"] < buried.details["required_m"]);

    for goal in [
        PlanGoal::Posture("yoga".into()),
        tool(pose(0.5, 0.0, 0.5, DOWN), Some("periscope")),
    ] {
        let unknown = refusal(goal);
        assert_eq!(unknown.name, "unknown_name");
        assert!(unknown.message.contains("ready") || unknown.message.contains("body"));
    }
    let short = planner
        .plan(&ask(PlanGoal::Posture("stow".into())), &[0.0; 3])
        .unwrap_err();
    assert_eq!(short.name, "bad_joints");
}

#[test]
fn a_straight_motion_keeps_to_its_line_its_axis_and_its_speed() {
    let robot = bluestreak();
    let planner = Planner::new(robot.clone());
    let from = pose(0.45, -0.05, 0.5, DOWN);
    let goal = PlanGoal::Tool {
        pose: from,
        visible_to: None,
    };
    let start = planner
        .plan(&ask(goal), robot.posture("ready").unwrap())
        .unwrap()
        .end_rad;
    let to = pose(0.55, 0.05, 0.45, [0.2, 0.0, -1.0]);
    let request = PlanRequest {
        max_tip_speed_m_s: Some(0.02),
        ..ask(PlanGoal::Straight(vec![to]))
    };
    let plan = planner.plan(&request, &start).unwrap();
    assert_sound(&robot, &plan, &start);
    let line = to.tip_m.coords - from.tip_m.coords;
    let mut before: Option<Vector3<f64>> = None;
    for q in along(&plan.trajectory, 0.01) {
        let here = planner.tool_pose(&q).unwrap();
        let off = here.tip_m.coords - from.tip_m.coords;
        let t = off.dot(&line) / line.norm_squared();
        assert!((off - line * t).norm() < 1e-4);
        let axis = from.axis.unit.slerp(&to.axis.unit, t.clamp(0.0, 1.0));
        assert!(here.axis.angle(&Direction::from(axis)) < 2e-3);
        if let Some(before) = before {
            assert!((here.tip_m.coords - before).norm() <= 0.02 * 0.01 * 1.05);
        }
        before = Some(here.tip_m.coords);
    }
    let end = planner.tool_pose(&plan.end_rad).unwrap();
    assert!(end.tip_m.distance(&to.tip_m) < 1e-6 && end.axis.angle(&to.axis) < 1e-6);
}

#[test]
fn a_line_that_leaves_the_workspace_is_refused_where_it_does() {
    let robot = bluestreak();
    let planner = Planner::new(robot.clone());
    let goal = PlanGoal::Tool {
        pose: pose(0.6, 0.0, 0.5, DOWN),
        visible_to: None,
    };
    let start = planner
        .plan(&ask(goal), robot.posture("ready").unwrap())
        .unwrap()
        .end_rad;
    let out = PlanGoal::Straight(vec![pose(1.2, 0.0, 0.5, DOWN)]);
    let fault = planner.plan(&ask(out), &start).unwrap_err();
    assert!(
        ["target_out_of_reach", "joint_limit", "branch_change"].contains(&fault.name.as_str()),
        "{fault}"
    );
    assert!((0.02..0.6).contains(&fault.details["along_m"]), "{fault}");
    let back = PlanGoal::Straight(vec![pose(0.6, 0.0, 0.52, [0.0, 0.0, 1.0])]);
    assert_eq!(
        planner.plan(&ask(back), &start).unwrap_err().name,
        "axis_reversal"
    );
}

#[test]
fn a_motion_without_length_is_a_plan() {
    let robot = bluestreak();
    let planner = Planner::new(robot.clone());
    let start = robot.posture("ready").unwrap();
    let here = planner.tool_pose(start).unwrap();
    for goal in [
        PlanGoal::Straight(vec![here]),
        PlanGoal::Posture("ready".into()),
    ] {
        let plan = planner.plan(&ask(goal), start).unwrap();
        assert_sound(&robot, &plan, start);
    }
}

#[test]
fn the_ground_may_be_touched_only_where_contact_is_meant() {
    let robot = bluestreak();
    let planner = planner_over(&robot, &terrain(|_, _| GROUND_M));
    let above = PlanGoal::Tool {
        pose: pose(0.5, 0.0, GROUND_M + 0.06, DOWN),
        visible_to: None,
    };
    let start = planner
        .plan(&ask(above), robot.posture("ready").unwrap())
        .unwrap()
        .end_rad;
    let touch = PlanGoal::Straight(vec![pose(0.5, 0.0, GROUND_M - 0.01, DOWN)]);
    let fault = planner.plan(&ask(touch.clone()), &start).unwrap_err();
    assert_eq!(fault.name, "no_collision_free_path");
    let request = PlanRequest {
        contact_radius_m: 0.07,
        ..ask(touch)
    };
    let contact = planner.plan(&request, &start).unwrap().end_rad;

    // From there the arm may leave, but not go deeper.
    let stow = planner
        .plan(&ask(PlanGoal::Posture("stow".into())), &contact)
        .unwrap();
    assert_sound(&robot, &stow, &contact);
    let deeper = PlanGoal::Straight(vec![pose(0.5, 0.0, GROUND_M - 0.03, DOWN)]);
    assert_eq!(
        planner.plan(&ask(deeper), &contact).unwrap_err().name,
        "no_collision_free_path"
    );
}

#[test]
fn a_wall_is_passed_over_and_the_same_question_has_the_same_answer() {
    let robot = bluestreak();
    let wall = |_: f64, y: f64| {
        if (-0.03..0.03).contains(&y) {
            0.45
        } else {
            0.2
        }
    };
    let points = terrain(wall);
    let planner = planner_over(&robot, &points);
    let side = |y| PlanGoal::Tool {
        pose: pose(0.5, y, 0.36, DOWN),
        visible_to: None,
    };
    let start = planner
        .plan(&ask(side(0.25)), robot.posture("ready").unwrap())
        .unwrap()
        .end_rad;
    let plan = planner.plan(&ask(side(-0.2)), &start).unwrap();
    assert_sound(&robot, &plan, &start);
    for q in along(&plan.trajectory, 0.1) {
        assert!(brute_clearance(&robot, &points, &q, true) > 0.0);
    }
    assert_eq!(planner.plan(&ask(side(-0.2)), &start).unwrap(), plan);
}

#[test]
fn what_the_cameras_see_of_the_arm_is_no_obstacle() {
    let robot = bluestreak();
    let planner = Planner::new(robot.clone());
    let ready = robot.posture("ready").unwrap();
    let mut points = terrain(|_, _| GROUND_M);
    let ground_only = planner.map_of(&points, ready).unwrap();
    let poses = robot.arm.link_poses(ready).unwrap();
    for (i, joint) in robot.description().arm.joints.iter().enumerate() {
        for p in joint.shape.iter().flat_map(core) {
            let centre = robot.rover_from_arm_base.isometry * poses[i + 1] * Point3::from(p);
            points.push(centre.coords + Vector3::new(0.0, 0.0, 0.05));
        }
    }
    assert_eq!(planner.map_of(&points, ready).unwrap(), ground_only);
    let nothing = planner
        .map_of(&[Vector3::new(9.0, 9.0, 9.0); 5], ready)
        .unwrap_err();
    assert_eq!(nothing.name, "no_map");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn no_planned_motion_collides(
        goal in prop::array::uniform5(-1.0..1.0f64), bumps in prop::array::uniform2(0.0..40.0f64),
    ) {
        let robot = bluestreak();
        let height = |x: f64, y: f64| 0.3 + 0.06 * (bumps[0] * x).sin() * (bumps[1] * y).cos();
        let points = terrain(height);
        let planner = planner_over(&robot, &points);
        let start = robot.posture("ready").unwrap();
        let goal: Vec<f64> = goal.iter().zip(robot.arm.limits())
            .map(|(t, l)| 0.5 * (l.lower_rad + l.upper_rad) + 0.5 * t * (l.upper_rad - l.lower_rad))
            .collect();
        match planner.plan(&ask(PlanGoal::Joints(goal.clone())), start) {
            Ok(plan) => {
                assert_sound(&robot, &plan, start);
                for q in along(&plan.trajectory, 0.2) {
                    let clearance = brute_clearance(&robot, &points, &q, true);
                    prop_assert!(clearance > 0.0, "{clearance} at {q:?}");
                }
            }
            Err(fault) => {
                prop_assert_eq!(&fault.name, "no_collision_free_path");
                prop_assert!(fault.details["distance_m"] < fault.details["required_m"]);
            }
        }
    }
}

/// The plate is thin: where its bounding ball would touch the forearm, the plate itself does not.
#[test]
fn the_fiducial_is_shown_on_the_side_of_the_shoulder_too() {
    let robot = bluestreak();
    let planner = planner_over(&robot, &terrain(|_, _| GROUND_M));
    let start = robot.posture("ready").unwrap();
    for y in [0.1, 0.15, 0.2] {
        let goal = PlanGoal::Tool {
            pose: pose(0.5, y, GROUND_M + 0.06, DOWN),
            visible_to: Some("body".into()),
        };
        let plan = planner.plan(&ask(goal), start).unwrap();
        assert_sound(&robot, &plan, start);
    }
}

/// Only the tool may touch: in a hole that is too narrow for what carries it, that is in the way.
#[test]
fn contact_excuses_the_tool_and_nothing_else() {
    let robot = bluestreak();
    let hole = |radius: f64| {
        move |x: f64, y: f64| {
            let beside = f64::hypot(x - 0.5, y);
            if beside < radius {
                GROUND_M
            } else {
                GROUND_M + 0.1
            }
        }
    };
    let down = PlanRequest {
        contact_radius_m: 0.2,
        ..ask(PlanGoal::Straight(vec![pose(0.5, 0.0, GROUND_M, DOWN)]))
    };
    let above = PlanGoal::Tool {
        pose: pose(0.5, 0.0, GROUND_M + 0.16, DOWN),
        visible_to: None,
    };
    for (radius, fits) in [(0.035, false), (0.2, true)] {
        let planner = planner_over(&robot, &terrain(hole(radius)));
        let start = planner
            .plan(&ask(above.clone()), robot.posture("ready").unwrap())
            .unwrap()
            .end_rad;
        match planner.plan(&down, &start) {
            Ok(_) => assert!(fits, "{radius}"),
            Err(fault) => {
                assert!(!fits, "{radius}: {fault}");
                assert_eq!(fault.name, "no_collision_free_path");
                assert!(fault.message.contains("terrain"), "{fault}");
            }
        }
    }
}
