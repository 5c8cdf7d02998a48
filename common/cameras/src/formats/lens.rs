//! Pinhole cameras with the distortions of OpenCV, which ROS and Kalibr share.
//!
//! With the point `(X, Y, Z)` in the camera's axes (x right, y down, z forward) and `x = X / Z`,
//! `y = Y / Z`, `r^2 = x^2 + y^2`:
//!
//! - radial and tangential ("plumb_bob", "rational_polynomial", "radtan"):
//!   `x' = x f + 2 p1 x y + p2 (r^2 + 2 x^2)`, `y' = y f + p1 (r^2 + 2 y^2) + 2 p2 x y`,
//!   `f = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)`;
//! - equidistant: `theta' = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)` of the
//!   angle theta from the axis, in place of its tangent.
//!
//! The pixel is `(fx x' + cx, fy y' + cy)`; as with us, (0, 0) is the centre of the first pixel.

use crate::{CameraError, Ray};
use nalgebra::{Isometry3, Matrix2, Point3, Unit, Vector2, Vector3};

/// A distortion of OpenCV.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Lens {
    /// Radial and tangential: `k1, k2, k3, k4, k5, k6` and `p1, p2`.
    Polynomial {
        /// Radial coefficients; the last three are the denominator's.
        k: [f64; 6],
        /// Tangential coefficients.
        p: [f64; 2],
    },
    /// By the angle from the axis: `k1, k2, k3, k4`.
    Equidistant {
        /// Coefficients.
        k: [f64; 4],
    },
}

/// A pinhole camera with a [`Lens`].
#[derive(Clone, Debug, PartialEq)]
pub struct LensCamera {
    /// Takes coordinates in the camera's axes to the frame of points and rays, metres.
    pub frame_from_camera: Isometry3<f64>,
    /// `fx, fy`, px.
    pub focal_px: [f64; 2],
    /// `cx, cy`, px.
    pub centre_px: [f64; 2],
    /// Width and height of the image, px.
    pub size_px: [u32; 2],
    /// The distortion.
    pub lens: Lens,
}

/// Steps from the axis to a pixel in [`LensCamera::ray`].
const STEPS: u32 = 32;
const NEWTON: u32 = 20;

impl Lens {
    /// No distortion.
    pub const NONE: Lens = Lens::Polynomial {
        k: [0.0; 6],
        p: [0.0; 2],
    };

    /// The distorted radius of a direction whose angle from the axis has the tangent `t`, without
    /// tangential terms.
    pub(super) fn radial(&self, t: f64) -> f64 {
        match self {
            Self::Polynomial { k, .. } => polynomial(k, &[0.0; 2], &Vector2::new(t, 0.0)).0.x,
            Self::Equidistant { k } => equidistant(k, t.atan()).0,
        }
    }

    /// `(x', y')` of a direction in the camera's axes; `None` where it has none.
    fn distorted(&self, d: &Vector3<f64>) -> Option<Vector2<f64>> {
        match self {
            Self::Polynomial { k, p } => {
                if !(d.z > 0.0) {
                    return None;
                }
                let (image, slope) = polynomial(k, p, &Vector2::new(d.x / d.z, d.y / d.z));
                (slope.determinant() > 0.0).then_some(image)
            }
            Self::Equidistant { k } => {
                let across = d.xy();
                let length = across.norm();
                let theta = length.atan2(d.z);
                let (bent, slope) = equidistant(k, theta);
                if !(slope > 0.0) {
                    return None;
                }
                if length == 0.0 {
                    return (d.z > 0.0).then(Vector2::zeros);
                }
                Some(across * (bent / length))
            }
        }
    }

    /// The direction that is imaged at `(x', y')`, found by following the straight path from the
    /// axis; `None` if the distortion stops rising on the way.
    fn undistorted(&self, image: &Vector2<f64>) -> Option<Vector3<f64>> {
        match self {
            Self::Polynomial { k, p } => {
                let mut at = Vector2::zeros();
                for step in 1..=STEPS {
                    let target = image * (f64::from(step) / f64::from(STEPS));
                    let mut last = f64::INFINITY;
                    for _ in 0..NEWTON {
                        let (found, slope) = polynomial(k, p, &at);
                        if !(slope.determinant() > 0.0) {
                            return None;
                        }
                        let move_by = slope.try_inverse()? * (target - found);
                        at += move_by;
                        last = move_by.norm();
                        if last <= 1e-14 * (1.0 + at.norm()) {
                            break;
                        }
                    }
                    if !(last <= 1e-10 * (1.0 + at.norm())) {
                        return None;
                    }
                }
                Some(Vector3::new(at.x, at.y, 1.0))
            }
            Self::Equidistant { k } => {
                let target = image.norm();
                if target == 0.0 {
                    return Some(Vector3::z());
                }
                let theta = inverse_equidistant(k, target)?;
                let across = image * (theta.sin() / target);
                Some(Vector3::new(across.x, across.y, theta.cos()))
            }
        }
    }
}

impl LensCamera {
    /// The pixel at which a point (metres, the camera's frame) is imaged.
    ///
    /// # Errors
    /// `BehindCamera`, or `OutsideField` where the distortion does not rise.
    pub fn project(&self, point: &Vector3<f64>) -> Result<Vector2<f64>, CameraError> {
        let d = self
            .frame_from_camera
            .inverse_transform_point(&Point3::from(*point))
            .coords;
        if !d.iter().all(|x| x.is_finite()) {
            return Err(CameraError::NotFinite);
        }
        let image = self.lens.distorted(&d).ok_or_else(|| {
            let off_axis_deg = d.xy().norm().atan2(d.z).to_degrees();
            if matches!(self.lens, Lens::Polynomial { .. }) && !(d.z > 0.0) {
                CameraError::BehindCamera {
                    point: *point,
                    range_m: d.z,
                }
            } else {
                CameraError::OutsideField {
                    off_axis_deg,
                    limit_deg: self.limit_deg(),
                }
            }
        })?;
        Ok(Vector2::new(
            self.focal_px[0] * image.x + self.centre_px[0],
            self.focal_px[1] * image.y + self.centre_px[1],
        ))
    }

    /// The ray of a pixel.
    ///
    /// # Errors
    /// `OutsideField` where the distortion does not rise all the way from the axis to the pixel.
    pub fn ray(&self, pixel_px: &Vector2<f64>) -> Result<Ray, CameraError> {
        let image = Vector2::new(
            (pixel_px.x - self.centre_px[0]) / self.focal_px[0],
            (pixel_px.y - self.centre_px[1]) / self.focal_px[1],
        );
        if !(image.x + image.y).is_finite() {
            return Err(CameraError::NotFinite);
        }
        let direction = self
            .lens
            .undistorted(&image)
            .ok_or_else(|| CameraError::OutsideField {
                off_axis_deg: image.norm().atan().to_degrees(),
                limit_deg: self.limit_deg(),
            })?;
        Ok(Ray {
            origin: self.frame_from_camera.translation.vector,
            direction: Unit::new_normalize(self.frame_from_camera.rotation * direction),
        })
    }

    /// The angle from the axis, degrees, up to which the distortion rises along the x axis.
    fn limit_deg(&self) -> f64 {
        let rises = |degrees: f64| {
            let angle = degrees.to_radians();
            let d = Vector3::new(angle.sin(), 0.0, angle.cos());
            self.lens.distorted(&d).is_some()
        };
        (0..360)
            .map(|half| f64::from(half) * 0.5)
            .take_while(|degrees| rises(*degrees))
            .last()
            .unwrap_or(0.0)
    }

    /// Whether the numbers describe a camera.
    ///
    /// # Errors
    /// `InvalidModel`.
    pub fn validate(&self) -> Result<(), CameraError> {
        let good = |x: f64| x.is_finite() && x > 0.0;
        if !self.focal_px.iter().all(|f| good(*f)) || !self.centre_px.iter().all(|c| c.is_finite())
        {
            return Err(crate::camera::invalid(format!(
                "focal lengths {:?} px and centre {:?} px, expected finite numbers, the former \
                 positive",
                self.focal_px, self.centre_px
            )));
        }
        if self.size_px.contains(&0) {
            return Err(crate::camera::invalid(format!(
                "the image is {} x {} px, expected at least 1 x 1",
                self.size_px[0], self.size_px[1]
            )));
        }
        Ok(())
    }
}

/// `(x', y')` of `(x, y)` and its derivative.
fn polynomial(k: &[f64; 6], p: &[f64; 2], at: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
    let (x, y) = (at.x, at.y);
    let r2 = x * x + y * y;
    let above = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]));
    let below = 1.0 + r2 * (k[3] + r2 * (k[4] + r2 * k[5]));
    let above_slope = k[0] + r2 * (2.0 * k[1] + 3.0 * r2 * k[2]);
    let below_slope = k[3] + r2 * (2.0 * k[4] + 3.0 * r2 * k[5]);
    let f = above / below;
    let slope = (above_slope - f * below_slope) / below;
    let image = Vector2::new(
        x * f + 2.0 * p[0] * x * y + p[1] * (r2 + 2.0 * x * x),
        y * f + p[0] * (r2 + 2.0 * y * y) + 2.0 * p[1] * x * y,
    );
    let mixed = 2.0 * (x * y * slope + p[0] * x + p[1] * y);
    let jacobian = Matrix2::new(
        f + 2.0 * x * x * slope + 2.0 * p[0] * y + 6.0 * p[1] * x,
        mixed,
        mixed,
        f + 2.0 * y * y * slope + 6.0 * p[0] * y + 2.0 * p[1] * x,
    );
    (image, jacobian)
}

/// `theta'` of `theta` and its derivative.
fn equidistant(k: &[f64; 4], theta: f64) -> (f64, f64) {
    let t2 = theta * theta;
    let value = theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))));
    let slope = 1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])));
    (value, slope)
}

fn inverse_equidistant(k: &[f64; 4], target: f64) -> Option<f64> {
    let mut theta = 0.0;
    for step in 1..=STEPS {
        let goal = target * f64::from(step) / f64::from(STEPS);
        let mut last = f64::INFINITY;
        for _ in 0..NEWTON {
            let (value, slope) = equidistant(k, theta);
            if !(slope > 0.0) {
                return None;
            }
            let move_by = (goal - value) / slope;
            theta += move_by;
            last = move_by.abs();
            if last <= 1e-15 * (1.0 + theta) {
                break;
            }
        }
        if !(last <= 1e-10 && theta < std::f64::consts::PI) {
            return None;
        }
    }
    Some(theta)
}
