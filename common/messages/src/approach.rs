//! The approach to a target seen from the mast: goal, feedback and result of `approach/drive_to`.

use crate::{
    imaging::FrameReference,
    mobility::SitePose,
    target::Target,
    wire,
    wire::{Wire, finite, in_range},
};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Limits of an approach; what is absent is the robot file's or the service's own.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ApproachLimits {
    /// Longest way of the wheels, m.
    pub max_distance_m: Option<f64>,
    /// Most stops.
    pub max_stops_n: Option<u32>,
    /// Longest way between two stops, as a fraction of the range.
    pub step_fraction: Option<f64>,
    /// Steepest ground to drive on, rad.
    pub max_slope_rad: Option<f64>,
    /// Largest slip.
    pub max_slip: Option<f64>,
    /// Largest uncertainty of the position at which to go on, mm, one sigma of the worst axis
    /// along the surface.
    pub max_sigma_mm: Option<f64>,
}

/// Goal of `approach/drive_to`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DriveToGoal {
    /// The target as it was selected in a mast image: pair, pixel, and position, normal and
    /// covariance in the rover frame of that moment.
    pub target: Target,
    /// The image in whose left picture the pixel was named: the anchor of all tracking.
    pub anchor: FrameReference,
    /// Limits.
    #[serde(default)]
    pub limits: ApproachLimits,
    /// Direction towards the sun, site frame, unit vector, if it is known: no base pose is chosen
    /// from which the rover shades its target.
    #[serde(default)]
    pub sun_in_site: Option<[f64; 3]>,
    /// Radius about the target within which another spot may be taken if the target itself cannot
    /// be reached, m; 0 for the target alone.
    #[serde(default)]
    pub spot_radius_m: f64,
    /// Base poses from which the placement has failed already: none like them is chosen again.
    #[serde(default)]
    pub avoid: Vec<SitePose>,
    /// What an earlier approach has lost of the place that was named first: the
    /// [`DriveToResult::lost_m2`] of it where `anchor` is its last image.
    #[serde(default)]
    pub lost_m2: [[f64; 3]; 3],
}

/// What the approach is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ApproachActivity {
    /// Pointing the mast and taking images.
    Looking,
    /// Finding the target in a new image.
    Tracking,
    /// Choosing the way or the base pose.
    Planning,
    /// Under way.
    Driving,
    /// From the mast's to the body's cameras.
    HandingOver,
}

/// Feedback of `approach/drive_to`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DriveToFeedback {
    /// What is being done.
    pub activity: ApproachActivity,
    /// Stop, from 0 for the place of the designation.
    pub stop_n: u32,
    /// Believed distance of the target from the rover frame's origin along the ground, m.
    pub range_m: f64,
    /// The last image in which the target was looked for, when it has just been found there.
    #[serde(default)]
    pub frame: Option<FrameReference>,
    /// Where the target is in the last left image, px, if it was found.
    pub pixel_px: Option<[f64; 2]>,
    /// Standard deviations of the target's position along the rover axes, mm.
    pub sigma_mm: [f64; 3],
    /// Correlation of the last match, 0 to 1.
    pub score: Option<f64>,
    /// Error along the surface that 95 % of placements on a target seen like this one stay below,
    /// mm; told before the drive.
    #[serde(default)]
    pub forecast_mm: Option<f64>,
}

/// How the target was found again at a stop.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sighting {
    /// The image.
    pub frame: FrameReference,
    /// Predicted pixel in the left image, px.
    pub predicted_px: [f64; 2],
    /// Found pixel in the left image, px, if the match was accepted.
    pub pixel_px: Option<[f64; 2]>,
    /// Half width and half height of the search window, px.
    pub window_px: [f64; 2],
    /// Correlation of the match, 0 to 1.
    pub score: f64,
    /// Forward-backward distance, px, if it was measured.
    pub forward_backward_px: Option<f64>,
    /// Shift by the relief correction, px, if it was made.
    pub relief_px: Option<f64>,
    /// How: `affine`, `translation`, `second_anchor`, `last_stop`, `new_image`, `first_ray`, `handover`.
    pub method: String,
    /// Why the match was refused, if it was.
    pub refusal: Option<String>,
}

/// One stop of the approach.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ApproachStop {
    /// Stop, from 0.
    pub stop_n: u32,
    /// When, s.
    pub sim_time_s: f64,
    /// Believed pose of the rover.
    pub pose: SitePose,
    /// Believed distance of the target from the rover frame's origin along the ground, m.
    pub range_m: f64,
    /// Every look for the target, in order; the last accepted one counts.
    pub sightings: Vec<Sighting>,
    /// Filtered target after this stop, rover frame of this stop, m.
    pub position_m: [f64; 3],
    /// Standard deviations along the rover axes, mm.
    pub sigma_mm: [f64; 3],
    /// Slip estimated on the way to this stop.
    pub slip: f64,
    /// What the pictures told of the motion to this stop; none where odometry alone did.
    #[serde(default)]
    pub seen_motion: Option<SeenMotion>,
}

/// A motion between two stops that landmarks in the pictures agree on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SeenMotion {
    /// Landmarks that agree.
    pub agreeing_n: u32,
    /// Landmarks found.
    pub found_n: u32,
    /// Root mean square distance of the agreeing ones from where the motion puts them, px.
    pub rms_px: f64,
}

/// What one source adds to the error of the position.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ErrorShare {
    /// `designation`, `tracking`, `relief`, `handover`, `stereo`, ...
    pub source: String,
    /// One sigma along the surface, mm.
    pub sigma_mm: f64,
}

/// The base pose that was chosen, and how good it is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BasePose {
    /// Believed pose in which the rover stands.
    pub pose: SitePose,
    /// Quality figures by name; names carry their unit (`reach_margin_m`, `manipulability`,
    /// `wheel_clearance_m`, `tilt_rad`).
    pub quality: BTreeMap<String, f64>,
    /// Candidates looked at.
    pub candidates_n: u32,
    /// Names of the conditions that refused candidates, and how many each.
    pub refused: BTreeMap<String, u32>,
}

/// Result of `approach/drive_to`: the rover stands with the target in the arm's workspace.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DriveToResult {
    /// The target in the body pair: pixels, and position, normal and covariance in the present
    /// rover frame.
    pub target: Target,
    /// Whether it is the designated target (or another spot within the goal's radius), and where
    /// it lies from the designated one, rover frame, m.
    pub spot_offset_m: Option<[f64; 3]>,
    /// Error of the position by source.
    pub budget: Vec<ErrorShare>,
    /// What tracking may have lost of the place that was named: covariance along the surface, site
    /// frame, m^2. It is in the target's own covariance already.
    pub lost_m2: [[f64; 3]; 3],
    /// What was forecast before the drive, see [`DriveToFeedback::forecast_mm`].
    pub forecast_mm: f64,
    /// The target in the left image of the pair that tracked it, as it was handed over, px.
    pub tracked_px: [f64; 2],
    /// That image.
    pub tracked_in: FrameReference,
    /// Distance between the pixel predicted by geometry alone and the matched one at the
    /// handover, px.
    pub handover_px: f64,
    /// The base pose.
    pub base: BasePose,
    /// Every stop.
    pub stops: Vec<ApproachStop>,
    /// Way of the wheels, m.
    pub driven_m: f64,
}

wire! { DriveToFeedback = "drive_to_feedback/3" }

impl Wire for DriveToGoal {
    const SCHEMA: &'static str = "drive_to_goal/4";
    fn validate(&self) -> Result<(), String> {
        self.target.validate().map_err(|e| format!("target.{e}"))?;
        if self.anchor.pair != self.target.pair {
            return Err(format!(
                "anchor.pair: `{}`, expected the target's, `{}`",
                self.anchor.pair, self.target.pair
            ));
        }
        let l = &self.limits;
        for (field, value, low, high) in [
            ("limits.max_distance_m", l.max_distance_m, 0.0, 1e3),
            ("limits.step_fraction", l.step_fraction, 0.02, 0.5),
            ("limits.max_slope_rad", l.max_slope_rad, 0.0, 1.2),
            ("limits.max_slip", l.max_slip, 0.0, 1.0),
            ("limits.max_sigma_mm", l.max_sigma_mm, 0.1, 1e4),
        ] {
            if let Some(value) = value {
                in_range(field, value, low, high)?;
            }
        }
        if let Some(sun) = &self.sun_in_site {
            let length = sun.iter().map(|x| x * x).sum::<f64>().sqrt();
            in_range("sun_in_site (length)", length, 1.0 - 1e-6, 1.0 + 1e-6)?;
        }
        for (i, pose) in self.avoid.iter().enumerate() {
            let place = pose.position_m.coords;
            let numbers = [place.x, place.y, place.z, pose.heading_rad];
            finite(&format!("avoid[{i}]"), &numbers)?;
        }
        finite("lost_m2", self.lost_m2.as_flattened())?;
        in_range("spot_radius_m", self.spot_radius_m, 0.0, 1.0)
    }
}

impl Wire for DriveToResult {
    const SCHEMA: &'static str = "drive_to_result/5";
    fn validate(&self) -> Result<(), String> {
        self.target.validate().map_err(|e| format!("target.{e}"))?;
        finite("tracked_px", &self.tracked_px)?;
        finite("handover_px", &[self.handover_px, self.driven_m])?;
        finite("lost_m2", self.lost_m2.as_flattened())?;
        for (i, share) in self.budget.iter().enumerate() {
            in_range(&format!("budget[{i}].sigma_mm"), share.sigma_mm, 0.0, 1e4)?;
        }
        Ok(())
    }
}
