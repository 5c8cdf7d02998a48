//! What the noise allows: the Cramer-Rao bound of a patch's position, from the same patch without
//! noise.
//!
//! Grey values = gain * picture(W(pixel)) + offset (+ a ramp) + white noise. The bound is the root
//! of the position's entry of the inverse Fisher matrix, W's other parameters, gain, offset and ramp
//! being unknown as well. Below it no unbiased estimator from that window can go.

use nalgebra::DMatrix;
use rover_vision::{Image8, PreparedImage};

/// Which parameters are unknown beside the position.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unknown {
    /// Position in u and v, affine map, gain, offset and ramp.
    Affine,
    /// Position along u with its slopes in u and v, gain and offset.
    Disparity,
}

/// Bound of the standard deviation per coordinate, px: of the window of half side `half` around
/// `centre` of the noise-free `clean`, for grey noise of `noise_dn` in units of `clean`. `None` if
/// the window leaves the image or tells nothing.
pub fn bound_px(
    clean: &Image8,
    centre: [i64; 2],
    half: i64,
    noise_dn: f64,
    unknown: Unknown,
) -> Option<f64> {
    let spline = PreparedImage::new(clean).ok()?;
    let size = if unknown == Unknown::Affine { 10 } else { 5 };
    let mut fisher = DMatrix::<f64>::zeros(size, size);
    for j in -half..=half {
        for i in -half..=half {
            let at = spline.sample((centre[0] + i) as f64, (centre[1] + j) as f64)?;
            let [value, du, dv] = [at.value, at.du, at.dv].map(f64::from);
            let (x, y) = (i as f64 / half as f64, j as f64 / half as f64);
            let row = match unknown {
                Unknown::Affine => {
                    vec![du, dv, du * x, du * y, dv * x, dv * y, value, 1.0, x, y]
                }
                Unknown::Disparity => vec![du, du * x, du * y, value, 1.0],
            };
            for (p, a) in row.iter().enumerate() {
                for (q, b) in row.iter().enumerate() {
                    fisher[(p, q)] += a * b;
                }
            }
        }
    }
    let inverse = fisher.cholesky()?.inverse();
    let variance = match unknown {
        Unknown::Affine => 0.5 * (inverse[(0, 0)] + inverse[(1, 1)]),
        Unknown::Disparity => inverse[(0, 0)],
    };
    let bound = noise_dn * variance.sqrt();
    bound.is_finite().then_some(bound)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_bound_of_a_wave_is_that_of_its_slopes_and_scales_with_the_noise() {
        let pixels = (0..41 * 41)
            .map(|i| {
                let (u, v) = (f64::from(i % 41), f64::from(i / 41));
                (127.0 + 50.0 * (0.5 * u).sin() + 50.0 * (0.5 * v).sin()).round() as u8
            })
            .collect();
        let image = Image8::from_raw(41, 41, pixels).unwrap();
        let one = bound_px(&image, [20, 20], 12, 1.0, Unknown::Affine).unwrap();
        let five = bound_px(&image, [20, 20], 12, 5.0, Unknown::Affine).unwrap();
        assert!((five / one - 5.0).abs() < 1e-9);
        // mean square slope 25^2 / 2 over 625 px, and little lost to the other parameters
        let alone = 1.0 / (312.5f64 * 625.0).sqrt();
        assert!(one > 0.95 * alone && one < 1.5 * alone, "{one} {alone}");
        assert!(bound_px(&image, [2, 20], 12, 1.0, Unknown::Disparity).is_none());
    }
}
