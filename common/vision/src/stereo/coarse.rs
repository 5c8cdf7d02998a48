//! Whole-pixel search along the epipolar curve, for a few surface slants.

use nalgebra::{Matrix2, Vector2, Vector3};
use rover_cameras::Camera;

use super::link::Link;
use super::{MatchFailure, MatchRules, PreparedImage};
use crate::ncc::{Template, score_map};
use crate::sample::{CHUNK, Grid};

/// A place on the epipolar curve that looks like the window around the pixel.
#[derive(Clone, Copy, Debug)]
pub(super) struct CoarseMatch {
    /// Inverse range of the nearest point of the epipolar curve, 1/m.
    pub inverse_range: f64,
    /// Whole pixel, refined along the curve by a parabola.
    pub pixel: Vector2<f64>,
    pub score: f64,
    /// Slant hypothesis that scored best (0: facing the camera).
    pub hypothesis: usize,
}

/// One whole pixel on the curve.
struct Stop {
    u: usize,
    v: usize,
    inverse_range: f64,
}

/// The whole pixels along the epipolar curve of `pixel` between the rules' ranges.
fn stops(
    a: &Camera,
    b: &Camera,
    image: &PreparedImage,
    pixel: &Vector2<f64>,
    rules: &MatchRules,
) -> Result<Vec<Stop>, MatchFailure> {
    let ray = a.ray(pixel).map_err(MatchFailure::camera)?;
    let (far, near) = (1.0 / rules.range_max_m, 1.0 / rules.range_min_m);
    // knots of a quadratic in the inverse range; the curve's bend is slight
    let at = |x: f64| b.project(&ray.at(1.0 / x)).map_err(MatchFailure::camera);
    let (p0, p1, p2) = (at(far)?, at(0.5 * (far + near))?, at(near)?);
    let length = (p1 - p0).norm() + (p2 - p1).norm();
    let count = (length.ceil() as usize).clamp(2, 4096);
    let half = f64::from(rules.half_search_window_px);
    let mut list: Vec<Stop> = Vec::with_capacity(count + 1);
    let step = 1.0 / count as f64;
    for k in 0..=count {
        let s = k as f64 * step;
        let (w0, w1, w2) = (
            (2.0 * s - 1.0) * (s - 1.0),
            4.0 * s * (1.0 - s),
            s * (2.0 * s - 1.0),
        );
        let p = p0 * w0 + p1 * w1 + p2 * w2;
        let fits = |x: f64, size: u32| x >= half - 0.5 && x + half < f64::from(size) - 0.5;
        if !(fits(p.x, image.width_px) && fits(p.y, image.height_px)) {
            continue;
        }
        let (u, v) = ((p.x + 0.5) as usize, (p.y + 0.5) as usize); // the nearest pixel
        if list.last().is_none_or(|last| (last.u, last.v) != (u, v)) {
            list.push(Stop {
                u,
                v,
                inverse_range: far + s * (near - far),
            });
        }
    }
    if list.len() < 3 {
        return Err(MatchFailure::CurveOutsideImage);
    }
    Ok(list)
}

/// Slopes of the displacement for every slant hypothesis, the first facing the camera.
pub(super) fn slants(link: &Link, rules: &MatchRules) -> Vec<Vector2<f64>> {
    let facing = link
        .slopes_of_normal(&link.direction)
        .unwrap_or_else(Vector2::zeros);
    let mut all = vec![facing];
    for n in &rules.slant_normals {
        if let Some(slopes) = link.slopes_of_normal(&Vector3::from(*n))
            && slopes.amax() <= rules.max_slope
            && all.iter().all(|s| (s - slopes).amax() > 0.03)
        {
            all.push(slopes);
        }
    }
    all
}

/// How the window is warped before it is compared.
pub(super) enum Warp {
    /// For each slant hypothesis of the rules.
    Slants,
    /// By this affine map of offsets into the other image.
    Known(Matrix2<f64>),
}

/// Above this score of the first hypothesis the others are not tried.
const GOOD_SCORE: f32 = 0.93;
/// Peaks of the first hypothesis around which the others are tried.
const FOLLOWED_PEAKS: usize = 4;

/// The best places along the curve, at least three pixels apart, best first.
pub(super) fn search(
    (a, b): (&Camera, &Camera),
    (from, to): (&PreparedImage, &PreparedImage),
    pixel: &Vector2<f64>,
    warp: &Warp,
    rules: &MatchRules,
    keep: usize,
) -> Result<Vec<CoarseMatch>, MatchFailure> {
    let stops = stops(a, b, to, pixel, rules)?;
    let matrices: Vec<Matrix2<f64>> = match warp {
        Warp::Known(matrix) => vec![*matrix],
        Warp::Slants => {
            let middle = stops[stops.len() / 2].inverse_range;
            let link = Link::new(a, b, pixel, middle).map_err(MatchFailure::camera)?;
            slants(&link, rules)
                .iter()
                .map(|slopes| link.matrix(slopes))
                .collect()
        }
    };
    let half = rules.half_search_window_px as usize;
    let mut values = vec![0.0f32; (2 * half + 1).pow(2) + CHUNK];
    let mut best: Vec<(f32, usize)> = vec![(-1.0, 0); stops.len()];
    let mut active = vec![true; stops.len()];
    let mut any = false;
    for (hypothesis, matrix) in matrices.iter().enumerate() {
        let Some(template) = warped_template(from, pixel, matrix, half, &mut values) else {
            continue;
        };
        let first = !any;
        any = true;
        correlate(&template, to, half, &stops, &active, hypothesis, &mut best);
        if first {
            let top = best.iter().map(|b| b.0).fold(-1.0, f32::max);
            if top >= GOOD_SCORE {
                break;
            }
            if f64::from(top) >= rules.min_search_score {
                active.fill(false);
                for peak in peak_indices(&best).into_iter().take(FOLLOWED_PEAKS) {
                    active[peak.saturating_sub(3)..(peak + 4).min(stops.len())].fill(true);
                }
            }
        }
    }
    if !any {
        return Err(MatchFailure::OutsideImage {
            u_px: pixel.x,
            v_px: pixel.y,
        });
    }
    Ok(peaks(&stops, &best, keep))
}

/// The window around a pixel as the other image would show it. `None` if it leaves the image or
/// has no contrast.
fn warped_template(
    from: &PreparedImage,
    pixel: &Vector2<f64>,
    matrix: &Matrix2<f64>,
    half: usize,
    values: &mut [f32],
) -> Option<Template> {
    let inverse = matrix.try_inverse()?;
    let side = 2 * half + 1;
    let grid = Grid {
        origin: pixel - inverse * Vector2::repeat(half as f64),
        step_u: inverse.column(0).into(),
        step_v: inverse.column(1).into(),
    };
    if from.spline.sample_grid(&grid, side, side, side, values) {
        Template::new(side, side, &values[..side * side], None).ok()
    } else {
        None
    }
}

/// Raises `best` where the template scores higher at an active stop. Runs of stops on one row are
/// correlated together.
fn correlate(
    template: &Template,
    to: &PreparedImage,
    half: usize,
    stops: &[Stop],
    active: &[bool],
    hypothesis: usize,
    best: &mut [(f32, usize)],
) {
    let mut first = 0;
    while first < stops.len() {
        if !active[first] {
            first += 1;
            continue;
        }
        let mut last = first;
        while last + 1 < stops.len()
            && active[last + 1]
            && stops[last + 1].v == stops[first].v
            && stops[last + 1].u.abs_diff(stops[last].u) == 1
        {
            last += 1;
        }
        let run = &stops[first..=last];
        let left = run[0].u.min(run[run.len() - 1].u);
        if let Some(map) = score_map(
            &to.grey,
            template,
            left - half,
            run[0].v - half,
            run.len(),
            1,
        ) {
            for (stop, best) in run.iter().zip(&mut best[first..]) {
                let score = map.scores.get(stop.u - left).copied().unwrap_or(-1.0);
                if score > best.0 {
                    *best = (score, hypothesis);
                }
            }
        }
        first = last + 1;
    }
}

/// Indices of the local maxima over two neighbours on each side, best first.
fn peak_indices(best: &[(f32, usize)]) -> Vec<usize> {
    let is_peak = |k: usize| {
        let near = k.saturating_sub(2)..(k + 3).min(best.len());
        near.into_iter()
            .all(|i| best[i].0 < best[k].0 || (best[i].0 == best[k].0 && i >= k))
    };
    let mut found: Vec<usize> = (0..best.len()).filter(|&k| is_peak(k)).collect();
    found.sort_by(|&a, &b| best[b].0.total_cmp(&best[a].0).then(a.cmp(&b)));
    found
}

/// The best peaks, refined by a parabola along the curve.
fn peaks(stops: &[Stop], best: &[(f32, usize)], keep: usize) -> Vec<CoarseMatch> {
    let refined = |k: usize| {
        let (score, hypothesis) = best[k];
        let whole = Vector2::new(stops[k].u as f64, stops[k].v as f64);
        let (mut pixel, mut inverse_range) = (whole, stops[k].inverse_range);
        if k > 0 && k + 1 < stops.len() {
            let (l, c, r) = (
                f64::from(best[k - 1].0),
                f64::from(score),
                f64::from(best[k + 1].0),
            );
            let bend = l - 2.0 * c + r;
            if bend < 0.0 {
                let shift = (0.5 * (l - r) / bend).clamp(-0.5, 0.5);
                let other = if shift < 0.0 {
                    &stops[k - 1]
                } else {
                    &stops[k + 1]
                };
                let towards = Vector2::new(other.u as f64, other.v as f64) - whole;
                pixel += towards * shift.abs();
                inverse_range += (other.inverse_range - inverse_range) * shift.abs();
            }
        }
        CoarseMatch {
            inverse_range,
            pixel,
            score: f64::from(score),
            hypothesis,
        }
    };
    peak_indices(best)
        .into_iter()
        .take(keep)
        .map(refined)
        .collect()
}
