//! Whole-pixel search along the epipolar curve, for a few surface slants.

use nalgebra::{Vector2, Vector3};
use rover_cameras::Camera;

use super::link::Link;
use super::{MatchFailure, MatchRules, PreparedImage};
use crate::ncc::{Template, score_map};

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
    for k in 0..=count {
        let s = k as f64 / count as f64;
        let (w0, w1, w2) = (
            (2.0 * s - 1.0) * (s - 1.0),
            4.0 * s * (1.0 - s),
            s * (2.0 * s - 1.0),
        );
        let p = p0 * w0 + p1 * w1 + p2 * w2;
        let (u, v) = (p.x.round(), p.y.round());
        let fits = |x: f64, size: u32| x >= half && x + half <= f64::from(size) - 1.0;
        if !(fits(u, image.width_px) && fits(v, image.height_px)) {
            continue;
        }
        let (u, v) = (u as usize, v as usize);
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

/// The best places along the curve, at least three pixels apart, best first.
pub(super) fn search(
    (a, b): (&Camera, &Camera),
    (from, to): (&PreparedImage, &PreparedImage),
    pixel: &Vector2<f64>,
    rules: &MatchRules,
    keep: usize,
) -> Result<Vec<CoarseMatch>, MatchFailure> {
    let stops = stops(a, b, to, pixel, rules)?;
    let middle = stops[stops.len() / 2].inverse_range;
    let link = Link::new(a, b, pixel, middle).map_err(MatchFailure::camera)?;
    let half = rules.half_search_window_px as usize;
    let side = 2 * half + 1;
    let mut values = vec![0.0f32; side * side];
    let mut best: Vec<(f32, usize)> = vec![(-1.0, 0); stops.len()];
    let mut any = false;
    for (hypothesis, slopes) in slants(&link, rules).iter().enumerate() {
        // window of the other image straight, this image's window warped
        let Some(inverse) = link.matrix(slopes).try_inverse() else {
            continue;
        };
        let (step_u, step_v) = (inverse.column(0), inverse.column(1));
        let origin = pixel - inverse * Vector2::repeat(half as f64);
        let inside = from.spline.sample_grid(
            [origin.x, origin.y],
            [step_u[0], step_u[1]],
            [step_v[0], step_v[1]],
            side,
            side,
            &mut values,
        );
        if !inside {
            continue;
        }
        any = true;
        let Ok(template) = Template::new(side, side, &values, None) else {
            continue;
        };
        // runs of stops on one row are correlated together
        let mut first = 0;
        while first < stops.len() {
            let mut last = first;
            while last + 1 < stops.len()
                && stops[last + 1].v == stops[first].v
                && stops[last + 1].u.abs_diff(stops[last].u) == 1
            {
                last += 1;
            }
            let run = &stops[first..=last];
            let left = run.iter().map(|s| s.u).min().unwrap_or(0);
            let map = score_map(
                &to.grey,
                &template,
                left - half,
                run[0].v - half,
                run.len(),
                1,
            );
            if let Some(map) = map {
                for (k, stop) in run.iter().enumerate() {
                    let score = map.scores.get(stop.u - left).copied().unwrap_or(-1.0);
                    if score > best[first + k].0 {
                        best[first + k] = (score, hypothesis);
                    }
                }
            }
            first = last + 1;
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

/// Local maxima over two neighbours on each side.
fn peaks(stops: &[Stop], best: &[(f32, usize)], keep: usize) -> Vec<CoarseMatch> {
    let mut found = Vec::new();
    for k in 0..stops.len() {
        let (score, hypothesis) = best[k];
        let near = k.saturating_sub(2)..(k + 3).min(stops.len());
        if near
            .into_iter()
            .any(|i| best[i].0 > score || (best[i].0 == score && i < k))
        {
            continue;
        }
        let whole = Vector2::new(stops[k].u as f64, stops[k].v as f64);
        let inner = k > 0 && k + 1 < stops.len();
        let (mut pixel, mut inverse_range) = (whole, stops[k].inverse_range);
        if inner {
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
        found.push(CoarseMatch {
            inverse_range,
            pixel,
            score: f64::from(score),
            hypothesis,
        });
    }
    found.sort_by(|a, b| {
        b.score
            .total_cmp(&a.score)
            .then(a.inverse_range.total_cmp(&b.inverse_range))
    });
    found.truncate(keep);
    found
}
