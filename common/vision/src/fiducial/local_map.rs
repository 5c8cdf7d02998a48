//! How a camera shows the plate around one of its points, and where it may be.

use nalgebra::{Isometry3, Matrix2, Matrix3x2, Vector2, Vector3};
use rover_cameras::Camera;

use super::NotFound;

/// Least cosine between the plate's normal and the direction to the camera: 80 degrees.
const MIN_FACING: f64 = 0.17;

/// The plate's image around one of its points.
///
/// With p the offset from the point on the plate (m) and d the offset from its pixel (px):
/// d = M p / (1 + g.p), which is exact for a perspective camera and off by the curvature of the
/// distortion otherwise; back: p = q / (1 - g.q), q = M^-1 d.
#[derive(Clone, Copy, Debug)]
pub(super) struct LocalMap {
    /// The point, plate x and y, m.
    pub centre_m: Vector2<f64>,
    /// Its pixel.
    pub pixel_px: Vector2<f64>,
    /// M, px/m.
    pub m: Matrix2<f64>,
    /// M^-1, m/px.
    pub inverse: Matrix2<f64>,
    /// g, 1/m.
    pub g: Vector2<f64>,
}

impl LocalMap {
    /// The map around `point` (plate frame) of a plate at `pose` (camera model's frame).
    pub fn new(
        camera: &Camera,
        pose: &Isometry3<f64>,
        point: &Vector3<f64>,
    ) -> Result<Self, NotFound> {
        let rotation = pose.rotation.to_rotation_matrix();
        let axes: Matrix3x2<f64> = rotation.matrix().fixed_columns::<2>(0).into_owned();
        let at = pose.rotation * point + pose.translation.vector;
        let seen = camera
            .project_with_jacobian(&at)
            .map_err(|e| NotFound::NotVisible(e.to_string()))?;
        let m = seen.jacobian * axes;
        let normal = rotation.matrix().column(2).into_owned();
        let ray = camera
            .ray(&seen.pixel_px)
            .map_err(|e| NotFound::NotVisible(e.to_string()))?;
        let facing = -normal.dot(ray.direction.as_ref());
        if !(facing >= MIN_FACING) {
            return Err(NotFound::NotVisible(format!(
                "the cosine between its normal and the direction to the camera is {facing:.3}, at \
                 least {MIN_FACING} is needed"
            )));
        }
        let [_, axis, _, _] = camera.model.cahv();
        let g = axes.transpose() * axis / seen.range_m;
        Self::from_parts(Vector2::new(point.x, point.y), seen.pixel_px, m, g)
            .ok_or_else(|| NotFound::NotVisible("it is seen edge on".into()))
    }

    pub fn from_parts(
        centre_m: Vector2<f64>,
        pixel_px: Vector2<f64>,
        m: Matrix2<f64>,
        g: Vector2<f64>,
    ) -> Option<Self> {
        Some(Self {
            centre_m,
            pixel_px,
            m,
            inverse: m.try_inverse()?,
            g,
        })
    }

    /// Pixel of a point on the plate (plate x and y, m).
    pub fn project(&self, plate_m: &Vector2<f64>) -> Vector2<f64> {
        let p = plate_m - self.centre_m;
        self.pixel_px + self.m * p / (1.0 + self.g.dot(&p))
    }

    /// The map around another point of the plate.
    pub fn at(&self, plate_m: &Vector2<f64>) -> Option<Self> {
        let p = plate_m - self.centre_m;
        let w = 1.0 + self.g.dot(&p);
        let moved = self.m * p / w;
        let m = (self.m - moved * self.g.transpose()) / w;
        Self::from_parts(*plate_m, self.pixel_px + moved, m, self.g / w)
    }

    /// Smallest and largest image length of a unit length on the plate, px/m.
    pub fn scales(&self) -> (f64, f64) {
        let s = self.m.singular_values();
        (s.min(), s.max())
    }
}

/// A place where the plate may be: the map around the centre of the searched part, and the NCC of
/// its appearance there.
#[derive(Clone, Copy, Debug)]
pub(super) struct Candidate {
    pub map: LocalMap,
    pub score: f64,
}
