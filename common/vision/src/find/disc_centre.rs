//! The image of a disc's centre, from the ellipse that the disc is seen as.
//!
//! The middle of the ellipse is not the image of the disc's middle: at range d, radius r and tilt w
//! they differ by about f (r/d)^2 sin w cos w px. With Q the ellipse's cone in the camera (rays x
//! with x^T Q x = 0) and n the normal of the disc's plane, the ray to the centre is Q^-1 n, the pole
//! of the plane's vanishing line.

use nalgebra::{Matrix3, SMatrix, SVector, SymmetricEigen, Vector2, Vector3};
use rover_cameras::Camera;

use super::NoFinding;

/// What it takes to tell the disc's centre from its ellipse's.
#[derive(Clone, Copy, Debug)]
pub struct DiscTruth<'a> {
    /// The camera that took the image.
    pub camera: &'a Camera,
    /// Normal of the disc's plane in the frame of the camera model's vectors, any length and sign.
    pub normal: Vector3<f64>,
}

/// Parameters t of the points ((1 - t^2), 2 t) / (1 + t^2) of a quarter of the unit circle.
const QUARTER: [f64; 6] = [0.0, 0.13, 0.27, 0.42, 0.58, 0.77];

/// The image of the disc's centre, from its ellipse (centre, B) and its plane's normal.
pub(super) fn true_centre(
    centre: [f64; 2],
    [a, b, c]: [f64; 3],
    truth: &DiscTruth,
) -> Result<Vector2<f64>, NoFinding> {
    let bad = |e: &dyn std::fmt::Display| NoFinding::BadInput(format!("disc centre: {e}"));
    let det = a * c - b * b;
    let middle = Vector2::new(centre[0], centre[1]);
    let axis = truth.camera.ray(&middle).map_err(|e| bad(&e))?;
    let z = axis.direction.into_inner();
    let basis = super::homography::frame_about(&z);
    let mut normal = SMatrix::<f64, 6, 6>::zeros();
    let mut rows = Vec::with_capacity(4 * QUARTER.len());
    let mut reach = 0.0f64;
    for t in QUARTER {
        let (s, k) = (2.0 * t / (1.0 + t * t), (1.0 - t * t) / (1.0 + t * t));
        for (e0, e1) in [(k, s), (-s, k), (-k, -s), (s, -k)] {
            // B^-1 e
            let d = Vector2::new(c * e0 - b * e1, a * e1 - b * e0) / det;
            let ray = truth.camera.ray(&(middle + d)).map_err(|e| bad(&e))?;
            let q = basis.transpose() * ray.direction.into_inner();
            let q = Vector2::new(q.x / q.z, q.y / q.z);
            reach = reach.max(q.norm());
            rows.push(q);
        }
    }
    for q in rows {
        let (x, y) = (q.x / reach, q.y / reach);
        let row = SVector::<f64, 6>::from([x * x, x * y, y * y, x, y, 1.0]);
        normal += row * row.transpose();
    }
    let eigen = SymmetricEigen::new(normal);
    let least = (0..6)
        .min_by(|&i, &j| eigen.eigenvalues[i].total_cmp(&eigen.eigenvalues[j]))
        .unwrap_or(0);
    let k = eigen.eigenvectors.column(least);
    let conic = Matrix3::new(
        k[0],
        0.5 * k[1],
        0.5 * k[3],
        0.5 * k[1],
        k[2],
        0.5 * k[4],
        0.5 * k[3],
        0.5 * k[4],
        k[5],
    );
    let scale = Matrix3::from_diagonal(&Vector3::new(1.0 / reach, 1.0 / reach, 1.0));
    let cone = basis * (scale * conic * scale) * basis.transpose();
    let length = truth.normal.norm();
    if !(length.is_finite() && length > 0.0) {
        return Err(bad(&format!(
            "the normal has length {length}, expected above 0"
        )));
    }
    let towards = cone
        .try_inverse()
        .map(|inverse| inverse * (truth.normal / length))
        .ok_or_else(|| bad(&"the ellipse is degenerate"))?;
    let towards = if towards.dot(&z) < 0.0 {
        -towards
    } else {
        towards
    };
    let at = truth
        .camera
        .project(&(axis.origin + towards.normalize()))
        .map_err(|e| bad(&e))?;
    let reach_px = (at - middle).norm();
    // the centre lies inside its ellipse; a normal across the line of sight says otherwise
    let d = at - middle;
    let (bx, by) = (a * d.x + b * d.y, b * d.x + c * d.y);
    if !((bx * bx + by * by).sqrt() < 0.7) {
        return Err(bad(&format!(
            "with this normal it would lie {reach_px:.2} px from its ellipse's middle; the disc \
             would be seen edge on"
        )));
    }
    Ok(at)
}
