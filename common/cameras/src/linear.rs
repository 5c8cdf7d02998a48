//! The linear part that CAHV and CAHVOR share: image plane coordinates from the vectors A, H, V
//! (Yakimovsky & Cunningham 1978).
//!
//! With `d` the offset of a point from the projection centre C, the pixel is
//! `u = d.H / d.A`, `v = d.V / d.A`. A pixel's ray is the normal of the two planes that contain
//! it: `(V - v A) x (H - u A)`, with the sign that makes it point forward along A.

use nalgebra::{Matrix2x3, Matrix3x2, Vector2, Vector3};

/// The image of the offset `d` whose range along A is `range_m` (positive).
#[inline]
pub(crate) fn image(
    h: &Vector3<f64>,
    v: &Vector3<f64>,
    d: &Vector3<f64>,
    range_m: f64,
) -> Vector2<f64> {
    let inverse = 1.0 / range_m;
    Vector2::new(d.dot(h) * inverse, d.dot(v) * inverse)
}

/// Derivative of [`image`] with respect to `d`, px/m: rows `(H - u A) / range`,
/// `(V - v A) / range`.
#[inline]
pub(crate) fn image_jacobian(
    a: &Vector3<f64>,
    h: &Vector3<f64>,
    v: &Vector3<f64>,
    pixel_px: &Vector2<f64>,
    range_m: f64,
) -> Matrix2x3<f64> {
    let inverse = 1.0 / range_m;
    let du = (h - a * pixel_px.x) * inverse;
    let dv = (v - a * pixel_px.y) * inverse;
    Matrix2x3::new(du.x, du.y, du.z, dv.x, dv.y, dv.z)
}

/// A direction through a pixel, of any length, pointing forward along A.
#[inline]
pub(crate) fn direction(
    a: &Vector3<f64>,
    h: &Vector3<f64>,
    v: &Vector3<f64>,
    pixel_px: &Vector2<f64>,
) -> Vector3<f64> {
    let normal = (v - a * pixel_px.y).cross(&(h - a * pixel_px.x));
    normal * forward_sign(a, &normal)
}

/// The unit vector along [`direction`] with its derivative with respect to the pixel, 1/px. Both
/// hold NaN if the vectors do not span space or are not finite.
#[inline]
pub(crate) fn direction_with_jacobian(
    a: &Vector3<f64>,
    h: &Vector3<f64>,
    v: &Vector3<f64>,
    pixel_px: &Vector2<f64>,
) -> (Vector3<f64>, Matrix3x2<f64>) {
    let row = v - a * pixel_px.y;
    let column = h - a * pixel_px.x;
    let normal = row.cross(&column);
    let scale = forward_sign(a, &normal) / normal.norm();
    let unit = normal * scale;
    let tangent = |dn: Vector3<f64>| {
        let dn = dn * scale;
        dn - unit * unit.dot(&dn)
    };
    let jacobian = Matrix3x2::from_columns(&[tangent(a.cross(&row)), tangent(column.cross(a))]);
    (unit, jacobian)
}

#[inline]
fn forward_sign(a: &Vector3<f64>, normal: &Vector3<f64>) -> f64 {
    if normal.dot(a) < 0.0 { -1.0 } else { 1.0 }
}
