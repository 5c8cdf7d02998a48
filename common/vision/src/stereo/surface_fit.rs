//! Fits over the matches around a pixel: the inverse range as a quadratic of the pixel offset, and
//! the plane of the points.

use nalgebra::{SMatrix, SVector, Unit, Vector2, Vector3};
use rover_geometry::Plane;

use super::{SurfaceFailure, SurfaceRules};

/// One match near the designated pixel.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sample {
    /// Offset from the designated pixel, px.
    pub offset: Vector2<f64>,
    /// Inverse range along this match's own ray, 1/m.
    pub inverse_range: f64,
    /// Its standard deviation, 1/m.
    pub sigma: f64,
    /// The point, cameras' frame, m.
    pub point: Vector3<f64>,
    /// Side of the matched window, px.
    pub side_px: f64,
}

/// The inverse range at the designated pixel.
pub(super) struct Centre {
    pub inverse_range: f64,
    /// Standard deviation if all samples were independent, 1/m.
    pub sigma: f64,
    /// Robust standard deviation of the samples about the fit, 1/m.
    pub scatter: f64,
}

type Normal = SMatrix<f64, 6, 6>;

fn terms(offset: &Vector2<f64>, scale: f64) -> SVector<f64, 6> {
    let (u, v) = (offset.x / scale, offset.y / scale);
    SVector::from([1.0, u, v, u * u, u * v, v * v])
}

const ROBUST_STEPS: usize = 6;
/// Huber's limit in units of the robust standard deviation.
const HUBER: f64 = 1.5;
/// Weight halves at this fraction of the grid's reach, so that what is near the pixel counts most.
const REACH_FRACTION: f64 = 0.6;

/// Robust quadratic fit, evaluated at offset zero. `window_variance` (px^2) is the second moment of
/// the matching window: each match reports the mean of a curved surface over its window, which is
/// too large by half the curvature times this; the fit takes it back out.
pub(super) fn fit_centre(
    samples: &[Sample],
    reach_px: f64,
    window_variance: f64,
) -> Option<Centre> {
    let scale = reach_px.max(1.0);
    let near = |s: &Sample| {
        let r = s.offset.norm() / (REACH_FRACTION * scale);
        1.0 / (1.0 + r * r)
    };
    let mut scatter = f64::INFINITY;
    let mut solution: Option<(SVector<f64, 6>, Normal)> = None;
    for _ in 0..ROBUST_STEPS {
        let mut normal = Normal::zeros();
        let mut right = SVector::<f64, 6>::zeros();
        let mut spread = Normal::zeros();
        for s in samples {
            let t = terms(&s.offset, scale);
            let residual = solution
                .as_ref()
                .map_or(0.0, |(x, _)| (s.inverse_range - x.dot(&t)).abs());
            let robust = if residual > HUBER * scatter {
                HUBER * scatter / residual
            } else {
                1.0
            };
            let weight = near(s) * robust / (s.sigma * s.sigma);
            normal.ger(weight, &t, &t, 1.0);
            right.axpy(weight * s.inverse_range, &t, 1.0);
            let variance = s.sigma * s.sigma;
            spread.ger(weight * weight * variance, &t, &t, 1.0);
        }
        let inverse = normal.cholesky()?.inverse();
        let x = inverse * right;
        let mut sizes: Vec<f64> = samples
            .iter()
            .map(|s| (s.inverse_range - x.dot(&terms(&s.offset, scale))).abs())
            .collect();
        sizes.sort_by(f64::total_cmp);
        scatter = (1.4826 * sizes[sizes.len() / 2]).max(1e-12);
        solution = Some((x, inverse * spread * inverse));
    }
    let (x, covariance) = solution?;
    // mean of u^2 over the window times the coefficient, for u and v
    let excess = (x[3] + x[5]) * window_variance / (scale * scale);
    let inverse_range = x[0] - excess;
    (inverse_range > 0.0 && inverse_range.is_finite()).then(|| Centre {
        inverse_range,
        sigma: covariance[(0, 0)].max(0.0).sqrt(),
        scatter,
    })
}

/// A plane, and which points it was fitted to.
pub(super) struct Patch {
    pub normal: Unit<Vector3<f64>>,
    /// Standard deviation of the normal in the direction in which it is known least, rad.
    pub normal_sigma_rad: f64,
    pub rms_m: f64,
    /// Extent of the points along the normal, m.
    pub roughness_m: f64,
    pub used: usize,
}

/// The flight rule (C. Leger): fit, and while the mean distance exceeds the limit drop the points
/// farther than a multiple of it. Roughness is taken over all points. `independent_part` of the
/// points are independent looks: matching windows overlap.
pub(super) fn fit_patch(
    samples: &[Sample],
    independent_part: f64,
    towards: &Vector3<f64>,
    rules: &SurfaceRules,
) -> Result<Patch, SurfaceFailure> {
    let too_few = |found| SurfaceFailure::TooFewPoints {
        found,
        needed: rules.min_points,
    };
    let mut kept: Vec<&Sample> = samples.iter().collect();
    loop {
        if kept.len() < rules.min_points {
            return Err(too_few(kept.len()));
        }
        let points: Vec<Vector3<f64>> = kept.iter().map(|s| s.point).collect();
        let plane = Plane::fit(&points, towards).map_err(|_| too_few(0))?;
        let distance = |s: &Sample| plane.signed_distance(&s.point);
        let n = kept.len() as f64;
        let mean = kept.iter().map(|s| distance(s).abs()).sum::<f64>() / n;
        let before = kept.len();
        if mean > rules.plane_error_m {
            let limit = rules.reject_factor * mean;
            let next: Vec<&Sample> = kept
                .iter()
                .filter(|s| distance(s).abs() <= limit)
                .copied()
                .collect();
            if next.len() < before && next.len() >= rules.min_points {
                kept = next;
                continue;
            }
        }
        // what the matches' own deviations make along the normal, or what is seen if that is more
        let cosine = plane.normal.dot(towards);
        let height = |s: &&Sample| s.sigma * cosine / (s.inverse_range * s.inverse_range);
        let expected = (kept.iter().map(|s| height(s).powi(2)).sum::<f64>() / n).sqrt();
        let looks = (n * independent_part).max(1.0);
        let normal_sigma_rad = expected.max(plane.rms) / (looks.sqrt() * plane.least_spread);
        let mut heights: Vec<f64> = samples.iter().map(distance).collect();
        heights.sort_by(f64::total_cmp);
        // the outermost two per cent are left to mismatches
        let trim = heights.len() / 50;
        let roughness_m = heights[heights.len() - 1 - trim] - heights[trim];
        return Ok(Patch {
            normal: plane.normal,
            normal_sigma_rad,
            rms_m: plane.rms,
            roughness_m,
            used: kept.len(),
        });
    }
}
