//! The camera: a model, the size of its image, and what can be asked of it.

use crate::{Cahv, Cahvor, Cahvore, CameraError};
use nalgebra::{Isometry3, Matrix2x3, Matrix3x2, Unit, Vector2, Vector3};
use serde::{Deserialize, Serialize};

/// A calibrated camera.
///
/// The model's vectors are in the frame that the holder of the camera names; points go in and
/// rays come out in that same frame. Pixel (0, 0) is the centre of the first pixel, u to the
/// right, v down.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Camera {
    /// How points map to pixels.
    pub model: CameraModel,
    /// Image width, px.
    pub width_px: u32,
    /// Image height, px.
    pub height_px: u32,
}

/// The camera models, in order of generality.
///
/// Written as `{ "cahv": { "c": [..], .. } }`; the upper-case names are read too.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub enum CameraModel {
    /// Perspective without distortion.
    #[serde(rename = "cahv", alias = "Cahv", alias = "CAHV")]
    Cahv(Cahv),
    /// Perspective with radial distortion.
    #[serde(rename = "cahvor", alias = "Cahvor", alias = "CAHVOR")]
    Cahvor(Cahvor),
    /// Any field of view, with radial distortion and a moving entrance pupil.
    #[serde(rename = "cahvore", alias = "Cahvore", alias = "CAHVORE")]
    Cahvore(Cahvore),
}

/// How a ray changes with its pixel: rows x, y, z of the model's frame; columns u, v.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RayJacobians {
    /// Of the unit direction, 1/px.
    pub direction: Matrix3x2<f64>,
    /// Of the origin, m/px: zero for a camera with a fixed projection centre.
    pub origin: Matrix3x2<f64>,
}

/// The half-line of points that a pixel sees, in the camera model's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Where it starts, metres.
    pub origin: Vector3<f64>,
    /// Where it points.
    pub direction: Unit<Vector3<f64>>,
}

impl Ray {
    /// The point `range_m` metres along the ray.
    #[inline]
    pub fn at(&self, range_m: f64) -> Vector3<f64> {
        self.origin + self.direction.as_ref() * range_m
    }
}

/// The image of a point with its derivative.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Projection {
    /// The pixel.
    pub pixel_px: Vector2<f64>,
    /// Derivative of the pixel with respect to the point, px/m: rows u, v; columns x, y, z of the
    /// model's frame.
    pub jacobian: Matrix2x3<f64>,
    /// Range along A: of the point for CAHV, of the point after distortion for the others (the
    /// denominator of the projection, as the JPL library reports it), metres.
    pub range_m: f64,
}

impl CameraModel {
    /// See [`Camera::project`]; needs no image size.
    #[inline]
    pub fn project(&self, point: &Vector3<f64>) -> Result<Vector2<f64>, CameraError> {
        match self {
            Self::Cahv(model) => model.project(point),
            Self::Cahvor(model) => model.project(point),
            Self::Cahvore(model) => model.project(point),
        }
    }

    /// See [`Camera::project_with_jacobian`]; needs no image size.
    #[inline]
    pub fn project_with_jacobian(&self, point: &Vector3<f64>) -> Result<Projection, CameraError> {
        match self {
            Self::Cahv(model) => model.project_with_jacobian(point),
            Self::Cahvor(model) => model.project_with_jacobian(point),
            Self::Cahvore(model) => model.project_with_jacobian(point),
        }
    }

    /// See [`Camera::ray`]; needs no image size.
    #[inline]
    pub fn ray(&self, pixel_px: &Vector2<f64>) -> Result<Ray, CameraError> {
        match self {
            Self::Cahv(model) => model.ray(pixel_px),
            Self::Cahvor(model) => model.ray(pixel_px),
            Self::Cahvore(model) => model.ray(pixel_px),
        }
    }

    /// See [`Camera::ray_with_jacobian`]; needs no image size.
    #[inline]
    pub fn ray_with_jacobian(
        &self,
        pixel_px: &Vector2<f64>,
    ) -> Result<(Ray, Matrix3x2<f64>), CameraError> {
        match self {
            Self::Cahv(model) => model.ray_with_jacobian(pixel_px),
            Self::Cahvor(model) => model.ray_with_jacobian(pixel_px),
            Self::Cahvore(model) => {
                let (ray, jacobians) = model.ray_with_jacobians(pixel_px)?;
                Ok((ray, jacobians.direction))
            }
        }
    }

    /// See [`Camera::ray_with_jacobians`]; needs no image size.
    #[inline]
    pub fn ray_with_jacobians(
        &self,
        pixel_px: &Vector2<f64>,
    ) -> Result<(Ray, RayJacobians), CameraError> {
        if let Self::Cahvore(model) = self {
            return model.ray_with_jacobians(pixel_px);
        }
        let (ray, direction) = self.ray_with_jacobian(pixel_px)?;
        let origin = Matrix3x2::zeros();
        Ok((ray, RayJacobians { direction, origin }))
    }

    /// See [`Camera::transformed`].
    pub fn transformed(&self, to_from: &Isometry3<f64>) -> Self {
        match self {
            Self::Cahv(model) => Self::Cahv(model.transformed(to_from)),
            Self::Cahvor(model) => Self::Cahvor(model.transformed(to_from)),
            Self::Cahvore(model) => Self::Cahvore(model.transformed(to_from)),
        }
    }

    /// The vectors C, A, H, V, which every model of the family has.
    #[inline]
    pub fn cahv(&self) -> [&Vector3<f64>; 4] {
        match self {
            Self::Cahv(m) => [&m.c, &m.a, &m.h, &m.v],
            Self::Cahvor(m) => [&m.c, &m.a, &m.h, &m.v],
            Self::Cahvore(m) => [&m.c, &m.a, &m.h, &m.v],
        }
    }

    /// The vectors A, H, V for changing.
    #[inline]
    pub fn ahv_mut(&mut self) -> [&mut Vector3<f64>; 3] {
        match self {
            Self::Cahv(m) => [&mut m.a, &mut m.h, &mut m.v],
            Self::Cahvor(m) => [&mut m.a, &mut m.h, &mut m.v],
            Self::Cahvore(m) => [&mut m.a, &mut m.h, &mut m.v],
        }
    }

    /// The optical axis O and the distortion coefficients R of a model that has them.
    #[inline]
    pub fn lens(&self) -> Option<[&Vector3<f64>; 2]> {
        match self {
            Self::Cahv(_) => None,
            Self::Cahvor(m) => Some([&m.o, &m.r]),
            Self::Cahvore(m) => Some([&m.o, &m.r]),
        }
    }

    /// The model's name as it is usually written.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Cahv(_) => "CAHV",
            Self::Cahvor(_) => "CAHVOR",
            Self::Cahvore(_) => "CAHVORE",
        }
    }
}

impl Camera {
    /// The pixel at which a point (metres, model's frame) is imaged, whether or not it lies
    /// within the image (see [`Self::contains`]).
    ///
    /// # Errors
    /// `BehindCamera`, `OutsideField` if the point is where the distortion is not one-to-one,
    /// `NotFinite`; for CAHVORE also `NearPupil` and `PupilNotFound`.
    #[inline]
    pub fn project(&self, point: &Vector3<f64>) -> Result<Vector2<f64>, CameraError> {
        self.model.project(point)
    }

    /// The pixel at which a point is seen in the image, at least `margin_px` from its border (see
    /// [`Self::contains`]).
    ///
    /// # Errors
    /// As [`Self::project`], and `OutsideImage`.
    pub fn project_into_image(
        &self,
        point: &Vector3<f64>,
        margin_px: f64,
    ) -> Result<Vector2<f64>, CameraError> {
        let pixel_px = self.project(point)?;
        if self.contains(&pixel_px, margin_px) {
            return Ok(pixel_px);
        }
        Err(CameraError::OutsideImage {
            pixel_px,
            width_px: self.width_px,
            height_px: self.height_px,
            margin_px,
        })
    }

    /// [`Self::project`] with the exact derivative of the pixel with respect to the point.
    ///
    /// # Errors
    /// As [`Self::project`].
    #[inline]
    pub fn project_with_jacobian(&self, point: &Vector3<f64>) -> Result<Projection, CameraError> {
        self.model.project_with_jacobian(point)
    }

    /// The ray of points that are imaged at a pixel; the pixel may lie outside the image.
    ///
    /// For CAHVOR this solves the JPL library's equation (cmod `cmod_cahvor_2d_to_3d`), which
    /// takes O to be of unit length. With such an O it is the exact inverse of
    /// [`Self::project`]. Published models carry six digits; if their O is longer or shorter than
    /// 1 by `e`, a round trip errs by a few `e |mu|` focal lengths: 1e-10 to 1e-8 px at the
    /// corners for most, 5e-6 px for the worst flight model in our tests (`e` = 4e-4).
    /// [`Self::with_unit_axes`] removes it. A CAHVORE ray is measured from O as a whole, so that
    /// its round trip errs by about `e` focal lengths.
    ///
    /// # Errors
    /// `OutsideField` if the pixel is further out than the distortion is one-to-one,
    /// `NoConvergence`, `NotFinite`.
    #[inline]
    pub fn ray(&self, pixel_px: &Vector2<f64>) -> Result<Ray, CameraError> {
        self.model.ray(pixel_px)
    }

    /// [`Self::ray`] with the exact derivative of its unit direction with respect to the pixel,
    /// 1/px (rows x, y, z of the model's frame; columns u, v). The origin of a
    /// CAHVORE ray depends on the pixel too: see [`Self::ray_with_jacobians`].
    ///
    /// # Errors
    /// As [`Self::ray`].
    #[inline]
    pub fn ray_with_jacobian(
        &self,
        pixel_px: &Vector2<f64>,
    ) -> Result<(Ray, Matrix3x2<f64>), CameraError> {
        self.model.ray_with_jacobian(pixel_px)
    }

    /// [`Self::ray`] with the exact derivatives of its direction and its origin.
    ///
    /// # Errors
    /// As [`Self::ray`].
    #[inline]
    pub fn ray_with_jacobians(
        &self,
        pixel_px: &Vector2<f64>,
    ) -> Result<(Ray, RayJacobians), CameraError> {
        self.model.ray_with_jacobians(pixel_px)
    }

    /// Whether a pixel lies inside the image and at least `margin_px` from its border.
    ///
    /// The image reaches half a pixel beyond the centres of its outermost pixels, so a margin of
    /// 0.5 allows exactly `[0, width - 1] x [0, height - 1]`, where interpolation needs no
    /// neighbour outside. A negative margin widens the image; a pixel that is not finite is
    /// nowhere.
    #[inline]
    pub fn contains(&self, pixel_px: &Vector2<f64>, margin_px: f64) -> bool {
        let low = margin_px - 0.5;
        let inside = |x: f64, size: u32| x >= low && x <= f64::from(size) - 1.0 - low;
        inside(pixel_px.x, self.width_px) && inside(pixel_px.y, self.height_px)
    }

    /// The same camera with its vectors in another frame: `to_from` takes coordinates of the
    /// present frame to those of the new one. C moves as a point, A, H, V, O turn, R stays.
    pub fn transformed(&self, to_from: &Isometry3<f64>) -> Camera {
        Camera {
            model: self.model.transformed(to_from),
            ..*self
        }
    }

    /// The camera with A and O scaled to unit length, and H and V scaled with A.
    ///
    /// Scaling A, H, V together changes no pixel. Scaling O changes the distortion by a relative
    /// amount of the order of O's length error, and makes [`Self::ray`] the exact inverse of
    /// [`Self::project`].
    ///
    /// # Errors
    /// `InvalidModel` if A or O is zero or not finite.
    pub fn with_unit_axes(&self) -> Result<Camera, CameraError> {
        let mut camera = self.clone();
        match &mut camera.model {
            CameraModel::Cahv(_) => {}
            CameraModel::Cahvor(m) => m.o /= length("O", &m.o)?,
            CameraModel::Cahvore(m) => m.o /= length("O", &m.o)?,
        }
        let [a, h, v] = camera.model.ahv_mut();
        let scale = length("A", a)?;
        for vector in [a, h, v] {
            *vector /= scale;
        }
        Ok(camera)
    }

    /// Whether the numbers describe a camera.
    ///
    /// # Errors
    /// `InvalidModel`, naming vector, value found and value expected, unless: both sizes are
    /// positive; all vectors are finite; A and O are of unit length to 1e-3; H and V point at
    /// least 5.7 degrees away from A's line and from each other's plane with it, with scales of at
    /// least 1e-3 px; O is within 90 degrees of A; `1 + r0` is
    /// positive; E is finite and the linearity between -1 and 1.
    pub fn validate(&self) -> Result<(), CameraError> {
        if self.width_px == 0 || self.height_px == 0 {
            return Err(invalid(format!(
                "the image is {} x {} px, expected at least 1 x 1",
                self.width_px, self.height_px
            )));
        }
        self.model.validate()
    }
}

impl CameraModel {
    /// As [`Camera::validate`], but for the image size.
    ///
    /// # Errors
    /// `InvalidModel`.
    pub fn validate(&self) -> Result<(), CameraError> {
        let [c, a, h, v] = self.cahv();
        for (name, vector) in [("C", c), ("A", a), ("H", h), ("V", v)] {
            check_finite(name, vector)?;
        }
        check_unit("A", a)?;
        let (across_h, across_v) = (a.cross(h), a.cross(v));
        for (name, across) in [("hs = |A x H|", across_h), ("vs = |A x V|", across_v)] {
            let scale_px = across.norm();
            if !(scale_px >= MIN_SCALE_PX && scale_px.is_finite()) {
                return Err(invalid(format!(
                    "the scale {name} is {scale_px} px, expected at least {MIN_SCALE_PX} px"
                )));
            }
        }
        let sine = across_h.normalize().cross(&across_v.normalize()).norm();
        if !(sine >= MIN_SINE) {
            return Err(invalid(format!(
                "H and V are parallel across A: the sine of the angle between them is {sine}, \
                 expected at least {MIN_SINE}"
            )));
        }
        let Some([o, r]) = self.lens() else {
            return Ok(());
        };
        check_finite("O", o)?;
        check_finite("R", r)?;
        check_unit("O", o)?;
        let cosine = o.dot(a);
        if !(cosine > 0.0) {
            return Err(invalid(format!(
                "O points away from A: their cosine is {cosine}, expected above 0"
            )));
        }
        if !(1.0 + r.x > 0.0) {
            return Err(invalid(format!("r0 is {}, expected above -1", r.x)));
        }
        if let Self::Cahvore(model) = self {
            check_finite("E", &model.e)?;
            if !(model.linearity.abs() <= 1.0) {
                return Err(invalid(format!(
                    "the linearity is {}, expected -1 to 1",
                    model.linearity
                )));
            }
        }
        Ok(())
    }
}

/// The largest accepted deviation of |A| and |O| from 1. Published flight models reach 4.3e-4.
const UNIT_TOLERANCE: f64 = 1e-3;
const MIN_SCALE_PX: f64 = 1e-3;
const MIN_SINE: f64 = 0.1;

pub(crate) fn invalid(reason: String) -> CameraError {
    CameraError::InvalidModel { reason }
}

fn check_finite(name: &str, vector: &Vector3<f64>) -> Result<(), CameraError> {
    if vector.iter().all(|x| x.is_finite()) {
        return Ok(());
    }
    let [x, y, z] = (*vector).into();
    Err(invalid(format!(
        "{name} is [{x} {y} {z}], expected finite numbers"
    )))
}

fn check_unit(name: &str, vector: &Vector3<f64>) -> Result<(), CameraError> {
    let length = vector.norm();
    if (length - 1.0).abs() <= UNIT_TOLERANCE {
        return Ok(());
    }
    Err(invalid(format!(
        "the length of {name} is {length}, expected 1 within {UNIT_TOLERANCE}"
    )))
}

fn length(name: &str, vector: &Vector3<f64>) -> Result<f64, CameraError> {
    let length = vector.norm();
    if length > 0.0 && length.is_finite() {
        return Ok(length);
    }
    Err(invalid(format!(
        "the length of {name} is {length}, expected a positive number"
    )))
}
