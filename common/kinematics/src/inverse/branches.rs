//! The closed form, branch by branch.

use super::closed_form::{Edge, PARALLEL, Preferred, Side, Solver};
use super::{AxisGoal, Branch, Elbow, IkError, Shoulder, Wrist, is_usable};
use crate::arm::Arm;
use crate::tool::Tool;
use crate::trig::sin_cos;
use nalgebra::Vector3;

/// Sine of the elbow, and cosine at the shoulder, below which two branches count as one.
const COINCIDENT: f64 = 1e-5;
/// The same before polishing: below it the true rows are asked.
const NEARLY_COINCIDENT: f64 = 1e-2;

impl Solver<'_> {
    /// Whether front and back coincide, given the polished angle of joint 0.
    #[inline]
    fn is_on_shoulder_edge(&self, side: &Side, w: &Vector3<f64>, theta1: f64) -> bool {
        let rho = w.x.hypot(w.y);
        let (s, c) = theta1.sin_cos();
        side.forward == 0.0 || (w.x * c + w.y * s).abs() < COINCIDENT * rho
    }

    fn run(&self, found: &mut impl FnMut(&[f64], Branch, bool)) -> Result<(), IkError> {
        let w = self.point - self.axis * self.turret.length;
        let mut least: Option<Edge> = None;
        let mut fails = |(constraint, by_m): Edge| {
            if least.is_none_or(|(_, other)| by_m < other) {
                least = Some((constraint, by_m));
            }
        };
        let mut any = false;
        for shoulder in [Shoulder::Front, Shoulder::Back] {
            let side = match self.side(shoulder, &w, self.margin) {
                Ok(side) => side,
                Err(edge) => {
                    fails(edge);
                    break;
                }
            };
            let on_axis = side.forward == 0.0;
            let is_near_edge = side.forward.abs() < NEARLY_COINCIDENT * w.xy().norm() || on_axis;
            let hand = self.hand(&side, &self.axis);
            let is_parallel = hand.sin_psi < PARALLEL;
            for wrist in [Wrist::Positive, Wrist::Negative] {
                let hand = match (is_parallel, wrist) {
                    (false, Wrist::Positive) => hand,
                    (false, Wrist::Negative) => hand.flipped(),
                    (true, Wrist::Negative) => break,
                    (true, Wrist::Positive) => match self.free_hand(&side, &hand) {
                        Ok(hand) => hand,
                        Err(edge) => {
                            fails(edge);
                            break;
                        }
                    },
                };
                let margin = self.plane_margin(&side, &hand);
                let plane = match self.plane(&side, &hand, margin, margin) {
                    Ok(plane) => plane,
                    Err(edge) => {
                        fails(edge);
                        continue;
                    }
                };
                for elbow in [Elbow::Positive, Elbow::Negative] {
                    let branch = Branch {
                        shoulder,
                        wrist,
                        elbow,
                    };
                    let posture = self.posture(&side, &hand, &plane, elbow);
                    let theta = match self.polish(&posture, branch) {
                        Ok(theta) => theta,
                        Err(by_m) => {
                            fails((posture.nearest_edge(), by_m));
                            continue;
                        }
                    };
                    let meets_front = is_near_edge && self.is_on_shoulder_edge(&side, &w, theta[0]);
                    let meets_elbow =
                        plane.sine < NEARLY_COINCIDENT && theta[2].sin().abs() < COINCIDENT;
                    any = true;
                    if !meets_front || on_axis || shoulder == Shoulder::Front {
                        let joints: [f64; 5] =
                            std::array::from_fn(|i| theta[i] - self.family.offsets[i]);
                        found(&joints, branch, meets_front || meets_elbow || is_parallel);
                    }
                    if meets_elbow {
                        break;
                    }
                }
            }
        }
        match (any, least) {
            (true, _) => Ok(()),
            (false, Some((constraint, by_m))) => Err(IkError::OutOfReach { constraint, by_m }),
            (false, None) => Err(IkError::NotFinite),
        }
    }
}

/// Calls `found` with joint angles, branch and singularity of every posture that meets `goal`.
pub(super) fn solve(
    arm: &Arm,
    tool: &Tool,
    goal: &AxisGoal,
    preferred: Option<Preferred<'_>>,
    mut found: impl FnMut(&[f64], Branch, bool),
) -> Result<(), IkError> {
    if !is_usable(tool, goal) {
        return Err(IkError::NotFinite);
    }
    Solver::new(arm, tool, goal, preferred)?.run(&mut found)
}

/// The branch of given joint angles.
pub(super) fn branch_of(arm: &Arm, tool: &Tool, q: &[f64]) -> Result<Branch, IkError> {
    let theta = arm.angles(q)?;
    let goal = AxisGoal::at(arm, tool, q)?;
    let solver = Solver::new(arm, tool, &goal, None)?;
    let (f, turret) = (solver.family, solver.turret);
    let w = goal.point - goal.axis.into_inner() * turret.length;
    let ([s1, sin_psi, sin_elbow, _], [c1, ..]) = sin_cos(
        &[theta[0], theta[4] + turret.ahead, f.bend * theta[2], 0.0],
        3,
    );
    let pick = |value: f64| value >= 0.0;
    Ok(Branch {
        shoulder: if pick(w.x * c1 + w.y * s1) {
            Shoulder::Front
        } else {
            Shoulder::Back
        },
        wrist: if pick(sin_psi) {
            Wrist::Positive
        } else {
            Wrist::Negative
        },
        elbow: if pick(sin_elbow * f.upper * f.fore) {
            Elbow::Positive
        } else {
            Elbow::Negative
        },
    })
}
