//! The template: zero-mean values in whole numbers, with a mask.

use std::borrow::Cow;

use super::LANES;
use crate::image::Image8;

/// Why a template could not be made.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum TemplateError {
    /// Width times height is not the number of values (or of mask entries), or is zero.
    #[error("a template of {width} x {height} needs as many values and mask entries, got {found}")]
    WrongLength {
        /// Stated width, px.
        width: usize,
        /// Stated height, px.
        height: usize,
        /// Entries given.
        found: usize,
    },
    /// Fewer than two pixels are inside the mask, or too many for exact sums.
    #[error("a template needs 2 to {limit} pixels inside its mask, got {found}")]
    BadCount {
        /// Pixels inside the mask.
        found: usize,
        /// Most pixels allowed.
        limit: usize,
    },
    /// The values inside the mask are all equal, or not finite.
    #[error("the template has no contrast (standard deviation {0}), nothing can be found with it")]
    NoContrast(f64),
}

/// A run of masked-in pixels in one template row.
#[derive(Clone, Copy, Debug)]
pub(super) struct Span {
    pub row: usize,
    pub start: usize,
    pub end: usize,
}

/// A zero-mean template with a mask, ready for correlation.
#[derive(Clone, Debug)]
pub struct Template {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) stride: usize,
    pub(super) values: Vec<i16>,
    /// 1 inside the mask and 0 outside, laid out as `values`; empty if all is inside.
    pub(super) mask: Vec<i16>,
    pub(super) spans: Vec<Span>,
    pub(super) rectangular: bool,
    pub(super) count: usize,
    /// Mean of `values` inside the mask.
    pub(super) mean: f64,
    pub(super) norm: f64,
}

/// Rounds to the nearest whole number, half to even; the argument is within +-4097. A sum that
/// pushes the fraction out of the significand: unlike a cast, vectors have it.
#[inline(always)]
fn round_to_i16(x: f32) -> i16 {
    const PUSH: f32 = 12_582_912.0; // 1.5 * 2^23, whose lowest bits are 0
    (x + PUSH).to_bits() as i16
}

/// The runs of `true` in each row.
fn spans_of(mask: &[bool], width: usize) -> Vec<Span> {
    let mut spans = Vec::new();
    for (row, line) in mask.chunks_exact(width).enumerate() {
        let mut start = None;
        for (column, &on) in line.iter().chain(std::iter::once(&false)).enumerate() {
            match (on, start) {
                (true, None) => start = Some(column),
                (false, Some(first)) => {
                    spans.push(Span {
                        row,
                        start: first,
                        end: column,
                    });
                    start = None;
                }
                _ => {}
            }
        }
    }
    spans
}

/// One run for each row.
fn whole_rows(width: usize, height: usize) -> Vec<Span> {
    let whole = |row| Span {
        row,
        start: 0,
        end: width,
    };
    (0..height).map(whole).collect()
}

/// Two sums over values, in four parts each, which need not wait for each other.
fn sums(values: &[f32], of: impl Fn(f64) -> [f64; 2]) -> [f64; 2] {
    let (mut a, mut b) = ([0.0f64; 4], [0.0f64; 4]);
    let fours = values.chunks_exact(4);
    let rest = fours.remainder();
    for four in fours {
        for k in 0..4 {
            let [x, y] = of(f64::from(four[k]));
            a[k] += x;
            b[k] += y;
        }
    }
    for (k, &x) in rest.iter().enumerate() {
        let [x, y] = of(f64::from(x));
        a[k] += x;
        b[k] += y;
    }
    [a, b].map(|x| (x[0] + x[1]) + (x[2] + x[3]))
}

/// Most pixels in a template.
const MAX_COUNT: usize = 65_536;

impl Template {
    /// A template of `width` x `height` values (any unit; only contrast counts), row by row.
    /// Pixels whose mask entry is `false` are ignored.
    ///
    /// # Errors
    /// [`TemplateError`] if the lengths do not fit or there is no contrast.
    pub fn new(
        width: usize,
        height: usize,
        values: &[f32],
        mask: Option<&[bool]>,
    ) -> Result<Self, TemplateError> {
        let wrong = |found| TemplateError::WrongLength {
            width,
            height,
            found,
        };
        if width == 0 || height == 0 || values.len() != width * height {
            return Err(wrong(values.len()));
        }
        if let Some(mask) = mask
            && mask.len() != values.len()
        {
            return Err(wrong(mask.len()));
        }
        let spans = mask.map_or_else(|| whole_rows(width, height), |m| spans_of(m, width));
        let count = spans.iter().map(|s| s.end - s.start).sum();
        if !(2..=MAX_COUNT).contains(&count) {
            return Err(TemplateError::BadCount {
                found: count,
                limit: MAX_COUNT,
            });
        }
        let run = |s: &Span| s.row * width + s.start..s.row * width + s.end;
        let chosen: Cow<[f32]> = if count == values.len() {
            values.into()
        } else {
            spans
                .iter()
                .flat_map(|s| &values[run(s)])
                .copied()
                .collect()
        };
        let n = count as f64;
        let mean = sums(&chosen, |x| [x, 0.0])[0] / n;
        let [size_sum, square_sum] = sums(&chosen, |x| [(x - mean).abs(), (x - mean) * (x - mean)]);
        let (low, high) = chosen.iter().fold((f32::MAX, f32::MIN), |(low, high), &x| {
            (low.min(x), high.max(x))
        });
        let largest = (f64::from(high) - mean).max(mean - f64::from(low));
        let deviation = (square_sum / n).sqrt();
        if !deviation.is_finite() || deviation <= 1e-6 * (1.0 + mean.abs()) {
            return Err(TemplateError::NoContrast(deviation));
        }
        // |sum of products| must stay below 2^31 for any image
        let gain = (4096.0 / largest).min(2.0e6 / size_sum) as f32;

        let stride = width.div_ceil(LANES) * LANES;
        let mut quantised = vec![0i16; stride * height];
        let (mut sum, mut square) = (0i64, 0i64);
        for s in &spans {
            let out = &mut quantised[s.row * stride + s.start..s.row * stride + s.end];
            // a row's values are at most 4096, and there are at most 65536 of them
            let (mut row_sum, mut row_square) = (0i32, 0i64);
            for (o, &x) in out.iter_mut().zip(&values[run(s)]) {
                let q = round_to_i16((x - mean as f32) * gain);
                *o = q;
                row_sum += i32::from(q);
                row_square += i64::from(i32::from(q) * i32::from(q));
            }
            sum += i64::from(row_sum);
            square += row_square;
        }
        let rectangular = count == width * height;
        let mut mask = Vec::new();
        if !rectangular {
            mask = vec![0i16; stride * height];
            for s in &spans {
                mask[s.row * stride + s.start..s.row * stride + s.end].fill(1);
            }
        }
        // Rounding leaves a small mean; the score takes it into account.
        let norm = (square as f64 - (sum as f64).powi(2) / n).sqrt();
        Ok(Self {
            width,
            height,
            stride,
            values: quantised,
            mask,
            spans,
            rectangular,
            count,
            mean: sum as f64 / n,
            norm,
        })
    }

    /// A template cut out of an image: columns `left..left + width`, rows `top..top + height`.
    ///
    /// # Errors
    /// [`TemplateError`] if the window leaves the image (as a wrong length) or has no contrast.
    pub fn cut(
        image: &Image8,
        left: u32,
        top: u32,
        width: u32,
        height: u32,
    ) -> Result<Self, TemplateError> {
        let mut values = Vec::with_capacity(width as usize * height as usize);
        for v in top..top.saturating_add(height) {
            for u in left..left.saturating_add(width) {
                values.extend(image.get(u, v).map(f32::from));
            }
        }
        Self::new(width as usize, height as usize, &values, None)
    }

    /// Width, px.
    #[must_use]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height, px.
    #[must_use]
    pub fn height(&self) -> usize {
        self.height
    }
}
