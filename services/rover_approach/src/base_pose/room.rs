//! How much room a posture of the arm leaves to the terrain about the target.

use super::TargetSpot;
use crate::shade::point_to_segment;
use nalgebra::{Point3, Vector3};
use rover_robot::{Robot, TOOL_REACH_M};

/// Farther aside the tangent plane does not speak for the surface, m.
const NEAR_M: f64 = 0.25;
/// Places looked at on each shape.
const PLACES: u32 = 5;
/// How much nearer the rest of the last link may come.
const NEARER: f64 = 3.0;

/// Distance of the arm at `joints_rad` from the tangent plane at the target, near the target, from
/// the places measured about it and from the ground on which the rover stands, m; `spot` in the
/// rover's frame. Of the last link the tool is left out, which is to go there, and the rest may come
/// nearer, which counts as more. None for joint angles that are none of this arm.
pub(super) fn room_m(robot: &Robot, spot: &TargetSpot, joints_rad: &[f64]) -> Option<f64> {
    let frames = robot.arm.link_poses(joints_rad).ok()?;
    let joints = &robot.description().arm.joints;
    let mut room_m = f64::INFINITY;
    let (tip, _) = robot.tool.at(&robot.arm, joints_rad).ok()?;
    let tip = (robot.rover_from_arm_base.isometry * Point3::from(tip)).coords;
    let links = frames.iter().skip(1).zip(joints).enumerate();
    for (link, (frame, joint)) in links.skip(1) {
        let is_last = link + 1 == joints.len();
        let weight = if is_last { NEARER } else { 1.0 };
        let rover_from_link = robot.rover_from_arm_base.isometry * frame;
        for shape in &joint.shape {
            let [a, b] = [shape.from_m, shape.to_m]
                .map(|end| (rover_from_link * Point3::from(Vector3::from(end))).coords);
            for k in 0..PLACES {
                let part = f64::from(k) / f64::from(PLACES - 1);
                let place = a + (b - a) * part;
                let away = place - spot.position_m;
                let above_m = away.dot(&spot.normal);
                if is_last && (place - tip).norm() < TOOL_REACH_M {
                    continue;
                }
                let mut least_m = place.z;
                if (away - spot.normal * above_m).norm() < NEAR_M {
                    least_m = least_m.min(above_m);
                }
                room_m = room_m.min((least_m - shape.radius_m) * weight);
            }
            if is_last {
                continue;
            }
            for point in &spot.around_m {
                room_m = room_m.min(point_to_segment(point, &a, &b) - shape.radius_m);
            }
        }
    }
    Some(room_m)
}
