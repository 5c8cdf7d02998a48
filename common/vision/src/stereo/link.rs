//! How the neighbourhood of a pixel in one image maps into the other, for a given range.

use nalgebra::{Matrix2, Matrix3x2, Vector2, Vector3};
use rover_cameras::{Camera, CameraError};

/// The affine map around a pixel of camera `a` into camera `b` for points near one range.
///
/// With d the offset from the pixel in `a` and t the displacement along the epipolar direction:
/// pixel in b = `at` + `base` d + `along` t.
#[derive(Clone, Copy, Debug)]
pub(super) struct Link {
    /// Inverse range that the map is made for, 1/m.
    pub inverse_range: f64,
    /// Ray of the pixel in `a`.
    pub origin: Vector3<f64>,
    pub direction: Vector3<f64>,
    /// Derivative of the ray's direction with respect to the pixel.
    pub turn: Matrix3x2<f64>,
    /// The point's pixel in `b`.
    pub at: Vector2<f64>,
    /// Derivative of that pixel with respect to the pixel in `a` at constant range.
    pub base: Matrix2<f64>,
    /// Unit epipolar direction in `b`, towards smaller range.
    pub along: Vector2<f64>,
    /// Unit direction across the epipolar curve.
    pub across: Vector2<f64>,
    /// Pixels along the epipolar direction per unit of inverse range, px m.
    pub px_per_inverse_range: f64,
}

impl Link {
    pub fn new(
        a: &Camera,
        b: &Camera,
        pixel: &Vector2<f64>,
        inverse_range: f64,
    ) -> Result<Self, CameraError> {
        let (ray, turn) = a.ray_with_jacobian(pixel)?;
        let direction = ray.direction.into_inner();
        let seen = b.project_with_jacobian(&ray.at(1.0 / inverse_range))?;
        let base = seen.jacobian * turn / inverse_range;
        let slide = seen.jacobian * direction * (-1.0 / (inverse_range * inverse_range));
        let px_per_inverse_range = slide.norm();
        if !(px_per_inverse_range > 0.0) {
            return Err(CameraError::NotFinite); // no baseline seen from this pixel
        }
        let along = slide / px_per_inverse_range;
        Ok(Self {
            inverse_range,
            origin: ray.origin,
            direction,
            turn,
            at: seen.pixel_px,
            base,
            along,
            across: Vector2::new(-along.y, along.x),
            px_per_inverse_range,
        })
    }

    /// Change of the displacement t per pixel of `a` for a surface with this normal: along the ray
    /// the inverse range of a plane is n.d / (n.(X - o)).
    pub fn slopes_of_normal(&self, normal: &Vector3<f64>) -> Option<Vector2<f64>> {
        let cosine = normal.dot(&self.direction);
        if cosine.abs() < 0.15 * normal.norm() {
            return None; // seen edge on
        }
        let slope = self.turn.transpose() * normal * (self.inverse_range / cosine);
        Some(slope * self.px_per_inverse_range)
    }

    /// The affine map's matrix for a surface with these slopes of t.
    pub fn matrix(&self, slopes: &Vector2<f64>) -> Matrix2<f64> {
        self.base + self.along * slopes.transpose()
    }

    /// Inverse range of a displacement, to first order.
    pub fn inverse_range_at(&self, displacement_px: f64) -> f64 {
        self.inverse_range + displacement_px / self.px_per_inverse_range
    }
}
