//! CAHVOR: CAHV behind a lens with radial distortion about its own optical axis (Gennery 1993).

use crate::cahv::{behind, finite_pixel, last_ahead, ray_along, ray_from};
use crate::radial::{Radial, RadialError};
use crate::{CameraError, Projection, Ray, linear};
use nalgebra::{Isometry3, Matrix3, Matrix3x2, Point3, Vector2, Vector3};
use serde::{Deserialize, Serialize};

/// A perspective camera with radial lens distortion.
///
/// A point at the offset `d` from C is first moved away from the optical axis O to
/// `d' = d + mu l`, where `l = d - (d.O) O`, `tau = |l|^2 / (d.O)^2` and
/// `mu = r0 + r1 tau + r2 tau^2`; then `d'` is imaged by C, A, H, V.
///
/// All vectors are in one frame, which the holder of the model names.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Cahvor {
    /// Projection centre, metres.
    pub c: Vector3<f64>,
    /// Axis: unit normal of the image plane, pointing forward.
    pub a: Vector3<f64>,
    /// Horizontal vector `hs H' + hc A`, px.
    pub h: Vector3<f64>,
    /// Vertical vector `vs V' + vc A`, px.
    pub v: Vector3<f64>,
    /// Unit vector of the optical axis, the axis of symmetry of the distortion.
    pub o: Vector3<f64>,
    /// Distortion coefficients `r0, r1, r2`, dimensionless. Not a vector of space: it does not
    /// turn with the camera.
    pub r: Vector3<f64>,
}

/// An offset from C split along the optical axis, and its distorted form.
struct Distorted {
    /// Component along O, metres.
    along_m: f64,
    /// Component across O, metres.
    across: Vector3<f64>,
    tau: f64,
    mu: f64,
    mu_slope: f64,
    /// The distorted offset.
    offset: Vector3<f64>,
    /// Range of the distorted offset along A, metres.
    range_m: f64,
}

impl Cahvor {
    #[inline]
    fn distort(&self, point: &Vector3<f64>) -> Result<Distorted, CameraError> {
        let d = point - self.c;
        let along_m = d.dot(&self.o);
        let across = d - self.o * along_m;
        let tau = across.norm_squared() / (along_m * along_m);
        let radial = Radial(&self.r);
        if !(along_m > 0.0 && radial.is_one_to_one(tau)) {
            return Err(self.refuse_point(point));
        }
        let (mu, mu_slope) = radial.displacement(tau);
        let offset = d + across * mu;
        let range_m = offset.dot(&self.a);
        if range_m > 0.0 {
            Ok(Distorted {
                along_m,
                across,
                tau,
                mu,
                mu_slope,
                offset,
                range_m,
            })
        } else {
            Err(self.refuse_point(point))
        }
    }

    /// Names the reason for which [`Self::distort`] cannot image `point`.
    #[cold]
    fn refuse_point(&self, point: &Vector3<f64>) -> CameraError {
        let d = point - self.c;
        let range_m = d.dot(&self.a);
        if !(range_m > 0.0) {
            return behind(point, range_m);
        }
        let along_m = d.dot(&self.o);
        let across_m = (d - self.o * along_m).norm();
        let across = d - self.o * along_m;
        let radial = Radial(&self.r);
        let limit = radial.limit().map_or(f64::INFINITY, f64::sqrt);
        let tangent = across_m / along_m;
        if along_m > 0.0 && tangent < limit {
            // One-to-one, but the distortion carries it behind the image plane.
            let toward = across.dot(&self.a) / across_m;
            let ahead = |t: f64| {
                let stretched = t * (1.0 + radial.displacement(t * t).0);
                self.o.dot(&self.a) + stretched * toward > 0.0
            };
            return outside(tangent.atan(), last_ahead(tangent, ahead));
        }
        outside(across_m.atan2(along_m), limit)
    }

    #[inline]
    pub(crate) fn project(&self, point: &Vector3<f64>) -> Result<Vector2<f64>, CameraError> {
        let distorted = self.distort(point)?;
        finite_pixel(linear::image(
            &self.h,
            &self.v,
            &distorted.offset,
            distorted.range_m,
        ))
    }

    #[inline]
    pub(crate) fn project_with_jacobian(
        &self,
        point: &Vector3<f64>,
    ) -> Result<Projection, CameraError> {
        let Distorted {
            along_m,
            across,
            tau,
            mu,
            mu_slope,
            offset,
            range_m,
        } = self.distort(point)?;
        let pixel_px = finite_pixel(linear::image(&self.h, &self.v, &offset, range_m))?;
        let outer = linear::image_jacobian(&self.a, &self.h, &self.v, &pixel_px, range_m);
        // With L = I - O O^T: d(offset)/dP = I + mu L + l dmu/dtau dtau/dP,
        // dtau/dP = (2/w^2) l^T L - (2 tau/w) O^T.
        let across_l = across - self.o * across.dot(&self.o);
        let dtau = (across_l * (2.0 / along_m) - self.o * (2.0 * tau)) / along_m;
        // The product outer * d(offset)/dP, without forming the 3x3 matrices.
        let jacobian = outer * (1.0 + mu) - (outer * self.o) * (self.o * mu).transpose()
            + (outer * across) * (dtau * mu_slope).transpose();
        Ok(Projection {
            pixel_px,
            jacobian,
            range_m,
        })
    }

    /// Takes the distortion out of the direction `distorted` (any length); also returns the pieces that
    /// the derivative needs.
    #[inline]
    fn undistort(
        &self,
        distorted: &Vector3<f64>,
        pixel_px: &Vector2<f64>,
    ) -> Result<Undistorted, CameraError> {
        let along = distorted.dot(&self.o);
        let across = distorted - self.o * along;
        let tau = across.norm_squared() / (along * along);
        let ratio = if along > 0.0 {
            Radial(&self.r).undistorted_ratio(tau)
        } else {
            Err(RadialError::Outside)
        };
        match ratio {
            Ok(ratio) => {
                let direction = distorted - across * (1.0 - ratio);
                Ok(Undistorted {
                    along,
                    across,
                    tau,
                    ratio,
                    direction,
                })
            }
            Err(reason) => Err(self.refuse_pixel(&reason, along, &across, pixel_px)),
        }
    }

    #[cold]
    fn refuse_pixel(
        &self,
        reason: &RadialError,
        along: f64,
        across: &Vector3<f64>,
        pixel_px: &Vector2<f64>,
    ) -> CameraError {
        let off_axis_rad = across.norm().atan2(along);
        match *reason {
            _ if !off_axis_rad.is_finite() || (along == 0.0 && *across == Vector3::zeros()) => {
                CameraError::NotFinite
            }
            RadialError::Outside => {
                let limit = Radial(&self.r).distorted_limit().unwrap_or(f64::INFINITY);
                outside(off_axis_rad, limit)
            }
            RadialError::NoConvergence {
                iterations,
                last_step,
            } => CameraError::NoConvergence {
                pixel_px: *pixel_px,
                iterations,
                last_step,
            },
        }
    }

    #[inline]
    pub(crate) fn ray(&self, pixel_px: &Vector2<f64>) -> Result<Ray, CameraError> {
        let distorted = linear::direction(&self.a, &self.h, &self.v, pixel_px);
        let direction = self.undistort(&distorted, pixel_px)?.direction;
        ray_along(&self.c, &direction)
    }

    #[inline]
    pub(crate) fn ray_with_jacobian(
        &self,
        pixel_px: &Vector2<f64>,
    ) -> Result<(Ray, Matrix3x2<f64>), CameraError> {
        let (distorted, d_distorted) =
            linear::direction_with_jacobian(&self.a, &self.h, &self.v, pixel_px);
        let Undistorted {
            along,
            across,
            tau,
            ratio,
            direction,
        } = self.undistort(&distorted, pixel_px)?;
        // The ratio x is given by f(x, tau) = r2 tau^2 x^5 + r1 tau x^3 + (1 + r0) x - 1 = 0.
        let [r0, r1, r2] = self.r.into();
        let x2 = ratio * ratio;
        let df_dx = 1.0 + r0 + tau * x2 * (3.0 * r1 + 5.0 * r2 * tau * x2);
        let df_dtau = ratio * x2 * (r1 + 2.0 * r2 * tau * x2);
        let dratio_dtau = -df_dtau / df_dx;
        let norm = direction.norm();
        let unit = direction / norm;
        let column = |d: Vector3<f64>| {
            let d_along = d.dot(&self.o);
            let d_across = d - self.o * d_along;
            let d_tau = 2.0 * (across.dot(&d_across) - tau * along * d_along) / (along * along);
            let d_direction = d - d_across * (1.0 - ratio) + across * (dratio_dtau * d_tau);
            (d_direction - unit * unit.dot(&d_direction)) / norm
        };
        let jacobian = Matrix3x2::from_columns(&[
            column(d_distorted.column(0).into_owned()),
            column(d_distorted.column(1).into_owned()),
        ]);
        Ok((ray_from(&self.c, unit)?, jacobian))
    }

    pub(crate) fn transformed(&self, to_from: &Isometry3<f64>) -> Self {
        let rotation: Matrix3<f64> = to_from.rotation.to_rotation_matrix().into_inner();
        Self {
            c: to_from.transform_point(&Point3::from(self.c)).coords,
            a: rotation * self.a,
            h: rotation * self.h,
            v: rotation * self.v,
            o: rotation * self.o,
            r: self.r,
        }
    }
}

/// A distorted direction split along the optical axis, and its undistorted form.
struct Undistorted {
    along: f64,
    across: Vector3<f64>,
    tau: f64,
    /// Ratio of the undistorted to the distorted tangent.
    ratio: f64,
    /// The undistorted direction, not of unit length.
    direction: Vector3<f64>,
}

/// A direction outside the field, from its angle and the tangent of the limit.
fn outside(off_axis_rad: f64, limit_tangent: f64) -> CameraError {
    if off_axis_rad.is_finite() {
        CameraError::OutsideField {
            off_axis_deg: off_axis_rad.to_degrees(),
            limit_deg: limit_tangent.atan().to_degrees(),
        }
    } else {
        CameraError::NotFinite
    }
}
