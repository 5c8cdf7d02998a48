//! Damped least squares for any arm.
//!
//! Task rows for a goal of point and axis: the three of the tool point (metres) and the two of the
//! rotation that turns the tool's axis onto the goal's (radians), measured in the plane square to
//! the tool's axis. For a whole pose: the three of the point and the three of the rotation vector.
//! Step `dq = J^T (J J^T + lambda I)^-1 e` with Levenberg's damping: smaller after a step that
//! helps, larger after one that does not. Joints that a step would push through a limit are held
//! there and the step is computed again without them.

use super::{AxisGoal, Constraint, IkError, is_usable, normalise};
use crate::arm::{Arm, Frames, MAX_JOINTS};
use crate::tool::Tool;
use nalgebra::{Isometry3, Matrix3, Rotation3, SMatrix, SVector, Unit, UnitQuaternion, Vector3};
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

/// Where a frame of the last link shall be: all six constraints, for arms of six or seven joints.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseGoal {
    /// The frame, fixed to the last link.
    pub link_from_tool: Isometry3<f64>,
    /// Where it shall be, arm base frame.
    pub base_from_tool: Isometry3<f64>,
}

/// The direction that a goal asks for.
#[derive(Clone, Copy)]
enum Aim {
    /// One axis of the last link, and where it shall point.
    Axis {
        in_link: Vector3<f64>,
        wanted: Unit<Vector3<f64>>,
    },
    /// The whole rotation of the last link.
    Rotation { base_from_link: UnitQuaternion<f64> },
}

/// A goal as the descent sees it.
#[derive(Clone, Copy)]
struct Task {
    tip_in_link: Vector3<f64>,
    point: Vector3<f64>,
    aim: Aim,
}

/// Where a descent ended.
struct End {
    q: [f64; MAX_JOINTS],
    position_error_m: f64,
    axis_error_rad: f64,
    iterations: usize,
}

type Jacobian = SMatrix<f64, 6, MAX_JOINTS>;

struct State {
    error: SVector<f64, 6>,
    jacobian: Jacobian,
    position_error_m: f64,
    axis_error_rad: f64,
}

struct Descent<'a> {
    arm: &'a Arm,
    task: Task,
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
        let tip = frames.origin[n] + frames.rotate(&self.task.tip_in_link);
        let miss = self.task.point - tip;
        // The rotation that is left, and the directions along which it is measured.
        let (turn, rows) = match &self.task.aim {
            Aim::Axis { in_link, wanted } => {
                let axis = frames.rotate(in_link);
                let (first, second) = tangent_basis(&Unit::new_normalize(axis));
                let turn = turn_between(&axis, wanted, &first);
                (turn, [first, second, Vector3::zeros()])
            }
            Aim::Rotation { base_from_link } => {
                let here = Matrix3::from_columns(&[frames.x[n], frames.y(n), frames.z[n]]);
                let here =
                    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(here));
                let turn = (base_from_link * here.inverse()).scaled_axis();
                (turn, [Vector3::x(), Vector3::y(), Vector3::z()])
            }
        };
        let k = self.position_weight;
        let row = |point: Vector3<f64>, angle: &Vector3<f64>| {
            let [a, b, c] = rows.map(|r| angle.dot(&r));
            SVector::<f64, 6>::new(k * point.x, k * point.y, k * point.z, a, b, c)
        };
        let error = row(miss, &turn);
        let mut jacobian = Jacobian::zeros();
        for joint in 0..n {
            let z = &frames.z[joint];
            let linear = z.cross(&(tip - frames.origin[joint]));
            jacobian.set_column(joint, &row(linear, z));
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
            for i in 0..6 {
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
    let task = Task {
        tip_in_link: tool.tip_in_link,
        point: goal.point,
        aim: Aim::Axis {
            in_link: tool.axis_in_link.into_inner(),
            wanted: goal.axis,
        },
    };
    solve(arm, task, seed, options)
}

/// Joint angles (radians) that put a frame of the last link on a pose, found by descent from `seed`
/// (radians). An arm of fewer than six joints meets only the poses that happen to suit it.
///
/// # Errors
/// As [`solve_numeric`], the whole orientation in place of the axis.
pub fn solve_pose(
    arm: &Arm,
    goal: &PoseGoal,
    seed: &[f64],
    options: &NumericOptions,
) -> Result<Vec<f64>, IkError> {
    arm.angles(seed)?;
    let usable = |pose: &Isometry3<f64>| {
        pose.translation.vector.norm_squared().is_finite()
            && (pose.rotation.coords.norm_squared() - 1.0).abs() < 1e-9
    };
    if !usable(&goal.link_from_tool) || !usable(&goal.base_from_tool) {
        return Err(IkError::NotFinite);
    }
    let task = Task {
        tip_in_link: goal.link_from_tool.translation.vector,
        point: goal.base_from_tool.translation.vector,
        aim: Aim::Rotation {
            base_from_link: goal.base_from_tool.rotation * goal.link_from_tool.rotation.inverse(),
        },
    };
    solve(arm, task, seed, options)
}

fn solve(
    arm: &Arm,
    task: Task,
    seed: &[f64],
    options: &NumericOptions,
) -> Result<Vec<f64>, IkError> {
    let n = arm.joint_count();
    let by_m = task.point.norm() - arm.reach_m(task.tip_in_link.norm());
    if by_m > options.position_tolerance_m {
        return Err(IkError::OutOfReach {
            constraint: Constraint::TotalLength,
            by_m,
        });
    }
    let descent = Descent {
        arm,
        task,
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
        task,
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
