//! Straight edges of a square to subpixel: lines through the places of steepest rise across them.

use nalgebra::Vector2;

use super::NoFinding;
use crate::sample::SplineImage;

/// The refusal of a square that is none.
pub(super) fn degenerate() -> NoFinding {
    NoFinding::NothingThere("a degenerate outline".into())
}

/// Half length of the profiles across an edge, px.
const PROFILE_PX: f64 = 2.5;
const PROFILE_STEP_PX: f64 = 0.25;
/// Ends of an edge that are left out, as a fraction of it.
const END: f64 = 0.1;
/// Rounds of refinement: profiles are laid anew across the improved lines.
const ROUNDS: usize = 2;

/// Corners by lines through the border's edges, and their standard deviation.
pub(super) fn refine(
    spline: &SplineImage,
    start: &[Vector2<f64>; 4],
    light: bool,
) -> Result<([Vector2<f64>; 4], f64), NoFinding> {
    let mut corners = *start;
    let mut sigma = 0.0;
    for _ in 0..ROUNDS {
        let mut lines = [(Vector2::zeros(), Vector2::zeros()); 4];
        let mut variance = 0.0;
        let middle = (corners[0] + corners[1] + corners[2] + corners[3]) / 4.0;
        for (k, line) in lines.iter_mut().enumerate() {
            let (a, b) = (corners[k], corners[(k + 1) % 4]);
            let (at, direction, v) = edge_line(spline, a, b, middle, light)?;
            *line = (at, direction);
            variance += v / 4.0;
        }
        for k in 0..4 {
            let before = lines[(k + 3) % 4];
            let corner = crossing(before, lines[k]).ok_or_else(degenerate)?;
            let moved = (corner - start[k]).norm();
            if !(moved <= PROFILE_PX) {
                return Err(NoFinding::Diverged {
                    moved_px: moved,
                    limit_px: PROFILE_PX,
                });
            }
            corners[k] = corner;
        }
        sigma = variance.sqrt();
    }
    Ok((corners, sigma))
}

/// The line through an edge: a point, its direction, and the variance of a corner on it, px^2.
fn edge_line(
    spline: &SplineImage,
    a: Vector2<f64>,
    b: Vector2<f64>,
    middle: Vector2<f64>,
    light: bool,
) -> Result<(Vector2<f64>, Vector2<f64>, f64), NoFinding> {
    let length = (b - a).norm();
    let small = |found_px| NoFinding::TooSmall {
        found_px,
        needed_px: 8.0,
    };
    if !(length >= 8.0) {
        return Err(small(length));
    }
    let along = (b - a) / length;
    let mut outward = Vector2::new(along.y, -along.x);
    if outward.dot(&((a + b) * 0.5 - middle)) < 0.0 {
        outward = -outward;
    }
    let sign = if light { -1.0 } else { 1.0 };
    let count = (length * (1.0 - 2.0 * END)).floor() as usize + 1;
    let mut seen: Vec<(f64, f64)> = Vec::with_capacity(count);
    for k in 0..count {
        let s = length * END + k as f64;
        let base = a + along * s;
        let (mut weight, mut moment) = (0.0, 0.0);
        let steps = (PROFILE_PX / PROFILE_STEP_PX) as i32;
        for i in -steps..=steps {
            let t = f64::from(i) * PROFILE_STEP_PX;
            let p = base + outward * t;
            let Some(sample) = spline.sample(p.x, p.y) else {
                return Err(NoFinding::OutsideImage {
                    u_px: p.x,
                    v_px: p.y,
                });
            };
            let rise = sign * (f64::from(sample.du) * outward.x + f64::from(sample.dv) * outward.y);
            if rise > 0.0 {
                let w = rise * rise;
                weight += w;
                moment += w * t;
            }
        }
        if weight > 0.0 {
            seen.push((s - 0.5 * length, moment / weight));
        }
    }
    // offset + slope s by least squares, the farthest tenth left out
    let mut line = (0.0, 0.0);
    let mut variance = 0.0;
    for round in 0..3 {
        if seen.len() < 6 {
            return Err(small(seen.len() as f64));
        }
        let n = seen.len() as f64;
        let ms = seen.iter().map(|p| p.0).sum::<f64>() / n;
        let mt = seen.iter().map(|p| p.1).sum::<f64>() / n;
        let ss: f64 = seen.iter().map(|p| (p.0 - ms) * (p.0 - ms)).sum();
        let st: f64 = seen.iter().map(|p| (p.0 - ms) * (p.1 - mt)).sum();
        let slope = st / ss.max(1e-9);
        line = (mt - slope * ms, slope);
        let off = |p: &(f64, f64)| (p.1 - line.0 - line.1 * p.0).abs();
        let square: f64 = seen.iter().map(|p| off(p) * off(p)).sum();
        let spread = square / (n - 2.0);
        // at the edge's end; neighbouring profiles share pixels
        variance = 2.0 * spread * (1.0 / n + 0.25 * length * length / ss.max(1e-9));
        if round < 2 {
            let limit = 2.5 * spread.sqrt() + 0.02;
            seen.retain(|p| off(p) <= limit);
        }
    }
    let at = (a + b) * 0.5 + outward * line.0;
    let direction = along + outward * line.1;
    Ok((at, direction / direction.norm(), variance))
}

/// Where two lines (point, direction) cross.
pub(super) fn crossing(
    a: (Vector2<f64>, Vector2<f64>),
    b: (Vector2<f64>, Vector2<f64>),
) -> Option<Vector2<f64>> {
    let cross = a.1.x * b.1.y - a.1.y * b.1.x;
    let d = b.0 - a.0;
    let t = (d.x * b.1.y - d.y * b.1.x) / cross;
    t.is_finite().then(|| a.0 + a.1 * t)
}
