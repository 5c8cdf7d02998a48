//! The arm's hardware contract: state, trajectory execution, stop.

use crate::{
    wire,
    wire::{Wire, finite, in_range},
};
use rover_kinematics::JointTrajectory;
use serde::{Deserialize, Serialize};

/// What the arm is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Motion {
    /// At rest, ready for a goal.
    Idle,
    /// Following a trajectory.
    Moving,
    /// Slowing down before the end of its trajectory.
    Stopping,
}

/// Why the last motion ended before its trajectory did.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StopReason {
    /// The contact switch closed.
    Contact,
    /// The tip force exceeded the goal's limit.
    Force {
        /// Measured force, N.
        found_n: f64,
        /// The goal's limit, N.
        limit_n: f64,
    },
    /// A joint left its trajectory by more than the goal's limit.
    Deviation {
        /// Joint index, from 0.
        joint_n: u32,
        /// Deviation, rad.
        found_rad: f64,
        /// The goal's limit, rad.
        limit_rad: f64,
    },
    /// The commander cancelled the goal.
    Cancelled,
    /// `arm/stop` was asked.
    StopCommand,
    /// The commander's presence ended or its heartbeat did not come in time.
    CommanderLost {
        /// Name of the commander.
        commander: String,
    },
}

impl std::fmt::Display for StopReason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Contact => f.write_str("the contact switch closed"),
            Self::Force { found_n, limit_n } => {
                write!(f, "tip force {found_n:.1} N, limit {limit_n} N")
            }
            Self::Deviation {
                joint_n,
                found_rad,
                limit_rad,
            } => write!(
                f,
                "joint {joint_n} is {found_rad:.4} rad off its trajectory, limit {limit_rad} rad"
            ),
            Self::Cancelled => f.write_str("the commander cancelled the goal"),
            Self::StopCommand => f.write_str("arm/stop was asked"),
            Self::CommanderLost { commander } => write!(f, "the commander `{commander}` is lost"),
        }
    }
}

/// The arm as its encoders and switch report it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ArmState {
    /// Simulated (or hardware) time, s.
    pub sim_time_s: f64,
    /// Control step since start.
    pub step: u64,
    /// Encoder angles, rad.
    pub joints_rad: Vec<f64>,
    /// Encoder rates, rad/s.
    pub rates_rad_s: Vec<f64>,
    /// Whether the contact switch is closed.
    pub contact: bool,
    /// Travel of the switch plunger, m, positive when pressed in.
    pub switch_travel_m: f64,
    /// Axial force on the plunger, N, as the instrument's load cell reports it.
    pub tip_force_n: f64,
    /// What the arm is doing.
    pub motion: Motion,
    /// Why the last motion ended early, if it did.
    pub stop_reason: Option<StopReason>,
}

/// Conditions under which the driver ends a motion early. The driver always stops when the switch
/// closes, unless the motion starts with the switch closed (a retract).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Guard {
    /// Stop when the axial tip force exceeds this, N.
    pub max_force_n: Option<f64>,
    /// Stop when a joint is off its trajectory by more than this, rad.
    pub max_deviation_rad: Option<f64>,
}

/// Goal of `arm/execute`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExecuteGoal {
    /// Must start at the present joint angles.
    pub trajectory: JointTrajectory,
    /// When to stop early.
    #[serde(default)]
    pub guard: Guard,
}

/// Feedback of `arm/execute`, one per heartbeat period.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExecuteFeedback {
    /// The arm at the end of the period.
    pub state: ArmState,
    /// Time since the start of the trajectory, s.
    pub elapsed_s: f64,
}

/// Result of `arm/execute`. A stop on contact or force is a result, not a failure; a stop for any
/// other reason fails the goal with a fault.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExecuteResult {
    /// The arm at rest after the motion.
    pub state: ArmState,
    /// Whether the trajectory was followed to its end.
    pub completed: bool,
    /// Largest axial tip force during the motion, N.
    pub peak_force_n: f64,
    /// Encoder angles in the control step in which the switch closed, rad, if it did.
    pub joints_at_contact_rad: Option<Vec<f64>>,
}

wire! {
    ArmState = "arm_state/1",
    ExecuteFeedback = "execute_feedback/1",
    ExecuteResult = "execute_result/1",
}

impl Wire for ExecuteGoal {
    const SCHEMA: &'static str = "execute_goal/1";
    fn validate(&self) -> Result<(), String> {
        for (field, value) in [
            ("guard.max_force_n", self.guard.max_force_n),
            ("guard.max_deviation_rad", self.guard.max_deviation_rad),
        ] {
            if let Some(value) = value {
                in_range(field, value, 0.0, 1e4)?;
            }
        }
        for (i, point) in self.trajectory.points.iter().enumerate() {
            finite(&format!("trajectory.points[{i}].q_rad"), &point.q_rad)?;
            finite(&format!("trajectory.points[{i}].qd_rad_s"), &point.qd_rad_s)?;
        }
        Ok(())
    }
}
