//! CAHVORE: a lens of any field of view whose entrance pupil moves along the optical axis with
//! the angle of the ray (Gennery 2006).

use crate::cahv::{behind, finite_pixel, last_ahead, ray_along};
use crate::pupil::{Pupil, Sight};
use crate::radial::{Radial, RadialError};
use crate::{CameraError, Projection, Ray, RayJacobians, linear};
use nalgebra::{Isometry3, Matrix3x2, Vector2, Vector3};
use serde::{Deserialize, Serialize};

/// A camera with radial distortion about O and an entrance pupil that moves along O.
///
/// A point is seen at the angle `theta` from O at which the ray from the pupil
/// `C + (theta / sin theta - 1) E(theta) O`, `E = e0 + e1 theta^2 + e2 theta^4`, meets it. With the
/// linearity L, `chi = tan(L theta) / L` (`theta` for L = 0, `sin(L theta) / L` for L < 0), the
/// tangent of the distorted angle is `chi (1 + r0 + r1 chi^2 + r2 chi^4)`; the direction at that
/// angle is imaged by A, H, V.
///
/// All vectors are in one frame, which the holder of the model names.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Cahvore {
    /// Reference point of the pupil's motion: where the pupil is for rays along O, metres.
    pub c: Vector3<f64>,
    /// Axis: unit normal of the image plane, pointing forward.
    pub a: Vector3<f64>,
    /// Horizontal vector `hs H' + hc A`, px.
    pub h: Vector3<f64>,
    /// Vertical vector `vs V' + vc A`, px.
    pub v: Vector3<f64>,
    /// Unit vector of the optical axis.
    pub o: Vector3<f64>,
    /// Distortion coefficients `r0, r1, r2`, dimensionless; they do not turn with the camera.
    pub r: Vector3<f64>,
    /// Motion of the entrance pupil, `e0, e1, e2`, metres; they do not turn with the camera.
    pub e: Vector3<f64>,
    /// The linearity L, -1 to 1: 1 for a perspective lens (type 1 of the JPL library), 0 for an
    /// ideal fisheye (type 2), anything else for type 3 with this parameter.
    pub linearity: f64,
}

/// A point on its way to the image.
struct Seen {
    sight: Sight,
    /// The part of the point's offset from C across O, and its length, metres.
    across: Vector3<f64>,
    across_m: f64,
    chi: f64,
    chi_slope: f64,
    mu: f64,
    offset: Vector3<f64>,
    range_m: f64,
}

/// Angles (radians) and tangents below this are taken as on the axis.
const ON_AXIS: f64 = 1e-8;

impl Cahvore {
    fn pupil(&self) -> Pupil<'_> {
        Pupil {
            e: &self.e,
            linearity: self.linearity,
        }
    }

    /// The largest angle from O (radians) that the model covers.
    pub(crate) fn field_limit_rad(&self) -> f64 {
        let pupil = self.pupil();
        let limit = pupil.limit_rad();
        Radial(&self.r)
            .limit()
            .and_then(|tau| pupil.angle(tau.sqrt()))
            .map_or(limit, |theta| theta.min(limit))
    }

    fn see(&self, point: &Vector3<f64>) -> Result<Seen, CameraError> {
        let d = point - self.c;
        let along_m = d.dot(&self.o);
        let across = d - self.o * along_m;
        let across_m = across.norm();
        if !(along_m + across_m).is_finite() {
            return Err(CameraError::NotFinite);
        }
        let sight = self
            .pupil()
            .sight(along_m, across_m)
            .map_err(|reason| reason.into_error(point))?;
        let (chi, chi_slope) = self.pupil().chi(sight.theta);
        let tau = chi * chi;
        if !Radial(&self.r).is_one_to_one(tau) {
            return Err(CameraError::OutsideField {
                off_axis_deg: sight.theta.to_degrees(),
                limit_deg: self.field_limit_rad().to_degrees(),
            });
        }
        let mu = Radial(&self.r).displacement(tau).0;
        // The distance along O at which the ray's angle would have the tangent chi.
        let reach_m = if chi > ON_AXIS {
            across_m / chi
        } else {
            along_m
        };
        let offset = self.o * reach_m + across * (1.0 + mu);
        let range_m = offset.dot(&self.a);
        if !(range_m > 0.0) {
            let own_m = d.dot(&self.a);
            if !(own_m > 0.0 && range_m.is_finite()) {
                return Err(behind(point, if own_m > 0.0 { range_m } else { own_m }));
            }
            // In front, but the distortion carries it behind the image plane.
            let toward = across.dot(&self.a) / across_m;
            let ahead = |theta: f64| {
                let chi = self.pupil().chi(theta).0;
                let stretched = chi * (1.0 + Radial(&self.r).displacement(chi * chi).0);
                self.o.dot(&self.a) + stretched * toward > 0.0
            };
            return Err(CameraError::OutsideField {
                off_axis_deg: sight.theta.to_degrees(),
                limit_deg: last_ahead(sight.theta, ahead).to_degrees(),
            });
        }
        Ok(Seen {
            sight,
            across,
            across_m,
            chi,
            chi_slope,
            mu,
            offset,
            range_m,
        })
    }

    pub(crate) fn project(&self, point: &Vector3<f64>) -> Result<Vector2<f64>, CameraError> {
        let seen = self.see(point)?;
        finite_pixel(linear::image(&self.h, &self.v, &seen.offset, seen.range_m))
    }

    pub(crate) fn project_with_jacobian(
        &self,
        point: &Vector3<f64>,
    ) -> Result<Projection, CameraError> {
        let seen = self.see(point)?;
        let pixel_px = finite_pixel(linear::image(&self.h, &self.v, &seen.offset, seen.range_m))?;
        let outer = linear::image_jacobian(&self.a, &self.h, &self.v, &pixel_px, seen.range_m);
        let out_of_o = outer * self.o;
        let stretch = 1.0 + seen.mu;
        // The part of d(offset)/dP that only turns: (1 + mu) (I - O O^T).
        let turning = outer * stretch - out_of_o * (self.o * stretch).transpose();
        let jacobian = if seen.chi > ON_AXIS {
            let n = seen.across / seen.across_m;
            // l = |across|, z = along O: dl/dP = n^T - (n.O) O^T, dz/dP = O^T. n.O vanishes but
            // for the length error of a published O.
            let dl = n - self.o * n.dot(&self.o);
            let dz = self.o;
            let dtheta = (dl * seen.sight.cosine - dz * seen.sight.sine) / seen.sight.slope_m;
            let dchi = dtheta * seen.chi_slope;
            let dreach = (dl - dchi * (seen.across_m / seen.chi)) / seen.chi;
            let [_, r1, r2] = self.r.into();
            let dmu = dchi * (2.0 * seen.chi * (r1 + 2.0 * r2 * seen.chi * seen.chi));
            turning + out_of_o * dreach.transpose() + (outer * seen.across) * dmu.transpose()
        } else {
            turning + out_of_o * self.o.transpose()
        };
        Ok(Projection {
            pixel_px,
            jacobian,
            range_m: seen.range_m,
        })
    }

    /// The distorted direction of a pixel, scaled to have the component 1 along O: the part
    /// across O, its length, and the undistorted chi that belongs to it.
    fn undistort(&self, pixel_px: &Vector2<f64>) -> Result<Bent, CameraError> {
        let distorted = linear::direction(&self.a, &self.h, &self.v, pixel_px);
        let along = distorted.dot(&self.o);
        let across = distorted - self.o * along;
        let off_axis_rad = across.norm().atan2(along);
        if !off_axis_rad.is_finite() || distorted == Vector3::zeros() {
            return Err(CameraError::NotFinite);
        }
        let outside = || {
            let limit = Radial(&self.r).distorted_limit().unwrap_or(f64::INFINITY);
            let pupil = self.pupil();
            let (chi, _) = pupil.chi(pupil.limit_rad());
            let widest = if chi.is_finite() && Radial(&self.r).is_one_to_one(chi * chi) {
                chi * (1.0 + Radial(&self.r).displacement(chi * chi).0)
            } else {
                f64::INFINITY
            };
            CameraError::OutsideField {
                off_axis_deg: off_axis_rad.to_degrees(),
                limit_deg: limit.min(widest).atan().to_degrees(),
            }
        };
        if !(along > 0.0) {
            return Err(outside());
        }
        let across = across / along;
        let tangent = across.norm();
        let ratio = Radial(&self.r)
            .undistorted_ratio(tangent * tangent)
            .map_err(|reason| match reason {
                RadialError::Outside => outside(),
                RadialError::NoConvergence {
                    iterations,
                    last_step,
                } => CameraError::NoConvergence {
                    pixel_px: *pixel_px,
                    iterations,
                    last_step,
                },
            })?;
        let chi = tangent * ratio;
        let theta = self
            .pupil()
            .angle(chi)
            .filter(|theta| *theta < self.pupil().limit_rad())
            .ok_or_else(outside)?;
        Ok(Bent {
            across,
            tangent,
            chi,
            theta,
        })
    }

    fn ray_of(&self, bent: &Bent) -> Result<Ray, CameraError> {
        if bent.tangent <= ON_AXIS {
            // sin(theta) / tangent at the axis.
            let direction = self.o + bent.across / (1.0 + self.r.x);
            return ray_along(&self.c, &direction);
        }
        let (sine, cosine) = bent.theta.sin_cos();
        let origin = self.c + self.o * self.pupil().shift(bent.theta).0;
        let direction = bent.across * (sine / bent.tangent) + self.o * cosine;
        ray_along(&origin, &direction)
    }

    pub(crate) fn ray(&self, pixel_px: &Vector2<f64>) -> Result<Ray, CameraError> {
        self.ray_of(&self.undistort(pixel_px)?)
    }

    pub(crate) fn ray_with_jacobians(
        &self,
        pixel_px: &Vector2<f64>,
    ) -> Result<(Ray, RayJacobians), CameraError> {
        let bent = self.undistort(pixel_px)?;
        let ray = self.ray_of(&bent)?;
        let (unit, d_unit) = linear::direction_with_jacobian(&self.a, &self.h, &self.v, pixel_px);
        let along = unit.dot(&self.o);
        let (sine, cosine) = bent.theta.sin_cos();
        let [_, r1, r2] = self.r.into();
        let tau = bent.chi * bent.chi;
        let dtangent_dchi = 1.0 + self.r.x + tau * (3.0 * r1 + 5.0 * r2 * tau);
        let dtheta_dtangent = 1.0 / (self.pupil().chi(bent.theta).1 * dtangent_dchi);
        let shift_slope = self.pupil().shift(bent.theta).1;
        let (radial, origin_slope) = if bent.tangent <= ON_AXIS {
            (None, Vector3::zeros())
        } else {
            (
                Some(bent.across / bent.tangent),
                self.o * (shift_slope * dtheta_dtangent),
            )
        };
        let norm = (bent
            .across
            .scale(sine / bent.tangent.max(f64::MIN_POSITIVE))
            + self.o * cosine)
            .norm();
        let column = |d: Vector3<f64>| {
            // Derivative of across = (unit - (unit.O) O) / (unit.O).
            let d_along = d.dot(&self.o);
            let d_across = (d - self.o * d_along - bent.across * d_along) / along;
            let (d_direction, d_tangent) = match radial {
                None => (d_across / (1.0 + self.r.x), 0.0),
                Some(n) => {
                    let d_tangent = n.dot(&d_across);
                    let d_theta = d_tangent * dtheta_dtangent;
                    let d_n = (d_across - n * d_tangent) / bent.tangent;
                    (
                        (n * cosine - self.o * sine) * d_theta + d_n * sine,
                        d_tangent,
                    )
                }
            };
            let u = ray.direction.as_ref();
            let turned = (d_direction - u * u.dot(&d_direction)) / norm;
            (turned, origin_slope * d_tangent)
        };
        let (first, second) = (
            column(d_unit.column(0).into_owned()),
            column(d_unit.column(1).into_owned()),
        );
        let jacobians = RayJacobians {
            direction: Matrix3x2::from_columns(&[first.0, second.0]),
            origin: Matrix3x2::from_columns(&[first.1, second.1]),
        };
        if jacobians.direction.iter().all(|x| x.is_finite()) {
            Ok((ray, jacobians))
        } else {
            Err(CameraError::NotFinite)
        }
    }

    pub(crate) fn transformed(&self, to_from: &Isometry3<f64>) -> Self {
        Self {
            c: (to_from * nalgebra::Point3::from(self.c)).coords,
            a: to_from.rotation * self.a,
            h: to_from.rotation * self.h,
            v: to_from.rotation * self.v,
            o: to_from.rotation * self.o,
            ..self.clone()
        }
    }
}

/// A pixel's direction, distortion taken out.
struct Bent {
    /// Distorted direction across O, per unit along O.
    across: Vector3<f64>,
    /// Its length: the tangent of the distorted angle.
    tangent: f64,
    chi: f64,
    theta: f64,
}
