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
use super::window::{Gradients, LeftWindow, dot};
use super::{MatchFailure, MatchRules, PreparedImage};

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
    /// The epipolar direction in the left image.
    along: Vector2<f64>,
    planes: [Vec<f32>; 4],
    factor: nalgebra::linalg::Cholesky<f64, nalgebra::Const<6>>,
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
        let length = window.values.len();
        let mut planes = [
            vec![0.0; length],
            vec![0.0; length],
            vec![0.0; length],
            vec![0.0; length],
        ];
        for j in 0..window.side {
            let dv = fv + j as f32 * scale;
            for i in 0..window.side {
                let at = j * window.stride + i;
                let (gu, gv) = (gradients.u[at], gradients.v[at]);
                let e = au * gu + av * gv;
                planes[0][at] = e;
                planes[1][at] = e * (fu + i as f32 * scale);
                planes[2][at] = e * dv;
                planes[3][at] = bu * gu + bv * gv;
            }
        }
        let all: [&[f32]; 6] = [
            &planes[0],
            &planes[1],
            &planes[2],
            &planes[3],
            &window.values,
            &window.ones,
        ];
        let mut normal = Normal::zeros();
        for p in 0..6 {
            for q in p..6 {
                normal[(p, q)] = dot(all[p], all[q]);
                normal[(q, p)] = normal[(p, q)];
            }
        }
        normal[(3, 3)] += hold;
        // a window without gradient along one slope must not fail, only not move
        for k in 0..3 {
            normal[(k, k)] += 1e-3 * ASSUMED_NOISE_DN * ASSUMED_NOISE_DN;
        }
        Some(Self {
            slopes,
            along,
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
    let mut samples = vec![0.0f32; count];
    let mut padded = vec![0.0f32; window.values.len()];
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
        let matrix = link.matrix(&now.slopes);
        let origin = link.at
            + matrix * window.first
            + link.along * now.along_px
            + link.across * now.across_px;
        let inside = right.spline.sample_grid(
            [origin.x, origin.y],
            [matrix.m11, matrix.m21],
            [matrix.m12, matrix.m22],
            window.side,
            window.side,
            &mut samples,
        );
        if !inside {
            return Err(MatchFailure::CurveOutsideImage);
        }
        window.pad(&samples, &mut padded);
        let d = &derived.planes;
        let (cross, sum) = (dot(&window.values, &padded), dot(&window.ones, &padded));
        let mut right_side = SVector::<f64, 6>::from([
            dot(&d[0], &padded),
            dot(&d[1], &padded),
            dot(&d[2], &padded),
            dot(&d[3], &padded),
            cross,
            sum,
        ]);
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
        let square = dot(&padded, &padded);
        let residual = (square - x.dot(&right_side)).max(0.0) / (n - 6.0);
        let noise_square = residual / (RESAMPLED_NOISE + gain * gain);
        let felt = noise_square * (1.0 + gain * gain);
        let along = &derived.along;
        let inflation = window.inflation(&d[0], gradients, along, noise_square);
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
        now.along_px += step.along_px.clamp(-1.0, 1.0);
        now.slopes += step.slopes.map(|s| s.clamp(-0.3, 0.3));
        now.across_px += step.across_px.clamp(-1.0, 1.0);
        let moved = (now.along_px - start.along_px).abs();
        if !(moved <= rules.max_correction_px) {
            return Err(MatchFailure::Diverged {
                moved_px: moved,
                limit_px: rules.max_correction_px,
            });
        }
        if !(now.slopes.amax() <= rules.max_slope) {
            return Err(MatchFailure::TooSteep {
                slope: now.slopes.amax(),
                limit: rules.max_slope,
            });
        }
        let size = step
            .along_px
            .abs()
            .max(step.across_px.abs())
            .max(half * step.slopes.amax());
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
