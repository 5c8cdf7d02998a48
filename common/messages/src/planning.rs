//! The arm planner's questions and answers.

use crate::{
    wire,
    wire::{Wire, finite, in_range},
};
use rover_geometry::{Direction, Point, Rover};
use rover_kinematics::JointTrajectory;
use serde::{Deserialize, Serialize};

/// A pose that a five-joint arm can be asked for: the instrument's tip and its approach axis.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ToolPose {
    /// Where the tip shall be, rover frame, m.
    pub tip_m: Point<Rover>,
    /// Where the instrument shall point, rover frame (into the surface).
    pub axis: Direction<Rover>,
}

/// Where the arm shall go.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PlanGoal {
    /// A posture named in the robot file.
    Posture(String),
    /// Joint angles, rad.
    Joints(Vec<f64>),
    /// A tool pose, reached by any collision-free joint motion. Among the arm's branches the one
    /// is taken that shows the fiducial best to `visible_to` (a camera pair), if that is given.
    Tool {
        /// The pose.
        pose: ToolPose,
        /// Camera pair that shall see the fiducial.
        visible_to: Option<String>,
    },
    /// A straight line of the tip through these poses, without a change of branch.
    Straight(Vec<ToolPose>),
}

/// Question to `planner/plan`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlanRequest {
    /// Joint angles to start from, rad; the present ones if not given.
    #[serde(default)]
    pub start_rad: Option<Vec<f64>>,
    /// Where to go.
    pub goal: PlanGoal,
    /// Fraction of the arm's rate and acceleration limits to use, above 0 up to 1.
    #[serde(default = "full_speed")]
    pub speed_fraction: f64,
    /// Limit on the tip's speed along a straight line, m/s.
    #[serde(default)]
    pub max_tip_speed_m_s: Option<f64>,
    /// Radius about the last pose's tip within which the instrument may touch the terrain, m: the
    /// contact motion ends inside the obstacle map by intent.
    #[serde(default)]
    pub contact_radius_m: f64,
}

fn full_speed() -> f64 {
    1.0
}

/// Answer of `planner/plan`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plan {
    /// The motion, within the arm's limits.
    pub trajectory: JointTrajectory,
    /// Joint angles at its end, rad.
    pub end_rad: Vec<f64>,
    /// Smallest distance to terrain, mount or the arm itself along the motion, m, as far as the
    /// planner's map knows; none if there was nothing to check against.
    pub clearance_m: Option<f64>,
}

/// Question to `planner/survey`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SurveyRequest {
    /// Camera pair to look with.
    pub pair: String,
}

/// Answer of `planner/survey`: what the obstacle map now holds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SurveyReport {
    /// Stereo points in the map.
    pub points_n: u32,
    /// Map cells with a height.
    pub cells_n: u32,
    /// Edge of a cell, m.
    pub cell_m: f64,
}

wire! {
    Plan = "plan/1",
    SurveyRequest = "survey_request/1",
    SurveyReport = "survey_report/1",
}

impl Wire for PlanRequest {
    const SCHEMA: &'static str = "plan_request/1";
    fn validate(&self) -> Result<(), String> {
        if let Some(start) = &self.start_rad {
            finite("start_rad", start)?;
        }
        if let PlanGoal::Joints(joints) = &self.goal {
            finite("goal.joints", joints)?;
        }
        if let PlanGoal::Straight(poses) = &self.goal
            && poses.is_empty()
        {
            return Err("goal.straight: no pose, expected at least one".into());
        }
        if let Some(speed) = self.max_tip_speed_m_s {
            in_range("max_tip_speed_m_s", speed, 1e-5, 10.0)?;
        }
        in_range("contact_radius_m", self.contact_radius_m, 0.0, 1.0)?;
        in_range("speed_fraction", self.speed_fraction, 1e-3, 1.0)
    }
}
