//! A picture found in an image by normalised cross-correlation, plain or as a predicted pose would
//! show it, and refined by affine least-squares matching.

use nalgebra::{Matrix2, SMatrix, SVector, Vector2};
use serde::{Deserialize, Serialize};

use super::pixels::noise_dn;
use super::warp::{Appearance, Patch, warp};
use super::{Finding, NoFinding, cut, near, positive};
use crate::image::{Image8, ImageF};
use crate::ncc::{Peak, TemplatePyramid, Window, search_peaks};
use crate::sample::{Grid, SplineImage};

/// Thresholds of the template search.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TemplateRules {
    /// Least NCC, in the search and after refinement.
    pub min_score: f64,
    /// Least NCC after refinement, freed of what the grey noise of image and picture takes off it:
    /// how alike the surfaces are, however noisy they are seen.
    pub min_similarity: f64,
    /// Largest NCC of any other place, as a fraction of the best one's.
    pub uniqueness_ratio: f64,
    /// Resolutions of the search; 1 correlates at full resolution only.
    pub levels: usize,
    /// Whether rotation, scale and shear are fitted besides the position.
    pub affine: bool,
    /// Largest correction of the search's result by the fit, px.
    pub max_correction_px: f64,
    /// Largest change of any element of the affine matrix.
    pub max_affine_change: f64,
    /// Largest standard deviation of the result, px.
    pub max_sigma_px: f64,
    /// Smallest standard deviation that is ever claimed, px.
    pub sigma_floor_px: f64,
}

impl Default for TemplateRules {
    fn default() -> Self {
        Self {
            min_score: 0.7,
            min_similarity: 0.9,
            uniqueness_ratio: 0.9,
            levels: 3,
            affine: true,
            max_correction_px: 2.0,
            max_affine_change: 0.3,
            max_sigma_px: 0.2,
            sigma_floor_px: 0.005,
        }
    }
}

impl TemplateRules {
    fn validate(&self) -> Result<(), NoFinding> {
        for (name, x) in [
            ("min_score", self.min_score),
            ("min_similarity", self.min_similarity),
            ("uniqueness_ratio", self.uniqueness_ratio),
            ("levels", self.levels as f64),
            ("max_correction_px", self.max_correction_px),
            ("max_affine_change", self.max_affine_change),
            ("max_sigma_px", self.max_sigma_px),
            ("sigma_floor_px", self.sigma_floor_px),
        ] {
            positive("template rules", name, x)?;
        }
        Ok(())
    }
}

/// Finds a picture in a window of the image.
///
/// # Errors
/// [`NoFinding`] with the rule that refused.
pub fn template(
    image: &Image8,
    picture: &Image8,
    window: Window,
    rules: &TemplateRules,
) -> Result<Finding, NoFinding> {
    picture.validate()?;
    let patch = Patch {
        width: picture.width_px as usize,
        height: picture.height_px as usize,
        values: picture.pixels.iter().map(|&p| f32::from(p)).collect(),
        mask: None,
        offset: Vector2::zeros(),
    };
    let whole = Window::whole(picture);
    let noises = [noise_dn(image, window), noise_dn(picture, whole)];
    find(image, &patch, window, noises, rules)
}

/// Finds a flat picture within `radius_px` of where its predicted appearance puts it, comparing the
/// image with the picture warped accordingly.
///
/// # Errors
/// [`NoFinding`] with the rule that refused.
pub fn warped_template(
    image: &Image8,
    picture: &Image8,
    appearance: &Appearance,
    radius_px: f64,
    rules: &TemplateRules,
) -> Result<Finding, NoFinding> {
    image.validate()?;
    picture.validate()?;
    let (patch, place) = warp(picture, appearance)?;
    let (half_u, half_v) = (patch.width as f64 / 2.0, patch.height as f64 / 2.0);
    let middle = place - patch.offset;
    let high = near(image, [middle.x, middle.y], radius_px + half_v + 1.0)?;
    let across = near(image, [middle.x, middle.y], radius_px + half_u + 1.0)?;
    let window = Window {
        left: across.left,
        width: across.width,
        top: high.top,
        height: high.height,
    };
    let whole = Window::whole(picture);
    let noises = [noise_dn(image, window), noise_dn(picture, whole)];
    find(image, &patch, window, noises, rules)
}

/// Peaks closer than this are one place, px.
const SAME_PLACE_PX: f64 = 3.0;

fn find(
    image: &Image8,
    patch: &Patch,
    window: Window,
    noises_dn: [f64; 2],
    rules: &TemplateRules,
) -> Result<Finding, NoFinding> {
    image.validate()?;
    rules.validate()?;
    let pyramid = TemplatePyramid::new(
        patch.width,
        patch.height,
        &patch.values,
        patch.mask.as_deref(),
        rules.levels,
    )
    .map_err(|e| NoFinding::BadInput(e.to_string()))?;
    let peaks = search_peaks(image, &pyramid, window);
    let best = peaks.first().ok_or(NoFinding::BadInput(format!(
        "the template has {} x {} px, the searched window {} x {} px",
        patch.width, patch.height, window.width, window.height
    )))?;
    let low = |score: f64| NoFinding::LowScore {
        score,
        limit: rules.min_score,
    };
    if best.score < rules.min_score {
        return Err(low(best.score));
    }
    let elsewhere = peaks[1..].iter().find(|p| {
        let (du, dv) = (p.u_px - best.u_px, p.v_px - best.v_px);
        du * du + dv * dv > SAME_PLACE_PX * SAME_PLACE_PX
    });
    if let Some(second) = elsewhere
        && second.score > rules.uniqueness_ratio * best.score
    {
        return Err(NoFinding::NotUnique {
            best: best.score,
            second: second.score,
            limit: rules.uniqueness_ratio,
        });
    }
    let found = refine(image, patch, best, noises_dn, rules)?;
    if found.score < rules.min_score {
        return Err(low(found.score));
    }
    if found.sigma_px > rules.max_sigma_px {
        return Err(NoFinding::Uncertain {
            sigma_px: found.sigma_px,
            limit_px: rules.max_sigma_px,
        });
    }
    Ok(found)
}

const MAX_STEPS: usize = 20;
/// A fit has settled when a step moves the middle by less, px.
const SETTLED_PX: f64 = 0.002;
/// Room around the patch that the fit may use, px.
const ROOM_PX: u32 = 12;

/// Affine least-squares matching from a peak, with gain, offset and a ramp of light. Derivatives are the template's, so that their noise
/// is independent of the image's.
fn refine(
    image: &Image8,
    patch: &Patch,
    peak: &Peak,
    noises_dn: [f64; 2],
    rules: &TemplateRules,
) -> Result<Finding, NoFinding> {
    let (w, h) = (patch.width, patch.height);
    let (half_u, half_v) = ((w as f64 - 1.0) / 2.0, (h as f64 - 1.0) / 2.0);
    let outside = || NoFinding::OutsideImage {
        u_px: peak.u_px,
        v_px: peak.v_px,
    };
    let room = f64::from(ROOM_PX);
    let clamp = |x: f64, size: u32| x.clamp(0.0, f64::from(size)) as u32;
    let left = clamp((peak.u_px - half_u - room).floor(), image.width_px);
    let top = clamp((peak.v_px - half_v - room).floor(), image.height_px);
    let right = clamp((peak.u_px + half_u + room).ceil() + 1.0, image.width_px);
    let bottom = clamp((peak.v_px + half_v + room).ceil() + 1.0, image.height_px);
    let part = cut(
        image,
        Window {
            left,
            top,
            width: right - left,
            height: bottom - top,
        },
    )?;
    let spline = SplineImage::new(&ImageF::from_image8(&part)?);
    let corner = Vector2::new(f64::from(left), f64::from(top));
    let scale = 1.0 / half_u.max(half_v).max(1.0);

    let Slopes { rows, inflation } = slopes(patch, scale, noises_dn[1]);
    let mut normal = SMatrix::<f64, 10, 10>::zeros();
    for (_, row) in &rows {
        normal.ger(1.0, row, row, 1.0);
    }
    let n = normal[(7, 7)];
    if n < 24.0 {
        return Err(NoFinding::TooSmall {
            found_px: n.sqrt(),
            needed_px: 24f64.sqrt(),
        });
    }
    let (mean, square) = (normal[(6, 7)] / n, normal[(6, 6)]);
    let patch_variance = square - n * mean * mean;
    if !rules.affine {
        for i in 2..6 {
            normal.fill_row(i, 0.0);
            normal.fill_column(i, 0.0);
            normal[(i, i)] = 1.0;
        }
    }
    for i in 0..6 {
        normal[(i, i)] += 1e-6 * patch_variance / n + 1e-9;
    }
    let factor = normal.cholesky().ok_or(NoFinding::LowContrast {
        found_dn: (patch_variance / n).max(0.0).sqrt(),
        needed_dn: 1.0,
    })?;

    let start = Vector2::new(peak.u_px, peak.v_px);
    let (mut centre, mut matrix) = (start, Matrix2::<f64>::identity());
    let mut samples = vec![0.0f32; w * h];
    for _ in 0..MAX_STEPS {
        let grid = Grid {
            origin: centre - corner - matrix * Vector2::new(half_u, half_v),
            step_u: matrix.column(0).into(),
            step_v: matrix.column(1).into(),
        };
        if !spline.sample_grid(&grid, w, h, w, &mut samples) {
            return border_peak(patch, peak, patch_variance, &rows, rules).ok_or_else(outside);
        }
        let mut right_side = SVector::<f64, 10>::zeros();
        let (mut sum, mut squares) = (0.0, 0.0);
        for (k, row) in &rows {
            let y = f64::from(samples[*k]);
            right_side.axpy(y, row, 1.0);
            sum += y;
            squares += y * y;
        }
        if !rules.affine {
            for i in 2..6 {
                right_side[i] = 0.0;
            }
        }
        let x = factor.solve(&right_side);
        let gain = x[6];
        if !(gain > 0.05 && x.iter().all(|x| x.is_finite())) {
            return Err(NoFinding::LowScore {
                score: 0.0,
                limit: rules.min_score,
            });
        }
        // image(W(d)) = gain T(d + step): the warp goes against the step
        let shift = -Vector2::new(x[0], x[1]) / gain;
        let change = -Matrix2::new(x[2], x[3], x[4], x[5]) * (scale / gain);
        let limit = |s: f64| s.clamp(-1.0, 1.0);
        centre += matrix * shift.map(limit);
        matrix *= Matrix2::identity() + change.map(|c| c.clamp(-0.1, 0.1));
        let moved = (centre - start).norm();
        if !(moved <= rules.max_correction_px) {
            return Err(NoFinding::Diverged {
                moved_px: moved,
                limit_px: rules.max_correction_px,
            });
        }
        let warp = (matrix - Matrix2::identity()).amax();
        if !(warp <= rules.max_affine_change) {
            return Err(NoFinding::Shape {
                what: "change of the affine map",
                found: warp,
                expected: format!("at most {}", rules.max_affine_change),
            });
        }
        if shift.norm() < SETTLED_PX && change.amax() / scale < 4.0 * SETTLED_PX {
            let cross = right_side[6] - mean * sum;
            let variance = squares - sum * sum / n;
            let score = cross / (patch_variance * variance).max(1e-12).sqrt();
            let [image_part, patch_part] = [
                signal_part(variance / n, noises_dn[0]),
                signal_part(patch_variance / n, noises_dn[1]),
            ];
            let similarity = score / (image_part * patch_part).sqrt();
            if !(similarity >= rules.min_similarity) {
                return Err(NoFinding::LowScore {
                    score: similarity,
                    limit: rules.min_similarity,
                });
            }
            let residual = (squares - x.dot(&right_side)).max(0.0) / (n - 10.0).max(1.0);
            let inverse = factor.inverse();
            let spread = 0.5 * (inverse[(0, 0)] + inverse[(1, 1)]);
            // the template carries noise of its own: both images count
            let sigma = (residual.max(0.08) * spread).sqrt() / gain * inflation;
            let floor = rules.sigma_floor_px;
            let at = centre + matrix * patch.offset;
            return Ok(Finding::at(
                at.x,
                at.y,
                score,
                (sigma * sigma + floor * floor).sqrt(),
            ));
        }
    }
    Err(NoFinding::Diverged {
        moved_px: (centre - start).norm(),
        limit_px: rules.max_correction_px,
    })
}

/// The picture's part of the fit.
struct Slopes {
    /// By pixel of the patch: derivatives by u, v and the four affine elements, then value, one and
    /// a ramp of light (x, y).
    rows: Vec<(usize, SVector<f64, 10>)>,
    /// What the noise in the derivatives adds to the standard deviation, as a factor.
    inflation: f64,
}

/// Noise of the central difference, (f(1) - f(-1)) / 2, in squares of the pixels' noise; of the same
/// averaged over three lines with weights 1, 2, 1; and what both have in common.
const PLAIN_NOISE: f64 = 0.5;
const SMOOTH_NOISE_IN_COMMON: f64 = 0.25;
/// Part of the squared derivatives that noise may make up before they are averaged across.
const NOISY: f64 = 0.2;

/// Derivatives of the picture where it and its neighbours are. With g the true derivative and d the
/// noisy one that the fit uses, its variance is that of exact derivatives times
/// (d.d)(g.g) / (d.g)^2: noise in d not only weakens it but lets the normal equations, which hold
/// d.d, promise too much.
fn slopes(patch: &Patch, scale: f64, noise_dn: f64) -> Slopes {
    let (w, h) = (patch.width, patch.height);
    let (half_u, half_v) = ((w as f64 - 1.0) / 2.0, (h as f64 - 1.0) / 2.0);
    let on = |i: usize, j: usize| patch.mask.as_ref().is_none_or(|m| m[j * w + i]);
    let at = |i: usize, j: usize| f64::from(patch.values[j * w + i]);
    let plain = |i: usize, j: usize| {
        let gu = 0.5 * (at(i + 1, j) - at(i - 1, j));
        let gv = 0.5 * (at(i, j + 1) - at(i, j - 1));
        (gu, gv)
    };
    let smooth = |i: usize, j: usize| {
        let gu = |j: usize| at(i + 1, j) - at(i - 1, j);
        let gv = |i: usize| at(i, j + 1) - at(i, j - 1);
        (
            0.125 * (gu(j - 1) + 2.0 * gu(j) + gu(j + 1)),
            0.125 * (gv(i - 1) + 2.0 * gv(i) + gv(i + 1)),
        )
    };
    let mut places = Vec::with_capacity(w * h);
    for j in 1..h.saturating_sub(1) {
        for i in 1..w.saturating_sub(1) {
            if on(i, j) && on(i - 1, j) && on(i + 1, j) && on(i, j - 1) && on(i, j + 1) {
                places.push((i, j));
            }
        }
    }
    let square = |(a, b): (f64, f64)| a * a + b * b;
    let plain_square: f64 = places.iter().map(|&(i, j)| square(plain(i, j))).sum();
    let noise = 2.0 * places.len() as f64 * noise_dn * noise_dn;
    let is_noisy = PLAIN_NOISE * noise > NOISY * plain_square;
    let (mut own, mut common) = (0.0, 0.0);
    let mut rows = Vec::with_capacity(places.len());
    for (i, j) in places {
        let exact = plain(i, j);
        // a picture with a mask is warped, which has averaged it already
        let used = if is_noisy && patch.mask.is_none() {
            smooth(i, j)
        } else {
            exact
        };
        own += square(used);
        common += used.0 * exact.0 + used.1 * exact.1;
        let (gu, gv) = used;
        let (x, y) = ((i as f64 - half_u) * scale, (j as f64 - half_v) * scale);
        let row = [gu, gv, gu * x, gu * y, gv * x, gv * y, at(i, j), 1.0, x, y];
        rows.push((j * w + i, SVector::from(row)));
    }
    let shared = if is_noisy && patch.mask.is_none() {
        SMOOTH_NOISE_IN_COMMON
    } else {
        PLAIN_NOISE
    };
    let signal = (common - shared * noise).max((1.0 - MOST_NOISE) * common);
    Slopes {
        rows,
        inflation: if signal > 0.0 { own / signal } else { 1.0 },
    }
}

/// Noise is never held responsible for more than this part of a window's variance.
const MOST_NOISE: f64 = 0.6;

/// The part of a window's variance that is not noise.
fn signal_part(variance: f64, noise_dn: f64) -> f64 {
    1.0 - (noise_dn * noise_dn / variance.max(1e-9)).min(MOST_NOISE)
}

/// Sigma granted to a peak at the image border, which cannot be fitted, px.
const UNFITTED_SIGMA_PX: f64 = 0.15;

/// A peak so close to the border that the fit has no room: the search's own subpixel result.
fn border_peak(
    patch: &Patch,
    peak: &Peak,
    variance: f64,
    rows: &[(usize, SVector<f64, 10>)],
    rules: &TemplateRules,
) -> Option<Finding> {
    let slopes: f64 = rows.iter().map(|(_, r)| r[0] * r[0] + r[1] * r[1]).sum();
    let noise = variance * (1.0 / (peak.score * peak.score) - 1.0).max(0.0) / rows.len() as f64;
    let sigma = (noise * 2.0 / slopes.max(1e-9)).sqrt();
    let sigma = (sigma * sigma + UNFITTED_SIGMA_PX * UNFITTED_SIGMA_PX).sqrt();
    (sigma <= rules.max_sigma_px && peak.score >= rules.min_similarity).then(|| {
        Finding::at(
            peak.u_px + patch.offset.x,
            peak.v_px + patch.offset.y,
            peak.score,
            sigma,
        )
    })
}
