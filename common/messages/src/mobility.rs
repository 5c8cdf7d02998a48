//! The hardware contract of a mobile robot: the mast's pan and tilt, the wheels, odometry and
//! attitude.
//!
//! Both actions are lockstep: simulated time passes only in the heartbeat periods that the
//! commander grants, and a commander that is lost stops mast or wheels in the very control step
//! that it last granted, as with the arm.

use crate::{
    wire,
    wire::{Wire, finite, in_range},
};
use nalgebra::{Isometry3, UnitQuaternion};
use rover_geometry::{Point, Rover, Site, Transform};
use serde::{Deserialize, Serialize};

/// The mast as its encoders report it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MastState {
    /// Simulated (or hardware) time, s.
    pub sim_time_s: f64,
    /// Control step since start.
    pub step: u64,
    /// Encoder angle of the pan joint, rad, positive to the left.
    pub pan_rad: f64,
    /// Encoder angle of the tilt joint, rad, positive downwards.
    pub tilt_rad: f64,
    /// Whether it moves.
    pub moving: bool,
}

/// Goal of `mast/point`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PointGoal {
    /// Pan, rad, positive to the left.
    pub pan_rad: f64,
    /// Tilt, rad, positive downwards.
    pub tilt_rad: f64,
}

/// Feedback of `mast/point`, one per heartbeat period.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PointFeedback {
    /// The mast at the end of the period.
    pub state: MastState,
}

/// Result of `mast/point`: the mast is at rest; its encoder angles differ from the goal's by the
/// drives' resolution.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PointResult {
    /// The mast at rest.
    pub state: MastState,
}

/// A pose of the rover in the site frame: rotation `Rz(heading) Ry(pitch) Rx(roll)`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SitePose {
    /// Origin of the rover frame, site frame, m.
    pub position_m: Point<Site>,
    /// Roll, rad, positive when the right side is down.
    pub roll_rad: f64,
    /// Pitch, rad, positive when the nose is down.
    pub pitch_rad: f64,
    /// Heading, rad, from the site's x towards its y.
    pub heading_rad: f64,
}

impl SitePose {
    /// The pose as a transform.
    pub fn site_from_rover(&self) -> Transform<Site, Rover> {
        let turn =
            UnitQuaternion::from_euler_angles(self.roll_rad, self.pitch_rad, self.heading_rad);
        Isometry3::from_parts(self.position_m.coords.into(), turn).into()
    }

    /// The pose of a transform.
    pub fn from_transform(site_from_rover: &Transform<Site, Rover>) -> Self {
        let pose = site_from_rover.isometry;
        let (roll_rad, pitch_rad, heading_rad) = pose.rotation.euler_angles();
        Self {
            position_m: pose.translation.vector.into(),
            roll_rad,
            pitch_rad,
            heading_rad,
        }
    }
}

/// What the wheels are doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Driving {
    /// At rest, ready for a goal.
    Idle,
    /// Turning the steered wheels.
    Steering,
    /// Under way.
    Driving,
    /// Slowing down, or waiting for rest.
    Stopping,
}

/// Odometry and attitude as the rover's own sensors report them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WheelsState {
    /// Simulated (or hardware) time, s.
    pub sim_time_s: f64,
    /// Control step since start.
    pub step: u64,
    /// Pose of the rover: roll and pitch from the attitude sensor, position and heading from the
    /// wheels, with the slip that the rover estimates taken off.
    pub pose: SitePose,
    /// Covariance of (along, across, heading) in the rover's present axes, grown over the whole
    /// drive, m^2, m rad and rad^2.
    pub covariance: [[f64; 3]; 3],
    /// Standard deviation of roll and of pitch, rad.
    pub tilt_sigma_rad: f64,
    /// Distance driven so far, m.
    pub driven_m: f64,
    /// Slip estimated from the wheels' torques over the last 0.2 m, fraction of the wheels' way
    /// that the rover did not make.
    pub slip: f64,
    /// Angles of the two rockers and the two bogies from their rest on level ground (left rocker,
    /// right rocker, left bogie, right bogie), rad.
    pub suspension_rad: [f64; 4],
    /// What the wheels are doing.
    pub driving: Driving,
}

/// One movement of the rover.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DriveArc {
    /// An arc of the rover frame's origin.
    Arc {
        /// Length, m; negative is backwards.
        length_m: f64,
        /// Curvature, 1/m; positive turns left when driving forwards, 0 is straight.
        curvature_1_m: f64,
    },
    /// A turn about the rover frame's origin.
    Turn {
        /// Angle, rad; positive to the left.
        angle_rad: f64,
    },
}

/// Conditions under which the wheels stop early; a condition that is absent is the robot file's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DriveGuard {
    /// Largest estimated slip.
    pub max_slip: Option<f64>,
    /// Largest tilt of the body against gravity, rad.
    pub max_tilt_rad: Option<f64>,
}

/// Goal of `wheels/drive`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DriveGoal {
    /// Where to.
    pub arc: DriveArc,
    /// Fraction of the robot's speed, above 0 up to 1.
    #[serde(default = "full_speed")]
    pub speed_fraction: f64,
    /// When to stop early.
    #[serde(default)]
    pub guard: DriveGuard,
}

fn full_speed() -> f64 {
    1.0
}

/// Why a drive ended early.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DriveStop {
    /// The estimated slip exceeded its limit.
    Slip {
        /// Estimated slip.
        found: f64,
        /// The limit.
        limit: f64,
    },
    /// The body tilted too far.
    Tilt {
        /// Measured tilt against gravity, rad.
        found_rad: f64,
        /// The limit, rad.
        limit_rad: f64,
    },
    /// A wheel stalled at its largest torque.
    Stalled {
        /// Wheel: front left, front right, middle left, middle right, rear left, rear right.
        wheel_n: u32,
    },
    /// The commander cancelled the goal.
    Cancelled,
    /// `wheels/stop` was asked.
    StopCommand,
    /// The commander's presence ended or its heartbeat did not come in time.
    CommanderLost {
        /// Name of the commander.
        commander: String,
    },
}

impl std::fmt::Display for DriveStop {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Slip { found, limit } => write!(f, "slip {found:.2}, limit {limit:.2}"),
            Self::Tilt {
                found_rad,
                limit_rad,
            } => write!(
                f,
                "tilt {:.1} deg, limit {:.1} deg",
                found_rad.to_degrees(),
                limit_rad.to_degrees()
            ),
            Self::Stalled { wheel_n } => write!(f, "wheel {wheel_n} stalled"),
            Self::Cancelled => f.write_str("the commander cancelled the goal"),
            Self::StopCommand => f.write_str("wheels/stop was asked"),
            Self::CommanderLost { commander } => write!(f, "the commander `{commander}` is lost"),
        }
    }
}

/// Feedback of `wheels/drive`, one per heartbeat period.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DriveFeedback {
    /// The rover at the end of the period.
    pub state: WheelsState,
    /// Part of the way done, 0 to 1.
    pub progress: f64,
}

/// Result of `wheels/drive`: the rover stands. A stop on slip, tilt or stall is a result, not a
/// failure; a stop for any other reason fails the goal with a fault.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DriveResult {
    /// Odometry at the start of the drive.
    pub before: SitePose,
    /// The rover after the drive.
    pub state: WheelsState,
    /// Covariance of (along, across, heading) of this drive alone, in the axes of `before`, m^2,
    /// m rad and rad^2.
    pub covariance: [[f64; 3]; 3],
    /// Whether the whole way was driven.
    pub completed: bool,
    /// Why not, if not.
    pub stop_reason: Option<DriveStop>,
}

impl DriveResult {
    /// The odometry increment: takes coordinates in the rover frame after the drive to the rover
    /// frame before it.
    pub fn before_from_after(&self) -> Transform<Rover, Rover> {
        self.before.site_from_rover().inverse() * self.state.pose.site_from_rover()
    }
}

fn checked(result: Result<(), String>, field: &str) -> Result<(), String> {
    result.map_err(|e| format!("{field}.{e}"))
}

fn symmetric(field: &str, m: &[[f64; 3]; 3]) -> Result<(), String> {
    for (i, row) in m.iter().enumerate() {
        finite(&format!("{field}[{i}]"), row)?;
        in_range(&format!("{field}[{i}][{i}]"), row[i], 0.0, 1e6)?;
    }
    Ok(())
}

impl SitePose {
    fn check(&self) -> Result<(), String> {
        finite("angles", &[self.roll_rad, self.pitch_rad, self.heading_rad])
    }
}

wire! {
    PointFeedback = "point_feedback/1",
    PointResult = "point_result/1",
    DriveFeedback = "drive_feedback/1",
}

impl Wire for MastState {
    const SCHEMA: &'static str = "mast_state/1";
    fn validate(&self) -> Result<(), String> {
        finite("angles", &[self.pan_rad, self.tilt_rad, self.sim_time_s])
    }
}

impl Wire for PointGoal {
    const SCHEMA: &'static str = "point_goal/1";
    fn validate(&self) -> Result<(), String> {
        in_range("pan_rad", self.pan_rad, -7.0, 7.0)?;
        in_range("tilt_rad", self.tilt_rad, -2.0, 2.0)
    }
}

impl Wire for WheelsState {
    const SCHEMA: &'static str = "wheels_state/1";
    fn validate(&self) -> Result<(), String> {
        checked(self.pose.check(), "pose")?;
        symmetric("covariance", &self.covariance)?;
        finite("slip", &[self.slip, self.driven_m, self.sim_time_s])?;
        in_range("tilt_sigma_rad", self.tilt_sigma_rad, 0.0, 1.0)
    }
}

impl Wire for DriveGoal {
    const SCHEMA: &'static str = "drive_goal/1";
    fn validate(&self) -> Result<(), String> {
        match self.arc {
            DriveArc::Arc {
                length_m,
                curvature_1_m,
            } => {
                in_range("arc.length_m", length_m, -20.0, 20.0)?;
                in_range("arc.curvature_1_m", curvature_1_m, -2.0, 2.0)?;
            }
            DriveArc::Turn { angle_rad } => in_range("arc.angle_rad", angle_rad, -6.3, 6.3)?,
        }
        in_range("speed_fraction", self.speed_fraction, 0.05, 1.0)?;
        if let Some(slip) = self.guard.max_slip {
            in_range("guard.max_slip", slip, 0.0, 1.0)?;
        }
        if let Some(tilt) = self.guard.max_tilt_rad {
            in_range("guard.max_tilt_rad", tilt, 0.0, 1.5)?;
        }
        Ok(())
    }
}

impl Wire for DriveResult {
    const SCHEMA: &'static str = "drive_result/1";
    fn validate(&self) -> Result<(), String> {
        checked(self.before.check(), "before")?;
        checked(self.state.validate(), "state")?;
        symmetric("covariance", &self.covariance)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    #[test]
    fn a_site_pose_and_its_transform_are_the_same() {
        let pose = SitePose {
            position_m: Point::new(1.0, -2.0, 0.1),
            roll_rad: 0.1,
            pitch_rad: -0.2,
            heading_rad: 2.5,
        };
        let back = SitePose::from_transform(&pose.site_from_rover());
        assert!((back.heading_rad - 2.5).abs() < 1e-12 && (back.pitch_rad + 0.2).abs() < 1e-12);
        // Nose down: a point ahead of the rover is below its origin.
        let nose_down = SitePose {
            pitch_rad: 0.2,
            ..pose
        };
        let ahead = nose_down.site_from_rover() * Point::<Rover>::new(1.0, 0.0, 0.0);
        assert!(ahead.coords.z < 0.1);
    }

    #[test]
    fn a_goal_out_of_range_names_its_field() {
        let goal = DriveGoal {
            arc: DriveArc::Arc {
                length_m: 1.0,
                curvature_1_m: 9.0,
            },
            speed_fraction: 1.0,
            guard: DriveGuard::default(),
        };
        let message = goal.validate().unwrap_err();
        assert_eq!(message, "arc.curvature_1_m: 9, expected -2 to 2");
    }
}
