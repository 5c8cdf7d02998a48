//! Damped least squares for any arm.
//!
//! Five task rows: the three of the tool point (metres) and the two of the rotation that turns
//! the tool's axis onto the goal's (radians), measured in the plane square to the tool's axis.
//! Step `dq = J^T (J J^T + lambda I)^-1 e` with Levenberg's damping: smaller after a step that
//! helps, larger after one that does not. Joints that a step would push through a limit are held
//! there and the step is computed again without them.

use super::{AxisGoal, Constraint, IkError, LimitViolation, is_usable, normalise, travel_time};
use crate::arm::{Arm, Frames, LIMIT_TOLERANCE_RAD, MAX_JOINTS};
use crate::tool::Tool;
use nalgebra::{SMatrix, SVector, Vector3};
use rover_geometry::tangent_basis;

/// How [`solve_numeric`] works.
#[derive(Clone, Debug, PartialEq)]
pub struct NumericOptions {
    /// Most iterations of one descent.
    pub max_iterations: usize,
    /// Distance of the tool point at which the goal counts as met, metres.
    pub position_tolerance_m: f64,
    /// Angle of the axis at which the goal counts as met, radians.
    pub axis_tolerance_rad: f64,
    /// Largest change of a joint in one iteration, radians.
    pub max_step_rad: f64,
    /// Whether joints are kept within their limits.
    pub respect_limits: bool,
}

impl Default for NumericOptions {
    fn default() -> Self {
        Self {
            max_iterations: 200,
            position_tolerance_m: 1e-10,
            axis_tolerance_rad: 1e-10,
            max_step_rad: 0.5,
            respect_limits: true,
        }
    }
}

/// Where a descent ended.
struct End {
    q: [f64; MAX_JOINTS],
    position_error_m: f64,
    axis_error_rad: f64,
    iterations: usize,
}

type Jacobian = SMatrix<f64, 5, MAX_JOINTS>;

struct State {
    error: SVector<f64, 5>,
    jacobian: Jacobian,
    position_error_m: f64,
    axis_error_rad: f64,
}

struct Descent<'a> {
    arm: &'a Arm,
    tool: &'a Tool,
    goal: &'a AxisGoal,
    /// Weight of a metre against a radian.
    position_weight: f64,
    options: &'a NumericOptions,
}

/// The shortest rotation vector from unit `from` to unit `to`; any of them for opposite ones.
fn turn_between(from: &Vector3<f64>, to: &Vector3<f64>, fallback: &Vector3<f64>) -> Vector3<f64> {
    let cross = from.cross(to);
    let sine = cross.norm();
    let angle = sine.atan2(from.dot(to));
    if sine > 1e-9 {
        cross * (angle / sine)
    } else if angle < 1.0 {
        cross
    } else {
        fallback * angle
    }
}

impl Descent<'_> {
    fn state(&self, q: &[f64]) -> Option<State> {
        let frames: Frames = self.arm.frames(q).ok()?;
        let n = frames.count;
        let axis = frames.rotate(&self.tool.axis_in_link);
        let tip = frames.origin[n] + frames.rotate(&self.tool.tip_in_link);
        let (first, second) = tangent_basis(&nalgebra::Unit::new_normalize(axis));
        let miss = self.goal.point - tip;
        let turn = turn_between(&axis, &self.goal.axis, &first);
        let k = self.position_weight;
        let error = SVector::<f64, 5>::new(
            k * miss.x,
            k * miss.y,
            k * miss.z,
            turn.dot(&first),
            turn.dot(&second),
        );
        let mut jacobian = Jacobian::zeros();
        for joint in 0..n {
            let z = &frames.z[joint];
            let linear = z.cross(&(tip - frames.origin[joint])) * k;
            let column =
                SVector::<f64, 5>::new(linear.x, linear.y, linear.z, z.dot(&first), z.dot(&second));
            jacobian.set_column(joint, &column);
        }
        let (position_error_m, axis_error_rad) = (miss.norm(), turn.norm());
        Some(State {
            error,
            jacobian,
            position_error_m,
            axis_error_rad,
        })
    }

    fn is_met(&self, state: &State) -> bool {
        state.position_error_m <= self.options.position_tolerance_m
            && state.axis_error_rad <= self.options.axis_tolerance_rad
    }

    /// The damped step from `q`; joints at a limit that it would break are held.
    fn step(&self, q: &[f64], state: &State, damping: f64) -> SVector<f64, MAX_JOINTS> {
        let mut jacobian = state.jacobian;
        let mut step = SVector::zeros();
        for _ in 0..=q.len() {
            let mut normal = jacobian * jacobian.transpose();
            for i in 0..5 {
                normal[(i, i)] += damping;
            }
            let Some(factor) = normal.cholesky() else {
                return SVector::zeros();
            };
            step = jacobian.tr_mul(&factor.solve(&state.error));
            let largest = step.amax();
            if largest > self.options.max_step_rad {
                step *= self.options.max_step_rad / largest;
            }
            if !self.options.respect_limits {
                return step;
            }
            let mut held = false;
            for (joint, l) in self.arm.limits().iter().enumerate() {
                let at_lower = q[joint] <= l.lower_rad && step[joint] < 0.0;
                let at_upper = q[joint] >= l.upper_rad && step[joint] > 0.0;
                if at_lower || at_upper {
                    jacobian.column_mut(joint).fill(0.0);
                    held = true;
                }
            }
            if !held {
                return step;
            }
        }
        step
    }

    fn run(&self, seed: &[f64]) -> Option<End> {
        let n = seed.len();
        let mut q = [0.0; MAX_JOINTS];
        q[..n].copy_from_slice(seed);
        let clamp = |q: &mut [f64; MAX_JOINTS]| {
            if self.options.respect_limits {
                for (value, l) in q.iter_mut().zip(self.arm.limits()) {
                    *value = value.clamp(l.lower_rad, l.upper_rad);
                }
            }
        };
        clamp(&mut q);
        let mut state = self.state(&q[..n])?;
        let mut cost = state.error.norm_squared();
        // Close to the goal full steps are safe from the start.
        let mut damping = cost.clamp(1e-15, 1e-3);
        let mut iterations = 0;
        while iterations < self.options.max_iterations && !self.is_met(&state) {
            iterations += 1;
            let step = self.step(&q[..n], &state, damping);
            let mut next = q;
            for joint in 0..n {
                next[joint] += step[joint];
            }
            clamp(&mut next);
            let moved = (0..n).map(|i| (next[i] - q[i]).abs()).fold(0.0, f64::max);
            let candidate = self.state(&next[..n])?;
            let next_cost = candidate.error.norm_squared();
            if next_cost < cost {
                (q, state, cost) = (next, candidate, next_cost);
                damping = (damping * 0.1).max(1e-15);
            } else {
                damping *= 8.0;
                if damping > 1e8 || moved < 1e-16 {
                    break;
                }
            }
        }
        let (position_error_m, axis_error_rad) = (state.position_error_m, state.axis_error_rad);
        Some(End {
            q,
            position_error_m,
            axis_error_rad,
            iterations,
        })
    }
}

/// Joint angles (radians) that meet `goal`, found by descent from `seed` (radians); for any arm
/// of 4 to 7 joints. The answer is within `options`' tolerances and, unless they say otherwise,
/// within the joint limits.
///
/// # Errors
/// [`IkError::OutOfReach`] when the point is beyond the arm's total length;
/// [`IkError::JointLimit`] when the descent succeeds only without the limits;
/// [`IkError::AxisInfeasible`] when from this seed the point can be met but not the axis with it;
/// otherwise [`IkError::NoConvergence`]. The last two are statements about this seed, not proofs.
/// [`IkError::NotFinite`] and [`IkError::Arm`] for unusable numbers.
pub fn solve_numeric(
    arm: &Arm,
    tool: &Tool,
    goal: &AxisGoal,
    seed: &[f64],
    options: &NumericOptions,
) -> Result<Vec<f64>, IkError> {
    arm.angles(seed)?;
    if !is_usable(tool, goal) {
        return Err(IkError::NotFinite);
    }
    let n = arm.joint_count();
    let lengths: f64 = arm.rows().iter().map(|r| r.a_m.hypot(r.d_m)).sum();
    let by_m = goal.point.norm() - lengths - tool.tip_in_link.norm();
    if by_m > options.position_tolerance_m {
        return Err(IkError::OutOfReach {
            constraint: Constraint::TotalLength,
            by_m,
        });
    }
    let descent = Descent {
        arm,
        tool,
        goal,
        position_weight: 1.0,
        options,
    };
    let end = descent.run(seed).ok_or(IkError::NotFinite)?;
    let is_met = |end: &End| {
        end.position_error_m <= options.position_tolerance_m
            && end.axis_error_rad <= options.axis_tolerance_rad
    };
    if is_met(&end) {
        return Ok(end.q[..n].to_vec());
    }
    if options.respect_limits {
        let without = NumericOptions {
            respect_limits: false,
            ..options.clone()
        };
        let free = Descent {
            options: &without,
            ..descent
        }
        .run(seed)
        .ok_or(IkError::NotFinite)?;
        if is_met(&free) {
            let mut q = free.q;
            return match normalise(arm, &mut q[..n], Some(seed)) {
                None => Ok(q[..n].to_vec()),
                Some(violation) => Err(violation.into()),
            };
        }
    }
    // Insist on the point and see what is left of the axis.
    let insisting = Descent {
        arm,
        tool,
        goal,
        position_weight: 1e4,
        options,
    };
    let point_only = insisting.run(&end.q[..n]).ok_or(IkError::NotFinite)?;
    if point_only.position_error_m <= 1e-6 && point_only.axis_error_rad > 1e-6 {
        return Err(IkError::AxisInfeasible {
            by_rad: point_only.axis_error_rad,
        });
    }
    Err(IkError::NoConvergence {
        position_error_m: end.position_error_m,
        axis_error_rad: end.axis_error_rad,
        iterations: end.iterations,
    })
}

/// The nearest to `near` of the answers from `near` itself and, if that fails, from fixed seeds
/// spread over the limits.
pub(crate) fn closest(
    arm: &Arm,
    tool: &Tool,
    goal: &AxisGoal,
    near: &[f64],
) -> Result<Vec<f64>, IkError> {
    const SEEDS: u32 = 24;
    let options = NumericOptions::default();
    let first = match solve_numeric(arm, tool, goal, near, &options) {
        Ok(q) => return Ok(q),
        Err(error @ (IkError::OutOfReach { .. } | IkError::NotFinite | IkError::Arm(_))) => {
            return Err(error);
        }
        Err(error) => error,
    };
    let mut best: Option<(f64, Vec<f64>)> = None;
    let mut least: Option<LimitViolation> = None;
    for index in 0..SEEDS {
        // A Kronecker sequence: the golden-ratio-like generalisation fills the box evenly.
        let seed: Vec<f64> = arm
            .limits()
            .iter()
            .zip(1_u32..)
            .map(|(l, joint)| {
                let step = KRONECKER.powi(-i32::try_from(joint).unwrap_or(1));
                let fraction = (0.5 + f64::from(index) * step).fract();
                l.lower_rad + fraction * (l.upper_rad - l.lower_rad)
            })
            .collect();
        match solve_numeric(arm, tool, goal, &seed, &options) {
            Ok(q) => {
                let time = travel_time(arm, &q, near);
                if best.as_ref().is_none_or(|(t, _)| time < *t) {
                    best = Some((time, q));
                }
            }
            Err(IkError::JointLimit {
                joint,
                value_rad,
                lower_rad,
                upper_rad,
            }) => {
                let violation = LimitViolation {
                    joint,
                    value_rad,
                    lower_rad,
                    upper_rad,
                };
                if least.is_none_or(|l| violation.excess_rad() < l.excess_rad()) {
                    least = Some(violation);
                }
            }
            Err(_) => {}
        }
    }
    match (best, least) {
        (Some((_, q)), _) => Ok(q),
        (None, Some(v)) if v.excess_rad() > LIMIT_TOLERANCE_RAD => Err(v.into()),
        _ => Err(first),
    }
}

/// The real root of `x^8 = x + 1`, whose powers are the steps of the sequence in 7 dimensions.
const KRONECKER: f64 = 1.096_981_557_798_559_8;
