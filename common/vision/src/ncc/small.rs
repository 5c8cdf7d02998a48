//! Scores of rectangular templates whose window sums fit 32 bits, a vector at a time.
//!
//! The same formula on the same whole numbers as in [`super::score`], so the same scores to the
//! last bit; only the sums are held shorter, which lets the compiler use whole vectors.

use super::dots::dots;
use super::{SearchImage, Template, VALUE_LIMIT};

/// Whether all sums over the template's window fit an `i32`.
pub(super) fn is_small(template: &Template) -> bool {
    template.rectangular && template.count as i64 * VALUE_LIMIT * VALUE_LIMIT <= i64::from(i32::MAX)
}

/// What the score's formula needs beside the sums.
#[derive(Clone, Copy)]
pub(super) struct Scale {
    /// Number of pixels.
    pub n: f64,
    /// Mean of the template's values.
    pub mean: f64,
    pub inverse_norm: f64,
    /// Variance times n up to which a window counts as flat.
    pub flat: f32,
}

impl Scale {
    /// The score of one position.
    #[inline(always)]
    pub fn score(&self, product: i32, sum: f64, square: f64) -> f32 {
        let variance = (square - sum * sum / self.n) as f32;
        let covariance = ((f64::from(product) - self.mean * sum) * self.inverse_norm) as f32;
        let score = covariance / variance.sqrt();
        if variance <= self.flat { 0.0 } else { score }
    }
}

/// Positions of a row of scores and where it starts.
#[derive(Clone, Copy)]
pub(super) struct Extent {
    pub left: usize,
    pub top: usize,
    pub width: usize,
    pub height: usize,
}

/// Appends the scores of all positions, row by row. The template is small and inside the image at
/// all of them.
pub(super) fn scores(
    image: &SearchImage,
    template: &Template,
    extent: Extent,
    scale: &Scale,
    out: &mut Vec<f32>,
) {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { scores_avx2(image, template, extent, scale, out) };
    }
    scores_plain(image, template, extent, scale, out);
}

/// The same with wider vectors.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn scores_avx2(
    image: &SearchImage,
    template: &Template,
    extent: Extent,
    scale: &Scale,
    out: &mut Vec<f32>,
) {
    scores_plain(image, template, extent, scale, out);
}

#[inline(always)]
fn scores_plain(
    image: &SearchImage,
    template: &Template,
    extent: Extent,
    scale: &Scale,
    out: &mut Vec<f32>,
) {
    let Extent {
        left, top, width, ..
    } = extent;
    let covered = width + template.width - 1;
    let line = |y: usize| &image.row(y)[left..left + covered];
    let (mut sums, mut squares) = (vec![0i32; covered], vec![0i32; covered]);
    for y in top..top + template.height {
        change::<1>(line(y), &mut sums, &mut squares);
    }
    let (mut window_sums, mut window_squares) = (vec![0i32; width], vec![0i32; width]);
    let mut products = vec![0i32; width];
    for y in top..top + extent.height {
        if y > top {
            change::<-1>(line(y - 1), &mut sums, &mut squares);
            change::<1>(line(y + template.height - 1), &mut sums, &mut squares);
        }
        boxes(&sums, template.width, &mut window_sums);
        boxes(&squares, template.width, &mut window_squares);
        dots(template, image, left, y, &mut products);
        let windows = window_sums.iter().zip(&window_squares);
        out.extend(
            products
                .iter()
                .zip(windows)
                .map(|(&p, (&sum, &square))| scale.score(p, f64::from(sum), f64::from(square))),
        );
    }
}

/// Adds a row to the column sums, or takes it away.
#[inline(always)]
fn change<const SIGN: i32>(row: &[i16], sums: &mut [i32], squares: &mut [i32]) {
    for ((sum, square), &x) in sums.iter_mut().zip(squares).zip(row) {
        let x = i32::from(x);
        *sum += SIGN * x;
        *square += SIGN * (x * x);
    }
}

/// Widest box that is summed up anew at every place.
const NARROW: usize = 16;

/// Sums of `side` neighbouring columns.
#[inline(always)]
fn boxes(columns: &[i32], side: usize, out: &mut [i32]) {
    let n = out.len();
    if side <= NARROW {
        out.copy_from_slice(&columns[..n]);
        for k in 1..side {
            for (o, c) in out.iter_mut().zip(&columns[k..k + n]) {
                *o += c;
            }
        }
        return;
    }
    let mut sum: i32 = columns[..side].iter().sum();
    out[0] = sum;
    let ends = columns[side..].iter().zip(columns);
    for (o, (new, old)) in out[1..].iter_mut().zip(ends) {
        sum += new - old;
        *o = sum;
    }
}
