//! How a point of the last link moves with the joints.

use crate::arm::{Arm, ArmError, Frames, MAX_JOINTS};
use nalgebra::{Isometry3, Matrix3, Matrix6xX, Rotation3, SMatrix, UnitQuaternion, Vector3};

/// Room for the Jacobian of any arm without allocation: column `i` belongs to joint `i`, linear
/// rows 0..3 (m/rad), angular rows 3..6 (rad/rad). Only the first `joint_count` columns are used.
pub type JacobianBuffer = SMatrix<f64, 6, MAX_JOINTS>;

/// Writes the geometric Jacobian of `point` (base frame): `z_{i-1} x (p - o_{i-1})` over `z_{i-1}`.
#[inline]
pub(crate) fn geometric(frames: &Frames, point: &Vector3<f64>, jacobian: &mut JacobianBuffer) {
    for joint in 0..frames.count {
        let z = &frames.z[joint];
        let linear = z.cross(&(point - frames.origin[joint]));
        let mut column = jacobian.column_mut(joint);
        (column[0], column[1], column[2]) = (linear.x, linear.y, linear.z);
        (column[3], column[4], column[5]) = (z.x, z.y, z.z);
    }
}

impl Arm {
    /// The 6 x n Jacobian of a point fixed to the last link (`point_in_link`, metres) at `q`
    /// (radians), in the base frame: rows 0..3 the point's velocity (m/s per rad/s), rows 3..6
    /// the link's angular velocity (rad/s per rad/s).
    ///
    /// # Errors
    /// As [`Arm::forward`].
    pub fn jacobian(
        &self,
        q: &[f64],
        point_in_link: &Vector3<f64>,
    ) -> Result<Matrix6xX<f64>, ArmError> {
        let mut buffer = JacobianBuffer::zeros();
        self.forward_with_jacobian(q, point_in_link, &mut buffer)?;
        Ok(Matrix6xX::from_fn(self.joint_count(), |row, joint| {
            buffer[(row, joint)]
        }))
    }

    /// The pose of the last link as from [`Arm::forward`], and into `jacobian` the Jacobian as
    /// from [`Arm::jacobian`], in one pass and without allocation. Columns from `joint_count`
    /// on are left as they were.
    ///
    /// # Errors
    /// As [`Arm::forward`].
    #[inline]
    pub fn forward_with_jacobian(
        &self,
        q: &[f64],
        point_in_link: &Vector3<f64>,
        jacobian: &mut JacobianBuffer,
    ) -> Result<Isometry3<f64>, ArmError> {
        let frames = self.frames(q)?;
        let n = frames.count;
        let point = frames.origin[n] + frames.rotate(point_in_link);
        geometric(&frames, &point, jacobian);
        let axes = Matrix3::from_columns(&[frames.x[n], frames.y(n), frames.z[n]]);
        let rotation =
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
        Ok(Isometry3::from_parts(frames.origin[n].into(), rotation))
    }
}
