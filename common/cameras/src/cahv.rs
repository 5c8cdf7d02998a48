//! CAHV: the linear camera (Yakimovsky & Cunningham 1978).

use crate::{CameraError, Projection, Ray, linear};
use nalgebra::{Isometry3, Matrix3x2, Point3, Unit, Vector2, Vector3};
use serde::{Deserialize, Serialize};

/// A perspective camera without lens distortion.
///
/// All vectors are in one frame, which the holder of the model names.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Cahv {
    /// Projection centre, metres.
    pub c: Vector3<f64>,
    /// Axis: unit normal of the image plane, pointing forward.
    pub a: Vector3<f64>,
    /// Horizontal vector `hs H' + hc A`, px.
    pub h: Vector3<f64>,
    /// Vertical vector `vs V' + vc A`, px.
    pub v: Vector3<f64>,
}

impl Cahv {
    /// The offset from C and its range along A.
    #[inline]
    fn offset(&self, point: &Vector3<f64>) -> Result<(Vector3<f64>, f64), CameraError> {
        let d = point - self.c;
        let range_m = d.dot(&self.a);
        if range_m > 0.0 {
            Ok((d, range_m))
        } else {
            Err(behind(point, range_m))
        }
    }

    #[inline]
    pub(crate) fn project(&self, point: &Vector3<f64>) -> Result<Vector2<f64>, CameraError> {
        let (d, range_m) = self.offset(point)?;
        finite_pixel(linear::image(&self.h, &self.v, &d, range_m))
    }

    #[inline]
    pub(crate) fn project_with_jacobian(
        &self,
        point: &Vector3<f64>,
    ) -> Result<Projection, CameraError> {
        let (d, range_m) = self.offset(point)?;
        let pixel_px = finite_pixel(linear::image(&self.h, &self.v, &d, range_m))?;
        let jacobian = linear::image_jacobian(&self.a, &self.h, &self.v, &pixel_px, range_m);
        Ok(Projection {
            pixel_px,
            jacobian,
            range_m,
        })
    }

    #[inline]
    pub(crate) fn ray(&self, pixel_px: &Vector2<f64>) -> Result<Ray, CameraError> {
        ray_along(
            &self.c,
            &linear::direction(&self.a, &self.h, &self.v, pixel_px),
        )
    }

    #[inline]
    pub(crate) fn ray_with_jacobian(
        &self,
        pixel_px: &Vector2<f64>,
    ) -> Result<(Ray, Matrix3x2<f64>), CameraError> {
        let (direction, jacobian) =
            linear::direction_with_jacobian(&self.a, &self.h, &self.v, pixel_px);
        Ok((ray_from(&self.c, direction)?, jacobian))
    }

    pub(crate) fn transformed(&self, to_from: &Isometry3<f64>) -> Self {
        Self {
            c: to_from.transform_point(&Point3::from(self.c)).coords,
            a: to_from.rotation * self.a,
            h: to_from.rotation * self.h,
            v: to_from.rotation * self.v,
        }
    }
}

/// A point without an image, because its range along A is not positive or not a number.
#[cold]
pub(crate) fn behind(point: &Vector3<f64>, range_m: f64) -> CameraError {
    if range_m.is_finite() {
        CameraError::BehindCamera {
            point: *point,
            range_m,
        }
    } else {
        CameraError::NotFinite
    }
}

/// The largest number up to `out`, which fails, for which `ahead` holds, as it does at 0.
#[cold]
pub(crate) fn last_ahead(out: f64, ahead: impl Fn(f64) -> bool) -> f64 {
    let (mut low, mut high) = (0.0, out);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if ahead(middle) {
            low = middle;
        } else {
            high = middle;
        }
    }
    low
}

#[inline]
pub(crate) fn finite_pixel(pixel_px: Vector2<f64>) -> Result<Vector2<f64>, CameraError> {
    if pixel_px.x.is_finite() && pixel_px.y.is_finite() {
        Ok(pixel_px)
    } else {
        Err(CameraError::NotFinite)
    }
}

/// A ray from a direction of any length.
#[inline]
pub(crate) fn ray_along(origin: &Vector3<f64>, along: &Vector3<f64>) -> Result<Ray, CameraError> {
    ray_from(origin, along * (1.0 / along.norm()))
}

/// A ray from a direction that is a unit vector unless an input was not finite.
#[inline]
pub(crate) fn ray_from(origin: &Vector3<f64>, unit: Vector3<f64>) -> Result<Ray, CameraError> {
    if (origin.sum() + unit.sum()).is_finite() {
        Ok(Ray {
            origin: *origin,
            direction: Unit::new_unchecked(unit),
        })
    } else {
        Err(CameraError::NotFinite)
    }
}
