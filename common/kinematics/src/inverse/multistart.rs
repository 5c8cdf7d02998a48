//! Descents from many seeds, always the same ones: the nearest answer, or all that are found.

use super::{
    AxisGoal, Constraint, IkError, LimitViolation, NumericOptions, PoseGoal, closest_solution,
    solve_axis, solve_numeric, solve_pose, travel_time,
};
use crate::arm::{Arm, LIMIT_TOLERANCE_RAD};
use crate::tool::Tool;

/// Seeds that are tried for one answer.
const SEEDS_FOR_ONE: u32 = 24;
/// Seeds that are tried for all answers.
const SEEDS_FOR_ALL: u32 = 96;
/// Answers whose joints all differ by less are one and the same, radians.
const SAME_RAD: f64 = 1e-5;
/// The same for an arm with more joints than the goal has constraints, whose answers are a
/// continuum of which samples are returned, radians.
const SAME_SAMPLE_RAD: f64 = 0.5;
/// The real root of `x^8 = x + 1`, whose powers are the steps of the sequence in 7 dimensions.
const KRONECKER: f64 = 1.096_981_557_798_559_8;

/// Seed number `index`: a Kronecker sequence, the generalisation of the golden ratio, fills the box
/// of the limits evenly, beginning with its middle.
fn seed(arm: &Arm, index: u32) -> Vec<f64> {
    let joints = arm.limits().iter().zip(1_u32..);
    joints
        .map(|(l, joint)| {
            let step = KRONECKER.powi(-i32::try_from(joint).unwrap_or(1));
            let fraction = (0.5 + f64::from(index) * step).fract();
            l.lower_rad + fraction * (l.upper_rad - l.lower_rad)
        })
        .collect()
}

/// The failure that says most, of those from several seeds.
struct Failures {
    first: IkError,
    least_violation: Option<LimitViolation>,
    least_axis_rad: Option<f64>,
}

impl Failures {
    fn new(first: IkError) -> Self {
        let mut failures = Self {
            first: first.clone(),
            least_violation: None,
            least_axis_rad: None,
        };
        failures.add(first);
        failures
    }

    fn add(&mut self, error: IkError) {
        match error {
            IkError::JointLimit {
                joint,
                value_rad,
                lower_rad,
                upper_rad,
            } => {
                let violation = LimitViolation {
                    joint,
                    value_rad,
                    lower_rad,
                    upper_rad,
                };
                let least = self.least_violation;
                if least.is_none_or(|l| violation.excess_rad() < l.excess_rad()) {
                    self.least_violation = Some(violation);
                }
            }
            IkError::AxisInfeasible { by_rad } => {
                let least = self.least_axis_rad;
                self.least_axis_rad = Some(least.map_or(by_rad, |l| l.min(by_rad)));
            }
            _ => {}
        }
    }

    /// A posture that only the limits forbid says more than one that does not exist.
    fn speak(self) -> IkError {
        match (self.least_violation, self.least_axis_rad) {
            (Some(v), _) if v.excess_rad() > LIMIT_TOLERANCE_RAD => v.into(),
            (_, Some(by_rad)) => IkError::AxisInfeasible { by_rad },
            _ => self.first,
        }
    }
}

/// Whether no other seed will do better.
fn is_final(error: &IkError) -> bool {
    matches!(
        error,
        IkError::NotFinite
            | IkError::Arm(_)
            | IkError::OutOfReach {
                constraint: Constraint::TotalLength,
                ..
            }
    )
}

/// The answer from `near` if it leads to one, otherwise the nearest to it of those from further
/// seeds.
fn nearest(
    arm: &Arm,
    near: &[f64],
    solve: impl Fn(&[f64]) -> Result<Vec<f64>, IkError>,
) -> Result<Vec<f64>, IkError> {
    let mut failures = match solve(near) {
        Ok(q) => return Ok(q),
        Err(error) if is_final(&error) => return Err(error),
        Err(error) => Failures::new(error),
    };
    let mut best: Option<(f64, Vec<f64>)> = None;
    for index in 0..SEEDS_FOR_ONE {
        match solve(&seed(arm, index)) {
            Ok(q) => {
                let time = travel_time(arm, &q, near);
                if best.as_ref().is_none_or(|(t, _)| time < *t) {
                    best = Some((time, q));
                }
            }
            Err(error) => failures.add(error),
        }
    }
    best.map(|(_, q)| q).ok_or_else(|| failures.speak())
}

/// The different answers from all seeds, in the order in which they are found.
fn all(
    arm: &Arm,
    constraints: usize,
    solve: impl Fn(&[f64]) -> Result<Vec<f64>, IkError>,
) -> Result<Vec<Vec<f64>>, IkError> {
    let same_rad = if arm.joint_count() > constraints {
        SAME_SAMPLE_RAD
    } else {
        SAME_RAD
    };
    let mut found: Vec<Vec<f64>> = Vec::new();
    let mut failures: Option<Failures> = None;
    for index in 0..SEEDS_FOR_ALL {
        match solve(&seed(arm, index)) {
            Ok(q) => {
                let differs = |other: &Vec<f64>| {
                    let joints = other.iter().zip(&q);
                    joints.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max) >= same_rad
                };
                if found.iter().all(differs) {
                    found.push(q);
                }
            }
            Err(error) if is_final(&error) => return Err(error),
            Err(error) => match &mut failures {
                None => failures = Some(Failures::new(error)),
                Some(failures) => failures.add(error),
            },
        }
    }
    match failures {
        Some(failures) if found.is_empty() => Err(failures.speak()),
        _ => Ok(found),
    }
}

/// The numeric answer nearest to `near`.
pub(super) fn closest(
    arm: &Arm,
    tool: &Tool,
    goal: &AxisGoal,
    near: &[f64],
) -> Result<Vec<f64>, IkError> {
    let options = NumericOptions::default();
    nearest(arm, near, |from| {
        solve_numeric(arm, tool, goal, from, &options)
    })
}

/// The joint angles within the limits that put a frame of the last link on a pose: those that a
/// descent from `near` (radians) leads to, otherwise the nearest of those from fixed further seeds.
///
/// # Errors
/// As [`solve_pose`]; of the failures from all seeds the one that says most.
pub fn closest_pose(arm: &Arm, goal: &PoseGoal, near: &[f64]) -> Result<Vec<f64>, IkError> {
    let options = NumericOptions::default();
    nearest(arm, near, |from| solve_pose(arm, goal, from, &options))
}

/// All joint angles (radians) within the limits that meet `goal`. In closed form where the arm's
/// family has one, and then complete, in the order of [`super::Branch::ALL`]; otherwise what descents
/// from 96 fixed seeds find, in the order in which they find it. An arm of six or seven joints meets
/// such a goal in a continuum of postures: the answers are samples of it.
///
/// # Errors
/// As [`closest_solution`].
pub fn all_solutions(arm: &Arm, tool: &Tool, goal: &AxisGoal) -> Result<Vec<Vec<f64>>, IkError> {
    match solve_axis(arm, tool, goal) {
        Ok(branches) => {
            let within: Vec<_> = branches
                .into_iter()
                .filter(|b| b.within_limits)
                .map(|b| b.joints_rad)
                .collect();
            if within.is_empty() {
                // Looks at a free plane angle too, or names the joint that breaks its limit least.
                return closest_solution(arm, tool, goal, &seed(arm, 0)).map(|q| vec![q]);
            }
            Ok(within)
        }
        Err(IkError::NotThisFamily(_)) => {
            let options = NumericOptions::default();
            all(arm, 5, |from| {
                solve_numeric(arm, tool, goal, from, &options)
            })
        }
        Err(error) => Err(error),
    }
}

/// All joint angles (radians) within the limits that put a frame of the last link on a pose, as far
/// as descents from 96 fixed seeds find them; samples of the continuum for an arm of seven joints.
///
/// # Errors
/// As [`closest_pose`].
pub fn all_poses(arm: &Arm, goal: &PoseGoal) -> Result<Vec<Vec<f64>>, IkError> {
    let options = NumericOptions::default();
    all(arm, 6, |from| solve_pose(arm, goal, from, &options))
}
