//! Planes fitted to points.

use nalgebra::{Matrix3, Unit, Vector3};

/// A plane through `centroid` with unit `normal`, and how well it fits the points it came from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plane {
    /// Mean of the points, in their frame and unit.
    pub centroid: Vector3<f64>,
    /// Unit normal; its sign is that of the `towards` given to [`Plane::fit`].
    pub normal: Unit<Vector3<f64>>,
    /// Root mean square distance of the points from the plane, unit of the points.
    pub rms: f64,
    /// Root mean square distance of the points from their centroid in that direction in the plane
    /// in which they spread least, unit of the points.
    pub least_spread: f64,
}

/// Why a plane could not be fitted.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum PlaneError {
    /// Fewer than three points.
    #[error("a plane needs at least 3 points, got {0}")]
    TooFewPoints(usize),
    /// The points lie on a line (or on one spot), so the normal is free.
    #[error(
        "the points lie on a line: their second spread is {0:.3e}, the plane is not determined"
    )]
    Collinear(f64),
    /// A coordinate is not a finite number.
    #[error("a point has a coordinate that is not finite")]
    NotFinite,
}

impl Plane {
    /// Total least squares plane: the normal is the eigenvector of the smallest eigenvalue of the
    /// points' covariance (C. Leger's rule for the flight surface normals), turned to the side of
    /// `towards`.
    ///
    /// # Errors
    /// [`PlaneError`] for fewer than three, collinear or non-finite points.
    pub fn fit(points: &[Vector3<f64>], towards: &Vector3<f64>) -> Result<Self, PlaneError> {
        if points.len() < 3 {
            return Err(PlaneError::TooFewPoints(points.len()));
        }
        if points.iter().any(|p| p.iter().any(|x| !x.is_finite())) {
            return Err(PlaneError::NotFinite);
        }
        let n = points.len() as f64;
        let centroid = points.iter().sum::<Vector3<f64>>() / n;
        let covariance = points.iter().fold(Matrix3::zeros(), |sum, p| {
            let d = p - centroid;
            sum + d * d.transpose()
        }) / n;
        let eigen = covariance.symmetric_eigen();
        let mut order = [0, 1, 2];
        order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
        let [small, middle, large] = order.map(|i| eigen.eigenvalues[i].max(0.0));
        if middle <= large * 1e-10 || large == 0.0 {
            return Err(PlaneError::Collinear(middle.sqrt()));
        }
        let mut normal = Unit::new_normalize(eigen.eigenvectors.column(order[0]).into_owned());
        if normal.dot(towards) < 0.0 {
            normal = -normal;
        }
        Ok(Self {
            centroid,
            normal,
            rms: small.sqrt(),
            least_spread: middle.sqrt(),
        })
    }

    /// Signed distance of `point` from the plane, positive on the normal's side.
    pub fn signed_distance(&self, point: &Vector3<f64>) -> f64 {
        self.normal.dot(&(point - self.centroid))
    }
}

/// Two unit vectors that span the plane orthogonal to `normal`; with it they form a right-handed
/// basis `(first, second, normal)`. The choice is a fixed function of `normal`.
pub fn tangent_basis(normal: &Unit<Vector3<f64>>) -> (Vector3<f64>, Vector3<f64>) {
    let helper = if normal.x.abs() < 0.6 {
        Vector3::x()
    } else {
        Vector3::y()
    };
    let first = (helper - normal.into_inner() * normal.dot(&helper)).normalize();
    (first, normal.cross(&first))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    #[test]
    fn a_fitted_plane_recovers_normal_side_and_noise() {
        let normal = Unit::new_normalize(Vector3::new(0.2, -0.3, 0.9));
        let (a, b) = tangent_basis(&normal);
        let mut points = Vec::new();
        for i in -3..=3 {
            for j in -3..=3 {
                let ripple = if (i + j) % 2 == 0 { 1e-3 } else { -1e-3 };
                points.push(
                    a * f64::from(i) + b * f64::from(j) + normal.into_inner() * (5.0 + ripple),
                );
            }
        }
        let plane = Plane::fit(&points, &Vector3::z()).expect("a plane");
        assert!(plane.normal.dot(&normal) > 1.0 - 1e-6);
        assert!((plane.rms - 1e-3).abs() < 1e-4);
        let below = Plane::fit(&points, &-Vector3::z()).expect("a plane");
        assert!(below.normal.dot(&normal) < 0.0);
    }

    #[test]
    fn degenerate_points_are_refused() {
        let line: Vec<_> = (0..5)
            .map(|i| Vector3::new(f64::from(i), 0.0, 0.0))
            .collect();
        assert!(matches!(
            Plane::fit(&line, &Vector3::z()),
            Err(PlaneError::Collinear(_))
        ));
        assert!(matches!(
            Plane::fit(&line[..2], &Vector3::z()),
            Err(PlaneError::TooFewPoints(2))
        ));
    }
}
