//! Least-squares matching of one window with the epipolar geometry built in.
//!
//! Model: right(W(d)) = alpha left(d) + beta, W(d) = at + base d + along (p0 + p1 du + p2 dv) +
//! across q. Derivatives come from the left window's gradient, taken once, so that their noise is
//! independent of the resampled right window and the estimate has no noise-induced bias (inverse
//! compositional idea of Baker and Matthews, with additive updates). What their noise does to steps
//! and to the stated deviation is put right, and where it is large they are smoothed, see
//! [`LeftWindow`]; the noise is read from the residual.

use nalgebra::{SMatrix, SVector, Vector2};

use super::link::Link;
use super::window::{Gradients, LeftWindow, Overlap, dots};
use super::{MatchFailure, MatchRules, PreparedImage};
use crate::sample::Grid;

/// Where a fit starts and what it ends with, relative to a [`Link`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Displacement {
    /// Along the epipolar direction, px.
    pub along_px: f64,
    /// Change of `along_px` per pixel of the left image, in u and v.
    pub slopes: Vector2<f64>,
    /// Across the epipolar direction, px.
    pub across_px: f64,
}

impl Displacement {
    /// Where the right image shows the window's pixels.
    fn grid(&self, link: &Link, window: &LeftWindow) -> Grid {
        let matrix = link.matrix(&self.slopes);
        let shift = link.along * self.along_px + link.across * self.across_px;
        Grid {
            origin: link.at + matrix * window.first + shift,
            step_u: matrix.column(0).into(),
            step_v: matrix.column(1).into(),
        }
    }

    /// Adds a step, cut where it is so large that the linear fit cannot hold.
    fn go(&mut self, step: &Self) {
        self.along_px += step.along_px.clamp(-1.0, 1.0);
        self.slopes += step.slopes.map(|s| s.clamp(-0.3, 0.3));
        self.across_px += step.across_px.clamp(-1.0, 1.0);
    }

    /// How far a step moves the middle or the edge of a window of this half side, px.
    fn size_px(&self, half: f64) -> f64 {
        let middle = self.along_px.abs().max(self.across_px.abs());
        middle.max(half * self.slopes.amax())
    }

    /// Whether a fit has stayed near its start and on a surface that is not too steep.
    fn check(&self, start: &Self, rules: &MatchRules) -> Result<(), MatchFailure> {
        let moved_px = (self.along_px - start.along_px).abs();
        if !(moved_px <= rules.max_correction_px) {
            return Err(MatchFailure::Diverged {
                moved_px,
                limit_px: rules.max_correction_px,
            });
        }
        if !(self.slopes.amax() <= rules.max_slope) {
            return Err(MatchFailure::TooSteep {
                slope: self.slopes.amax(),
                limit: rules.max_slope,
            });
        }
        Ok(())
    }
}

/// A finished fit.
#[derive(Clone, Copy, Debug)]
pub(super) struct Refined {
    pub displacement: Displacement,
    /// NCC of the fitted windows.
    pub score: f64,
    /// Standard deviation of `along_px`, px.
    pub sigma_px: f64,
    /// Root mean square difference between the windows, DN of the right image.
    pub residual_dn: f64,
    /// Standard deviations of the left and the right window, DN.
    pub deviations_dn: [f64; 2],
    /// Side of the window, px.
    pub side_px: usize,
}

const MAX_STEPS: usize = 20;
/// Steps after which only half of each is taken.
const FULL_STEPS: usize = 8;
/// A fit has settled when a step moves window middle and edges by less, px.
const SETTLED_PX: f64 = 0.002;
/// Below this a step settles the fit too if all that would follow, to judge by the last two, add
/// up to less than a settled one.
const NEARLY_SETTLED_PX: f64 = 0.01;
/// Slopes that change by more than this since the derivatives were taken have them taken anew.
const RELINEARISE_SLOPE: f64 = 0.03;
/// Grey noise assumed when the offset across the curve is held, DN.
const ASSUMED_NOISE_DN: f64 = 2.0;
/// Steps after which the residual tells the noise.
const FIRST_STEPS: usize = 2;
/// Derivatives that promise this much more than they hold are smoothed if that helps.
const NOISY: f64 = 1.1;
/// Least gain between the windows.
const MIN_GAIN: f64 = 0.2;

/// Part of white noise's variance that resampling leaves, on the average over places between the
/// pixels: the square of the integral of the squared cubic cardinal spline (one per axis). What it
/// takes away is not in the residual, but the fit, which is smooth, feels the noise in full.
const RESAMPLED_NOISE: f64 = 0.764;

type Normal = SMatrix<f64, 6, 6>;

/// Derivatives by the four geometric parameters, one padded plane each, and the normal matrix.
struct Derivatives {
    slopes: Vector2<f64>,
    /// The derivatives along the epipolar direction beside the true ones.
    overlap: Overlap,
    planes: [Vec<f32>; 4],
    factor: nalgebra::linalg::Cholesky<f64, nalgebra::Const<6>>,
}

/// The columns of the linear fit: four derivatives, gain and offset.
#[inline(always)]
fn columns<'a>(planes: &'a [Vec<f32>; 4], window: &'a LeftWindow) -> [&'a [f32]; 6] {
    let [a, b, c, d] = planes;
    [a, b, c, d, &window.values, &window.ones]
}

impl Derivatives {
    #[inline(always)]
    fn new(
        window: &LeftWindow,
        gradients: &Gradients,
        link: &Link,
        slopes: Vector2<f64>,
        hold: f64,
    ) -> Option<Self> {
        // gradient in the right image = A^-T gradient in the left one
        let inverse = link.matrix(&slopes).try_inverse()?;
        let (along, across) = (inverse * link.along, inverse * link.across);
        let (au, av) = (along.x as f32, along.y as f32);
        let (bu, bv) = (across.x as f32, across.y as f32);
        let scale = 1.0 / window.half as f32;
        let (fu, fv) = (window.first.x as f32 * scale, window.first.y as f32 * scale);
        let (length, stride) = (window.values.len(), window.stride);
        let mut planes = [(); 4].map(|()| vec![0.0f32; length]);
        // the gradients in the padding are zero, and so are the derivatives
        let rows = (0..length).step_by(stride).map(|at| at..at + stride);
        for (j, row) in rows.enumerate() {
            let dv = fv + j as f32 * scale;
            let (gu, gv) = (&gradients.u[row.clone()], &gradients.v[row.clone()]);
            let [p, q, r, s] = planes.each_mut().map(|plane| &mut plane[row.clone()]);
            for i in 0..stride {
                let e = au * gu[i] + av * gv[i];
                p[i] = e;
                q[i] = e * (fu + i as i32 as f32 * scale);
                r[i] = e * dv;
                s[i] = bu * gu[i] + bv * gv[i];
            }
        }
        let all = columns(&planes, window);
        let mut normal = Normal::zeros();
        for (p, one) in all.iter().enumerate() {
            normal.set_column(p, &dots(all, one).into());
        }
        normal[(3, 3)] += hold;
        // a window without gradient along one slope must not fail, only not move
        for k in 0..3 {
            normal[(k, k)] += 1e-3 * ASSUMED_NOISE_DN * ASSUMED_NOISE_DN;
        }
        Some(Self {
            slopes,
            overlap: window.overlap(&planes[0], gradients, &along),
            planes,
            factor: normal.cholesky()?,
        })
    }
}

/// Fits the displacement from a start.
pub(super) fn refine(
    window: &LeftWindow,
    right: &PreparedImage,
    link: &Link,
    start: Displacement,
    rules: &MatchRules,
) -> Result<Refined, MatchFailure> {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { refine_avx2(window, right, link, start, rules) };
    }
    refine_plain(window, right, link, start, rules)
}

/// The same with wider vectors.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn refine_avx2(
    window: &LeftWindow,
    right: &PreparedImage,
    link: &Link,
    start: Displacement,
    rules: &MatchRules,
) -> Result<Refined, MatchFailure> {
    refine_plain(window, right, link, start, rules)
}

#[inline(always)]
fn refine_plain(
    window: &LeftWindow,
    right: &PreparedImage,
    link: &Link,
    start: Displacement,
    rules: &MatchRules,
) -> Result<Refined, MatchFailure> {
    let hold = (ASSUMED_NOISE_DN / rules.epipolar_sigma_px).powi(2);
    let singular = || MatchFailure::NoTexture {
        found_dn: window.deviation_dn,
        needed_dn: rules.min_texture_dn,
    };
    let half = window.half as f64;
    let count = window.side * window.side;
    let mut now = start;
    let mut samples = vec![0.0f32; window.values.len()];
    let mut quieter: Option<Gradients> = None;
    let mut is_noise_settled = false;
    let mut last_size = 0.0;
    let mut derivatives: Option<Derivatives> = None;
    for taken in 0..MAX_STEPS {
        let gradients = quieter.as_ref().unwrap_or(&window.exact);
        let derived = match derivatives.take() {
            Some(kept) => kept,
            None => {
                Derivatives::new(window, gradients, link, now.slopes, hold).ok_or_else(singular)?
            }
        };
        let (grid, side) = (now.grid(link, window), window.side);
        let right = &right.spline;
        if !right.sample_grid(&grid, side, side, window.stride, &mut samples) {
            return Err(MatchFailure::CurveOutsideImage);
        }
        window.centre(&mut samples);
        let [a, b, c, d, values, ones] = columns(&derived.planes, window);
        let sums = dots([a, b, c, d, values, ones, &samples], &samples);
        let [a, b, c, d, cross, sum, square] = sums;
        let mut right_side = SVector::<f64, 6>::from([a, b, c, d, cross, sum]);
        right_side[3] += now.across_px * hold;
        let x = derived.factor.solve(&right_side);
        let gain = x[4];
        if !(gain >= MIN_GAIN) {
            return Err(MatchFailure::LowScore {
                score: 0.0,
                limit: rules.min_score,
            });
        }
        // the residual is noise of both windows
        let n = count as f64;
        let residual = (square - x.dot(&right_side)).max(0.0) / (n - 6.0);
        let noise_square = residual / (RESAMPLED_NOISE + gain * gain);
        let felt = noise_square * (1.0 + gain * gain);
        let inflation = derived.overlap.inflation(noise_square);
        // the noise of the left values takes as much from the gain
        let gain = gain / window.signal_part(noise_square);
        if !is_noise_settled && inflation > NOISY && taken >= FIRST_STEPS {
            is_noise_settled = true;
            quieter = window.quieter_gradients(noise_square);
            if quieter.is_some() {
                continue;
            }
        }
        // Derivatives of the left window alone may overshoot for ever about the right answer.
        let part = if taken < FULL_STEPS {
            inflation
        } else {
            0.5 * inflation
        };
        let step = Displacement {
            along_px: -x[0] / gain * part,
            slopes: Vector2::new(-x[1], -x[2]) / (gain * half) * part,
            across_px: -x[3] / gain * part,
        };
        now.go(&step);
        now.check(&start, rules)?;
        let size = step.size_px(half);
        let shrinking = size / last_size;
        let is_next_settled = shrinking < 1.0
            && size < NEARLY_SETTLED_PX
            && size * shrinking < SETTLED_PX * (1.0 - shrinking);
        last_size = size;
        if size < SETTLED_PX || is_next_settled {
            let variance = square - sum * sum / n;
            let score = cross / (window.square * variance).sqrt();
            let inverse = derived.factor.inverse();
            let sigma = (felt.max(0.1) * inverse[(0, 0)]).sqrt() * inflation / gain;
            return Ok(Refined {
                displacement: now,
                score,
                sigma_px: sigma.hypot(rules.sigma_floor_px),
                residual_dn: residual.sqrt(),
                deviations_dn: [window.deviation_dn, (variance / n).max(0.0).sqrt()],
                side_px: window.side,
            });
        }
        if (now.slopes - derived.slopes).amax() <= RELINEARISE_SLOPE {
            derivatives = Some(derived);
        }
    }
    Err(MatchFailure::Diverged {
        moved_px: (now.along_px - start.along_px).abs(),
        limit_px: rules.max_correction_px,
    })
}
