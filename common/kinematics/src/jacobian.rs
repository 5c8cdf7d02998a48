//! How a point of the last link moves with the joints.

use crate::arm::{Arm, MAX_JOINTS};
use crate::rows::ArmError;
use crate::trig::sin_cos;
use nalgebra::{Isometry3, Matrix6xX, Quaternion, SMatrix, UnitQuaternion, Vector3};

/// Room for the Jacobian of any arm without allocation: column `i` belongs to joint `i`, linear
/// rows 0..3 (m/rad), angular rows 3..6 (rad/rad). Only the first `joint_count` columns are used.
pub type JacobianBuffer = SMatrix<f64, 6, MAX_JOINTS>;

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
        if !self.tilts_rad().is_empty() {
            return self.tilted_with_jacobian(q, point_in_link, jacobian);
        }
        match q.len() {
            4 => self.with_jacobian_of::<4>(q, point_in_link, jacobian),
            5 => self.with_jacobian_of::<5>(q, point_in_link, jacobian),
            6 => self.with_jacobian_of::<6>(q, point_in_link, jacobian),
            _ => self.with_jacobian_of::<7>(q, point_in_link, jacobian),
        }
    }

    /// [`Self::forward_with_jacobian`] with tilts.
    #[cold]
    fn tilted_with_jacobian(
        &self,
        q: &[f64],
        point_in_link: &Vector3<f64>,
        jacobian: &mut JacobianBuffer,
    ) -> Result<Isometry3<f64>, ArmError> {
        let frames = self.frames(q)?;
        let point = frames.origin[frames.count] + frames.rotate(point_in_link);
        for joint in 0..frames.count {
            let axis = frames.z[joint];
            let linear = axis.cross(&(point - frames.origin[joint]));
            jacobian.fixed_view_mut::<3, 1>(0, joint).copy_from(&linear);
            jacobian.fixed_view_mut::<3, 1>(3, joint).copy_from(&axis);
        }
        self.tilted_forward(q)
    }

    /// [`Self::forward_with_jacobian`] for `N` joints, so that the compiler unrolls it.
    #[inline(always)]
    fn with_jacobian_of<const N: usize>(
        &self,
        q: &[f64],
        point_in_link: &Vector3<f64>,
        jacobian: &mut JacobianBuffer,
    ) -> Result<Isometry3<f64>, ArmError> {
        let (sine, cosine) = sin_cos(&self.angles(q)?, N);
        let (mut x, mut y, mut z) = (Vector3::x(), Vector3::y(), Vector3::z());
        let mut origin = Vector3::zeros();
        let (mut axes, mut origins) = ([z; N], [origin; N]);
        for joint in 0..N {
            let link = &self.links[joint];
            let (s, c) = (sine[joint], cosine[joint]);
            (axes[joint], origins[joint]) = (z, origin);
            let turned = y * c - x * s;
            x = x * c + y * s;
            origin += z * link.d + x * link.a;
            y = turned * link.cos_alpha + z * link.sin_alpha;
            z = z * link.cos_alpha - turned * link.sin_alpha;
        }
        let p = point_in_link;
        let point = origin + x * p.x + y * p.y + z * p.z;
        for joint in 0..N {
            let axis = &axes[joint];
            let linear = axis.cross(&(point - origins[joint]));
            let mut column = jacobian.column_mut(joint);
            (column[0], column[1], column[2]) = (linear.x, linear.y, linear.z);
            (column[3], column[4], column[5]) = (axis.x, axis.y, axis.z);
        }
        Ok(Isometry3::from_parts(origin.into(), quaternion(&x, &y, &z)))
    }
}

/// The rotation with the given columns.
#[inline]
fn quaternion(x: &Vector3<f64>, y: &Vector3<f64>, z: &Vector3<f64>) -> UnitQuaternion<f64> {
    // Four times each component times the largest one; that one is found by the diagonal.
    let (w, i, j, k) = if x.x + y.y + z.z > 0.0 {
        (1.0 + x.x + y.y + z.z, y.z - z.y, z.x - x.z, x.y - y.x)
    } else if x.x >= y.y && x.x >= z.z {
        (y.z - z.y, 1.0 + x.x - y.y - z.z, x.y + y.x, z.x + x.z)
    } else if y.y >= z.z {
        (z.x - x.z, x.y + y.x, 1.0 - x.x + y.y - z.z, y.z + z.y)
    } else {
        (x.y - y.x, z.x + x.z, y.z + z.y, 1.0 - x.x - y.y + z.z)
    };
    let scale = 1.0 / ((w * w + i * i) + (j * j + k * k)).sqrt();
    UnitQuaternion::new_unchecked(Quaternion::new(w * scale, i * scale, j * scale, k * scale))
}
