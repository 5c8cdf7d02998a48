//! Inverse kinematics: joint angles that put the tool point on a point and point the tool's axis.
//!
//! The goal is five constraints, three of position and two of direction; the turn about the
//! approach axis is free. A five-joint arm has finitely many answers, and for the family of the
//! Mars Exploration Rover arm they are found in closed form ([`solve_axis`]); any other arm of
//! 4 to 7 joints is solved by damped least squares ([`solve_numeric`]). Whatever fails says which
//! constraint fails, and by how much.

mod branches;
mod closed_form;
pub(crate) mod family;
mod multistart;
mod numeric;
mod polish;

use crate::arm::{Arm, LIMIT_TOLERANCE_RAD, MAX_JOINTS};
use crate::rows::{ArmError, JointLimits, NO_RATE_LIMIT_RAD_S};
use crate::tool::Tool;
pub use family::FamilyMismatch;
pub use multistart::{all_poses, all_solutions, closest_pose};
use nalgebra::{Unit, Vector3};
pub use numeric::{NumericOptions, PoseGoal, solve_numeric, solve_pose};
use std::f64::consts::{PI, TAU};
use std::fmt;

/// Where the tool point shall be and where the tool shall point, arm base frame.
#[derive(Clone, Debug, PartialEq)]
pub struct AxisGoal {
    /// Position of the tool point, metres.
    pub point: Vector3<f64>,
    /// Direction of the approach axis, unit.
    pub axis: Unit<Vector3<f64>>,
}

/// Whether the arm reaches to the side that the first joint faces, or over its own base.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Shoulder {
    /// The wrist is on the side that joint 0 faces.
    Front,
    /// The wrist is behind it.
    Back,
}

/// Sign of the sine of the last joint's angle, measured from the place where the tool's axis is
/// parallel to the arm's bending axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Wrist {
    /// The sine is positive.
    Positive,
    /// The sine is negative: the wrist is flipped.
    Negative,
}

/// Sign of the sine of the elbow's angle (joint 2).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Elbow {
    /// The sine is positive.
    Positive,
    /// The sine is negative.
    Negative,
}

/// One of the eight postures in which a five-joint arm of the family can reach the same goal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Branch {
    /// Front or back.
    pub shoulder: Shoulder,
    /// Wrist as it is, or flipped.
    pub wrist: Wrist,
    /// Elbow to one side or the other.
    pub elbow: Elbow,
}

/// A joint angle outside its limits.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LimitViolation {
    /// Joint, from 0.
    pub joint: usize,
    /// The angle the solution needs, radians.
    pub value_rad: f64,
    /// Lower limit, radians.
    pub lower_rad: f64,
    /// Upper limit, radians.
    pub upper_rad: f64,
}

/// One answer of [`solve_axis`].
#[derive(Clone, Debug, PartialEq)]
pub struct IkSolution {
    /// Joint angles, radians, from the base outwards.
    pub joints_rad: Vec<f64>,
    /// The posture.
    pub branch: Branch,
    /// Whether every joint is within its limits.
    pub within_limits: bool,
    /// The joint that is furthest outside its limits, if any.
    pub limit_violation: Option<LimitViolation>,
    /// Whether the arm loses a degree of freedom here: the axis is parallel to the bending axis
    /// (the plane angle is then free and was chosen), the elbow is straight or fully folded, or
    /// the wrist is on the shoulder's limit. Of coinciding branches only the first is returned.
    pub singular: bool,
}

/// The geometric condition that a goal breaks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Constraint {
    /// The goal is nearer to the first joint's axis than the arm's sideways offset.
    ShoulderOffset,
    /// The wrist would have to be further from the shoulder than upper arm plus forearm.
    ArmExtended,
    /// The wrist would have to be nearer to the shoulder than upper arm minus forearm.
    ArmFolded,
    /// The point is further from the base than all links together are long.
    TotalLength,
}

impl fmt::Display for Constraint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::ShoulderOffset => "the sideways offset of the arm keeps it off the first axis",
            Self::ArmExtended => "upper arm and forearm stretched out are too short",
            Self::ArmFolded => "upper arm and forearm folded still reach too far",
            Self::TotalLength => "all links together are too short",
        })
    }
}

/// Why there are no joint angles for a goal. Joint indices count from 0.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum IkError {
    /// No posture reaches; the least broken condition is given.
    #[error("the goal is out of reach: {constraint}, by {:.3} mm", by_m * 1e3)]
    OutOfReach {
        /// The condition broken.
        constraint: Constraint,
        /// By how much, metres.
        by_m: f64,
    },
    /// The point is reached, but the axis cannot be turned as asked.
    #[error("the point is reachable but the approach axis (for a pose: the orientation) misses by {:.3} deg", by_rad.to_degrees())]
    AxisInfeasible {
        /// Smallest angle found between the wanted and a possible axis, radians.
        by_rad: f64,
    },
    /// Every posture that reaches breaks a joint limit; the one that breaks it least is given.
    #[error(
        "joint[{joint}] would have to go to {value_rad:.6} rad, outside {lower_rad:.6} to \
         {upper_rad:.6} rad, in the posture that comes closest to the limits"
    )]
    JointLimit {
        /// The joint.
        joint: usize,
        /// The angle needed, radians.
        value_rad: f64,
        /// Its lower limit, radians.
        lower_rad: f64,
        /// Its upper limit, radians.
        upper_rad: f64,
    },
    /// The arm or the tool is not of the family that has the closed form.
    #[error("no closed form for this arm and tool: {0}")]
    NotThisFamily(FamilyMismatch),
    /// The numeric solver stopped short of the goal.
    #[error(
        "no joint angles found: after {iterations} iterations the tool point is {:.6} mm and the \
         direction {:.6} deg from the goal", position_error_m * 1e3, axis_error_rad.to_degrees()
    )]
    NoConvergence {
        /// Distance of the tool point from the goal, metres.
        position_error_m: f64,
        /// Angle between the axes, radians.
        axis_error_rad: f64,
        /// Iterations spent.
        iterations: usize,
    },
    /// A number of the goal, the tool or the seed is NaN or infinite, or an axis is not unit.
    #[error("the goal, the tool or the seed has a value that is not finite, or a non-unit axis")]
    NotFinite,
    /// The joint angles given do not fit the arm.
    #[error(transparent)]
    Arm(#[from] ArmError),
}

impl AxisGoal {
    /// The goal that the tool meets at joint angles `q` (radians).
    ///
    /// # Errors
    /// As [`Arm::forward`].
    pub fn at(arm: &Arm, tool: &Tool, q: &[f64]) -> Result<Self, ArmError> {
        let (point, axis) = tool.at(arm, q)?;
        Ok(Self { point, axis })
    }

    /// Distance (metres) of the tool point and angle (radians, `0..=pi`) of the tool's axis from
    /// this goal at joint angles `q` (radians).
    ///
    /// # Errors
    /// As [`Arm::forward`].
    pub fn miss(&self, arm: &Arm, tool: &Tool, q: &[f64]) -> Result<(f64, f64), ArmError> {
        let (point, axis) = tool.at(arm, q)?;
        let angle = axis.cross(&self.axis).norm().atan2(axis.dot(&self.axis));
        Ok(((self.point - point).norm(), angle))
    }
}

impl Branch {
    /// The eight branches in the order in which [`solve_axis`] answers.
    pub const ALL: [Self; 8] = {
        use {Elbow as E, Shoulder as S, Wrist as W};
        [
            Self {
                shoulder: S::Front,
                wrist: W::Positive,
                elbow: E::Positive,
            },
            Self {
                shoulder: S::Front,
                wrist: W::Positive,
                elbow: E::Negative,
            },
            Self {
                shoulder: S::Front,
                wrist: W::Negative,
                elbow: E::Positive,
            },
            Self {
                shoulder: S::Front,
                wrist: W::Negative,
                elbow: E::Negative,
            },
            Self {
                shoulder: S::Back,
                wrist: W::Positive,
                elbow: E::Positive,
            },
            Self {
                shoulder: S::Back,
                wrist: W::Positive,
                elbow: E::Negative,
            },
            Self {
                shoulder: S::Back,
                wrist: W::Negative,
                elbow: E::Positive,
            },
            Self {
                shoulder: S::Back,
                wrist: W::Negative,
                elbow: E::Negative,
            },
        ]
    };

    /// The posture that an arm of the closed-form family has at joint angles `q` (radians).
    ///
    /// # Errors
    /// [`IkError::NotThisFamily`] for another arm or tool, [`IkError::Arm`] for angles that do
    /// not fit the arm.
    pub fn of(arm: &Arm, tool: &Tool, q: &[f64]) -> Result<Self, IkError> {
        branches::branch_of(arm, tool, q)
    }
}

fn is_usable(tool: &Tool, goal: &AxisGoal) -> bool {
    let unit = |axis: &Unit<Vector3<f64>>| (axis.norm_squared() - 1.0).abs() < 1e-9;
    // A norm is finite only if every component is.
    goal.point.norm_squared().is_finite()
        && tool.tip_in_link.norm_squared().is_finite()
        && unit(&goal.axis)
        && unit(&tool.axis_in_link)
}

/// `angle` shifted by whole turns to where it suits the limits best: within them and nearest to
/// `preferred` if some shift is, otherwise the shift that exceeds them least.
fn into_limits(angle: f64, lower: f64, upper: f64, preferred: f64) -> f64 {
    // Seldom is there a turn to make, and rounding costs more than a comparison.
    let near = if (preferred - angle).abs() <= PI {
        angle
    } else {
        angle + TAU * ((preferred - angle) / TAU).round()
    };
    let (low, high) = (lower - LIMIT_TOLERANCE_RAD, upper + LIMIT_TOLERANCE_RAD);
    if near >= low && near <= high {
        return near;
    }
    let first = angle + TAU * ((low - angle) / TAU).ceil();
    let last = angle + TAU * ((high - angle) / TAU).floor();
    if first > last {
        // No shift is within: `last` lies below the range and `first` above it.
        return if lower - last < first - upper {
            last
        } else {
            first
        };
    }
    if near < low { first } else { last }
}

/// Brings every angle into its limits where whole turns can, nearest to `preferred` or, without
/// it, to the middle of the limits; tells the worst violation that remains.
fn normalise(arm: &Arm, q: &mut [f64], preferred: Option<&[f64]>) -> Option<LimitViolation> {
    let mut worst: Option<(f64, LimitViolation)> = None;
    for (joint, (value, l)) in q.iter_mut().zip(arm.limits()).enumerate() {
        let middle = 0.5 * (l.lower_rad + l.upper_rad);
        let wanted = preferred.map_or(middle, |p| p[joint]);
        *value = into_limits(*value, l.lower_rad, l.upper_rad, wanted);
        let excess = (l.lower_rad - *value).max(*value - l.upper_rad);
        if excess > LIMIT_TOLERANCE_RAD && worst.is_none_or(|(w, _)| excess > w) {
            let violation = LimitViolation {
                joint,
                value_rad: *value,
                lower_rad: l.lower_rad,
                upper_rad: l.upper_rad,
            };
            worst = Some((excess, violation));
        }
    }
    worst.map(|(_, violation)| violation)
}

impl LimitViolation {
    fn excess_rad(&self) -> f64 {
        (self.lower_rad - self.value_rad).max(self.value_rad - self.upper_rad)
    }
}

impl From<LimitViolation> for IkError {
    fn from(v: LimitViolation) -> Self {
        Self::JointLimit {
            joint: v.joint,
            value_rad: v.value_rad,
            lower_rad: v.lower_rad,
            upper_rad: v.upper_rad,
        }
    }
}

/// All postures that meet `goal`, in the order of [`Branch::ALL`], exact to rounding (the closed
/// form is polished on the true rows, so that a twist of 1.570796 instead of pi/2 costs nothing).
///
/// Angles are shifted by whole turns into the joint limits where that is possible, nearest to
/// the middle of the limits. Solutions outside the limits are returned and flagged. Where the
/// goal's axis is parallel to the bending axis the plane angle (joints 1 + 2 + 3) is free; the
/// answer then is the one whose elbow is nearest to a right angle, flagged singular, and its axis
/// is within 1e-6 rad.
///
/// # Errors
/// [`IkError::NotThisFamily`] for an arm or tool without the closed form,
/// [`IkError::OutOfReach`] when no posture reaches, [`IkError::NotFinite`] for unusable numbers.
pub fn solve_axis(arm: &Arm, tool: &Tool, goal: &AxisGoal) -> Result<Vec<IkSolution>, IkError> {
    let mut solutions = Vec::with_capacity(8);
    branches::solve(arm, tool, goal, None, |joints, branch, singular| {
        let mut joints_rad = joints.to_vec();
        let limit_violation = normalise(arm, &mut joints_rad, None);
        let within_limits = limit_violation.is_none();
        solutions.push(IkSolution {
            joints_rad,
            branch,
            within_limits,
            limit_violation,
            singular,
        });
    })?;
    Ok(solutions)
}

/// Seconds that the slowest joint needs from `a` to `b` at its full rate: the distance by which
/// [`closest_solution`] chooses.
fn travel_time(arm: &Arm, a: &[f64], b: &[f64]) -> f64 {
    let rates = arm.limits().iter().map(|l| l.max_rate_rad_s);
    let slowest = rates.fold(NO_RATE_LIMIT_RAD_S, f64::min);
    let rate = |l: &JointLimits| {
        if l.max_rate_rad_s < NO_RATE_LIMIT_RAD_S {
            l.max_rate_rad_s
        } else {
            slowest
        }
    };
    let times = a
        .iter()
        .zip(b)
        .zip(arm.limits())
        .map(|((a, b), l)| (a - b).abs() / rate(l));
    times.fold(0.0, f64::max)
}

/// The joint angles within the limits that meet `goal` and are nearest to `near` (radians): the
/// largest joint travel, each joint's weighted by its full rate, is smallest. Closed form where
/// the arm's family has one (a free plane angle stays that of `near`, or as near to it as reach
/// and limits allow), otherwise numeric, seeded from `near` and then from fixed further seeds.
///
/// # Errors
/// [`IkError::JointLimit`] when every posture that reaches breaks a limit, and whatever
/// [`solve_axis`] or [`solve_numeric`] say.
pub fn closest_solution(
    arm: &Arm,
    tool: &Tool,
    goal: &AxisGoal,
    near: &[f64],
) -> Result<Vec<f64>, IkError> {
    arm.angles(near)?;
    match closest_closed_form(arm, tool, goal, near) {
        Err(IkError::NotThisFamily(_)) => multistart::closest(arm, tool, goal, near),
        answer => answer,
    }
}

fn closest_closed_form(
    arm: &Arm,
    tool: &Tool,
    goal: &AxisGoal,
    near: &[f64],
) -> Result<Vec<f64>, IkError> {
    const STEP_RAD: f64 = TAU / 72.0;
    let mut best: Option<(f64, [f64; MAX_JOINTS])> = None;
    let mut least: Option<LimitViolation> = None;
    let n = near.len();
    // One pass is enough unless the plane angle is free and its first choice breaks a limit.
    for attempt in 0..72_u32 {
        let side = if attempt % 2 == 0 { 1.0 } else { -1.0 };
        let turn = side * f64::from(attempt.div_ceil(2)) * STEP_RAD;
        let mut is_free = false;
        let preferred = closed_form::Preferred {
            near,
            turn_rad: turn,
        };
        branches::solve(arm, tool, goal, Some(preferred), |joints, _, singular| {
            is_free |= singular;
            let mut q = [0.0; MAX_JOINTS];
            q[..n].copy_from_slice(joints);
            match normalise(arm, &mut q[..n], Some(near)) {
                None => {
                    let time = travel_time(arm, &q[..n], near);
                    if best.is_none_or(|(t, _)| time < t) {
                        best = Some((time, q));
                    }
                }
                Some(violation) => {
                    if least.is_none_or(|l| violation.excess_rad() < l.excess_rad()) {
                        least = Some(violation);
                    }
                }
            }
        })?;
        if best.is_some() || !is_free {
            break;
        }
    }
    match (best, least) {
        (Some((_, q)), _) => Ok(q[..n].to_vec()),
        (None, Some(violation)) => Err(violation.into()),
        (None, None) => Err(IkError::NotFinite),
    }
}

#[cfg(test)]
mod tests;
