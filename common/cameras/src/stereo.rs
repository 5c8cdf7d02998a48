//! Two rays, one point: triangulation, its covariance, and the epipolar curve.

use crate::{Camera, CameraError, Ray, RayJacobians};
use nalgebra::{Isometry3, Matrix2, Matrix3, Matrix3x2, Vector2, Vector3};
use serde::{Deserialize, Serialize};
use std::fmt;
use thiserror::Error;

/// The point nearest to two rays.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Triangulation {
    /// Midpoint of the shortest segment between the rays, metres, in the cameras' frame.
    pub point: Vector3<f64>,
    /// Length of that segment, metres: how far the rays miss each other.
    pub miss_m: f64,
    /// Distance along the left ray to its end of the segment, metres.
    pub range_left_m: f64,
    /// Distance along the right ray to its end of the segment, metres.
    pub range_right_m: f64,
}

/// One of the two cameras of a pair.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// The left camera.
    Left,
    /// The right camera.
    Right,
}

impl fmt::Display for Side {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Side::Left => "left",
            Side::Right => "right",
        })
    }
}

/// Why two pixels or rays gave no point.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum TriangulationError {
    /// The rays do not determine a range.
    #[error(
        "the rays are parallel: the sine of the angle between them is {sine}, expected at least \
         {MIN_SINE}"
    )]
    Parallel {
        /// Sine of the angle between the two rays.
        sine: f64,
    },
    /// The rays come nearest behind a camera: they diverge in front, as from a wrong match.
    #[error(
        "the rays come nearest to each other at {range_left_m} m along the left and \
         {range_right_m} m along the right ray; both must be in front (> 0 m)"
    )]
    BehindCamera {
        /// Signed distance along the left ray, metres.
        range_left_m: f64,
        /// Signed distance along the right ray, metres.
        range_right_m: f64,
    },
    /// A pixel has no ray.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// The rays miss each other by more than a limit allows; see [`Triangulation::check_miss`].
    #[error(
        "the rays miss each other by {miss_m} m at a range of {range_m} m, expected at most \
         {limit_m} m"
    )]
    Miss {
        /// Distance between the rays, metres.
        miss_m: f64,
        /// Range at which it was found, metres (the smaller of the two).
        range_m: f64,
        /// The largest distance allowed at that range, metres.
        limit_m: f64,
    },
    /// A pixel covariance is not one.
    #[error(
        "the {side} pixel's covariance [[{} {}] [{} {}]] px^2 is not symmetric, finite and \
         positive semidefinite",
        found.m11, found.m12, found.m21, found.m22
    )]
    Covariance {
        /// Which pixel.
        side: Side,
        /// The matrix given, px^2.
        found: Matrix2<f64>,
    },
}

/// How far two rays may miss each other.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MissLimit {
    /// Largest miss distance at any range, metres.
    pub absolute_m: f64,
    /// Largest ratio of miss distance to range, m/m.
    pub per_range: f64,
}

impl Default for MissLimit {
    /// The limits of the MER ground software (VICAR `marsxyz`): 5 cm and 0.5 % of the range.
    fn default() -> Self {
        Self {
            absolute_m: 0.05,
            per_range: 0.005,
        }
    }
}

impl Triangulation {
    /// Refuses a point whose rays miss each other by more than `limit`.
    ///
    /// # Errors
    /// [`TriangulationError::Miss`].
    pub fn check_miss(&self, limit: &MissLimit) -> Result<(), TriangulationError> {
        let range_m = self.range_left_m.min(self.range_right_m);
        let limit_m = limit.absolute_m.min(limit.per_range * range_m);
        if self.miss_m <= limit_m {
            Ok(())
        } else {
            Err(TriangulationError::Miss {
                miss_m: self.miss_m,
                range_m,
                limit_m,
            })
        }
    }
}

/// Rays closer to parallel than this (sine of their angle) give no point: their range would be
/// accurate to less than seven digits of f64 and is beyond any baseline that a rover has.
const MIN_SINE: f64 = 1e-9;

/// The point nearest to two rays, given in one frame.
///
/// With the rays `P1 + s u` and `P2 + t v`, `b = P2 - P1` and `n = u x v`, the shortest segment
/// is at `s = (b x v).n / n.n`, `t = (b x u).n / n.n`; the point is its middle. This is the
/// paper's equation (1), `b = d_left r_left - d_right r_right` in the least-squares sense, and
/// the closed form of the JPL library, without the cancellation in `1 - (u.v)^2`.
///
/// # Errors
/// `Parallel`, `BehindCamera`, or `Camera(NotFinite)`.
#[inline]
pub fn closest_point(left: &Ray, right: &Ray) -> Result<Triangulation, TriangulationError> {
    let (u, v) = (left.direction.as_ref(), right.direction.as_ref());
    let b = right.origin - left.origin;
    let n = u.cross(v);
    let n2 = n.norm_squared();
    if !(n2 >= MIN_SINE * MIN_SINE) {
        return Err(if n2.is_finite() {
            TriangulationError::Parallel { sine: n2.sqrt() }
        } else {
            CameraError::NotFinite.into()
        });
    }
    let range_left_m = b.cross(v).dot(&n) / n2;
    let range_right_m = b.cross(u).dot(&n) / n2;
    if !(range_left_m + range_right_m).is_finite() {
        return Err(CameraError::NotFinite.into());
    }
    if !(range_left_m > 0.0 && range_right_m > 0.0) {
        return Err(TriangulationError::BehindCamera {
            range_left_m,
            range_right_m,
        });
    }
    let on_left = left.at(range_left_m);
    let on_right = right.at(range_right_m);
    Ok(Triangulation {
        point: (on_left + on_right) * 0.5,
        miss_m: (on_left - on_right).norm(),
        range_left_m,
        range_right_m,
    })
}

/// Two cameras whose models are given in one frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StereoPair {
    /// The left camera.
    pub left: Camera,
    /// The right camera.
    pub right: Camera,
}

impl StereoPair {
    /// The point seen at `left_px` and `right_px`, in the cameras' frame.
    ///
    /// Two pixels that do not belong together also give a point, at which their rays miss each
    /// other: look at [`Triangulation::miss_m`] or call [`Triangulation::check_miss`].
    ///
    /// # Errors
    /// Any of [`TriangulationError`] but `Miss` and `Covariance`.
    #[inline]
    pub fn triangulate(
        &self,
        left_px: &Vector2<f64>,
        right_px: &Vector2<f64>,
    ) -> Result<Triangulation, TriangulationError> {
        closest_point(&self.left.ray(left_px)?, &self.right.ray(right_px)?)
    }

    /// [`Self::triangulate`] with the covariance of the point (m^2, cameras' frame) that follows,
    /// to first order, from those of the two pixels (px^2), taken as independent of each other.
    /// The camera models count as exact.
    ///
    /// # Errors
    /// Any of [`TriangulationError`] but `Miss`.
    pub fn triangulate_with_covariance(
        &self,
        left_px: &Vector2<f64>,
        right_px: &Vector2<f64>,
        left_cov: &Matrix2<f64>,
        right_cov: &Matrix2<f64>,
    ) -> Result<(Triangulation, Matrix3<f64>), TriangulationError> {
        check_covariance(Side::Left, left_cov)?;
        check_covariance(Side::Right, right_cov)?;
        let (found, [by_left, by_right]) = self.triangulate_with_jacobian(left_px, right_px)?;
        let covariance =
            by_left * left_cov * by_left.transpose() + by_right * right_cov * by_right.transpose();
        // The products are symmetric up to rounding; make them so exactly.
        Ok((found, (covariance + covariance.transpose()) * 0.5))
    }

    /// [`Self::triangulate`] with the exact derivatives of the point with respect to the left and
    /// the right pixel, m/px.
    ///
    /// # Errors
    /// As [`Self::triangulate`].
    pub fn triangulate_with_jacobian(
        &self,
        left_px: &Vector2<f64>,
        right_px: &Vector2<f64>,
    ) -> Result<(Triangulation, [Matrix3x2<f64>; 2]), TriangulationError> {
        let (left, left_by) = self.left.ray_with_jacobians(left_px)?;
        let (right, right_by) = self.right.ray_with_jacobians(right_px)?;
        let found = closest_point(&left, &right)?;
        let (u, v) = (left.direction.as_ref(), right.direction.as_ref());
        let (s, t) = (found.range_left_m, found.range_right_m);
        // s and t are given by F = (u.e, v.e) = 0 with e = P1 + s u - P2 - t v. With c = u.v
        // dF/d(s, t) = [[1, -c], [c, -1]], whose determinant is c^2 - 1 = -|u x v|^2.
        let e = left.at(s) - right.at(t);
        let cosine = u.dot(v);
        let sine2 = u.cross(v).norm_squared();
        let ranges = |f1: f64, f2: f64| ((-f1 + cosine * f2) / sine2, (-cosine * f1 + f2) / sine2);
        let by_left = |du: Vector3<f64>, dp: Vector3<f64>| {
            let (ds, dt) = ranges(
                (e + u * s).dot(&du) + u.dot(&dp),
                v.dot(&du) * s + v.dot(&dp),
            );
            (dp + du * s + u * ds + v * dt) * 0.5
        };
        let by_right = |dv: Vector3<f64>, dp: Vector3<f64>| {
            let (ds, dt) = ranges(
                -u.dot(&dv) * t - u.dot(&dp),
                (e - v * t).dot(&dv) - v.dot(&dp),
            );
            (dp + dv * t + u * ds + v * dt) * 0.5
        };
        let columns =
            |d: &RayJacobians, by: &dyn Fn(Vector3<f64>, Vector3<f64>) -> Vector3<f64>| {
                let column = |i: usize| {
                    by(
                        d.direction.column(i).into_owned(),
                        d.origin.column(i).into_owned(),
                    )
                };
                Matrix3x2::from_columns(&[column(0), column(1)])
            };
        let jacobians = [columns(&left_by, &by_left), columns(&right_by, &by_right)];
        Ok((found, jacobians))
    }

    /// The pair with its vectors in another frame; see [`Camera::transformed`].
    pub fn transformed(&self, to_from: &Isometry3<f64>) -> StereoPair {
        StereoPair {
            left: self.left.transformed(to_from),
            right: self.right.transformed(to_from),
        }
    }

    /// The right image of the point `range_m` metres along the left pixel's ray, and its
    /// derivative with respect to that range, px/m.
    ///
    /// Over all ranges this is the epipolar line of `left_px`, curved where the right lens
    /// distorts. The pixel may lie outside the right image.
    ///
    /// # Errors
    /// Those of [`Camera::ray`] on the left and of [`Camera::project`] on the right camera;
    /// `BehindCamera` also for a range that is not positive.
    #[inline]
    pub fn epipolar_point(
        &self,
        left_px: &Vector2<f64>,
        range_m: f64,
    ) -> Result<(Vector2<f64>, Vector2<f64>), CameraError> {
        let ray = self.left.ray(left_px)?;
        let point = ray.at(range_m);
        if !range_m.is_finite() {
            return Err(CameraError::NotFinite);
        }
        if !(range_m > 0.0) {
            return Err(CameraError::BehindCamera { point, range_m });
        }
        let image = self.right.project_with_jacobian(&point)?;
        Ok((image.pixel_px, image.jacobian * ray.direction.as_ref()))
    }

    /// Distance between the two projection centres, metres.
    pub fn baseline_m(&self) -> f64 {
        let ([left, ..], [right, ..]) = (self.left.model.cahv(), self.right.model.cahv());
        (right - left).norm()
    }

    /// Whether both cameras are valid and apart from each other; see [`Camera::validate`].
    ///
    /// # Errors
    /// [`CameraError::InvalidModel`], naming the side.
    pub fn validate(&self) -> Result<(), CameraError> {
        for (side, camera) in [(Side::Left, &self.left), (Side::Right, &self.right)] {
            camera.validate().map_err(|error| match error {
                CameraError::InvalidModel { reason } => CameraError::InvalidModel {
                    reason: format!("{side} camera: {reason}"),
                },
                other => other,
            })?;
        }
        let baseline_m = self.baseline_m();
        if baseline_m > 0.0 {
            Ok(())
        } else {
            Err(CameraError::InvalidModel {
                reason: format!("the baseline is {baseline_m} m, expected above 0 m"),
            })
        }
    }
}

/// Accepts a symmetric positive semidefinite matrix, up to rounding.
fn check_covariance(side: Side, cov: &Matrix2<f64>) -> Result<(), TriangulationError> {
    let size = cov.amax();
    let tolerance = 1e-12 * size;
    let good = cov.iter().all(|x| x.is_finite())
        && (cov.m12 - cov.m21).abs() <= tolerance
        && cov.m11 >= 0.0
        && cov.m22 >= 0.0
        && cov.determinant() >= -tolerance * size;
    if good {
        Ok(())
    } else {
        Err(TriangulationError::Covariance { side, found: *cov })
    }
}
