//! Questions to the simulator that only the scenario runner may ask.

use crate::{
    imaging::ImageData,
    target::Target,
    wire,
    wire::{Wire, in_range},
};
use serde::{Deserialize, Serialize};

/// Question to `sim/truth/score`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScoreRequest {
    /// The target as it was selected.
    pub target: Target,
    /// The target as it was handed over to the pair that the arm works with, if it was.
    #[serde(default)]
    pub handed_over: Option<Target>,
    /// Encoder angles of the purely kinematic placement on the believed target, rad.
    pub open_loop_joints_rad: Option<Vec<f64>>,
}

/// The placement measured against the truth. A quantity that does not exist is absent.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Score {
    /// True surface point seen at the designated pixel, world frame, m.
    pub target_in_world_m: [f64; 3],
    /// True surface normal there.
    pub normal_in_world: [f64; 3],
    /// The believed target (as it was handed over, if it was), world frame, camera mount error
    /// removed, m.
    pub believed_in_world_m: [f64; 3],
    /// First touch of the instrument on the terrain, world frame, m.
    pub contact_in_world_m: Option<[f64; 3]>,
    /// Distance between the two in the plane of the true normal, mm.
    pub lateral_error_mm: Option<f64>,
    /// Distance between the two along the true normal, mm.
    pub range_error_mm: Option<f64>,
    /// Angle between the instrument's axis at contact and the true inward normal, deg.
    pub axis_error_deg: Option<f64>,
    /// The lateral error of a purely kinematic placement, mm.
    pub open_loop_lateral_error_mm: Option<f64>,
    /// Distance between believed and true tip at the present encoder angles, mm, mount error
    /// included.
    pub arm_model_error_mm: f64,
    /// Distance between the believed target and the true one, mm, mount error removed.
    pub target_error_mm: f64,
}

/// Question to `sim/truth/view`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ViewRequest {
    /// Position of the outside camera, world frame, m.
    pub eye_m: [f64; 3],
    /// Point that it looks at, world frame, m.
    pub look_at_m: [f64; 3],
    /// Columns, px.
    pub width_px: u32,
    /// Rows, px.
    pub height_px: u32,
    /// Horizontal field of view, deg.
    pub field_of_view_deg: f64,
}

/// Answer of `sim/truth/view`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct View {
    /// What the outside camera sees.
    pub image: ImageData,
}

/// Answer of `sim/truth/state`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TruthState {
    /// Simulated time, s.
    pub sim_time_s: f64,
    /// True tip position, world frame, m.
    pub tip_in_world_m: [f64; 3],
    /// True joint angles, rad.
    pub joints_rad: Vec<f64>,
    /// Seconds of computing so far by kind: physics, rendering.
    pub physics_wall_s: f64,
    /// Rendering, s of wall time.
    pub rendering_wall_s: f64,
    /// Physics steps so far.
    pub steps: u64,
    /// First uncontrolled contact: simulated time, s, and the link (from 0) that touched
    /// something solid.
    pub collision: Option<(f64, u32)>,
    /// The rover, if it drives.
    #[serde(default)]
    pub rover: Option<TrueRover>,
}

/// Where a rover really is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrueRover {
    /// Origin of the rover frame, world frame, m.
    pub position_m: [f64; 3],
    /// Roll, pitch and yaw of the rover frame (fixed axes), world frame, rad.
    pub rpy_rad: [f64; 3],
    /// Angle between the present attitude and that in which the wheels left the body, deg: what
    /// the arm's weight does.
    pub tilt_by_arm_deg: f64,
    /// Distance between true and believed position in the site frame, m.
    pub position_error_m: f64,
    /// Believed minus true heading, rad.
    pub heading_error_rad: f64,
}

/// What a target lies on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SurfaceKind {
    /// A rock.
    Rock,
    /// The ground.
    Ground,
}

/// Question to `sim/truth/designate`: remembers, for scores, what the pixel shows now.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DesignateRequest {
    /// Camera pair whose left image the pixel belongs to.
    pub pair: String,
    /// Column and row, px.
    pub pixel_px: [f64; 2],
}

/// A true place on the terrain.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TruePlace {
    /// The point, world frame, m.
    pub point_in_world_m: [f64; 3],
    /// Outward normal over the instrument's footprint, world frame.
    pub normal_in_world: [f64; 3],
    /// Index of the rock, or none for the ground.
    pub rock_n: Option<u32>,
    /// Distance from the rover frame's origin along the ground, m.
    pub range_m: f64,
}

/// Question to `sim/truth/pick`: a place that a person might choose.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PickRequest {
    /// Camera pair in which it shall be named.
    pub pair: String,
    /// What it shall lie on.
    pub surface: SurfaceKind,
    /// Nearest and farthest distance from the rover frame's origin along the ground, m.
    pub range_m: [f64; 2],
    /// Which of many such places.
    pub choice_n: u32,
}

/// Answer of `sim/truth/pick`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pick {
    /// The place.
    pub place: TruePlace,
    /// Pan and tilt that bring it to the middle of the mast's view as a person would, rad, if the
    /// robot has a mast.
    pub mast_rad: Option<[f64; 2]>,
    /// Where the pair's left camera sees it now, px, if it does.
    pub pixel_px: Option<[f64; 2]>,
}

/// Question to `sim/step`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StepRequest {
    /// Heartbeat periods to let pass.
    pub periods_n: u32,
}

impl Default for StepRequest {
    fn default() -> Self {
        Self { periods_n: 1 }
    }
}

/// A fault that the simulator can be told to show.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum InjectedFault {
    /// The fiducial's pattern vanishes (covered by dust) or comes back.
    FiducialHidden(bool),
    /// The rock with this index vanishes.
    RockVanishes(u32),
    /// The contact switch no longer closes.
    SwitchDead(bool),
}

wire! {
    ScoreRequest = "score_request/2",
    Score = "score/2",
    ViewRequest = "view_request/1",
    View = "view/1",
    TruthState = "truth_state/2",
    DesignateRequest = "designate_request/1",
    TruePlace = "true_place/1",
    Pick = "pick/1",
    InjectedFault = "injected_fault/1",
}

impl Wire for PickRequest {
    const SCHEMA: &'static str = "pick_request/1";
    fn validate(&self) -> Result<(), String> {
        in_range("range_m[0]", self.range_m[0], 0.0, 100.0)?;
        in_range("range_m[1]", self.range_m[1], self.range_m[0], 100.0)
    }
}

impl Wire for StepRequest {
    const SCHEMA: &'static str = "step_request/1";
    fn validate(&self) -> Result<(), String> {
        in_range("periods_n", f64::from(self.periods_n), 1.0, 100_000.0)
    }
}
