//! The radial distortion of CAHVOR: an even polynomial in the tangent of the angle from the
//! optical axis (Gennery 1993), its domain, and its inverse.
//!
//! With `t` the tangent of the true angle from O and `t'` that of the distorted one,
//! `t' = t (1 + r0 + r1 t^2 + r2 t^4)`. The model describes a lens only as far as this is
//! one-to-one, that is up to the first zero of its slope
//! `g(tau) = 1 + r0 + 3 r1 tau + 5 r2 tau^2`, `tau = t^2`.

use nalgebra::Vector3;

/// Why a distorted radius has no undistorted one.
pub(crate) enum RadialError {
    /// Beyond the part where the polynomial is one-to-one.
    Outside,
    /// The iteration did not settle.
    NoConvergence { iterations: u32, last_step: f64 },
}

/// The polynomial with coefficients `r0, r1, r2`.
#[derive(Clone, Copy)]
pub(crate) struct Radial<'a>(pub(crate) &'a Vector3<f64>);

/// Relative step at which the bracketed inverse counts as settled.
const SETTLED: f64 = 1e-12;
/// Error below which the fast inverse counts as settled: less than half the resolution of f64.
const FAST_RESIDUE: f64 = 2e-17;
/// Largest last step of the fast inverse if the polynomial is so flat that it hardly bends.
const FAST_STEP: f64 = 1e-3;
const FAST_ITERATIONS: u32 = 20;
const SAFE_ITERATIONS: u32 = 200;

impl Radial<'_> {
    /// The relative displacement `mu = r0 + r1 tau + r2 tau^2` and its slope `dmu/dtau`.
    #[inline]
    pub(crate) fn displacement(self, tau: f64) -> (f64, f64) {
        let r = self.0;
        (r.x + tau * (r.y + tau * r.z), r.y + 2.0 * tau * r.z)
    }

    /// Whether the polynomial rises all the way from the axis to `tau`.
    #[inline]
    pub(crate) fn is_one_to_one(self, tau: f64) -> bool {
        let (c, b, a) = self.slope_coefficients();
        let rises = |t: f64| c + t * (b + t * a) > 0.0;
        // The slope is a parabola; between two positive ends it can dip below zero only if it
        // opens upwards and has its vertex between them.
        c > 0.0
            && rises(tau)
            && !(a > 0.0 && b < 0.0 && -b < 2.0 * a * tau && !rises(-b / (2.0 * a)))
    }

    /// The smallest `tau` at which the polynomial stops rising; `None` if it rises for ever.
    pub(crate) fn limit(self) -> Option<f64> {
        let (c, b, a) = self.slope_coefficients();
        if c <= 0.0 {
            return Some(0.0);
        }
        if a == 0.0 {
            return (b < 0.0).then(|| -c / b);
        }
        let discriminant = b * b - 4.0 * a * c;
        if discriminant < 0.0 {
            return None;
        }
        // Roots without cancellation.
        let q = -0.5 * (b + discriminant.sqrt().copysign(b));
        [q / a, c / q]
            .into_iter()
            .filter(|t| *t > 0.0)
            .reduce(f64::min)
    }

    /// Tangent of the distorted angle at [`Self::limit`].
    pub(crate) fn distorted_limit(self) -> Option<f64> {
        self.limit()
            .map(|tau| tau.sqrt() * (1.0 + self.displacement(tau).0))
    }

    /// The ratio `x = t / t'` for the distorted `tau = t'^2`: the root of
    /// `r2 tau^2 x^5 + r1 tau x^3 + (1 + r0) x - 1 = 0` on the rising part next to the axis.
    #[inline]
    pub(crate) fn undistorted_ratio(self, tau: f64) -> Result<f64, RadialError> {
        let (k1, k3, k5) = (1.0 + self.0.x, self.0.y * tau, self.0.z * tau * tau);
        let mut x = 1.0 - (self.0.x + k3 + k5);
        // A Newton step s leaves an error of about s^2 f''/(2 f'); this bounds f'' for x near 1.
        let bend = 3.0 * k3.abs() + 10.0 * k5.abs();
        for _ in 0..FAST_ITERATIONS {
            let x2 = x * x;
            let slope = k1 + x2 * (3.0 * k3 + x2 * 5.0 * k5);
            if !(slope > 0.0) {
                break;
            }
            let step = (x * (k1 + x2 * (k3 + x2 * k5)) - 1.0) / slope;
            x -= step;
            if step * step * bend <= FAST_RESIDUE * slope && step.abs() < FAST_STEP {
                if x > 0.0 && self.is_one_to_one(x * x * tau) {
                    return Ok(x);
                }
                break;
            }
        }
        self.undistorted_ratio_bracketed(tau)
    }

    /// The same root by Newton steps that may not leave a shrinking bracket: for strong
    /// distortion, where plain Newton steps wander to a branch that describes no lens.
    #[cold]
    fn undistorted_ratio_bracketed(self, tau: f64) -> Result<f64, RadialError> {
        let (k1, k3, k5) = (1.0 + self.0.x, self.0.y * tau, self.0.z * tau * tau);
        let residual = |x: f64| {
            let x2 = x * x;
            x * (k1 + x2 * (k3 + x2 * k5)) - 1.0
        };
        let mut low = 0.0;
        let mut high = match self.limit() {
            Some(limit) => (limit / tau).sqrt(),
            None => {
                let mut high = 1.0;
                while residual(high) < 0.0 && high < 1e150 {
                    high *= 2.0;
                }
                high
            }
        };
        if !(residual(high) >= 0.0) {
            return Err(RadialError::Outside);
        }
        let mut x = 0.5 * (low + high);
        let mut last_step = f64::INFINITY;
        for _ in 0..SAFE_ITERATIONS {
            let x2 = x * x;
            let value = residual(x);
            if value < 0.0 {
                low = x;
            } else {
                high = x;
            }
            let newton = x - value / (k1 + x2 * (3.0 * k3 + x2 * 5.0 * k5));
            let inside = newton >= low && newton <= high;
            let next = if inside { newton } else { 0.5 * (low + high) };
            last_step = next - x;
            x = next;
            if last_step.abs() < SETTLED * x {
                return Ok(x);
            }
        }
        Err(RadialError::NoConvergence {
            iterations: SAFE_ITERATIONS,
            last_step,
        })
    }

    /// `g(tau) = c + b tau + a tau^2` as `(c, b, a)`.
    #[inline]
    fn slope_coefficients(self) -> (f64, f64, f64) {
        (1.0 + self.0.x, 3.0 * self.0.y, 5.0 * self.0.z)
    }
}
