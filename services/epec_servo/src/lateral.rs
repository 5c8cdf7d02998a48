//! The error in the plane of a surface: what a placement is judged by.

use nalgebra::{Matrix2, Matrix3, Unit, Vector3};
use rover_geometry::tangent_basis;
use std::f64::consts::TAU;

/// Radius that an error with the given mean (m) and covariance (m^2) keeps in 95 % of cases, seen
/// in the plane orthogonal to `normal`: the mean's length plus the 95 % radius of the normal
/// distribution about it, which is a little more than the exact quantile.
pub fn bound_95(
    mean: &Vector3<f64>,
    covariance: &Matrix3<f64>,
    normal: &Unit<Vector3<f64>>,
) -> f64 {
    let (a, b) = tangent_basis(normal);
    let in_plane = Matrix2::new(
        a.dot(&(covariance * a)),
        a.dot(&(covariance * b)),
        b.dot(&(covariance * a)),
        b.dot(&(covariance * b)),
    );
    let variances = in_plane.symmetric_eigenvalues();
    let offset = mean.dot(&a).hypot(mean.dot(&b));
    offset + radius_95(variances[0].max(0.0), variances[1].max(0.0))
}

/// Radius of the circle that holds 95 % of a centred normal distribution in the plane with these
/// variances along its axes.
pub fn radius_95(variance_a: f64, variance_b: f64) -> f64 {
    let (large, small) = (variance_a.max(variance_b), variance_a.min(variance_b));
    if large <= 0.0 {
        return 0.0;
    }
    // Below this ratio the distribution is a line to within 1e-6 of its 95 % bound.
    let ratio = (small / large).max(1e-6);
    let (mut low, mut high) = (1.9, 2.5);
    for _ in 0..40 {
        let middle = (low + high) / 2.0;
        if inside(middle, ratio) < 0.95 {
            low = middle
        } else {
            high = middle
        }
    }
    large.sqrt() * (low + high) / 2.0
}

/// Share of a centred normal distribution with variances 1 and `ratio` within `radius`: polar
/// coordinates after scaling the small axis, where only the angle is left to integrate.
fn inside(radius: f64, ratio: f64) -> f64 {
    const STEPS: u32 = 4096;
    let outside: f64 = (0..STEPS)
        .map(|i| {
            let (sin, cos) = ((f64::from(i) + 0.5) * TAU / f64::from(STEPS)).sin_cos();
            (-0.5 * radius * radius / (cos * cos + ratio * sin * sin)).exp()
        })
        .sum();
    1.0 - outside / f64::from(STEPS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_95_percent_radius_has_its_known_limits() {
        // Rayleigh: sqrt(-2 ln 0.05); one axis: the normal distribution's two-sided quantile.
        assert!((radius_95(4.0, 4.0) - 2.0 * 2.447_746_83).abs() < 1e-6);
        assert!((radius_95(1.0, 0.0) - 1.959_964).abs() < 1e-3);
        assert_eq!(radius_95(0.0, 0.0), 0.0);
    }

    #[test]
    fn only_the_error_in_the_plane_counts() {
        let normal = Unit::new_normalize(Vector3::new(0.3, -0.2, 0.9));
        let along = normal.into_inner();
        let covariance = along * along.transpose() * 25.0;
        assert!(bound_95(&(along * 7.0), &covariance, &normal) < 1e-6);
        let (a, _) = tangent_basis(&normal);
        assert!((bound_95(&(a * 3.0), &covariance, &normal) - 3.0).abs() < 1e-6);
    }
}
