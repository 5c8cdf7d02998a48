//! Least squares of a shape's blurred image on grey values.
//!
//! Model: pixel = offset + gain * value(pixel; p). Gain and offset are solved for together with the
//! linearised change of p (Gauss-Newton with the linear parameters projected out). The first two
//! parameters are the centre.

use nalgebra::{DMatrix, DVector};

use super::NoFinding;
use crate::image::Image8;

/// A shape with `N` parameters.
pub(super) trait PixelModel<const N: usize> {
    /// Value (any unit), its derivatives by the parameters, and the pixel's weight (0 to 1).
    fn at(&self, p: &[f64; N], u: f64, v: f64, slopes: &mut [f64; N]) -> (f64, f64);

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
    /// Standard deviation of the centre in each direction (root mean square of both), px.
    pub sigma_px: f64,
    /// Fraction of the window's pixels that are clipped.
    pub saturated: f64,
}

const MAX_STEPS: usize = 25;
/// A fit has settled when its step moves the centre by less, px.
const SETTLED_PX: f64 = 0.002;
/// Grey values from here on count as clipped, DN.
const SATURATION_DN: u8 = 254;
/// Quantisation alone has this standard deviation, DN.
const QUANTISATION_DN: f64 = 0.29;
/// Least weight of a window, px.
const MIN_WEIGHT_PX: f64 = 16.0;

/// Normal equations over the window: `N` slopes, value, one, and the grey value last.
struct Sums {
    matrix: DMatrix<f64>,
    saturated: f64,
    counted: f64,
}

fn accumulate<const N: usize>(
    image: &Image8,
    model: &impl PixelModel<N>,
    p: &[f64; N],
) -> Result<Sums, NoFinding> {
    let reach = model.reach(p);
    let fits = |x: f64, size: u32| x - reach >= 0.0 && x + reach <= f64::from(size) - 1.0;
    if !(fits(p[0], image.width_px) && fits(p[1], image.height_px)) {
        return Err(NoFinding::OutsideImage {
            u_px: p[0],
            v_px: p[1],
        });
    }
    let range = |x: f64| (x - reach).ceil() as usize..=(x + reach).floor() as usize;
    let mut matrix = DMatrix::zeros(N + 3, N + 3);
    let mut column = vec![0.0; N + 3];
    let (mut saturated, mut counted) = (0.0, 0.0);
    for v in range(p[1]) {
        let row = &image.pixels[v * image.width_px as usize..][..image.width_px as usize];
        for u in range(p[0]) {
            let mut slopes = [0.0; N];
            let (value, weight) = model.at(p, u as f64, v as f64, &mut slopes);
            if !(weight > 0.0) {
                continue;
            }
            counted += 1.0;
            saturated += f64::from(u8::from(row[u] >= SATURATION_DN));
            column[..N].copy_from_slice(&slopes);
            column[N] = value;
            column[N + 1] = 1.0;
            column[N + 2] = f64::from(row[u]);
            for i in 0..N + 3 {
                let weighted = weight * column[i];
                for j in i..N + 3 {
                    matrix[(i, j)] += weighted * column[j];
                }
            }
        }
    }
    for i in 0..N + 3 {
        for j in 0..i {
            matrix[(i, j)] = matrix[(j, i)];
        }
    }
    Ok(Sums {
        matrix,
        saturated: saturated / f64::max(counted, 1.0),
        counted,
    })
}

/// Fits the shape from a start; the centre may move by `max_move_px` at most.
pub(super) fn fit_pixels<const N: usize>(
    image: &Image8,
    model: &impl PixelModel<N>,
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
    for _ in 0..MAX_STEPS {
        let sums = accumulate(image, model, &p)?;
        let size = N + 2;
        let weight = sums.matrix[(N + 1, N + 1)];
        if weight < MIN_WEIGHT_PX {
            return Err(NoFinding::TooSmall {
                found_px: weight.sqrt(),
                needed_px: MIN_WEIGHT_PX.sqrt(),
            });
        }
        let mut normal = sums.matrix.view((0, 0), (size, size)).into_owned();
        for i in 0..N {
            normal[(i, i)] *= 1.0 + 1e-6;
            normal[(i, i)] += 1e-9;
        }
        let right = DVector::from_fn(size, |i, _| sums.matrix[(i, N + 2)]);
        let factor = normal.cholesky().ok_or_else(|| diverged(&p))?;
        let x = factor.solve(&right);
        let gain = x[N];
        if !x.iter().all(|x| x.is_finite()) || gain == 0.0 {
            return Err(diverged(&p));
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
            let grey = sums.matrix[(N + 2, N + 2)];
            let sum = sums.matrix[(N + 1, N + 2)];
            let residual = (grey - x.dot(&right)).max(0.0);
            let total = grey - sum * sum / weight;
            let freedom = (weight - size as f64).max(1.0);
            let rms_dn = (residual / freedom).sqrt();
            let inverse = factor.inverse();
            let variance = 0.5 * (inverse[(0, 0)] + inverse[(1, 1)]);
            return Ok(PixelFit {
                parameters: p,
                gain_dn: gain,
                score: (1.0 - residual / total.max(1e-9)).max(0.0).sqrt(),
                rms_dn,
                sigma_px: rms_dn.max(QUANTISATION_DN) * variance.max(0.0).sqrt() / gain.abs(),
                saturated: if sums.counted > 0.0 {
                    sums.saturated
                } else {
                    0.0
                },
            });
        }
    }
    Err(diverged(&p))
}
