//! The left window of a match: values and gradients, and which gradients serve best in noise.
//!
//! A fit whose derivatives d are noisy gets (d.g) of the step that it should, g being the true
//! derivatives, and promises (d.d): both differ from g.g by the noise in d. With the noise known so
//! is (d.g), from any second set of derivatives of the same window; step and standard deviation are
//! put right by (d.d) / (d.g), and the set with the largest (d.g)^2 / (d.d) is the one to use.

use nalgebra::Vector2;

use super::PreparedImage;
use crate::ncc::SearchImage;

/// Number of partial sums in [`dot`].
pub(super) const LANES: usize = 8;

/// Dot product with a fixed order of summation. Lengths are equal multiples of [`LANES`].
#[inline(always)]
pub(super) fn dot(a: &[f32], b: &[f32]) -> f64 {
    dots([a], b)[0]
}

/// The [`dot`] products of several vectors with one: their sums need not wait for each other.
#[inline(always)]
pub(super) fn dots<const N: usize>(several: [&[f32]; N], one: &[f32]) -> [f64; N] {
    let mut sums = [[0.0f32; LANES]; N];
    let length = one.len() / LANES;
    let (one, _) = one.as_chunks::<LANES>();
    let several = several.map(|a| &a.as_chunks::<LANES>().0[..length]);
    for k in 0..length {
        for (sums, a) in sums.iter_mut().zip(&several) {
            for l in 0..LANES {
                sums[l] += a[k][l] * one[k][l];
            }
        }
    }
    sums.map(|s| f64::from(((s[0] + s[4]) + (s[1] + s[5])) + ((s[2] + s[6]) + (s[3] + s[7]))))
}

/// The left window: values and gradients at whole pixels around a pixel, in rows padded with
/// zeros to whole vectors.
pub(super) struct LeftWindow<'a> {
    image: &'a PreparedImage,
    /// First pixel.
    corner: [usize; 2],
    pub half: usize,
    pub side: usize,
    pub stride: usize,
    /// Offset of the first window pixel from the exact pixel.
    pub first: Vector2<f64>,
    /// Values less their mean.
    pub values: Vec<f32>,
    /// The spline's own gradients.
    pub exact: Gradients,
    /// 1 in the window, 0 in the padding.
    pub ones: Vec<f32>,
    pub mean: f32,
    /// Sum of the squares of `values`.
    pub square: f64,
    /// Standard deviation, DN.
    pub deviation_dn: f64,
}

/// Gradients in u and v, in padded rows.
pub(super) struct Gradients {
    pub u: Vec<f32>,
    pub v: Vec<f32>,
    /// What white noise of variance 1 adds to the mean product with the spline's gradients in one
    /// direction.
    noise_in_common: f64,
}

/// What a set of derivatives holds of the true ones, with which noise.
#[derive(Clone, Copy, Debug)]
pub(super) struct Overlap {
    /// d.d
    own: f64,
    /// d.e with the spline's own derivatives e.
    common: f64,
    /// What white noise of variance 1 adds to `common`.
    noise_in_common: f64,
}

impl Overlap {
    /// (d.d) / (d.g) with the true derivatives g, for noise of this variance, DN^2.
    pub fn inflation(&self, noise_square: f64) -> f64 {
        let noise = noise_square * self.noise_in_common;
        let signal = (self.common - noise).max((1.0 - MOST_NOISE) * self.common);
        if signal > 0.0 {
            (self.own / signal).max(0.2)
        } else {
            1.0
        }
    }
}

/// Of the spline's gradient at a pixel with itself: the sum of the squares of its weights,
/// (sqrt 3 / 2) z^(k - 1) (1 - z^2) at the distances k = 1, 2 ..., z = sqrt 3 - 2.
const EXACT_NOISE: f64 = 1.392;

/// A central difference, smoothed along and across.
struct Kernel {
    /// Weights at the distances 1 and 2 along, odd.
    along: [f32; 2],
    /// Weights at the distances 0, 1 and 2 across, even.
    across: [f32; 3],
    noise_in_common: f64,
}

/// (-1 0 1) / 2 by (1 2 1) / 4, and (-1 -2 0 2 1) / 8 by (1 4 6 4 1) / 16.
const KERNELS: [Kernel; 2] = [
    Kernel {
        along: [0.5, 0.0],
        across: [0.5, 0.25, 0.0],
        noise_in_common: 0.402,
    },
    Kernel {
        along: [0.25, 0.125],
        across: [0.375, 0.25, 0.0625],
        noise_in_common: 0.1305,
    },
];
/// Pixels that a kernel needs around the window.
const KERNEL_REACH: usize = 2;
/// Noise is never held responsible for more than this part of the derivatives.
const MOST_NOISE: f64 = 0.9;

impl<'a> LeftWindow<'a> {
    /// The window of half side `half` around `pixel`; `None` if it leaves the image.
    pub fn new(image: &'a PreparedImage, pixel: &Vector2<f64>, half: usize) -> Option<Self> {
        let (cu, cv) = (pixel.x.round(), pixel.y.round());
        let room = half as f64 + 1.0;
        let fits = |x: f64, size: u32| x >= room && x + room <= f64::from(size) - 1.0;
        if !(fits(cu, image.width_px) && fits(cv, image.height_px)) {
            return None;
        }
        let side = 2 * half + 1;
        let stride = side.div_ceil(LANES) * LANES;
        let (u0, v0) = (cu as usize - half, cv as usize - half);
        let plane = || vec![0.0f32; stride * side];
        let (mut values, mut ones, mut gradient_u, mut gradient_v) =
            (plane(), plane(), plane(), plane());
        let mut sum = 0.0;
        for j in 0..side {
            let at = j * stride..j * stride + side;
            let row = &image.grey.values(v0 + j)[u0..u0 + side];
            for (x, &held) in values[at.clone()].iter_mut().zip(row) {
                *x = SearchImage::grey(held);
                sum += f64::from(*x);
            }
            ones[at.clone()].fill(1.0);
            image
                .spline
                .gradient_row(u0, v0 + j, &mut gradient_u[at.clone()], &mut gradient_v[at]);
        }
        let n = (side * side) as f64;
        let mean = (sum / n) as f32;
        for (x, one) in values.iter_mut().zip(&ones) {
            *x -= mean * one;
        }
        let square = dot(&values, &values);
        Some(Self {
            image,
            corner: [u0, v0],
            half,
            side,
            stride,
            first: Vector2::new(u0 as f64 - pixel.x, v0 as f64 - pixel.y),
            values,
            exact: Gradients {
                u: gradient_u,
                v: gradient_v,
                noise_in_common: EXACT_NOISE,
            },
            ones,
            mean,
            square,
            deviation_dn: (square / n).sqrt(),
        })
    }

    /// Pixels.
    pub fn count(&self) -> f64 {
        (self.side * self.side) as f64
    }

    /// The part of the values' variance that is not noise of this variance, DN^2; a tenth at least.
    pub fn signal_part(&self, noise_square: f64) -> f64 {
        1.0 - (noise_square * self.count() / self.square.max(1e-9)).min(MOST_NOISE)
    }

    /// The best gradients for noise of this variance, DN^2; `None` if those are the spline's own.
    pub fn quieter_gradients(&self, noise_square: f64) -> Option<Gradients> {
        let worth = |own: f64, common: f64, in_common: f64| {
            let noise = 2.0 * self.count() * noise_square * in_common;
            let signal = (common - noise).max((1.0 - MOST_NOISE) * common).max(0.0);
            signal * signal / own.max(1e-9)
        };
        let e = &self.exact;
        let own = dot(&e.u, &e.u) + dot(&e.v, &e.v);
        let mut best = (worth(own, own, EXACT_NOISE), None);
        for kernel in &KERNELS {
            let Some(g) = self.convolved(kernel) else {
                continue;
            };
            let own = dot(&g.u, &g.u) + dot(&g.v, &g.v);
            let common = dot(&g.u, &e.u) + dot(&g.v, &e.v);
            let worth = worth(own, common, g.noise_in_common);
            if worth > best.0 {
                best = (worth, Some(g));
            }
        }
        best.1
    }

    /// Gradients by a kernel; `None` if it leaves the image.
    fn convolved(&self, kernel: &Kernel) -> Option<Gradients> {
        let [u0, v0] = self.corner;
        let r = KERNEL_REACH;
        let fits = |x: usize, size: u32| x >= r && x + self.side + r <= size as usize;
        if !(fits(u0, self.image.width_px) && fits(v0, self.image.height_px)) {
            return None;
        }
        let [a1, a2] = kernel.along;
        let [b0, b1, b2] = kernel.across;
        let wide = self.side + 2 * r;
        let odd = |x: &[f32], k: usize| a1 * (x[k + 3] - x[k + 1]) + a2 * (x[k + 4] - x[k]);
        let even = |x: &[f32], k: usize| {
            b0 * x[k + 2] + b1 * (x[k + 1] + x[k + 3]) + b2 * (x[k] + x[k + 4])
        };
        // rows first: differences for u, means for v
        let (mut by_u, mut by_v) = (
            vec![0.0f32; wide * self.side],
            vec![0.0f32; wide * self.side],
        );
        let mut line = vec![0.0f32; wide];
        for j in 0..wide {
            let row = &self.image.grey.values(v0 + j - r)[u0 - r..u0 - r + wide];
            for (x, &held) in line.iter_mut().zip(row) {
                *x = SearchImage::grey(held);
            }
            for i in 0..self.side {
                by_u[j * self.side + i] = odd(&line, i);
                by_v[j * self.side + i] = even(&line, i);
            }
        }
        let plane = || vec![0.0f32; self.stride * self.side];
        let (mut u, mut v) = (plane(), plane());
        let column =
            |x: &[f32], j: usize, i: usize| [0, 1, 2, 3, 4].map(|k| x[(j + k) * self.side + i]);
        for j in 0..self.side {
            for i in 0..self.side {
                u[j * self.stride + i] = even(&column(&by_u, j, i), 0);
                v[j * self.stride + i] = odd(&column(&by_v, j, i), 0);
            }
        }
        Some(Gradients {
            u,
            v,
            noise_in_common: kernel.noise_in_common,
        })
    }

    /// What derivatives `d` along `direction` (in the left image) that were made from `gradients`
    /// have in common with the window's own.
    #[inline(always)]
    pub fn overlap(&self, d: &[f32], gradients: &Gradients, direction: &Vector2<f64>) -> Overlap {
        let e = &self.exact;
        let [own, by_u, by_v] = dots([d, &e.u, &e.v], d);
        Overlap {
            own,
            common: direction.x * by_u + direction.y * by_v,
            noise_in_common: self.count() * gradients.noise_in_common * direction.norm_squared(),
        }
    }

    /// Takes the left window's mean off samples in padded rows and empties the padding.
    #[inline(always)]
    pub fn centre(&self, samples: &mut [f32]) {
        for (x, one) in samples.iter_mut().zip(&self.ones) {
            *x = if *one > 0.0 { *x - self.mean } else { 0.0 };
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::image::Image8;
    use crate::synthetic;

    /// A texture of wavelengths from 5 px on, with grey noise.
    fn prepared(noise_dn: f64) -> PreparedImage {
        let mut rng = synthetic::rng(5);
        let pixels = (0..80 * 80)
            .map(|i| {
                let (u, v) = (f64::from(i % 80), f64::from(i / 80));
                let x = synthetic::texture(u, v, 40.0, 5.0, 30.0, 8);
                (x + noise_dn * synthetic::normal(&mut rng))
                    .round()
                    .clamp(0.0, 255.0) as u8
            })
            .collect();
        PreparedImage::new(&Image8::from_raw(80, 80, pixels).unwrap()).unwrap()
    }

    #[test]
    fn what_noise_adds_to_the_derivatives_is_what_the_same_image_without_noise_shows() {
        let (clean, noisy) = (prepared(0.0), prepared(8.0));
        let pixel = Vector2::new(40.0, 40.0);
        let truth = LeftWindow::new(&clean, &pixel, 25).unwrap();
        let window = LeftWindow::new(&noisy, &pixel, 25).unwrap();
        let direction = Vector2::new(1.0, 0.0);
        let smoothed = KERNELS.iter().map(|k| window.convolved(k).unwrap());
        let exact = LeftWindow::new(&noisy, &pixel, 25).unwrap().exact;
        let mut found = Vec::new();
        for gradients in std::iter::once(exact).chain(smoothed) {
            let d = &gradients.u;
            let stated = window.overlap(d, &gradients, &direction).inflation(64.0);
            let measured = dot(d, d) / dot(d, &truth.exact.u);
            println!("(d.d) / (d.g): {stated:.3} stated, {measured:.3} measured");
            assert!((stated / measured - 1.0).abs() < 0.2, "{stated} {measured}");
            found.push(measured);
        }
        assert!(found[0] > 2.0 && found[1] < found[0] && found[2] < found[1]);
        assert!((window.signal_part(64.0) * window.square / truth.square - 1.0).abs() < 0.05);
    }

    #[test]
    fn gradients_are_smoothed_in_noise_and_only_there() {
        let pixel = Vector2::new(40.0, 40.0);
        let (clean, noisy) = (prepared(0.0), prepared(8.0));
        let window = LeftWindow::new(&clean, &pixel, 7).unwrap();
        assert!(window.quieter_gradients(0.01).is_none());
        let window = LeftWindow::new(&noisy, &pixel, 7).unwrap();
        assert!(window.quieter_gradients(64.0).is_some());
        // too close to the border for the smoothing, but not for the window
        let window = LeftWindow::new(&noisy, &Vector2::new(8.0, 40.0), 7).unwrap();
        assert!(window.quieter_gradients(64.0).is_none());
    }
}
