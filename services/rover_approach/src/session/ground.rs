//! The ground as the mast has seen it on the way.

use super::Session;
use crate::egomotion::Landmark;
use crate::hardware::Frame;
use crate::obstacles::{GroundMap, GroundRules, PlanarPose};
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use rover_messages::{Fault, approach::ApproachActivity, status::work};
use rover_vision::{MatchRules, sparse_points};

/// Where the ground is looked at before each movement, m ahead.
const HAZARD_LOOK_M: f64 = 2.0;
/// Pixels between the points of the ground map.
const MAP_STEP_PX: u32 = 28;
/// What the mast sees so near to the rover is the rover itself, m.
const OWN_M: f64 = 0.08;
/// Frames whose points are kept.
const MAP_FRAMES: usize = 6;

impl Session<'_> {
    /// Looks at the ground that the next movement leads over, unless the target's own image shows
    /// it or it is known already.
    pub(super) async fn look_ahead(&mut self) -> Result<(), Fault> {
        self.tell(ApproachActivity::Looking);
        let bearing = self.estimate.position_m.xy().normalize();
        let range_m = self.estimate.position_m.xy().norm();
        let [half_x, half_y] = self.mobility.footprint_half_m;
        let level = self.level_from_rover();
        let towards = level * self.estimate.position_m;
        let ahead = PlanarPose {
            x_m: 0.0,
            y_m: 0.0,
            heading_rad: towards.y.atan2(towards.x),
        };
        let far_m = half_x + half_x + self.rules.max_step_m;
        let known = || self.map().knows(&ahead, [half_x, far_m], half_y);
        if range_m < HAZARD_LOOK_M || known() {
            return Ok(());
        }
        let place = bearing * HAZARD_LOOK_M;
        self.point_at(&Vector3::new(place.x, place.y, 0.0)).await?;
        let frame = self.hardware.capture(&self.goal.target.pair, 0).await?;
        self.remember(&frame);
        Ok(())
    }

    pub(super) fn remember_ground(&mut self) {
        let frame = self.now.clone();
        self.landmarks = self.remember(&frame);
    }

    /// Adds a frame's points to the ground known; those of old frames are forgotten. Returns them
    /// as landmarks.
    fn remember(&mut self, frame: &Frame) -> Vec<Landmark> {
        let Some(site_from_rover) = frame.frame.site_from_rover() else {
            return Vec::new();
        };
        let view = &frame.view;
        let rules = MatchRules {
            range_min_m: 0.9,
            range_max_m: 8.0,
            ..MatchRules::default()
        };
        let points = self.hardware.shell.timed(work::VISION, || {
            sparse_points(&view.left, &view.right, &view.cameras, MAP_STEP_PX, &rules)
        });
        let Ok(points) = points else {
            return Vec::new();
        };
        let [half_x, half_y] = self.mobility.footprint_half_m;
        let own = |p: &Vector3<f64>| {
            let below = p.x.abs() < half_x + OWN_M && p.y.abs() < half_y + OWN_M;
            below || self.shade.touches(p, OWN_M)
        };
        let in_site = points
            .iter()
            .filter(|(_, p)| !own(p))
            .map(|(_, p)| (site_from_rover.isometry * Point3::from(*p)).coords)
            .collect();
        self.ground.push(in_site);
        if self.ground.len() > MAP_FRAMES {
            self.ground.remove(0);
        }
        let landmark = |(pixel_px, point_m)| Landmark { pixel_px, point_m };
        points.into_iter().map(landmark).collect()
    }

    /// The ground known, in the levelled rover frame.
    pub(super) fn map(&self) -> GroundMap {
        let pose = &self.wheels.pose;
        let turn = UnitQuaternion::from_euler_angles(0.0, 0.0, pose.heading_rad);
        let site_from_level = Isometry3::from_parts(pose.position_m.coords.into(), turn);
        let level_from_site = site_from_level.inverse();
        let points: Vec<Vector3<f64>> = self
            .ground
            .iter()
            .flatten()
            .map(|p| (level_from_site * Point3::from(*p)).coords)
            .collect();
        GroundMap::from_points(&points, GroundRules::default()).passed(self.mobility)
    }
}
