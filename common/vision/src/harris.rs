//! Harris corners: response, and a list of peaks to subpixel.
//!
//! R = det M - k trace(M)^2 with M the gradient's second moments under a Gaussian window (C. Harris
//! and M. Stephens, 1988; paper section 3, reference 12).

use serde::{Deserialize, Serialize};

use crate::image::{Image8, ImageError, ImageF};
use crate::ncc::quadratic_peak;

/// Settings of the corner detector.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HarrisRules {
    /// Smoothing before the gradient is taken, px.
    pub gradient_sigma_px: f64,
    /// Window of the second moments, px.
    pub window_sigma_px: f64,
    /// Weight of the squared trace, 0.04 to 0.06.
    pub k: f64,
    /// Least response, as a fraction of the largest in the image.
    pub min_relative_response: f64,
    /// Least distance between two corners, px.
    pub min_distance_px: f64,
    /// Corners returned at most.
    pub max_corners: usize,
}

impl Default for HarrisRules {
    fn default() -> Self {
        Self {
            gradient_sigma_px: 1.0,
            window_sigma_px: 1.5,
            k: 0.05,
            min_relative_response: 0.01,
            min_distance_px: 5.0,
            max_corners: 500,
        }
    }
}

/// A corner.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Corner {
    /// Column, px.
    pub u_px: f64,
    /// Row, px.
    pub v_px: f64,
    /// Harris response, DN^4 / px^4.
    pub response: f64,
}

/// The Harris response of every pixel, DN^4 / px^4.
///
/// # Errors
/// [`ImageError`] if the pixel buffer does not belong to the size.
pub fn harris_response(image: &Image8, rules: &HarrisRules) -> Result<ImageF, ImageError> {
    let smooth = ImageF::from_image8(image)?.blurred(rules.gradient_sigma_px);
    let (w, h) = (smooth.width(), smooth.height());
    let mut moments = [
        vec![0.0f32; w * h],
        vec![0.0f32; w * h],
        vec![0.0f32; w * h],
    ];
    for v in 0..h {
        let (up, down) = (
            smooth.row(v.saturating_sub(1)),
            smooth.row((v + 1).min(h - 1)),
        );
        let row = smooth.row(v);
        for u in 0..w {
            let gu = 0.5 * (row[(u + 1).min(w - 1)] - row[u.saturating_sub(1)]);
            let gv = 0.5 * (down[u] - up[u]);
            let at = v * w + u;
            moments[0][at] = gu * gu;
            moments[1][at] = gu * gv;
            moments[2][at] = gv * gv;
        }
    }
    let [uu, uv, vv] = moments.map(|m| ImageF::from_parts(w, h, m).blurred(rules.window_sigma_px));
    let k = rules.k as f32;
    let values = uu.values().iter().zip(uv.values()).zip(vv.values());
    let response = values
        .map(|((&a, &b), &c)| a * c - b * b - k * (a + c) * (a + c))
        .collect();
    Ok(ImageF::from_parts(w, h, response))
}

/// Corners, strongest first, refined by a quadratic over 3 x 3 responses.
///
/// # Errors
/// [`ImageError`] if the pixel buffer does not belong to the size.
pub fn harris_corners(image: &Image8, rules: &HarrisRules) -> Result<Vec<Corner>, ImageError> {
    let response = harris_response(image, rules)?;
    let (w, h) = (response.width(), response.height());
    let largest = response.values().iter().copied().fold(0.0f32, f32::max);
    let limit = (f64::from(largest) * rules.min_relative_response) as f32;
    let mut peaks: Vec<(usize, usize, f32)> = Vec::new();
    for v in 1..h.saturating_sub(1) {
        let rows = [response.row(v - 1), response.row(v), response.row(v + 1)];
        for u in 1..w.saturating_sub(1) {
            let r = rows[1][u];
            if !(r > limit && r > 0.0) {
                continue;
            }
            let beats = |j: usize, i: usize| {
                let other = rows[j][u + i - 1];
                other < r || (other == r && (j, i) > (1, 1))
            };
            if (0..9).all(|k| k == 4 || beats(k / 3, k % 3)) {
                peaks.push((u, v, r));
            }
        }
    }
    peaks.sort_by(|a, b| b.2.total_cmp(&a.2).then((a.1, a.0).cmp(&(b.1, b.0))));
    let mut corners: Vec<Corner> = Vec::new();
    for (u, v, r) in peaks {
        if corners.len() >= rules.max_corners {
            break;
        }
        let mut block = [[0.0f64; 3]; 3];
        for (j, line) in block.iter_mut().enumerate() {
            for (i, cell) in line.iter_mut().enumerate() {
                *cell = f64::from(response.row(v + j - 1)[u + i - 1]);
            }
        }
        let (du, dv) = quadratic_peak(&block).unwrap_or((0.0, 0.0));
        let corner = Corner {
            u_px: u as f64 + du,
            v_px: v as f64 + dv,
            response: f64::from(r),
        };
        let near =
            |c: &Corner| (c.u_px - corner.u_px).hypot(c.v_px - corner.v_px) < rules.min_distance_px;
        if !corners.iter().any(near) {
            corners.push(corner);
        }
    }
    Ok(corners)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    /// White squares on grey, with exact area coverage at their borders.
    fn squares(shift: f64) -> Image8 {
        let cover =
            |x: f64, from: f64, to: f64| ((x + 0.5).min(to) - (x - 0.5).max(from)).clamp(0.0, 1.0);
        let pixels = (0..120 * 90)
            .map(|i| {
                let (u, v) = ((i % 120) as f64, (i / 120) as f64);
                let mut x = 60.0;
                for (cu, cv) in [(30.0, 30.0), (80.0, 50.0)] {
                    let inside = cover(u, cu + shift, cu + shift + 20.0) * cover(v, cv, cv + 20.0);
                    x += 140.0 * inside;
                }
                x as u8
            })
            .collect();
        Image8::from_raw(120, 90, pixels).unwrap()
    }

    #[test]
    fn the_corners_of_squares_are_the_strongest_peaks() {
        for shift in [0.0, 0.25, 0.5] {
            let corners = harris_corners(&squares(shift), &HarrisRules::default()).unwrap();
            assert_eq!(corners.len(), 8, "{corners:?}");
            for (cu, cv) in [(30.0, 30.0), (80.0, 50.0)] {
                for (du, dv) in [(0.0, 0.0), (20.0, 0.0), (0.0, 20.0), (20.0, 20.0)] {
                    let (u, v) = (cu + shift + du, cv + dv);
                    let nearest = corners
                        .iter()
                        .map(|c| (c.u_px - u).hypot(c.v_px - v))
                        .fold(f64::INFINITY, f64::min);
                    assert!(nearest < 2.0, "corner ({u}, {v}): {nearest} px"); // pulled inwards
                }
            }
        }
    }

    #[test]
    fn edges_have_a_negative_response_and_flat_areas_none() {
        let response = harris_response(&squares(0.0), &HarrisRules::default()).unwrap();
        assert!(response.row(40)[30] < -1.0);
        assert!(response.row(40)[40].abs() < 1e-3);
        let flat = Image8::from_raw(40, 40, vec![9; 1600]).unwrap();
        assert!(
            harris_corners(&flat, &HarrisRules::default())
                .unwrap()
                .is_empty()
        );
    }

    #[test]
    fn the_number_of_corners_is_limited_and_the_strongest_are_kept() {
        let rules = HarrisRules {
            max_corners: 3,
            ..HarrisRules::default()
        };
        let few = harris_corners(&squares(0.25), &rules).unwrap();
        let all = harris_corners(&squares(0.25), &HarrisRules::default()).unwrap();
        assert_eq!(few[..], all[..3]);
    }
}
