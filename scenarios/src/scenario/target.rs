//! What to place the instrument on, and how to get there.

use super::{Check, ScenarioError};
use rover_messages::{
    approach::{ApproachLimits, DriveToGoal},
    imaging::FrameReference,
    simulation::{PickRequest, SurfaceKind},
    target::Target,
};
use rover_robot::{CameraMount, Robot};
use rover_sim::TargetPixel;
use serde::{Deserialize, Serialize};

/// What to place the instrument on: one pixel of one camera pair, or a place that the simulator
/// picks in a person's stead.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TargetChoice {
    /// Camera pair, as named in the robot file.
    pub pair: String,
    /// Column and row in the left image, px; (0, 0) is the centre of the first pixel.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pixel_px: Option<[f64; 2]>,
    /// Pan (to the left) and tilt (down) of the mast for that image, deg; for a pair on the mast.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mast_deg: Option<[f64; 2]>,
    /// Instead of a pixel: what a person would look for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pick: Option<PickChoice>,
}

/// What a person would look for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PickChoice {
    /// `rock` or `ground`.
    pub surface: SurfaceKind,
    /// Nearest and farthest distance from the rover along the ground, m.
    pub range_m: [f64; 2],
    /// Which of many such places.
    #[serde(default)]
    pub choice_n: u32,
}

/// How the rover drives to a target seen from the mast.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ApproachSettings {
    /// Longest way of the wheels, m.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_distance_m: Option<f64>,
    /// Most stops.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_stops_n: Option<u32>,
    /// Longest way between two stops, as a fraction of the range.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub step_fraction: Option<f64>,
    /// Steepest ground to drive on, deg.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_slope_deg: Option<f64>,
    /// Largest slip.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_slip: Option<f64>,
    /// Largest uncertainty of the target's position near the rover at which to go on, mm, one
    /// sigma.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_sigma_mm: Option<f64>,
    /// Base poses from which the placement is tried at most.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_base_poses_n: Option<u32>,
    /// Azimuth (from the rover's first heading to its left) and elevation of the sun, deg; if not
    /// given, those of the simulated sun.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sun_deg: Option<[f64; 2]>,
    /// Another spot within this radius may be taken if the target itself cannot be reached, mm; 0
    /// for the target alone.
    pub spot_radius_mm: f64,
}

impl TargetChoice {
    /// The pixel, where it is known before the run; the simulator measures occlusion from the
    /// surface seen there.
    pub(super) fn known_from_the_start(&self) -> Option<TargetPixel> {
        let pixel_px = self.pixel_px.filter(|_| self.mast_deg.is_none())?;
        Some(TargetPixel {
            pair: self.pair.clone(),
            pixel_px,
        })
    }

    /// The question to the simulator for a place to pick.
    pub fn pick_request(&self) -> Option<PickRequest> {
        self.pick.as_ref().map(|pick| PickRequest {
            pair: self.pair.clone(),
            surface: pick.surface,
            range_m: pick.range_m,
            choice_n: pick.choice_n,
        })
    }

    pub(super) fn check(&self, robot: &Robot, check: &Check) -> Result<(), ScenarioError> {
        let pair = robot
            .pair(&self.pair)
            .map_err(|e| check.error("target.pair", e.to_string()))?;
        let one = usize::from(self.pixel_px.is_some()) + usize::from(self.pick.is_some());
        check.require(
            one == 1,
            "target",
            format!("has {one} of `pixel_px` and `pick`, expected exactly one"),
        )?;
        if let Some(pixel_px) = &self.pixel_px {
            let size = [pair.cameras.left.width_px, pair.cameras.left.height_px];
            for ((axis, &x), n) in ["u", "v"].iter().zip(pixel_px).zip(size) {
                let high = f64::from(n) - 0.5;
                check.range(&format!("target.pixel_px ({axis})"), x, -0.5, high)?;
            }
        }
        if let Some(mast_deg) = &self.mast_deg {
            check.require(
                pair.mount == CameraMount::Mast && self.pixel_px.is_some(),
                "target.mast_deg",
                "given, expected only beside `pixel_px` and for a pair on the mast",
            )?;
            let mast = robot
                .mast()
                .map_err(|e| check.error("target.mast_deg", e.to_string()))?;
            for (axis, &x, limits) in [
                ("pan", &mast_deg[0], mast.pan_rad),
                ("tilt", &mast_deg[1], mast.tilt_rad),
            ] {
                let [low, high] = limits.map(f64::to_degrees);
                check.range(&format!("target.mast_deg ({axis})"), x, low, high)?;
            }
        }
        if let Some(pick) = &self.pick {
            let [near, far] = pick.range_m;
            check.range("target.pick.range_m[0]", near, 0.0, 100.0)?;
            check.range("target.pick.range_m[1]", far, near, 100.0)?;
        }
        Ok(())
    }
}

impl ApproachSettings {
    pub(super) fn check(
        &self,
        robot: &Robot,
        target: &TargetChoice,
        check: &Check,
    ) -> Result<(), ScenarioError> {
        let cannot = |e: rover_robot::RobotError| check.error("approach", e.to_string());
        robot.mobility().map_err(cannot)?;
        robot.mast().map_err(cannot)?;
        let mount = robot.pair(&target.pair).map(|pair| pair.mount);
        check.require(
            mount.is_ok_and(|mount| mount == CameraMount::Mast),
            "target.pair",
            format!(
                "`{}`, expected a pair on the mast, as the target is driven to",
                target.pair
            ),
        )?;
        if let Some([azimuth, elevation]) = self.sun_deg {
            check.range("approach.sun_deg (azimuth)", azimuth, -360.0, 360.0)?;
            check.range("approach.sun_deg (elevation)", elevation, -90.0, 90.0)?;
        }
        for (field, value, low, high) in [
            ("max_distance_m", self.max_distance_m, 0.1, 1e3),
            ("step_fraction", self.step_fraction, 0.02, 0.5),
            ("max_slope_deg", self.max_slope_deg, 0.0, 60.0),
            ("max_slip", self.max_slip, 0.0, 1.0),
            ("max_sigma_mm", self.max_sigma_mm, 0.1, 1e4),
            (
                "max_base_poses_n",
                self.max_base_poses_n.map(f64::from),
                1.0,
                100.0,
            ),
            ("spot_radius_mm", Some(self.spot_radius_mm), 0.0, 1e3),
        ] {
            if let Some(value) = value {
                check.range(&format!("approach.{field}"), value, low, high)?;
            }
        }
        Ok(())
    }

    /// The approach's goal for a target selected in the image `anchor`.
    pub fn goal(&self, target: &Target, anchor: FrameReference) -> DriveToGoal {
        let sun_in_site = self.sun_deg.map(|angles| {
            let [azimuth, elevation] = angles.map(f64::to_radians);
            let level = elevation.cos();
            [
                level * azimuth.cos(),
                level * azimuth.sin(),
                elevation.sin(),
            ]
        });
        DriveToGoal {
            sun_in_site,
            target: target.clone(),
            anchor,
            limits: ApproachLimits {
                max_distance_m: self.max_distance_m,
                max_stops_n: self.max_stops_n,
                step_fraction: self.step_fraction,
                max_slope_rad: self.max_slope_deg.map(f64::to_radians),
                max_slip: self.max_slip,
                max_sigma_mm: self.max_sigma_mm,
            },
            spot_radius_m: self.spot_radius_mm * 1e-3,
            avoid: Vec::new(),
            lost_m2: [[0.0; 3]; 3],
        }
    }
}
