//! The servo's and the contact motion's goals, feedback and results.

use crate::{
    target::Target,
    wire,
    wire::{Wire, in_range},
};
use rover_compensation::Compensation;
use serde::{Deserialize, Serialize};

/// How the end-effector's position error is estimated; written as its name in scenarios.
pub use rover_methods::Kind as Method;

/// What is observed of the fiducial.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Observation {
    /// The position of one mark, as in the paper.
    Position,
    /// Position and orientation of the whole plate.
    #[default]
    Pose,
}

/// Goal of `servo/place`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlaceGoal {
    /// Where to place the instrument.
    pub target: Target,
    /// Distances of the tip from the target along the normal at which to look, far to near, m;
    /// the last one is the standoff.
    pub stations_m: Vec<f64>,
    /// How to estimate the error.
    #[serde(default)]
    pub method: Method,
    /// What to observe.
    #[serde(default)]
    pub observation: Observation,
    /// At the standoff: repeat until the next correction is below this, m.
    pub tolerance_m: f64,
    /// At the standoff: at most so many corrections.
    pub max_corrections_n: u32,
    /// Refuse to go on when the predicted lateral error of the tip (95 % bound) exceeds this, m.
    pub max_predicted_error_m: f64,
}

/// One look at the fiducial.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Look {
    /// When, s.
    pub sim_time_s: f64,
    /// Control step of the image.
    pub step: u64,
    /// Distance from the target along the normal that was commanded, m.
    pub station_m: f64,
    /// Whether the fiducial was found in both images.
    pub found: bool,
    /// Why not, if not.
    pub reason: Option<String>,
    /// Seen minus predicted position of the tip, rover frame, m, if seen.
    pub error_vector_m: Option<[f64; 3]>,
    /// Rotation from predicted to seen orientation, rotation vector in the rover frame, rad, if
    /// the orientation was observed.
    pub rotation_error_rad: Option<[f64; 3]>,
    /// Where the fiducial's mark was found in the left image, px.
    pub left_px: Option<[f64; 2]>,
    /// Where the fiducial's mark was found in the right image, px.
    pub right_px: Option<[f64; 2]>,
    /// Reprojection residual, px, if the pose was observed.
    pub rms_px: Option<f64>,
    /// Predicted lateral error of the tip at the target if placed now, 95 % bound, m.
    pub predicted_error_m: f64,
}

/// Feedback of `servo/place`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlaceFeedback {
    /// What is being done: `moving`, `looking`.
    pub activity: String,
    /// Believed distance of the tip from the target, m.
    pub distance_m: f64,
    /// The last look, if there was one.
    pub look: Option<Look>,
}

/// Result of `servo/place`: the tip is at the standoff.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlaceResult {
    /// Every look, in order.
    pub looks: Vec<Look>,
    /// Whether the last correction was below the tolerance.
    pub converged: bool,
    /// Standoff reached, m.
    pub standoff_m: f64,
    /// Predicted lateral error of the tip at the target, 95 % bound, m; target uncertainty
    /// included.
    pub predicted_error_m: f64,
    /// What the contact motion shall apply.
    pub compensation: Compensation,
}

/// Goal of `contact/approach`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ContactGoal {
    /// Where to make contact.
    pub target: Target,
    /// The servo's last knowledge of the error.
    pub compensation: Compensation,
    /// Distance of the tip from the target at the start, m.
    pub standoff_m: f64,
    /// Travel beyond the target after which there is no surface, m.
    pub max_overtravel_m: f64,
    /// Largest axial force, N.
    pub max_force_n: f64,
    /// Speed along the normal, m/s.
    pub speed_m_s: f64,
    /// Whether to go back to the standoff after contact.
    pub retract: bool,
}

/// Feedback of `contact/approach`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ContactFeedback {
    /// What is being done: `approaching`, `in_contact`, `retracting`.
    pub activity: String,
    /// Believed distance of the tip from the target, m, negative beyond it.
    pub distance_m: f64,
    /// Axial force, N.
    pub tip_force_n: f64,
}

/// Result of `contact/approach`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ContactResult {
    /// Switch travel at rest in contact, m.
    pub switch_travel_m: f64,
    /// Largest axial force, N.
    pub peak_force_n: f64,
    /// Distance driven along the normal until contact, m.
    pub approach_m: f64,
    /// Encoder angles when the switch closed, rad.
    pub joints_at_contact_rad: Vec<f64>,
    /// When the switch closed, s.
    pub sim_time_s: f64,
    /// Whether the instrument was retracted.
    pub retracted: bool,
}

wire! {
    PlaceFeedback = "place_feedback/1",
    PlaceResult = "place_result/1",
    ContactFeedback = "contact_feedback/1",
    ContactResult = "contact_result/1",
}

impl Wire for PlaceGoal {
    const SCHEMA: &'static str = "place_goal/1";
    fn validate(&self) -> Result<(), String> {
        self.target.validate().map_err(|e| format!("target.{e}"))?;
        if self.stations_m.is_empty() {
            return Err("stations_m: empty, expected at least the standoff".into());
        }
        for (i, &s) in self.stations_m.iter().enumerate() {
            in_range(&format!("stations_m[{i}]"), s, 0.005, 1.0)?;
        }
        if self.stations_m.windows(2).any(|w| w[1] >= w[0]) {
            return Err(format!(
                "stations_m: {:?}, expected far to near",
                self.stations_m
            ));
        }
        in_range("tolerance_m", self.tolerance_m, 1e-6, 0.1)?;
        in_range(
            "max_predicted_error_m",
            self.max_predicted_error_m,
            1e-6,
            1.0,
        )?;
        in_range(
            "max_corrections_n",
            f64::from(self.max_corrections_n),
            1.0,
            100.0,
        )
    }
}

impl Wire for ContactGoal {
    const SCHEMA: &'static str = "contact_goal/1";
    fn validate(&self) -> Result<(), String> {
        self.target.validate().map_err(|e| format!("target.{e}"))?;
        in_range("standoff_m", self.standoff_m, 0.0, 1.0)?;
        in_range("max_overtravel_m", self.max_overtravel_m, 0.0, 0.2)?;
        in_range("max_force_n", self.max_force_n, 0.1, 200.0)?;
        in_range("speed_m_s", self.speed_m_s, 1e-4, 0.1)
    }
}
