//! The moving entrance pupil of CAHVORE and its projection of angles (Gennery 2006, "Generalized
//! camera calibration including fish-eye lenses").
//!
//! With `z` and `l` a point's offset from C along and across the axis O, the angle `theta` at
//! which it is seen is the root of
//! `g(theta) = z sin(theta) - l cos(theta) - (theta - sin(theta)) E(theta)`: the line at that
//! angle from the pupil at `s(theta) = (theta / sin(theta) - 1) E(theta)` on O passes through it.
//! Where `g' = rho - sin(theta) s'(theta)` (`rho` the distance from the pupil) is not positive the
//! point lies within the caustic of the rays, and there is no single ray to it.

use crate::CameraError;
use nalgebra::Vector3;
use std::f64::consts::{FRAC_PI_2, PI};

/// The parameters of the pupil's motion and of the projection of angles.
#[derive(Clone, Copy)]
pub(crate) struct Pupil<'a> {
    pub(crate) e: &'a Vector3<f64>,
    pub(crate) linearity: f64,
}

/// The angle at which a point is seen.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sight {
    pub(crate) theta: f64,
    pub(crate) sine: f64,
    pub(crate) cosine: f64,
    /// `g'(theta)`, metres: positive.
    pub(crate) slope_m: f64,
}

/// Why a point is not seen.
pub(crate) enum NoSight {
    /// At the pupil itself, or within the caustic near it.
    NearPupil { distance_m: f64 },
    /// At an angle that the projection does not cover.
    Outside { theta: f64, limit: f64 },
    /// The iteration did not settle.
    NoConvergence { last_step: f64 },
}

impl NoSight {
    #[cold]
    pub(crate) fn into_error(self, point: &Vector3<f64>) -> CameraError {
        match self {
            Self::NearPupil { distance_m } => CameraError::NearPupil {
                point: *point,
                distance_m,
            },
            Self::Outside { theta, limit } => CameraError::OutsideField {
                off_axis_deg: theta.to_degrees(),
                limit_deg: limit.to_degrees(),
            },
            Self::NoConvergence { last_step } => CameraError::PupilNotFound {
                point: *point,
                iterations: ITERATIONS,
                last_step,
            },
        }
    }
}

/// Last Newton step at which the angle counts as settled; what is left is of the size of its
/// square.
const SETTLED_RAD: f64 = 1e-10;
const ITERATIONS: u32 = 100;
/// Angles below this have the pupil at C, and the ratio of angle to sine at 1.
const SMALL_RAD: f64 = 1e-8;

impl Pupil<'_> {
    /// The angle, radians, up to which the projection of angles is defined.
    pub(crate) fn limit_rad(self) -> f64 {
        (FRAC_PI_2 / self.linearity.abs()).min(PI)
    }

    /// `chi(theta)` and its slope.
    #[inline]
    pub(crate) fn chi(self, theta: f64) -> (f64, f64) {
        let l = self.linearity;
        if l == 0.0 {
            return (theta, 1.0);
        }
        let (sine, cosine) = (l * theta).sin_cos();
        if l > 0.0 {
            (sine / (cosine * l), 1.0 / (cosine * cosine))
        } else {
            (sine / l, cosine)
        }
    }

    /// The angle with that `chi`, radians; `None` if there is none.
    #[inline]
    pub(crate) fn angle(self, chi: f64) -> Option<f64> {
        let l = self.linearity;
        let theta = if l == 0.0 {
            chi
        } else if l > 0.0 {
            (l * chi).atan() / l
        } else {
            (l * chi).asin() / l
        };
        theta.is_finite().then_some(theta)
    }

    /// `E(theta)` and its slope.
    #[inline]
    fn polynomial(self, theta: f64) -> (f64, f64) {
        let t2 = theta * theta;
        let e = self.e;
        (
            e.x + t2 * (e.y + t2 * e.z),
            theta * (2.0 * e.y + 4.0 * e.z * t2),
        )
    }

    /// How far the pupil has moved along O, metres, and the derivative of that, m/rad.
    #[inline]
    pub(crate) fn shift(self, theta: f64) -> (f64, f64) {
        if theta < SMALL_RAD {
            return (0.0, 0.0);
        }
        let (sine, cosine) = theta.sin_cos();
        let (e, slope) = self.polynomial(theta);
        let excess = theta / sine - 1.0;
        let excess_slope = (sine - theta * cosine) / (sine * sine);
        (excess * e, excess_slope * e + excess * slope)
    }

    /// The angle at which the point `along_m` along and `across_m >= 0` across O is seen.
    pub(crate) fn sight(self, along_m: f64, across_m: f64) -> Result<Sight, NoSight> {
        let start = across_m.atan2(along_m);
        let limit = self.limit_rad();
        if along_m == 0.0 && across_m == 0.0 {
            return Err(NoSight::NearPupil { distance_m: 0.0 });
        }
        if *self.e == Vector3::zeros() {
            return if start < limit {
                let (sine, cosine) = start.sin_cos();
                Ok(Sight {
                    theta: start,
                    sine,
                    cosine,
                    slope_m: along_m.hypot(across_m),
                })
            } else {
                Err(NoSight::Outside {
                    theta: start,
                    limit,
                })
            };
        }
        // g, its slope, sine and cosine.
        let g = |theta: f64| {
            let (sine, cosine) = theta.sin_cos();
            let (e, slope) = self.polynomial(theta);
            let excess = theta - sine;
            let value = along_m * sine - across_m * cosine - excess * e;
            let slope_m = along_m * cosine + across_m * sine - (1.0 - cosine) * e - excess * slope;
            (value, slope_m, sine, cosine)
        };
        // The root is kept between an angle with g <= 0 and one with g > 0 as soon as both are
        // known: g(0) = -l.
        let (mut low, mut high) = (0.0, limit);
        let mut theta = start.min(limit);
        let mut last_step = f64::INFINITY;
        for _ in 0..ITERATIONS {
            let (value, slope_m, ..) = g(theta);
            if value > 0.0 {
                high = theta;
            } else {
                low = theta;
            }
            let newton = theta - value / slope_m;
            let next = if slope_m > 0.0 && newton >= low && newton <= high {
                newton
            } else {
                0.5 * (low + high)
            };
            last_step = next - theta;
            theta = next;
            if last_step.abs() < SETTLED_RAD {
                return self.checked(theta, limit, g(theta), along_m, across_m);
            }
        }
        Err(NoSight::NoConvergence { last_step })
    }

    /// Accepts a settled angle if its ray reaches the point from the front and outside the
    /// caustic.
    fn checked(
        self,
        theta: f64,
        limit: f64,
        (_, slope_m, sine, cosine): (f64, f64, f64, f64),
        along_m: f64,
        across_m: f64,
    ) -> Result<Sight, NoSight> {
        if !(theta < limit - 2.0 * SETTLED_RAD) {
            return Err(NoSight::Outside { theta, limit });
        }
        let shift_m = self.shift(theta).0;
        let distance_m = (along_m - shift_m) * cosine + across_m * sine;
        if slope_m > 0.0 && distance_m > 0.0 {
            Ok(Sight {
                theta,
                sine,
                cosine,
                slope_m,
            })
        } else {
            Err(NoSight::NearPupil { distance_m })
        }
    }
}
