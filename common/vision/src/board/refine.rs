//! Corners to subpixel: the point to which all gradients around it are perpendicular.
//!
//! With the gradient g at the pixel p, an edge through the corner q has `g . (q - p) = 0`; over a
//! window, `q = (sum w g g^T)^-1 sum w g g^T p`. The window is laid out anew around each estimate, at
//! subpixel places, so that at the end it is symmetric about the corner and neither blur nor
//! noise has a side to pull it to.

use super::Chessboard;
use crate::sample::SplineImage;
use nalgebra::{Matrix2, Vector2};

/// A refined corner.
#[derive(Clone, Copy, Debug)]
pub(super) struct Refined {
    pub(super) pixel_px: Vector2<f64>,
    pub(super) sigma_px: f64,
}

/// Half the window's side as a fraction of the distance to the nearest neighbour, and its bounds, px.
const SHARE: f64 = 0.4;
const HALF_PX: (f64, f64) = (2.5, 9.0);
const ITERATIONS: usize = 25;
const SETTLED_PX: f64 = 1e-3;
/// Least ratio of the smaller to the larger eigenvalue: both edges must be there.
const MIN_RATIO: f64 = 0.02;

/// All corners of a complete grid, row by row; `None` if one of them runs away or is no crossing.
pub(super) fn all(
    image: &SplineImage,
    placed: &[Vector2<f64>],
    board: Chessboard,
    scale: f64,
) -> Option<Vec<Refined>> {
    let at = |i: usize, j: usize| placed[j * board.columns + i];
    let mut corners = Vec::with_capacity(placed.len());
    for j in 0..board.rows {
        for i in 0..board.columns {
            let here = at(i, j);
            let mut nearest = f64::INFINITY;
            for (di, dj) in [(-1_isize, 0_isize), (1, 0), (0, -1), (0, 1)] {
                if let (Some(x), Some(y)) = (i.checked_add_signed(di), j.checked_add_signed(dj))
                    && x < board.columns
                    && y < board.rows
                {
                    nearest = nearest.min((at(x, y) - here).norm());
                }
            }
            let half = (SHARE * nearest).clamp(HALF_PX.0, HALF_PX.1.max(2.0 * scale));
            corners.push(corner(image, here, half, (1.5 * scale).max(0.3 * nearest))?);
        }
    }
    Some(corners)
}

/// One corner near `start`; `None` if it moves by more than `reach_px`.
pub(super) fn corner(
    image: &SplineImage,
    start: Vector2<f64>,
    half_px: f64,
    reach_px: f64,
) -> Option<Refined> {
    let n = half_px.ceil() as i32;
    let spread = 0.5 * half_px * half_px;
    let mut at = start;
    let mut sigma_px = f64::INFINITY;
    for _ in 0..ITERATIONS {
        let mut normal = Matrix2::zeros();
        let mut moment = Vector2::zeros();
        let mut squares = 0.0;
        let mut weights = 0.0;
        for dv in -n..=n {
            for du in -n..=n {
                let d = Vector2::new(f64::from(du), f64::from(dv));
                if d.norm() > half_px {
                    continue;
                }
                let s = image.sample(at.x + d.x, at.y + d.y)?;
                let g = Vector2::new(f64::from(s.du), f64::from(s.dv));
                let w = (-d.norm_squared() / (2.0 * spread)).exp();
                normal += g * g.transpose() * w;
                let distance = g.dot(&d);
                moment += g * (distance * w);
                squares += w * distance * distance;
                weights += w;
            }
        }
        let eigen = normal.symmetric_eigenvalues();
        if !(eigen.min() > MIN_RATIO * eigen.max() && eigen.min() > 0.0) {
            return None;
        }
        let step = normal.try_inverse()? * moment;
        at += step;
        if !((at - start).norm() <= reach_px) {
            return None;
        }
        // Scatter of the gradients' distances from the corner, shared by as many pixels.
        sigma_px = (squares / eigen.min() / weights.max(1.0)).sqrt();
        if step.norm() < SETTLED_PX {
            break;
        }
    }
    Some(Refined {
        pixel_px: at,
        sigma_px,
    })
}
