//! The image side of the correlation, at full or reduced resolution.

use super::{LANES, OFFSET, SCALE};
use crate::image::Image8;

/// A part of an image at full, half, quarter ... resolution, prepared for correlation.
#[derive(Clone, Debug)]
pub struct SearchImage {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) stride: usize,
    pub(super) values: Vec<i16>,
}

impl SearchImage {
    /// Columns `left..left + width` and rows `top..top + height` of `image`, reduced `level` times
    /// by two (means of 2^level x 2^level pixels). The region is cut at the image border; an empty
    /// region gives an image of zero size.
    #[must_use]
    pub fn new(image: &Image8, left: u32, top: u32, width: u32, height: u32, level: u32) -> Self {
        let level = level.min(4);
        let cut = |start: u32, length: u32, size: u32| {
            (size.min(start.saturating_add(length)).saturating_sub(start)) as usize >> level
        };
        let (w, h) = (
            cut(left, width, image.width_px),
            cut(top, height, image.height_px),
        );
        let stride = w + 2 * LANES;
        let mut values = vec![0i16; stride * h];
        let source = Source {
            pixels: &image.pixels,
            stride: image.width_px as usize,
            left: left as usize,
            top: top as usize,
        };
        if w > 0 {
            reduce(&source, (w, level), stride, &mut values);
        }
        Self {
            width: w,
            height: h,
            stride,
            values,
        }
    }

    /// The whole image, reduced `level` times by two.
    #[must_use]
    pub fn whole(image: &Image8, level: u32) -> Self {
        Self::new(image, 0, 0, image.width_px, image.height_px, level)
    }

    /// Width in its own pixels.
    #[must_use]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in its own pixels.
    #[must_use]
    pub fn height(&self) -> usize {
        self.height
    }

    /// One row of held values, see [`SearchImage::grey`].
    pub(crate) fn values(&self, y: usize) -> &[i16] {
        &self.row(y)[..self.width]
    }

    /// The grey value (DN) that a held value stands for.
    #[inline]
    pub(crate) fn grey(held: i16) -> f32 {
        (f32::from(held) + OFFSET as f32) * (1.0 / SCALE as f32)
    }

    pub(super) fn row(&self, y: usize) -> &[i16] {
        &self.values[y * self.stride..(y + 1) * self.stride]
    }
}

/// The part of an image that is reduced.
struct Source<'a> {
    pixels: &'a [u8],
    stride: usize,
    left: usize,
    top: usize,
}

/// Fills rows of `width` values, `stride` apart, with means of 2^level x 2^level pixels.
fn reduce(source: &Source, size: (usize, u32), stride: usize, values: &mut [i16]) {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { reduce_avx2(source, size, stride, values) };
    }
    reduce_plain(source, size, stride, values);
}

/// The same with wider vectors.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn reduce_avx2(source: &Source, size: (usize, u32), stride: usize, values: &mut [i16]) {
    reduce_plain(source, size, stride, values);
}

#[inline(always)]
fn reduce_plain(source: &Source, (width, level): (usize, u32), stride: usize, values: &mut [i16]) {
    let step = 1usize << level;
    let mut columns = vec![0u16; width * step];
    for (y, out) in values.chunks_exact_mut(stride).enumerate() {
        let row = |k: usize| {
            let start = (source.top + y * step + k) * source.stride + source.left;
            &source.pixels[start..start + width * step]
        };
        let out = &mut out[..width];
        if level == 0 {
            for (o, &p) in out.iter_mut().zip(row(0)) {
                *o = i16::from(p) * SCALE as i16 - OFFSET as i16;
            }
            continue;
        }
        columns.fill(0);
        for k in 0..step {
            for (c, &p) in columns.iter_mut().zip(row(k)) {
                *c += u16::from(p);
            }
        }
        match level {
            1 => add_groups::<2>(&columns, out, |s| s << 1),
            2 => add_groups::<4>(&columns, out, |s| s >> 1),
            3 => add_groups::<8>(&columns, out, |s| s >> 3),
            _ => add_groups::<16>(&columns, out, |s| s >> 5),
        }
    }
}

/// Adds groups of N neighbouring columns, whose sums (up to 16 x 16 x 255) fit u16, and `scale`s
/// them to [`SCALE`] times the mean.
#[inline(always)]
fn add_groups<const N: usize>(columns: &[u16], out: &mut [i16], scale: impl Fn(u16) -> u16) {
    for (o, group) in out.iter_mut().zip(columns.chunks_exact(N)) {
        let sum: u16 = group.iter().sum();
        *o = scale(sum) as i16 - OFFSET as i16;
    }
}
