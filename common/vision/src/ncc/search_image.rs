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
        let step = 1usize << level;
        let cut = |start: u32, length: u32, size: u32| {
            (size.min(start.saturating_add(length)).saturating_sub(start)) as usize >> level
        };
        let (w, h) = (
            cut(left, width, image.width_px),
            cut(top, height, image.height_px),
        );
        let stride = w + 2 * LANES;
        let mut values = vec![0i16; stride * h];
        let source_stride = image.width_px as usize;
        let mut sums = vec![0u16; w];
        for y in 0..h {
            let row_start =
                |k: usize| (top as usize + y * step + k) * source_stride + left as usize;
            let out = &mut values[y * stride..y * stride + w];
            if level == 0 {
                let row = &image.pixels[row_start(0)..row_start(0) + w];
                for (o, &p) in out.iter_mut().zip(row) {
                    *o = i16::from(p) * SCALE as i16 - OFFSET as i16;
                }
                continue;
            }
            sums.fill(0);
            for k in 0..step {
                let row = &image.pixels[row_start(k)..row_start(k) + w * step];
                match level {
                    1 => add_groups::<2>(&mut sums, row),
                    2 => add_groups::<4>(&mut sums, row),
                    3 => add_groups::<8>(&mut sums, row),
                    _ => add_groups::<16>(&mut sums, row),
                }
            }
            // 16 x 16 x 255 fits u16; scale to 8 times the mean
            let shift = 2 * level as i32 - 3;
            for (o, &s) in out.iter_mut().zip(&sums) {
                let scaled = if shift >= 0 {
                    i32::from(s) >> shift
                } else {
                    i32::from(s) << -shift
                };
                *o = (scaled - OFFSET) as i16;
            }
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

/// Adds groups of N neighbouring bytes to one sum each.
#[inline(always)]
fn add_groups<const N: usize>(sums: &mut [u16], row: &[u8]) {
    for (sum, group) in sums.iter_mut().zip(row.chunks_exact(N)) {
        *sum += group.iter().map(|&p| u16::from(p)).sum::<u16>();
    }
}
