//! The true robot of the numeric studies and what can be seen of it.

use super::{
    StudyError,
    draws::Draws,
    workspace::{CAMERA_CENTRE_M, JOINTS, arm, tool},
};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rover_compensation::ErrorModel;
use rover_kinematics::{Arm, ArmError};

/// The believed arm with the cameras' centre, in the arm base frame.
///
/// # Errors
/// [`ArmError`] never, for the studies' arm.
pub fn believed() -> Result<ErrorModel, ArmError> {
    Ok(ErrorModel {
        arm: arm()?,
        tool: tool(),
        rover_from_arm_base: Isometry3::identity(),
        mount_centre_in_rover: Vector3::from(CAMERA_CENTRE_M),
    })
}

/// One draw of the 26 model errors.
#[derive(Clone, Debug)]
pub struct TrueRobot {
    /// The arm as it is.
    pub arm: Arm,
    /// Takes a true position to where the believed cameras see it: `exp(w)(p - c0) + c0 + t`.
    pub believed_from_true: Isometry3<f64>,
}

impl TrueRobot {
    /// Draws theta, d, a, alpha of each joint, then rotation and translation of the mount.
    ///
    /// # Errors
    /// [`StudyError::Arm`] never, for finite standard deviations.
    pub fn draw(
        believed: &ErrorModel,
        draws: &mut Draws,
        angle_rad: f64,
        length_m: f64,
    ) -> Result<Self, StudyError> {
        let mut errors = [0.0; 4 * JOINTS];
        for (i, e) in errors.iter_mut().enumerate() {
            let sigma = if i % 4 == 0 || i % 4 == 3 {
                angle_rad
            } else {
                length_m
            };
            *e = sigma * draws.normal();
        }
        let rotation = draws.vector(angle_rad);
        let translation = draws.vector(length_m);
        Self::new(believed, &errors, rotation, translation)
    }

    /// The robot with these errors: four per joint (rad, m, m, rad), the mount's rotation vector
    /// (rad) and translation (m).
    ///
    /// # Errors
    /// [`StudyError::Arm`] for errors that are not finite.
    pub fn new(
        believed: &ErrorModel,
        errors: &[f64],
        rotation: Vector3<f64>,
        translation: Vector3<f64>,
    ) -> Result<Self, StudyError> {
        let centre = Translation3::from(believed.mount_centre_in_rover);
        let turn = UnitQuaternion::from_scaled_axis(rotation);
        Ok(Self {
            arm: believed.arm.perturbed(errors)?,
            believed_from_true: Translation3::from(translation) * centre * turn * centre.inverse(),
        })
    }

    /// Where the cameras see a point of the last link at joint angles `q`, m.
    ///
    /// # Errors
    /// [`ArmError`] for joint angles that do not fit the arm.
    pub fn seen(&self, q: &[f64], point_in_link: &Vector3<f64>) -> Result<Vector3<f64>, ArmError> {
        let p = self.arm.point(q, point_in_link)?;
        Ok((self.believed_from_true * nalgebra::Point3::from(p)).coords)
    }
}
