//! Weighted correlation search and subpixel alignment of a template with a warped image.
//!
//! Alignment is the efficient second-order minimisation of S. Benhimane and E. Malis (2004): a
//! Gauss-Newton step with the mean of the template's and the warped image's gradient. Grey values
//! are normalised to weighted mean zero and deviation one on both sides, weights are Gaussian.

use crate::error::TrackError;
use crate::patch::{HalfSize, Patch};
use crate::warp::PlaneWarp;
use nalgebra::{DMatrix, DVector, Matrix2, Vector2};
use rover_cameras::Camera;
use rover_vision::PreparedImage;

/// A template: grey values with a margin of one pixel for gradients, and the weights.
#[derive(Clone, Debug)]
pub struct Template {
    /// Half sizes of the compared window.
    pub half: HalfSize,
    patch: Patch,
    weights: Vec<f64>,
    normal: Normalised,
}

/// Bounds of the refinement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AlignRules {
    /// Longest step of one iteration, template px.
    pub max_step_px: f64,
    /// Farthest from the search's result, template px.
    pub max_shift_px: f64,
    /// Largest affine term.
    pub max_affine: f64,
    /// Iterations.
    pub iterations: usize,
    /// Smallest accepted deviation of the template's grey values, DN.
    pub min_texture_dn: f64,
}

impl Default for AlignRules {
    fn default() -> Self {
        Self {
            max_step_px: 1.0,
            max_shift_px: 3.5,
            max_affine: 0.6,
            iterations: 15,
            min_texture_dn: 1.5,
        }
    }
}

/// Which corrections the alignment may make.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Freedom {
    /// A shift.
    Translation,
    /// A shift and four affine terms.
    Affine,
}

/// Outcome of an alignment.
#[derive(Clone, Copy, Debug)]
pub struct Aligned {
    /// Shift of the template, template px: offset `d` is found at `shift + turn d`.
    pub shift: Vector2<f64>,
    /// Affine part.
    pub turn: Matrix2<f64>,
    /// Weighted correlation.
    pub score: f64,
    /// Covariance of the shift from the residuals, template px^2.
    pub covariance_px2: Matrix2<f64>,
}

#[derive(Clone, Debug)]
struct Normalised {
    values: Vec<f64>,
    deviation: f64,
}

fn weights(half: HalfSize) -> Vec<f64> {
    let spread = |x: i64, h: usize| (x as f64 / (0.7 * h as f64 + 0.5)).powi(2);
    let (hu, hv) = (half.u as i64, half.v as i64);
    let raw: Vec<f64> = (-hv..=hv)
        .flat_map(|v| {
            (-hu..=hu).map(move |u| (-0.5 * (spread(u, half.u) + spread(v, half.v))).exp())
        })
        .collect();
    let sum: f64 = raw.iter().sum();
    raw.iter().map(|w| w / sum).collect()
}

/// Normalises the inner part (a margin of one pixel left out) of a patch.
fn normalised(patch: &Patch, weights: &[f64]) -> Normalised {
    let inner = (1..patch.half.rows() - 1)
        .flat_map(|j| (1..patch.half.columns() - 1).map(move |i| patch.at(i, j)));
    let values: Vec<f64> = inner.collect();
    let mean: f64 = values.iter().zip(weights).map(|(x, w)| x * w).sum();
    let variance: f64 = values
        .iter()
        .zip(weights)
        .map(|(x, w)| w * (x - mean) * (x - mean))
        .sum();
    let deviation = variance.sqrt().max(1e-9);
    Normalised {
        values: values.iter().map(|x| (x - mean) / deviation).collect(),
        deviation,
    }
}

fn correlation(a: &Normalised, b: &Normalised, weights: &[f64]) -> f64 {
    a.values
        .iter()
        .zip(&b.values)
        .zip(weights)
        .map(|((x, y), w)| w * x * y)
        .sum()
}

impl Template {
    /// A template about `pixel_px` of an image.
    ///
    /// # Errors
    /// [`TrackError::OutsideImage`] if the window leaves the image.
    pub fn cut(
        image: &PreparedImage,
        pixel_px: &Vector2<f64>,
        half: HalfSize,
    ) -> Result<Self, TrackError> {
        let footprint = Matrix2::identity();
        let patch = Patch::by_map(image, half.grown(1), &footprint, |d| Some(pixel_px + d))
            .ok_or_else(|| TrackError::OutsideImage {
                u_px: pixel_px.x,
                v_px: pixel_px.y,
                columns: half.columns() + 2,
                rows: half.rows() + 2,
            })?;
        let weights = weights(half);
        let normal = normalised(&patch, &weights);
        Ok(Self {
            half,
            patch,
            weights,
            normal,
        })
    }

    /// Its weights, row by row; they sum to one.
    #[must_use]
    pub fn weights(&self) -> &[f64] {
        &self.weights
    }

    /// The same with only some of its pixels counting.
    #[must_use]
    pub fn masked(&self, counts: &[bool]) -> Self {
        let left = |(w, counts): (&f64, &bool)| if *counts { *w } else { 0.0 };
        let raw: Vec<f64> = self.weights.iter().zip(counts).map(left).collect();
        let sum: f64 = raw.iter().sum::<f64>().max(1e-12);
        let weights: Vec<f64> = raw.iter().map(|w| w / sum).collect();
        Self {
            half: self.half,
            normal: normalised(&self.patch, &weights),
            patch: self.patch.clone(),
            weights,
        }
    }

    /// Weighted standard deviation of its grey values, DN.
    #[must_use]
    pub fn deviation_dn(&self) -> f64 {
        self.normal.deviation
    }

    /// The offset (template px, whole) at which the template correlates best with `wide`, a patch
    /// larger than the template by the search's reach, and the correlation there. Also the best
    /// correlation farther than three pixels from it.
    #[must_use]
    pub fn search(&self, wide: &Patch) -> Option<(Vector2<f64>, f64, f64)> {
        let reach_u = wide.half.u.checked_sub(self.half.u)?;
        let reach_v = wide.half.v.checked_sub(self.half.v)?;
        let (columns, rows) = (self.half.columns(), self.half.rows());
        let mut scores = Vec::with_capacity((2 * reach_u + 1) * (2 * reach_v + 1));
        for j0 in 0..=2 * reach_v {
            for i0 in 0..=2 * reach_u {
                let (mut sum, mut squares, mut product) = (0.0, 0.0, 0.0);
                for j in 0..rows {
                    let start = (j0 + j) * wide.half.columns() + i0;
                    let there = &wide.values[start..start + columns];
                    let range = j * columns..(j + 1) * columns;
                    let w = &self.weights[range.clone()];
                    let t = &self.normal.values[range];
                    for ((x, w), t) in there.iter().zip(w).zip(t) {
                        let wx = w * x;
                        sum += wx;
                        squares += wx * x;
                        product += wx * t;
                    }
                }
                // the template's weighted mean is zero
                let variance = (squares - sum * sum).max(1e-9);
                scores.push((product / variance.sqrt(), i0, j0));
            }
        }
        let best = scores
            .iter()
            .copied()
            .fold(None::<(f64, usize, usize)>, |b, s| match b {
                Some(b) if b.0 >= s.0 => Some(b),
                _ if s.0.is_finite() => Some(s),
                other => other,
            })?;
        let second = scores
            .iter()
            .filter(|s| s.1.abs_diff(best.1).max(s.2.abs_diff(best.2)) > 3)
            .fold(-1.0_f64, |m, s| m.max(s.0));
        let shift = Vector2::new(
            best.1 as f64 - reach_u as f64,
            best.2 as f64 - reach_v as f64,
        );
        Some((shift, best.0, second))
    }

    /// Aligns the template with `image`; `sample(shift, turn)` resamples the image on the window
    /// grown by one pixel, with offset `d` taken at `shift + turn d`.
    ///
    /// # Errors
    /// [`TrackError::Diverged`] beyond the bounds, [`TrackError::NotVisible`] where the image has
    /// no values.
    pub fn align(
        &self,
        freedom: Freedom,
        rules: &AlignRules,
        sample: impl Fn(&Vector2<f64>, &Matrix2<f64>) -> Option<Patch>,
    ) -> Result<Aligned, TrackError> {
        let count = match freedom {
            Freedom::Translation => 2,
            Freedom::Affine => 6,
        };
        let (mut shift, mut turn) = (Vector2::zeros(), Matrix2::identity());
        let mut last = None;
        for _ in 0..rules.iterations {
            let patch = sample(&shift, &turn).ok_or(TrackError::NotVisible)?;
            let seen = normalised(&patch, &self.weights);
            let (hessian, gradient, residual) = self.normal_equations(&patch, &seen, count);
            let inverse = hessian.cholesky().ok_or(TrackError::Diverged {
                what: "texture, DN",
                found: self.normal.deviation,
                limit: rules.min_texture_dn,
            })?;
            let step = -inverse.solve(&gradient);
            let scale = (rules.max_step_px / step.rows(0, 2).norm().max(1e-12)).min(1.0);
            let step = step * scale;
            let d_shift = Vector2::new(step[0], step[1]);
            let d_turn = if count == 6 {
                Matrix2::new(1.0 + step[2], step[3], step[4], 1.0 + step[5])
            } else {
                Matrix2::identity()
            };
            shift += turn * d_shift;
            turn *= d_turn;
            let check = |what, found: f64, limit: f64| {
                if found <= limit {
                    Ok(())
                } else {
                    Err(TrackError::Diverged { what, found, limit })
                }
            };
            check("shift, px", shift.norm(), rules.max_shift_px)?;
            check(
                "affine term",
                (turn - Matrix2::identity()).abs().max(),
                rules.max_affine,
            )?;
            let corner = inverse.inverse().fixed_view::<2, 2>(0, 0).into_owned();
            // neighbouring residuals are not independent of each other: lens blur and
            // interpolation join about four pixels
            let effective = 0.25 * (self.half.columns() * self.half.rows()) as f64;
            let covariance_px2 = corner * (residual / effective);
            last = Some(covariance_px2);
            if d_shift.norm() < 2e-3 && (d_turn - Matrix2::identity()).abs().max() < 5e-4 {
                break;
            }
        }
        let patch = sample(&shift, &turn).ok_or(TrackError::NotVisible)?;
        let score = correlation(
            &self.normal,
            &normalised(&patch, &self.weights),
            &self.weights,
        );
        Ok(Aligned {
            shift,
            turn,
            score,
            covariance_px2: last.unwrap_or_else(Matrix2::identity),
        })
    }

    /// Hessian, gradient and weighted mean square residual at the present warp.
    fn normal_equations(
        &self,
        patch: &Patch,
        seen: &Normalised,
        count: usize,
    ) -> (DMatrix<f64>, DVector<f64>, f64) {
        let mut hessian = DMatrix::<f64>::zeros(count, count);
        let mut gradient = DVector::<f64>::zeros(count);
        let mut residual = 0.0;
        let (columns, rows) = (self.half.columns(), self.half.rows());
        let (ct, cs) = (0.25 / self.normal.deviation, 0.25 / seen.deviation);
        for j in 0..rows {
            for i in 0..columns {
                let k = j * columns + i;
                // half the central difference of each side
                let du = (self.patch.at(i + 2, j + 1) - self.patch.at(i, j + 1)) * ct
                    + (patch.at(i + 2, j + 1) - patch.at(i, j + 1)) * cs;
                let dv = (self.patch.at(i + 1, j + 2) - self.patch.at(i + 1, j)) * ct
                    + (patch.at(i + 1, j + 2) - patch.at(i + 1, j)) * cs;
                let (u, v) = (i as f64 - self.half.u as f64, j as f64 - self.half.v as f64);
                let row = [du, dv, du * u, du * v, dv * u, dv * v];
                let e = seen.values[k] - self.normal.values[k];
                let w = self.weights[k];
                residual += w * e * e;
                for a in 0..count {
                    gradient[a] += w * row[a] * e;
                    for b in 0..=a {
                        hessian[(a, b)] += w * row[a] * row[b];
                    }
                }
            }
        }
        for a in 0..count {
            for b in a + 1..count {
                hessian[(a, b)] = hessian[(b, a)];
            }
        }
        (hessian, gradient, residual)
    }
}

/// Searches for the template about where `warp` predicts it, within `reach` (template px), in the
/// affine tangent of the warp. Returns the pixel found, its correlation and the second best.
///
/// # Errors
/// [`TrackError::NotVisible`] or [`TrackError::OutsideImage`] when the search leaves the image.
pub fn search(
    template: &Template,
    image: &PreparedImage,
    camera: &Camera,
    warp: &PlaneWarp,
    reach: HalfSize,
) -> Result<(Vector2<f64>, f64, f64), TrackError> {
    let footprint = warp.jacobian(camera).ok_or(TrackError::NotVisible)?;
    let centre = warp
        .pixel(camera, &Vector2::zeros())
        .ok_or(TrackError::NotVisible)?;
    // as much of the search as the image holds
    let mut reach = reach;
    let wide = loop {
        let half = HalfSize {
            u: template.half.u + reach.u,
            v: template.half.v + reach.v,
        };
        let found = Patch::by_map(image, half, &footprint, |d| Some(centre + footprint * d));
        match found {
            Some(wide) => break wide,
            None if reach.u <= 2 && reach.v <= 2 => {
                return Err(TrackError::OutsideImage {
                    u_px: centre.x,
                    v_px: centre.y,
                    columns: half.columns(),
                    rows: half.rows(),
                });
            }
            None => {
                reach = HalfSize {
                    u: (reach.u * 4 / 5).max(2),
                    v: (reach.v * 4 / 5).max(2),
                }
            }
        }
    };
    let (shift, score, second) = template.search(&wide).ok_or(TrackError::NotVisible)?;
    Ok((centre + footprint * shift, score, second))
}

/// Refines a warp so that the template agrees with the image.
///
/// # Errors
/// As [`Template::align`].
pub fn refine(
    template: &Template,
    image: &PreparedImage,
    camera: &Camera,
    warp: &PlaneWarp,
    freedom: Freedom,
    rules: &AlignRules,
) -> Result<(PlaneWarp, Aligned), TrackError> {
    let grown = template.half.grown(1);
    let aligned = template.align(freedom, rules, |shift, turn| {
        Patch::warped(image, camera, &warp.adjusted(shift, turn)?, grown)
    })?;
    let refined = warp
        .adjusted(&aligned.shift, &aligned.turn)
        .ok_or(TrackError::NotVisible)?;
    Ok((refined, aligned))
}
