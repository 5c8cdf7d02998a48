//! Values and gradients between the pixels.
//!
//! Three interpolators: bilinear (fast, biased), Keys' cubic convolution with a = -1/2
//! (Catmull-Rom; no preparation), and the cubic B-spline through the pixel values (M. Unser,
//! "Splines: a perfect fit", 1999), whose phase error is the smallest and which subpixel matching
//! uses.

mod grid;

use crate::image::ImageF;

pub(crate) use grid::{CHUNK, Grid};

/// A value and its derivatives to the right and downwards, per px.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// Interpolated value.
    pub value: f32,
    /// Derivative with respect to u, per px.
    pub du: f32,
    /// Derivative with respect to v, per px.
    pub dv: f32,
}

/// Splits a coordinate into the index of the pixel at or before it and the rest, provided that
/// `before` pixels before and `after` pixels after that index exist.
#[inline]
fn split(x: f64, size: usize, before: usize, after: usize) -> Option<(usize, f32)> {
    if !(x >= before as f64 && x <= size as f64) {
        return None;
    }
    let index = x as usize;
    if index + after < size {
        Some((index, (x - index as f64) as f32))
    } else if index > before && index + after == size && x == index as f64 {
        Some((index - 1, 1.0)) // exactly on the last admissible pixel
    } else {
        None
    }
}

/// Bilinear value and gradient at (`u`, `v`); `None` outside the pixel centres.
#[must_use]
pub fn bilinear(image: &ImageF, u: f64, v: f64) -> Option<Sample> {
    let (iu, fu) = split(u, image.width(), 0, 1)?;
    let (iv, fv) = split(v, image.height(), 0, 1)?;
    let (upper, lower) = (image.row(iv), image.row(iv + 1));
    let (a, b, c, d) = (upper[iu], upper[iu + 1], lower[iu], lower[iu + 1]);
    let (top, bottom) = (a + (b - a) * fu, c + (d - c) * fu);
    Some(Sample {
        value: top + (bottom - top) * fv,
        du: (b - a) * (1.0 - fv) + (d - c) * fv,
        dv: bottom - top,
    })
}

/// Weights of Keys' kernel (a = -1/2) for the pixels at -1, 0, 1, 2 and their derivatives.
fn keys_weights(t: f32) -> ([f32; 4], [f32; 4]) {
    let (t2, t3) = (t * t, t * t * t);
    (
        [
            -0.5 * t3 + t2 - 0.5 * t,
            1.5 * t3 - 2.5 * t2 + 1.0,
            -1.5 * t3 + 2.0 * t2 + 0.5 * t,
            0.5 * t3 - 0.5 * t2,
        ],
        [
            -1.5 * t2 + 2.0 * t - 0.5,
            4.5 * t2 - 5.0 * t,
            -4.5 * t2 + 4.0 * t + 0.5,
            1.5 * t2 - t,
        ],
    )
}

/// Weights of the cubic B-spline for the coefficients at -1, 0, 1, 2.
#[inline(always)]
fn spline_weights(t: f32) -> [f32; 4] {
    let s = 1.0 - t;
    let (t2, s2) = (t * t, s * s);
    [
        s2 * s * (1.0 / 6.0),
        2.0 / 3.0 - 0.5 * t2 * (2.0 - t),
        2.0 / 3.0 - 0.5 * s2 * (2.0 - s),
        t2 * t * (1.0 / 6.0),
    ]
}

/// Derivatives of [`spline_weights`].
#[inline(always)]
fn spline_slopes(t: f32) -> [f32; 4] {
    let s = 1.0 - t;
    [
        -0.5 * s * s,
        -2.0 * t + 1.5 * t * t,
        2.0 * s - 1.5 * s * s,
        0.5 * t * t,
    ]
}

/// Sums a 4 x 4 neighbourhood with separable weights.
fn gather(image: &ImageF, iu: usize, iv: usize, wu: &[f32; 4], wv: &[f32; 4]) -> f32 {
    (0..4)
        .map(|j| {
            let row = &image.row(iv + j - 1)[iu - 1..iu + 3];
            wv[j] * (wu[0] * row[0] + wu[1] * row[1] + wu[2] * row[2] + wu[3] * row[3])
        })
        .sum()
}

/// Keys' bicubic value and gradient at (`u`, `v`); `None` closer than one pixel to the border.
#[must_use]
pub fn bicubic(image: &ImageF, u: f64, v: f64) -> Option<Sample> {
    let (iu, fu) = split(u, image.width(), 1, 2)?;
    let (iv, fv) = split(v, image.height(), 1, 2)?;
    let ((wu, su), (wv, sv)) = (keys_weights(fu), keys_weights(fv));
    Some(Sample {
        value: gather(image, iu, iv, &wu, &wv),
        du: gather(image, iu, iv, &su, &wv),
        dv: gather(image, iu, iv, &wu, &sv),
    })
}

/// An image as the coefficients of the cubic B-spline surface through its pixel values.
#[derive(Clone, Debug)]
pub struct SplineImage {
    coefficients: ImageF,
}

/// Pole of the cubic B-spline's inverse filter, sqrt(3) - 2.
const POLE: f64 = -0.267_949_192_431_122_7;
/// Terms kept on each side of the inverse filter: `POLE`^9 is 7e-6.
const PREFILTER_RADIUS: usize = 8;

impl SplineImage {
    /// The spline through the pixel values (inverse filter cut after 8 terms and normalised: error
    /// below 1e-4 of the local contrast; borders repeated).
    #[must_use]
    pub fn new(image: &ImageF) -> Self {
        let raw: Vec<f64> = (0..=PREFILTER_RADIUS)
            .map(|k| POLE.powi(k as i32))
            .collect();
        let sum = raw[0] + 2.0 * raw[1..].iter().sum::<f64>();
        let kernel: Vec<f32> = raw.iter().map(|x| (x / sum) as f32).collect();
        Self {
            coefficients: image.convolved_separable(&kernel),
        }
    }

    /// Width, px.
    #[must_use]
    pub fn width(&self) -> usize {
        self.coefficients.width()
    }

    /// Height, px.
    #[must_use]
    pub fn height(&self) -> usize {
        self.coefficients.height()
    }

    /// Value and gradient at (`u`, `v`); `None` closer than one pixel to the border.
    #[must_use]
    pub fn sample(&self, u: f64, v: f64) -> Option<Sample> {
        let (iu, fu) = split(u, self.width(), 1, 2)?;
        let (iv, fv) = split(v, self.height(), 1, 2)?;
        let (wu, wv) = (spline_weights(fu), spline_weights(fv));
        let image = &self.coefficients;
        Some(Sample {
            value: gather(image, iu, iv, &wu, &wv),
            du: gather(image, iu, iv, &spline_slopes(fu), &wv),
            dv: gather(image, iu, iv, &wu, &spline_slopes(fv)),
        })
    }

    /// The value of [`SplineImage::sample`] alone.
    #[must_use]
    pub fn value(&self, u: f64, v: f64) -> Option<f32> {
        let (iu, fu) = split(u, self.width(), 1, 2)?;
        let (iv, fv) = split(v, self.height(), 1, 2)?;
        let (wu, wv) = (spline_weights(fu), spline_weights(fv));
        Some(gather(&self.coefficients, iu, iv, &wu, &wv))
    }

    /// Whether [`SplineImage::sample`] has a value at (`u`, `v`).
    #[must_use]
    pub fn covers(&self, u: f64, v: f64) -> bool {
        u >= 1.0 && v >= 1.0 && u <= self.width() as f64 - 2.0 && v <= self.height() as f64 - 2.0
    }

    /// Gradients exactly at the pixels (`iu`..) of row `iv`, all at least one pixel inside.
    pub(crate) fn gradient_row(&self, iu: usize, iv: usize, du: &mut [f32], dv: &mut [f32]) {
        let (width, n) = (self.width(), du.len());
        let start = (iv - 1) * width + iu - 1;
        let values = self.coefficients.values();
        let line = |k: usize| &values[start + k * width..start + k * width + n + 2];
        let (a, b, c) = (line(0), line(1), line(2));
        const E: f32 = 1.0 / 12.0;
        const M: f32 = 4.0 / 12.0;
        for (i, (du, dv)) in du.iter_mut().zip(dv).enumerate() {
            *du = E * ((a[i + 2] - a[i]) + (c[i + 2] - c[i])) + M * (b[i + 2] - b[i]);
            *dv = E * ((c[i] - a[i]) + (c[i + 2] - a[i + 2])) + M * (c[i + 1] - a[i + 1]);
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    fn wave(u: f64, v: f64) -> f64 {
        120.0 + 40.0 * (0.9 * u + 0.3 * v).sin() + 25.0 * (0.7 * v - 0.2 * u).cos()
    }

    pub(super) fn wave_image() -> ImageF {
        let values = (0..40 * 30).map(|i| wave((i % 40) as f64, (i / 40) as f64) as f32);
        ImageF::from_raw(40, 30, values.collect()).unwrap()
    }

    fn worst(of: impl Fn(f64, f64) -> Sample) -> (f64, f64) {
        let mut worst = (0.0f64, 0.0f64);
        for k in 0..400 {
            let u = 8.0 + 23.0 * (k as f64 * 0.618_034).fract();
            let v = 8.0 + 13.0 * (k as f64 * 0.414_214).fract();
            let s = of(u, v);
            worst.0 = worst.0.max((f64::from(s.value) - wave(u, v)).abs());
            let h = 1e-3;
            let du = f64::from(of(u + h, v).value - of(u - h, v).value) / (2.0 * h);
            let dv = f64::from(of(u, v + h).value - of(u, v - h).value) / (2.0 * h);
            worst.1 = worst.1.max(
                (du - f64::from(s.du))
                    .abs()
                    .max((dv - f64::from(s.dv)).abs()),
            );
        }
        worst
    }

    #[test]
    fn the_spline_follows_a_wave_far_better_than_keys_and_bilinear() {
        let image = wave_image();
        let spline = SplineImage::new(&image);
        let (by_spline, _) = worst(|u, v| spline.sample(u, v).unwrap());
        let (by_keys, _) = worst(|u, v| bicubic(&image, u, v).unwrap());
        let (by_line, _) = worst(|u, v| bilinear(&image, u, v).unwrap());
        assert!(by_spline < 0.15, "spline {by_spline}");
        assert!(by_keys < 1.5 && by_keys > by_spline, "keys {by_keys}");
        assert!(by_line > by_keys, "bilinear {by_line}");
    }

    #[test]
    fn gradients_are_the_derivatives_of_the_values() {
        let image = wave_image();
        let spline = SplineImage::new(&image);
        assert!(worst(|u, v| spline.sample(u, v).unwrap()).1 < 0.15);
        assert!(worst(|u, v| bicubic(&image, u, v).unwrap()).1 < 0.6); // kinked at pixels
    }

    #[test]
    fn pixels_are_reproduced_and_the_border_is_refused() {
        let image = wave_image();
        let spline = SplineImage::new(&image);
        for (u, v) in [(3usize, 4usize), (20, 11), (37, 27), (1, 1)] {
            let exact = image.row(v)[u];
            let s = spline.sample(u as f64, v as f64).unwrap();
            if u > 8 && v > 8 && u < 31 && v < 21 {
                assert!((s.value - exact).abs() < 2e-3, "{} {exact}", s.value);
            }
            let (mut du, mut dv) = ([0.0; 1], [0.0; 1]);
            spline.gradient_row(u, v, &mut du, &mut dv);
            let g = [du[0], dv[0]];
            assert!((g[0] - s.du).abs() < 1e-3 && (g[1] - s.dv).abs() < 1e-3);
            assert_eq!(bilinear(&image, u as f64, v as f64).unwrap().value, exact);
            assert!((bicubic(&image, u as f64, v as f64).unwrap().value - exact).abs() < 1e-4);
        }
        assert!(bilinear(&image, 39.0, 29.0).is_some());
        for (u, v) in [
            (-0.1, 5.0),
            (39.5, 5.0),
            (5.0, f64::NAN),
            (f64::INFINITY, 3.0),
        ] {
            assert!(bilinear(&image, u, v).is_none());
            assert!(spline.sample(u, v).is_none());
        }
        assert!(spline.sample(0.5, 5.0).is_none());
        assert!(spline.sample(38.0, 28.0).is_some() && spline.covers(38.0, 28.0));
    }
}
