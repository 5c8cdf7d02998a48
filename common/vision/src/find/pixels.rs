//! Least squares of a shape's blurred image on grey values.
//!
//! Model: pixel = (offset + gain * value(pixel; p)) * (1 + slope of light . offset from the middle).
//! Gain, offset and the slope are solved for together with the linearised change of p (Gauss-Newton
//! with the linear parameters projected out). The first two parameters are the centre.
//!
//! Whether it is the shape at all is asked of the residual in two ways, both against the noise that
//! the image itself shows: how much more of it there is, and how far the shape would have to be
//! deformed (curved edges, bulges, uneven blur ...) to explain it.

use nalgebra::{DMatrix, DVector};

use super::NoFinding;
use super::sums::{Brightness, LINEAR, accumulate};
use crate::image::Image8;
use crate::ncc::Window;

/// A shape with `N` parameters.
pub(super) trait PixelModel<const N: usize> {
    /// What all pixels share for given parameters.
    type Shared;

    /// What all pixels share.
    fn shared(&self, p: &[f64; N]) -> Self::Shared;

    /// Value (any unit), its derivatives by the parameters, and the pixel's weight (0 to 1).
    fn at(&self, shared: &Self::Shared, u: f64, v: f64, slopes: &mut [f64; N]) -> (f64, f64);

    /// Number of deformations of the shape that are tested.
    const DEFORMATIONS: usize;
    /// Deformation that is granted (print, lens, sensor, the model's own approximations), px.
    const GRANTED_PX: f64;

    /// What deformations by one pixel each would add to the value at a pixel; `out` is zero.
    fn deform(&self, p: &[f64; N], u: f64, v: f64, out: &mut [f64]);

    /// How far the window reaches from the centre in u and v, px.
    fn reach(&self, p: &[f64; N]) -> f64;

    /// Shortens a step, and keeps the parameters within bounds.
    fn advance(&self, p: &mut [f64; N], step: &[f64; N]);
}

/// A finished fit.
#[derive(Clone, Debug)]
pub(super) struct PixelFit<const N: usize> {
    pub parameters: [f64; N],
    /// Grey values per unit of the model's value, DN.
    pub gain_dn: f64,
    /// Correlation of model and image, 0 to 1.
    pub score: f64,
    pub rms_dn: f64,
    /// Weighted pixels less parameters.
    freedom: f64,
    light: Brightness,
    /// Standard deviation of the centre in each direction (root mean square of both), px.
    pub sigma_px: f64,
    /// Fraction of the window's pixels that are clipped.
    pub saturated: f64,
}

/// What every fitted shape must satisfy.
#[derive(Clone, Copy, Debug)]
pub(super) struct FitRules {
    pub min_contrast_dn: f64,
    pub max_blur_px: f64,
    pub min_score: f64,
    pub max_residual_fraction: f64,
    pub max_deformation: f64,
    pub noise_dn: f64,
    pub max_saturated_fraction: f64,
    pub max_sigma_px: f64,
    pub sigma_floor_px: f64,
}

/// [`FitRules`] from the fields of the same names of a detector's rules, with its limit of the blur.
macro_rules! fit_rules {
    ($rules:expr, $max_blur_px:expr) => {
        $crate::find::pixels::FitRules {
            min_contrast_dn: $rules.min_contrast_dn,
            max_blur_px: $max_blur_px,
            min_score: $rules.min_score,
            max_residual_fraction: $rules.max_residual_fraction,
            max_deformation: $rules.max_deformation,
            noise_dn: $rules.noise_dn,
            max_saturated_fraction: $rules.max_saturated_fraction,
            max_sigma_px: $rules.max_sigma_px,
            sigma_floor_px: $rules.sigma_floor_px,
        }
    };
}
pub(super) use fit_rules;

impl FitRules {
    /// Largest rms difference between model and image, DN, for the image's own noise and so many
    /// pixels.
    pub fn residual_limit_dn(&self, noise_dn: f64, contrast_dn: f64, freedom: f64) -> f64 {
        let noise_dn = noise_dn.min(self.noise_dn).max(QUANTISATION_DN);
        // the variance of a mean of n squares of noise is 2 / n
        let chance = 1.0 + RESIDUAL_SIGMAS * (2.0 / freedom).sqrt();
        let misfit_dn = self.max_residual_fraction * contrast_dn;
        (noise_dn * noise_dn * chance + misfit_dn * misfit_dn).sqrt()
    }
}

impl<const N: usize> PixelFit<N> {
    /// The standard deviation to state, px, if contrast, blur (the last parameter), score, residual,
    /// deformation, clipping and certainty are acceptable; `noise_dn` is the image's own.
    pub fn check<M: PixelModel<N>>(
        &self,
        image: &Image8,
        model: &M,
        contrast_dn: f64,
        noise_dn: f64,
        rules: &FitRules,
    ) -> Result<f64, NoFinding> {
        if !(contrast_dn >= rules.min_contrast_dn) {
            return Err(NoFinding::LowContrast {
                found_dn: contrast_dn,
                needed_dn: rules.min_contrast_dn,
            });
        }
        let blur_px = self.parameters[N - 1];
        if !(blur_px <= rules.max_blur_px) {
            return Err(NoFinding::Shape {
                what: "blur of the edge in px",
                found: blur_px,
                expected: format!("at most {:.2}", rules.max_blur_px),
            });
        }
        if !(self.score >= rules.min_score) {
            return Err(NoFinding::LowScore {
                score: self.score,
                limit: rules.min_score,
            });
        }
        let limit_dn = rules.residual_limit_dn(noise_dn, contrast_dn, self.freedom);
        if !(self.rms_dn <= limit_dn) {
            return Err(NoFinding::Misfit {
                rms_dn: self.rms_dn,
                limit_dn,
            });
        }
        if !(self.saturated <= rules.max_saturated_fraction) {
            return Err(NoFinding::Saturated {
                fraction: self.saturated,
                limit: rules.max_saturated_fraction,
            });
        }
        let noise_dn = noise_dn.min(rules.noise_dn).max(QUANTISATION_DN);
        let deformation = self.deformation(image, model, noise_dn)?;
        // where the shape is more deformed than noise explains, its place is as much less certain
        let sigma_px = (self.sigma_px * deformation.max(1.0)).hypot(rules.sigma_floor_px);
        if !(sigma_px <= rules.max_sigma_px) {
            return Err(NoFinding::Uncertain {
                sigma_px,
                limit_px: rules.max_sigma_px,
            });
        }
        if !(deformation <= rules.max_deformation) {
            return Err(NoFinding::Shape {
                what: "deformation over what noise explains",
                found: deformation,
                expected: format!("at most {}", rules.max_deformation),
            });
        }
        Ok(sigma_px)
    }

    /// Deformations of the shape that would explain the residual, root mean square, over what noise
    /// and the granted deformation explain: 1 or less for the shape itself.
    fn deformation<M: PixelModel<N>>(
        &self,
        image: &Image8,
        model: &M,
        noise_dn: f64,
    ) -> Result<f64, NoFinding> {
        let extra = M::DEFORMATIONS;
        let size = N + extra + LINEAR;
        let sums = accumulate(image, model, &self.parameters, self.light, extra)?;
        let singular = || NoFinding::NothingThere("a window too small to tell shapes apart".into());
        let mut normal = sums.matrix.view((0, 0), (size, size)).into_owned();
        hold(&mut normal, size - LINEAR);
        let right = DVector::from_fn(size, |i, _| sums.matrix[(i, size)]);
        let factor = normal.cholesky().ok_or_else(singular)?;
        let x = factor.solve(&right);
        let scale = 1.0 / self.gain_dn;
        let noise = noise_dn * scale;
        let covariance = factor.inverse().view((N, N), (extra, extra)) * (noise * noise);
        let granted = DMatrix::identity(extra, extra) * (M::GRANTED_PX * M::GRANTED_PX);
        let against = (covariance + granted).cholesky().ok_or_else(singular)?;
        let amplitudes = x.rows(N, extra) * scale;
        let ratio = amplitudes.dot(&against.solve(&amplitudes)) / extra as f64;
        Ok(ratio.max(0.0).sqrt())
    }
}

/// Residuals pass that noise alone exceeds by chance this many standard deviations away.
const RESIDUAL_SIGMAS: f64 = 4.0;

/// Largest sample of second differences that the noise is read from.
const NOISE_SAMPLE: usize = 20_000;
/// Surroundings of a window that help to read the noise, px.
const NOISE_MARGIN_PX: u32 = 16;

/// Standard deviation of the grey noise in and around a window, DN: the median size of the second
/// difference in u of the second difference in v, which smooth shading and straight edges along
/// the pixels do not change (mask of J. Immerkaer, "Fast noise variance estimation", 1996). Clipped
/// pixels are left out.
pub(crate) fn noise_dn(image: &Image8, window: Window) -> f64 {
    let m = NOISE_MARGIN_PX;
    let wide = Window {
        left: window.left.saturating_sub(m),
        top: window.top.saturating_sub(m),
        width: window.width.saturating_add(2 * m),
        height: window.height.saturating_add(2 * m),
    }
    .clipped(image);
    let (w, h) = (wide.width as usize, wide.height as usize);
    if w < 3 || h < 3 {
        return QUANTISATION_DN;
    }
    let row = |y: usize| {
        let start = (wide.top as usize + y) * image.width_px as usize + wide.left as usize;
        &image.pixels[start..start + w]
    };
    let every = ((w - 2) * (h - 2)).div_ceil(NOISE_SAMPLE);
    let mut counts = vec![0usize; 2049];
    let mut total = 0;
    for y in (1..h - 1).step_by(every) {
        let lines = [row(y - 1), row(y), row(y + 1)];
        for x in 1..w - 1 {
            let clipped = |p: u8| p == 0 || p >= SATURATION_DN;
            if lines
                .iter()
                .any(|l| l[x - 1..x + 2].iter().any(|&p| clipped(p)))
            {
                continue;
            }
            let second = |l: &[u8]| i32::from(l[x - 1]) - 2 * i32::from(l[x]) + i32::from(l[x + 1]);
            let mixed = second(lines[0]) - 2 * second(lines[1]) + second(lines[2]);
            counts[(mixed.unsigned_abs() as usize).min(2048)] += 1;
            total += 1;
        }
    }
    // the median of |x| of a normal x is 0.6745 sigma; the mask's weights have norm 6
    let mut below = 0;
    for (size, count) in counts.into_iter().enumerate() {
        if 2 * (below + count) >= total && count > 0 {
            let part = (0.5 * total as f64 - below as f64) / count as f64;
            let median = (size as f64 - 0.5 + part).max(0.0);
            return (median / (0.6745 * 6.0)).max(QUANTISATION_DN);
        }
        below += count;
    }
    QUANTISATION_DN
}

const MAX_STEPS: usize = 25;
/// A fit has settled when its step moves the centre by less, px.
const SETTLED_PX: f64 = 0.002;
/// After so many steps a fit that explains less than half of the grey values' variance is given up.
const PATIENCE: usize = 5;
const HOPELESS_SCORE: f64 = std::f64::consts::FRAC_1_SQRT_2;
/// Grey values from here on count as clipped, DN.
pub(super) const SATURATION_DN: u8 = 254;
/// Quantisation alone has this standard deviation, DN.
const QUANTISATION_DN: f64 = 0.29;
/// Least weight of a window, px.
const MIN_WEIGHT_PX: f64 = 16.0;

/// Adds the least that keeps a parameter without influence from making the equations singular.
fn hold(normal: &mut DMatrix<f64>, parameters: usize) {
    for i in 0..parameters {
        normal[(i, i)] *= 1.0 + 1e-6;
        normal[(i, i)] += 1e-9;
    }
}

/// Fits the shape from a start; the centre may move by `max_move_px` at most.
pub(super) fn fit_pixels<const N: usize, M: PixelModel<N>>(
    image: &Image8,
    model: &M,
    start: [f64; N],
    max_move_px: f64,
) -> Result<PixelFit<N>, NoFinding> {
    let mut p = start;
    let moved = |p: &[f64; N]| {
        let (du, dv) = (p[0] - start[0], p[1] - start[1]);
        (du * du + dv * dv).sqrt()
    };
    let diverged = |p: &[f64; N]| NoFinding::Diverged {
        moved_px: moved(p),
        limit_px: max_move_px,
    };
    let mut light = Brightness {
        offset: 1.0,
        gain: 0.0,
    };
    let size = N + LINEAR;
    for round in 0..MAX_STEPS {
        let sums = accumulate(image, model, &p, light, 0)?;
        let weight = sums.matrix[(size - 1, size - 1)];
        if weight < MIN_WEIGHT_PX {
            return Err(NoFinding::TooSmall {
                found_px: weight.sqrt(),
                needed_px: MIN_WEIGHT_PX.sqrt(),
            });
        }
        let mut normal = sums.matrix.view((0, 0), (size, size)).into_owned();
        hold(&mut normal, N + 2);
        let right = DVector::from_fn(size, |i, _| sums.matrix[(i, size)]);
        let factor = normal.cholesky().ok_or_else(|| diverged(&p))?;
        let x = factor.solve(&right);
        let (gain, offset) = (x[size - 2], x[size - 1]);
        if !x.iter().all(|x| x.is_finite()) || gain == 0.0 {
            return Err(diverged(&p));
        }
        let grey = sums.matrix[(size, size)];
        let sum = sums.matrix[(size - 1, size)];
        let residual = (grey - x.dot(&right)).max(0.0);
        let total = grey - sum * sum / weight;
        let score = (1.0 - residual / total.max(1e-9)).max(0.0).sqrt();
        if round >= PATIENCE && score < HOPELESS_SCORE {
            return Err(NoFinding::LowScore {
                score,
                limit: HOPELESS_SCORE,
            });
        }
        let mut step = [0.0; N];
        for (s, x) in step.iter_mut().zip(x.iter()) {
            *s = x / gain;
        }
        let before = p;
        model.advance(&mut p, &step);
        if !(moved(&p) <= max_move_px) {
            return Err(diverged(&p));
        }
        let (du, dv) = (p[0] - before[0], p[1] - before[1]);
        let rest = (2..N).fold(0.0f64, |m, i| m.max((p[i] - before[i]).abs()));
        if (du * du + dv * dv).sqrt() < SETTLED_PX && rest < 0.01 {
            let freedom = (weight - size as f64).max(1.0);
            let rms_dn = (residual / freedom).sqrt();
            let inverse = factor.inverse();
            let variance = 0.5 * (inverse[(0, 0)] + inverse[(1, 1)]);
            return Ok(PixelFit {
                parameters: p,
                gain_dn: gain,
                score,
                rms_dn,
                freedom,
                light,
                sigma_px: rms_dn.max(QUANTISATION_DN) * variance.max(0.0).sqrt() / gain.abs(),
                saturated: if sums.counted > 0.0 {
                    sums.saturated
                } else {
                    0.0
                },
            });
        }
        let size_dn = offset.abs() + gain.abs();
        light = Brightness {
            offset: offset / size_dn,
            gain: gain / size_dn,
        };
    }
    Err(diverged(&p))
}
