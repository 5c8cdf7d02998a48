//! How the predicted pose of the last link changes with the errors of the model.
//!
//! To first order a point of the last link that the believed arm predicts at `p` truly is at
//! `p + J phi`, where `phi` are the errors of the Denavit-Hartenberg rows, four per joint in the
//! order `[theta, d, a, alpha]`, optionally followed by the six of the camera mount. The columns
//! are exact derivatives: a change of row `i` moves everything beyond it as a screw does, about
//! `z_{i-1}` through `o_{i-1}` (theta, d) or about `x_i` through `o_i` (alpha, a).

use crate::arm::{Arm, Frames};
use crate::rows::{ArmError, finite};
use nalgebra::{Matrix3xX, Matrix6xX, Vector3};

/// Model errors per joint: theta (rad), d (m), a (m), alpha (rad).
pub const ERRORS_PER_JOINT: usize = 4;
/// Model errors of the camera mount: rotation vector (rad), then translation (m).
pub const MOUNT_PARAMETERS: usize = 6;

const NONE: Vector3<f64> = Vector3::new(0.0, 0.0, 0.0);

/// The four (linear, angular) columns of joint `i` for the point `p`.
fn columns(arm: &Arm, f: &Frames, i: usize, p: &Vector3<f64>) -> [(Vector3<f64>, Vector3<f64>); 4] {
    let (z, x) = (f.z[i], arm.twist_axis(f, i));
    [
        (z.cross(&(p - f.origin[i])), z),
        (z, NONE),
        (x, NONE),
        (x.cross(&(p - f.origin[i + 1])), x),
    ]
}

fn frames_and_point(
    arm: &Arm,
    q: &[f64],
    point_in_link: &Vector3<f64>,
) -> Result<(Frames, Vector3<f64>), ArmError> {
    finite("point in link", point_in_link.as_slice())?;
    let frames = arm.frames(q)?;
    let point = frames.origin[frames.count] + frames.rotate(point_in_link);
    Ok((frames, point))
}

/// Derivative of a point of the last link (`point_in_link`, metres) with respect to the model
/// errors of the rows: 3 x 4n, base frame, columns `[theta, d, a, alpha]` per joint (m/rad, m/m).
///
/// # Errors
/// [`ArmError`] when `q` (radians) has the wrong length or anything is not finite.
pub fn point_error_jacobian(
    arm: &Arm,
    q: &[f64],
    point_in_link: &Vector3<f64>,
) -> Result<Matrix3xX<f64>, ArmError> {
    let (frames, point) = frames_and_point(arm, q, point_in_link)?;
    let mut jacobian = Matrix3xX::zeros(ERRORS_PER_JOINT * frames.count);
    for i in 0..frames.count {
        for (k, (linear, _)) in columns(arm, &frames, i, &point).iter().enumerate() {
            jacobian.set_column(ERRORS_PER_JOINT * i + k, linear);
        }
    }
    Ok(jacobian)
}

/// Derivative of the pose of the last link with respect to the model errors of the rows: 6 x 4n,
/// base frame. Rows 0..3 as [`point_error_jacobian`]; rows 3..6 the rotation vector of the link
/// (rad/rad): `R(phi) = exp(J_rot phi) R(0)` to first order.
///
/// # Errors
/// As [`point_error_jacobian`].
pub fn pose_error_jacobian(
    arm: &Arm,
    q: &[f64],
    point_in_link: &Vector3<f64>,
) -> Result<Matrix6xX<f64>, ArmError> {
    let (frames, point) = frames_and_point(arm, q, point_in_link)?;
    let mut jacobian = Matrix6xX::zeros(ERRORS_PER_JOINT * frames.count);
    fill_pose(arm, &frames, &point, &mut jacobian);
    Ok(jacobian)
}

/// [`pose_error_jacobian`] with the six errors of the camera mount appended: 6 x (4n + 6).
///
/// The cameras believe a point `p` to be at `exp(w)(p - c0) + c0 + t`, with `c0` the
/// `mount_centre` (base frame, metres), so the last columns are `[-skew(p - c0), I]` in the
/// linear rows and `[I, 0]` in the rotation rows: what the cameras see minus what the believed
/// arm predicts is, to first order, this Jacobian times all the errors.
///
/// # Errors
/// As [`point_error_jacobian`].
pub fn pose_error_jacobian_with_mount(
    arm: &Arm,
    q: &[f64],
    point_in_link: &Vector3<f64>,
    mount_centre: &Vector3<f64>,
) -> Result<Matrix6xX<f64>, ArmError> {
    finite("mount centre", mount_centre.as_slice())?;
    let (frames, point) = frames_and_point(arm, q, point_in_link)?;
    let arm_columns = ERRORS_PER_JOINT * frames.count;
    let mut jacobian = Matrix6xX::zeros(arm_columns + MOUNT_PARAMETERS);
    fill_pose(arm, &frames, &point, &mut jacobian);
    let lever = point - mount_centre;
    jacobian
        .fixed_view_mut::<3, 3>(0, arm_columns)
        .copy_from(&-lever.cross_matrix());
    jacobian
        .fixed_view_mut::<3, 3>(3, arm_columns)
        .fill_with_identity();
    jacobian
        .fixed_view_mut::<3, 3>(0, arm_columns + 3)
        .fill_with_identity();
    Ok(jacobian)
}

fn fill_pose(arm: &Arm, frames: &Frames, point: &Vector3<f64>, jacobian: &mut Matrix6xX<f64>) {
    for i in 0..frames.count {
        for (k, (linear, angular)) in columns(arm, frames, i, point).iter().enumerate() {
            let column = ERRORS_PER_JOINT * i + k;
            jacobian.fixed_view_mut::<3, 1>(0, column).copy_from(linear);
            jacobian
                .fixed_view_mut::<3, 1>(3, column)
                .copy_from(angular);
        }
    }
}
