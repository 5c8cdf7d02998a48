//! Rotations in files: nine numbers that may be a little off for their few digits.

use super::FormatError;
use super::yaml::wrong;
use nalgebra::{Matrix3, Rotation3, UnitQuaternion};

/// Largest deviation of a rotation from orthonormal that is mended rather than refused.
const ROTATION_TOLERANCE: f64 = 1e-4;

/// The rotation nearest to a matrix of finite numbers.
pub(super) fn rotation(
    field: &str,
    matrix: &Matrix3<f64>,
) -> Result<UnitQuaternion<f64>, FormatError> {
    let error = (matrix * matrix.transpose() - Matrix3::identity()).amax();
    if error < ROTATION_TOLERANCE && matrix.determinant() > 0.0 {
        let rotation = Rotation3::from_matrix(matrix);
        return Ok(UnitQuaternion::from_rotation_matrix(&rotation));
    }
    Err(wrong(
        field,
        format_args!("a matrix off by {error:.1e}"),
        format!("a rotation to {ROTATION_TOLERANCE:e}"),
    ))
}
