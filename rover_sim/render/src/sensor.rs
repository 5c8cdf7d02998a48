//! From radiance to grey levels: lens blur, photon and read noise, eight bits.

use crate::error::RenderError;
use crate::simd::{Lanes, Simd, dispatched};
use rayon::prelude::*;

/// How a camera turns radiance into grey levels; the response is linear.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImagingParameters {
    /// Standard deviation of the lens's Gaussian point spread, pixels; 0 for none, at most 3.
    pub psf_sigma_px: f64,
    /// Grey levels per unit of radiance. A diffuse surface of albedo `a` that faces a sun of
    /// intensity 1 has radiance `a`. The brightest mark that is to be measured should stay below
    /// level 235 (a clipped white moves its edges), the ground should be at 100 to 120. The
    /// default does both for ground of albedo 0.43 under a sun 40 deg high and marks of albedo 0.5.
    pub gain_dn: f64,
    /// Standard deviation of the read noise, grey levels; 0 for none.
    pub read_noise_dn: f64,
    /// Photo-electrons per grey level; the photon noise of a pixel at level `g` has standard
    /// deviation `sqrt(g / electrons_per_dn)`. Infinite for none.
    pub electrons_per_dn: f64,
}

impl Default for ImagingParameters {
    fn default() -> Self {
        Self {
            psf_sigma_px: 0.6,
            gain_dn: 420.0,
            read_noise_dn: 0.5,
            electrons_per_dn: 150.0,
        }
    }
}

impl ImagingParameters {
    pub(crate) fn check(&self) -> Result<(), RenderError> {
        for (what, value, low, high) in [
            ("psf_sigma_px", self.psf_sigma_px, 0.0, 3.0),
            ("gain_dn", self.gain_dn, 1e-9, 1e9),
            ("read_noise_dn", self.read_noise_dn, 0.0, 255.0),
            (
                "electrons_per_dn",
                self.electrons_per_dn,
                1e-3,
                f64::INFINITY,
            ),
        ] {
            if !(value >= low && value <= high) {
                return Err(RenderError::Imaging {
                    what,
                    value,
                    low,
                    high,
                });
            }
        }
        Ok(())
    }
}

/// An image of eight-bit grey levels, row by row from the top left.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Grey8 {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `width * height` levels.
    pub pixels: Vec<u8>,
}

/// `exp(-x)` for `x` in 0..50 by arithmetic alone, the same on every machine.
fn exp_minus(x: f64) -> f64 {
    let y = -x / 64.0;
    let series = (1..=14)
        .rev()
        .fold(1.0, |sum, k| 1.0 + sum * y / f64::from(k));
    (0..6).fold(series, |e, _| e * e)
}

/// Half of a normalised Gaussian kernel, centre first.
fn kernel(sigma_px: f64) -> Vec<f32> {
    if sigma_px < 0.05 {
        return vec![1.0];
    }
    let radius = (3.5 * sigma_px).ceil() as usize;
    let half: Vec<f64> = (0..=radius)
        .map(|i| exp_minus(0.5 * (i as f64 / sigma_px).powi(2)))
        .collect();
    let sum = half[0] + 2.0 * half[1..].iter().sum::<f64>();
    half.iter().map(|w| (w / sum) as f32).collect()
}

/// Exposes an image of radiances. `noise_seed` decides the noise, pixel by pixel.
pub(crate) fn expose(
    level: crate::simd::Level,
    width: usize,
    height: usize,
    radiance: &[f32],
    parameters: &ImagingParameters,
    noise_seed: u64,
) -> Grey8 {
    let kernel = kernel(parameters.psf_sigma_px);
    let radius = kernel.len() - 1;
    let padded = width.div_ceil(8) * 8;
    let mut across = vec![0.0_f32; padded * height];
    across
        .par_chunks_mut(padded)
        .zip(radiance.par_chunks(width))
        .with_min_len(32)
        .for_each_init(
            || vec![0.0_f32; padded + 2 * radius],
            |wide, (out, row)| {
                wide[..radius].fill(row[0]);
                wide[radius..radius + width].copy_from_slice(row);
                wide[radius + width..].fill(row[width - 1]);
                blur_row(level, &kernel, wide, out);
            },
        );
    let noise = Noise {
        seed: noise_seed,
        gain: parameters.gain_dn as f32,
        read_variance: (parameters.read_noise_dn * parameters.read_noise_dn) as f32,
        variance_per_level: (1.0 / parameters.electrons_per_dn) as f32,
    };
    let mut pixels = vec![0_u8; width * height];
    pixels
        .par_chunks_mut(width)
        .enumerate()
        .with_min_len(32)
        .for_each_init(
            || vec![0.0_f32; padded],
            |row, (v, out)| {
                let line = |offset: isize| {
                    let at = (v as isize + offset).clamp(0, height as isize - 1) as usize;
                    &across[at * padded..(at + 1) * padded]
                };
                let lines: Vec<&[f32]> = (-(radius as isize)..=radius as isize).map(line).collect();
                blur_column(level, &kernel, &lines, row);
                noise.quantise(row, v * width, out);
            },
        );
    Grey8 {
        width,
        height,
        pixels,
    }
}

dispatched! {
    fn blur_row = blur_row_kernel(kernel: &[f32], wide: &[f32], out: &mut [f32])
}

/// `wide` is `out` with the kernel's radius added at either end.
#[inline(always)]
fn blur_row_kernel<S: Simd>(kernel: &[f32], wide: &[f32], out: &mut [f32]) {
    let radius = kernel.len() - 1;
    for (i, eight) in out.as_chunks_mut::<8>().0.iter_mut().enumerate() {
        let at = |shift: usize| S::load(lanes(&wide[i * 8 + shift..]));
        let mut sum = S::splat(kernel[0]) * at(radius);
        for (k, &w) in kernel.iter().enumerate().skip(1) {
            sum = sum + S::splat(w) * (at(radius - k) + at(radius + k));
        }
        S::store(sum, eight);
    }
}

dispatched! {
    fn blur_column = blur_column_kernel(kernel: &[f32], lines: &[&[f32]], out: &mut [f32])
}

#[inline(always)]
fn blur_column_kernel<S: Simd>(kernel: &[f32], lines: &[&[f32]], out: &mut [f32]) {
    let radius = kernel.len() - 1;
    for (i, eight) in out.as_chunks_mut::<8>().0.iter_mut().enumerate() {
        let at = |line: usize| S::load(lanes(&lines[line][i * 8..]));
        let mut sum = S::splat(kernel[0]) * at(radius);
        for (k, &w) in kernel.iter().enumerate().skip(1) {
            sum = sum + S::splat(w) * (at(radius - k) + at(radius + k));
        }
        S::store(sum, eight);
    }
}

/// The first eight values.
#[inline(always)]
fn lanes(x: &[f32]) -> &Lanes {
    &x.as_chunks::<8>().0[0]
}

struct Noise {
    seed: u64,
    gain: f32,
    read_variance: f32,
    variance_per_level: f32,
}

/// The finaliser of SplitMix64: every bit of the result depends on every bit of the input.
pub(crate) fn mix(x: u64) -> u64 {
    let x = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// A normal deviate from a hash: the number of ones among 64 bits (binomial, standard deviation 4)
/// smoothed by a uniform value one count wide.
fn deviate(seed: u64, index: usize) -> f32 {
    let h = mix(seed ^ (index as u64).wrapping_mul(0xd134_2543_de82_ef95));
    let ones = (h.count_ones() as i32 - 32) as f32;
    let smooth = (mix(h) >> 40) as f32 / 16_777_216.0 - 0.5;
    // variance 16 + 1/12
    (ones + smooth) * 0.249_351_6
}

impl Noise {
    fn quantise(&self, radiance: &[f32], first: usize, out: &mut [u8]) {
        let quiet = self.read_variance == 0.0 && self.variance_per_level == 0.0;
        for (i, (level, &light)) in out.iter_mut().zip(radiance).enumerate() {
            let mut g = light * self.gain;
            if !quiet {
                let variance = self.read_variance + self.variance_per_level * g.max(0.0);
                g += variance.sqrt() * deviate(self.seed, first + i);
            }
            *level = (g + 0.5).clamp(0.0, 255.0) as u8;
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use crate::simd::Level;

    #[test]
    fn deviates_are_standard_normal() {
        let n = 400_000;
        let values: Vec<f64> = (0..n).map(|i| f64::from(deviate(7, i))).collect();
        let moment = |k: i32| values.iter().map(|x| x.powi(k)).sum::<f64>() / n as f64;
        assert!(moment(1).abs() < 0.005, "mean {}", moment(1));
        assert!((moment(2) - 1.0).abs() < 0.01, "variance {}", moment(2));
        assert!(moment(3).abs() < 0.03, "skew {}", moment(3));
        assert!((moment(4) - 3.0).abs() < 0.1, "kurtosis {}", moment(4));
        let neighbours: f64 = values.windows(2).map(|w| w[0] * w[1]).sum::<f64>() / n as f64;
        assert!(neighbours.abs() < 0.006, "correlation {neighbours}");
    }

    #[test]
    fn blur_keeps_the_sum_and_has_the_stated_width() {
        let (w, h) = (64, 48);
        let mut radiance = vec![0.0; w * h];
        radiance[24 * w + 32] = 1.0;
        let p = ImagingParameters {
            psf_sigma_px: 1.0,
            gain_dn: 1500.0,
            read_noise_dn: 0.0,
            electrons_per_dn: f64::INFINITY,
        };
        let image = expose(Level::Portable, w, h, &radiance, &p, 0);
        let (mut sum, mut spread) = (0.0, 0.0);
        for (i, &g) in image.pixels.iter().enumerate() {
            let (u, v) = ((i % w) as f64 - 32.0, (i / w) as f64 - 24.0);
            sum += f64::from(g);
            spread += f64::from(g) * (u * u + v * v) / 2.0;
        }
        assert!((sum - 1500.0).abs() < 15.0, "{sum}");
        assert!((spread / sum - 1.0).abs() < 0.03, "{}", spread / sum);
    }

    #[test]
    fn own_exponential_agrees_with_the_library() {
        for i in 0..100 {
            let x = f64::from(i) * 0.1;
            assert!((exp_minus(x) - (-x).exp()).abs() < 1e-14 * (-x).exp() * 100.0);
        }
    }

    #[test]
    fn noise_grows_with_the_square_root_of_the_light() {
        let p = ImagingParameters {
            psf_sigma_px: 0.0,
            gain_dn: 100.0,
            read_noise_dn: 1.0,
            electrons_per_dn: 20.0,
        };
        for light in [0.5_f32, 2.0] {
            let image = expose(Level::Portable, 256, 256, &vec![light; 65536], &p, 3);
            let n = image.pixels.len() as f64;
            let mean = image.pixels.iter().map(|&g| f64::from(g)).sum::<f64>() / n;
            let var = image
                .pixels
                .iter()
                .map(|&g| (f64::from(g) - mean).powi(2))
                .sum::<f64>()
                / n;
            let expected = 1.0 + f64::from(light) * 100.0 / 20.0 + 1.0 / 12.0;
            assert!((var / expected - 1.0).abs() < 0.03, "{var} {expected}");
        }
    }
}
