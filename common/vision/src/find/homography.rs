//! Flat fiducials: the map of a square, and the pose from four or more points without a start.

use nalgebra::{
    Isometry3, Matrix3, Point3, Rotation3, SMatrix, SVector, SymmetricEigen, Translation3,
    UnitQuaternion, Vector2, Vector3,
};
use rover_cameras::Camera;

/// Pose (camera model's frame from fiducial) of points in the plane z = 0 of the fiducial, by the
/// direct linear transform over the rays of their pixels; a start for a least-squares fit. `None`
/// if the points do not determine it or a pixel has no ray.
pub(super) fn plane_pose(
    camera: &Camera,
    points: &[(Vector2<f64>, Vector2<f64>)],
) -> Option<Isometry3<f64>> {
    if points.len() < 4 {
        return None;
    }
    let n = points.len() as f64;
    let middle_m = points.iter().map(|(p, _)| p).sum::<Vector2<f64>>() / n;
    let middle_px = points.iter().map(|(_, q)| q).sum::<Vector2<f64>>() / n;
    let axis = camera.ray(&middle_px).ok()?;
    let z = axis.direction.into_inner();
    let basis = frame_about(&z);
    let mut rays = Vec::with_capacity(points.len());
    let (mut spread_m, mut spread) = (0.0f64, 0.0f64);
    for (p, q) in points {
        let ray = camera.ray(q).ok()?;
        let d = basis.transpose() * ray.direction.into_inner();
        let d = Vector2::new(d.x / d.z, d.y / d.z);
        let p = p - middle_m;
        spread_m = spread_m.max(p.norm());
        spread = spread.max(d.norm());
        rays.push((p, d));
    }
    if !(spread_m > 0.0 && spread > 0.0) {
        return None;
    }
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for (p, d) in rays {
        let (p, d) = (p / spread_m, d / spread);
        for row in [
            [p.x, p.y, 1.0, 0.0, 0.0, 0.0, -d.x * p.x, -d.x * p.y, -d.x],
            [0.0, 0.0, 0.0, p.x, p.y, 1.0, -d.y * p.x, -d.y * p.y, -d.y],
        ] {
            let row = SVector::<f64, 9>::from(row);
            normal += row * row.transpose();
        }
    }
    let eigen = SymmetricEigen::new(normal);
    let least = (0..9).min_by(|&i, &j| eigen.eigenvalues[i].total_cmp(&eigen.eigenvalues[j]))?;
    let h = eigen.eigenvectors.column(least);
    let h = Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], h[8]);
    let undo = Matrix3::from_diagonal(&Vector3::new(spread, spread, 1.0));
    let units = Matrix3::from_diagonal(&Vector3::new(1.0 / spread_m, 1.0 / spread_m, 1.0));
    let h = undo * h * units;
    let length = (h.column(0).norm() * h.column(1).norm()).sqrt();
    if !(length > 0.0 && length.is_finite()) {
        return None;
    }
    let h = h * (if h[(2, 2)] < 0.0 { -1.0 } else { 1.0 } / length);
    let (a, b) = (h.column(0).into_owned(), h.column(1).into_owned());
    // the nearest orthonormal pair: halve the angle that they miss
    let (sum, difference) = ((a + b).try_normalize(1e-9)?, (a - b).try_normalize(1e-9)?);
    let half = std::f64::consts::FRAC_1_SQRT_2;
    let (a, b) = ((sum + difference) * half, (sum - difference) * half);
    let rotation = Matrix3::from_columns(&[a, b, a.cross(&b)]);
    if !rotation.iter().all(|x| x.is_finite()) {
        return None;
    }
    let rotation = Rotation3::from_matrix_unchecked(basis * rotation);
    let origin = axis.origin + basis * h.column(2);
    let at_middle = Isometry3::from_parts(
        Translation3::from(origin),
        UnitQuaternion::from_rotation_matrix(&rotation),
    );
    let shift = Isometry3::translation(-middle_m.x, -middle_m.y, 0.0);
    let pose = at_middle * shift;
    (pose * Point3::origin())
        .coords
        .iter()
        .all(|x| x.is_finite())
        .then_some(pose)
}

/// The homography that takes the square (0, 0), (size, 0), (size, size), (0, size) to four corners.
pub(super) fn square_homography(corners: &[Vector2<f64>; 4], size: f64) -> Option<Matrix3<f64>> {
    let mut matrix = SMatrix::<f64, 8, 8>::zeros();
    let mut right = SVector::<f64, 8>::zeros();
    let square = [(0.0, 0.0), (size, 0.0), (size, size), (0.0, size)];
    for (k, ((x, y), p)) in square.into_iter().zip(corners).enumerate() {
        let u = [x, y, 1.0, 0.0, 0.0, 0.0, -p.x * x, -p.x * y];
        let v = [0.0, 0.0, 0.0, x, y, 1.0, -p.y * x, -p.y * y];
        for i in 0..8 {
            matrix[(2 * k, i)] = u[i];
            matrix[(2 * k + 1, i)] = v[i];
        }
        right[2 * k] = p.x;
        right[2 * k + 1] = p.y;
    }
    let h = matrix.lu().solve(&right)?;
    let map = Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], 1.0);
    map.iter().all(|x| x.is_finite()).then_some(map)
}

/// Axes of some frame whose last axis is the unit vector `z`.
pub(super) fn frame_about(z: &Vector3<f64>) -> Matrix3<f64> {
    let other = if z.x.abs() < 0.6 {
        Vector3::x()
    } else {
        Vector3::y()
    };
    let x = z.cross(&other).normalize();
    Matrix3::from_columns(&[x, z.cross(&x), *z])
}
