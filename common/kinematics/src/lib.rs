//! Kinematics of a serial arm given by its Denavit-Hartenberg rows.
//!
//! Conventions: metres, radians, `f64`; everything in the arm base frame (frame 0) unless a name
//! says otherwise. Classic Denavit-Hartenberg: frame `i` seen from frame `i-1` is
//! `Rz(theta_i + offset_i) Tz(d_i) Tx(a_i) Rx(alpha_i)`, so joint `i` turns about `z_{i-1}`.
//! Joints are indexed from 0 in the interface (`joint[0]` turns about the base's z) and the link
//! poses from 0 = base to `n` = last link, which carries the instrument and the fiducial.
//!
//! | module | question it answers |
//! |---|---|
//! | [`Arm`] | where is each link, how does it move with the joints |
//! | [`Tool`] | where on the last link is the instrument, and which way does it point |
//! | [`solve_axis`], [`closest_solution`], [`solve_numeric`] | which joint angles put the tool point on a point with a given approach axis |
//! | [`solve_pose`], [`closest_pose`], [`all_poses`] | which joint angles put a frame of the last link on a pose |
//! | [`pose_error_jacobian`] | how does the predicted pose change with the errors of the model |
//! | [`JointTrajectory`] | is a motion within the limits of the joints, and the quickest that is |
//!
//! Results do not depend on the machine: sine and cosine are computed by the crate itself from
//! IEEE additions and multiplications, and nothing is fused, random or threaded.

mod arm;
mod inverse;
mod jacobian;
mod model_error;
mod rows;
mod tool;
mod trajectory;
mod trig;

pub use arm::{Arm, LIMIT_TOLERANCE_RAD, MAX_JOINTS, MIN_JOINTS};
pub use inverse::{
    AxisGoal, Branch, Constraint, Elbow, FamilyMismatch, IkError, IkSolution, LimitViolation,
    NumericOptions, PoseGoal, Shoulder, Wrist, all_poses, all_solutions, closest_pose,
    closest_solution, solve_axis, solve_numeric, solve_pose,
};
pub use jacobian::JacobianBuffer;
pub use model_error::{
    ERRORS_PER_JOINT, MOUNT_PARAMETERS, point_error_jacobian, pose_error_jacobian,
    pose_error_jacobian_with_mount,
};
pub use rows::{ArmError, DhRow, JointLimits, NO_RATE_LIMIT_RAD_S};
pub use tool::Tool;
pub use trajectory::{
    JointTrajectory, Quantity, TimingOptions, TrajectoryError, TrajectoryPoint, through,
    through_with,
};
