//! Normalised cross-correlation of a masked template, in whole numbers.
//!
//! c = sum (I - mean I)(T - mean T) / sqrt(sum (I - mean I)^2 sum (T - mean T)^2) over the mask.
//! Image and template are held as `i16`, products are summed in `i32` and sums of squares come from
//! running sums, all without rounding: a score does not depend on the vector unit or the order of
//! work.

use crate::image::Image8;

/// Grey value times this, minus [`OFFSET`], is what a [`SearchImage`] holds.
const SCALE: i32 = 8;
/// Shift that brings the grey values 0..255 to about +-1024.
const OFFSET: i32 = 1024;
/// Largest size of a value of a [`SearchImage`].
const VALUE_LIMIT: i64 = 1024;
// 4096 squares of such values fit the u32 running sums
const _: () = assert!(VALUE_LIMIT * VALUE_LIMIT * 4096 <= u32::MAX as i64 + 1);
/// Vector length that rows are padded to.
const LANES: usize = 8;
/// Standard deviation (DN) below which an image window counts as flat: its score is 0.
const FLAT_DN: f64 = 0.5;

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
struct Span {
    row: usize,
    start: usize,
    end: usize,
}

/// A zero-mean template with a mask, ready for correlation.
#[derive(Clone, Debug)]
pub struct Template {
    width: usize,
    height: usize,
    stride: usize,
    values: Vec<i16>,
    spans: Vec<Span>,
    rectangular: bool,
    count: usize,
    /// Mean of `values` inside the mask.
    mean: f64,
    norm: f64,
}

/// Rounds half up; the argument is within +-4097.
#[inline(always)]
fn round_to_i16(x: f32) -> i16 {
    ((x + 8192.5) as i32 - 8192) as i16
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
        let inside = |i: usize| mask.is_none_or(|m| m[i]);
        let count = mask.map_or(values.len(), |m| m.iter().filter(|&&on| on).count());
        if !(2..=MAX_COUNT).contains(&count) {
            return Err(TemplateError::BadCount {
                found: count,
                limit: MAX_COUNT,
            });
        }
        let chosen = || {
            values
                .iter()
                .enumerate()
                .filter(|&(i, _)| inside(i))
                .map(|(_, &x)| x)
        };
        let n = count as f64;
        let mean = chosen().map(f64::from).sum::<f64>() / n;
        let (mut largest, mut size_sum, mut square_sum) = (0.0f64, 0.0f64, 0.0f64);
        for x in chosen() {
            let d = f64::from(x) - mean;
            largest = largest.max(d.abs());
            size_sum += d.abs();
            square_sum += d * d;
        }
        let deviation = (square_sum / n).sqrt();
        if !deviation.is_finite() || deviation <= 1e-6 * (1.0 + mean.abs()) {
            return Err(TemplateError::NoContrast(deviation));
        }
        // |sum of products| must stay below 2^31 for any image
        let gain = (4096.0 / largest).min(2.0e6 / size_sum) as f32;

        let stride = width.div_ceil(LANES) * LANES;
        let mut quantised = vec![0i16; stride * height];
        let (mut sum, mut square) = (0i64, 0i64);
        let lines = quantised
            .chunks_exact_mut(stride)
            .zip(values.chunks_exact(width));
        for (row, (out, line)) in lines.enumerate() {
            for (column, (o, &x)) in out.iter_mut().zip(line).enumerate() {
                if inside(row * width + column) {
                    let q = round_to_i16((x - mean as f32) * gain);
                    *o = q;
                    sum += i64::from(q);
                    square += i64::from(i32::from(q) * i32::from(q));
                }
            }
        }
        // Rounding leaves a small mean; the score takes it into account.
        let norm = (square as f64 - (sum as f64).powi(2) / n).sqrt();
        Ok(Self {
            width,
            height,
            stride,
            values: quantised,
            spans: mask.map_or_else(Vec::new, |m| spans_of(m, width)),
            rectangular: count == width * height,
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

/// A part of an image at full, half, quarter ... resolution, prepared for correlation.
#[derive(Clone, Debug)]
pub struct SearchImage {
    width: usize,
    height: usize,
    stride: usize,
    values: Vec<i16>,
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

    fn row(&self, y: usize) -> &[i16] {
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

/// Sums of products of the template with the image at positions `x..x + out.len()` of row `y`.
///
/// The caller guarantees that the template lies inside the image at all of them; rows are padded so
/// that whole vectors can be read.
fn dots(template: &Template, image: &SearchImage, x: usize, y: usize, out: &mut [i32]) {
    if out.is_empty() {
        return;
    }
    let last_row = (y + template.height - 1) * image.stride;
    assert!(
        last_row + x + out.len() - 1 + template.stride <= image.values.len()
            && template.values.len() == template.stride * template.height,
        "a template position reads beyond the search image"
    );
    let start = y * image.stride + x;
    #[cfg(target_arch = "x86_64")]
    {
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: AVX2 is there, and the assertion covers every read.
            unsafe { dots_avx2(template, image, start, out) };
        } else {
            // SAFETY: SSE2 belongs to every x86-64, and the assertion covers every read.
            unsafe { dots_sse2(template, image, start, out) };
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    dots_plain(template, image, start, out);
}

/// The same without vector instructions.
#[cfg(any(test, not(target_arch = "x86_64")))]
fn dots_plain(template: &Template, image: &SearchImage, start: usize, out: &mut [i32]) {
    for (i, o) in out.iter_mut().enumerate() {
        *o = 0;
        for (row, line) in template.values.chunks_exact(template.stride).enumerate() {
            let other = &image.values[start + i + row * image.stride..];
            for (&a, &b) in line.iter().zip(other) {
                *o = o.wrapping_add(i32::from(a) * i32::from(b));
            }
        }
    }
}

/// # Safety
/// For every position `start + i` and every template row, `template.stride` values must follow.
#[cfg(target_arch = "x86_64")]
unsafe fn dots_sse2(template: &Template, image: &SearchImage, start: usize, out: &mut [i32]) {
    use std::arch::x86_64::{
        __m128i, _mm_add_epi32, _mm_cvtsi128_si32, _mm_loadu_si128, _mm_madd_epi16,
        _mm_setzero_si128, _mm_shuffle_epi32,
    };
    for (i, o) in out.iter_mut().enumerate() {
        // SAFETY: as the caller guarantees.
        unsafe {
            let mut sum = _mm_setzero_si128();
            let mut a = template.values.as_ptr();
            let mut line = image.values.as_ptr().add(start + i);
            for _ in 0..template.height {
                for k in (0..template.stride).step_by(8) {
                    let t = _mm_loadu_si128(a.add(k).cast::<__m128i>());
                    let p = _mm_loadu_si128(line.add(k).cast::<__m128i>());
                    sum = _mm_add_epi32(sum, _mm_madd_epi16(t, p));
                }
                a = a.wrapping_add(template.stride);
                line = line.wrapping_add(image.stride);
            }
            sum = _mm_add_epi32(sum, _mm_shuffle_epi32(sum, 0b01_00_11_10));
            sum = _mm_add_epi32(sum, _mm_shuffle_epi32(sum, 0b10_11_00_01));
            *o = _mm_cvtsi128_si32(sum);
        }
    }
}

/// # Safety
/// The processor must have AVX2; for every position `start + i` and every template row,
/// `template.stride` values must follow.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
unsafe fn dots_avx2(template: &Template, image: &SearchImage, start: usize, out: &mut [i32]) {
    use std::arch::x86_64::{
        __m128i, __m256i, _mm_add_epi32, _mm_cvtsi128_si32, _mm_loadu_si128, _mm_madd_epi16,
        _mm_setzero_si128, _mm_shuffle_epi32, _mm256_add_epi32, _mm256_castsi256_si128,
        _mm256_extracti128_si256, _mm256_loadu_si256, _mm256_madd_epi16, _mm256_setzero_si256,
    };
    let (wide, odd) = (
        template.stride / 16 * 16,
        !template.stride.is_multiple_of(16),
    );
    for (i, o) in out.iter_mut().enumerate() {
        // SAFETY: as the caller guarantees.
        unsafe {
            let mut sum = _mm256_setzero_si256();
            let mut rest = _mm_setzero_si128();
            let mut a = template.values.as_ptr();
            let mut line = image.values.as_ptr().add(start + i);
            for _ in 0..template.height {
                for k in (0..wide).step_by(16) {
                    let t = _mm256_loadu_si256(a.add(k).cast::<__m256i>());
                    let p = _mm256_loadu_si256(line.add(k).cast::<__m256i>());
                    sum = _mm256_add_epi32(sum, _mm256_madd_epi16(t, p));
                }
                if odd {
                    let t = _mm_loadu_si128(a.add(wide).cast::<__m128i>());
                    let p = _mm_loadu_si128(line.add(wide).cast::<__m128i>());
                    rest = _mm_add_epi32(rest, _mm_madd_epi16(t, p));
                }
                a = a.wrapping_add(template.stride);
                line = line.wrapping_add(image.stride);
            }
            let halves = _mm_add_epi32(
                _mm256_castsi256_si128(sum),
                _mm256_extracti128_si256(sum, 1),
            );
            let mut sum = _mm_add_epi32(halves, rest);
            sum = _mm_add_epi32(sum, _mm_shuffle_epi32(sum, 0b01_00_11_10));
            sum = _mm_add_epi32(sum, _mm_shuffle_epi32(sum, 0b10_11_00_01));
            *o = _mm_cvtsi128_si32(sum);
        }
    }
}

/// Scores for template positions: the template's first pixel at column `left + i`, row `top + j`
/// of the [`SearchImage`].
#[derive(Clone, Debug)]
pub struct ScoreMap {
    /// Leftmost position, px of the search image.
    pub left: usize,
    /// Topmost position, px of the search image.
    pub top: usize,
    /// Number of positions across.
    pub width: usize,
    /// Number of positions down.
    pub height: usize,
    /// NCC of every position, row by row, -1 to 1; 0 where the image is flat.
    pub scores: Vec<f32>,
}

impl ScoreMap {
    /// Score at a position counted from `left`, `top`.
    #[must_use]
    pub fn at(&self, i: usize, j: usize) -> f32 {
        self.scores[j * self.width + i]
    }

    /// The best position and its score; the first of equals. `None` for an empty map.
    #[must_use]
    pub fn best(&self) -> Option<(usize, usize, f32)> {
        let mut best: Option<(usize, f32)> = None;
        for (i, &s) in self.scores.iter().enumerate() {
            if best.is_none_or(|(_, b)| s > b) {
                best = Some((i, s));
            }
        }
        best.map(|(i, s)| (i % self.width, i / self.width, s))
    }

    /// The best `count` local maxima (of their 3 x 3 neighbourhoods), best first.
    #[must_use]
    pub fn peaks(&self, count: usize) -> Vec<(usize, usize, f32)> {
        let mut all = Vec::new();
        for j in 0..self.height {
            for i in 0..self.width {
                let s = self.at(i, j);
                let rows = j.saturating_sub(1)..=(j + 1).min(self.height - 1);
                let is_peak = rows.into_iter().all(|y| {
                    (i.saturating_sub(1)..=(i + 1).min(self.width - 1)).all(|x| {
                        let other = self.at(x, y);
                        other < s || (other == s && (y, x) >= (j, i))
                    })
                });
                if is_peak {
                    all.push((i, j, s));
                }
            }
        }
        all.sort_by(|a, b| b.2.total_cmp(&a.2).then((a.1, a.0).cmp(&(b.1, b.0))));
        all.truncate(count);
        all
    }

    /// Shift of the peak from (`i`, `j`) by the least-squares quadratic over 3 x 3 scores, px; each
    /// part within +-1. Zero at the border of the map.
    #[must_use]
    pub fn refine(&self, i: usize, j: usize) -> (f64, f64) {
        if i == 0 || j == 0 || i + 1 >= self.width || j + 1 >= self.height {
            return (0.0, 0.0);
        }
        let mut block = [[0.0f64; 3]; 3];
        for (y, row) in block.iter_mut().enumerate() {
            for (x, cell) in row.iter_mut().enumerate() {
                *cell = f64::from(self.at(i + x - 1, j + y - 1));
            }
        }
        quadratic_peak(&block).unwrap_or((0.0, 0.0))
    }
}

/// Position of the maximum of the least-squares quadratic through 3 x 3 values (rows are v), px
/// from the middle. `None` if it has no maximum or lies further than 1 px away.
#[must_use]
pub fn quadratic_peak(block: &[[f64; 3]; 3]) -> Option<(f64, f64)> {
    let column = |x: usize| block[0][x] + block[1][x] + block[2][x];
    let row = |y: usize| block[y].iter().sum::<f64>();
    let du = (column(2) - column(0)) / 6.0;
    let dv = (row(2) - row(0)) / 6.0;
    let duu = (column(0) - 2.0 * column(1) + column(2)) / 3.0;
    let dvv = (row(0) - 2.0 * row(1) + row(2)) / 3.0;
    let duv = (block[2][2] - block[2][0] - block[0][2] + block[0][0]) / 4.0;
    let det = duu * dvv - duv * duv;
    if !(det > 0.0 && duu < 0.0) {
        return None;
    }
    let shift = ((duv * dv - dvv * du) / det, (duv * du - duu * dv) / det);
    (shift.0.abs() <= 1.0 && shift.1.abs() <= 1.0).then_some(shift)
}

/// Sums that the score's denominator needs, for one row of positions.
struct WindowSums {
    sums: Vec<i64>,
    squares: Vec<i64>,
}

/// Column sums of a rectangular template's window, moved down row by row.
struct ColumnSums {
    sums: Vec<i32>,
    squares: Vec<u32>,
}

impl ColumnSums {
    fn new(image: &SearchImage, left: usize, columns: usize, top: usize, rows: usize) -> Self {
        let mut this = Self {
            sums: vec![0; columns],
            squares: vec![0; columns],
        };
        for y in top..top + rows {
            this.change::<1>(&image.row(y)[left..left + columns]);
        }
        this
    }

    fn change<const SIGN: i32>(&mut self, row: &[i16]) {
        for ((sum, square), &x) in self.sums.iter_mut().zip(&mut self.squares).zip(row) {
            let x = i32::from(x);
            *sum += SIGN * x;
            *square = square.wrapping_add_signed(SIGN * x * x);
        }
    }

    fn windows(&self, width: usize, out: &mut WindowSums) {
        let mut sum: i64 = self.sums[..width].iter().map(|&x| i64::from(x)).sum();
        let mut square: i64 = self.squares[..width].iter().map(|&x| i64::from(x)).sum();
        out.sums[0] = sum;
        out.squares[0] = square;
        for i in 1..out.sums.len() {
            sum += i64::from(self.sums[i + width - 1]) - i64::from(self.sums[i - 1]);
            square += i64::from(self.squares[i + width - 1]) - i64::from(self.squares[i - 1]);
            out.sums[i] = sum;
            out.squares[i] = square;
        }
    }
}

/// Row-wise running sums (first `left` columns left out) for templates with a mask.
struct RowPrefix {
    stride: usize,
    top: usize,
    sums: Vec<i32>,
    squares: Vec<u32>,
}

impl RowPrefix {
    fn new(image: &SearchImage, left: usize, columns: usize, top: usize, rows: usize) -> Self {
        let stride = columns + 1;
        let mut this = Self {
            stride,
            top,
            sums: vec![0; stride * rows],
            squares: vec![0; stride * rows],
        };
        for y in 0..rows {
            let (mut sum, mut square) = (0i32, 0u32);
            let row = &image.row(top + y)[left..left + columns];
            let start = y * stride + 1;
            let out = this.sums[start..]
                .iter_mut()
                .zip(&mut this.squares[start..]);
            for ((s, q), &x) in out.zip(row) {
                sum += i32::from(x);
                square = square.wrapping_add((i32::from(x) * i32::from(x)) as u32);
                *s = sum;
                *q = square;
            }
        }
        this
    }

    fn windows(&self, template: &Template, y: usize, out: &mut WindowSums) {
        out.sums.fill(0);
        out.squares.fill(0);
        let n = out.sums.len();
        for span in &template.spans {
            let start = (y + span.row - self.top) * self.stride;
            let (from, to) = (start + span.start, start + span.end);
            let ends = self.sums[to..to + n].iter().zip(&self.sums[from..from + n]);
            for (o, (b, a)) in out.sums.iter_mut().zip(ends) {
                *o += i64::from(b - a);
            }
            let ends = self.squares[to..to + n]
                .iter()
                .zip(&self.squares[from..from + n]);
            for (o, (b, a)) in out.squares.iter_mut().zip(ends) {
                *o += i64::from(b.wrapping_sub(*a));
            }
        }
    }
}

/// NCC of `template` with its first pixel at every position `left..left + columns`,
/// `top..top + rows` of `image`. Positions at which the template would leave the image are cut off
/// (the map tells its true extent); `None` if none is left.
#[must_use]
pub fn score_map(
    image: &SearchImage,
    template: &Template,
    left: usize,
    top: usize,
    columns: usize,
    rows: usize,
) -> Option<ScoreMap> {
    let last_x = (image.width + 1).checked_sub(template.width)?;
    let last_y = (image.height + 1).checked_sub(template.height)?;
    let width = last_x.min(left.checked_add(columns)?).checked_sub(left)?;
    let height = last_y.min(top.checked_add(rows)?).checked_sub(top)?;
    if width == 0 || height == 0 {
        return None;
    }
    let covered_columns = width + template.width - 1;
    let covered_rows = height + template.height - 1;
    let mut scores = Vec::with_capacity(width * height);
    let mut windows = WindowSums {
        sums: vec![0; width],
        squares: vec![0; width],
    };
    let n = template.count as f64;
    let mut columns_state = (template.rectangular && template.height <= 4000)
        .then(|| ColumnSums::new(image, left, covered_columns, top, template.height));
    let prefix = columns_state
        .is_none()
        .then(|| RowPrefix::new(image, left, covered_columns, top, covered_rows));
    let flat = (n * (FLAT_DN * f64::from(SCALE)).powi(2)) as f32;
    let inverse_norm = 1.0 / template.norm;
    let mut products = vec![0i32; width];
    for y in top..top + height {
        if let Some(state) = &mut columns_state {
            if y > top {
                state.change::<-1>(&image.row(y - 1)[left..left + covered_columns]);
                let next = &image.row(y + template.height - 1)[left..left + covered_columns];
                state.change::<1>(next);
            }
            state.windows(template.width, &mut windows);
        }
        if let Some(prefix) = &prefix {
            prefix.windows(template, y, &mut windows);
        }
        dots(template, image, left, y, &mut products);
        let sums = windows.sums.iter().zip(&windows.squares);
        scores.extend(
            products
                .iter()
                .zip(sums)
                .map(|(&product, (&sum, &square))| {
                    let sum = sum as f64;
                    let variance = (square as f64 - sum * sum / n) as f32;
                    let covariance =
                        ((f64::from(product) - template.mean * sum) * inverse_norm) as f32;
                    if variance <= flat {
                        0.0
                    } else {
                        covariance / variance.sqrt()
                    }
                }),
        );
    }
    Some(ScoreMap {
        left,
        top,
        width,
        height,
        scores,
    })
}

/// Where a template was found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Peak {
    /// Column of the template's middle, (width - 1) / 2, in the image, px.
    pub u_px: f64,
    /// Row of the template's middle in the image, px.
    pub v_px: f64,
    /// NCC at the best whole pixel, -1 to 1.
    pub score: f64,
}

/// A template at full and reduced resolutions.
#[derive(Clone, Debug)]
pub struct TemplatePyramid {
    levels: Vec<Template>,
}

/// Shortest side of a template at the coarsest level, px.
const MIN_COARSE_SIDE: usize = 6;
/// Local maxima of the coarsest level that are followed to finer levels.
const COARSE_CANDIDATES: usize = 4;

impl TemplatePyramid {
    /// Reduces a template by two as long as its sides keep [`MIN_COARSE_SIDE`] pixels, at most
    /// `max_levels` levels in all; masked pixels (`false`) spoil the means they are part of.
    ///
    /// # Errors
    /// [`TemplateError`] if the full-resolution template cannot be used.
    pub fn new(
        width: usize,
        height: usize,
        values: &[f32],
        mask: Option<&[bool]>,
        max_levels: usize,
    ) -> Result<Self, TemplateError> {
        let mut levels = vec![Template::new(width, height, values, mask)?];
        let (mut w, mut h) = (width, height);
        let mut values = values.to_vec();
        let mut mask = mask.map(<[bool]>::to_vec);
        while levels.len() < max_levels && (w / 2).min(h / 2) >= MIN_COARSE_SIDE {
            let (half_w, half_h) = (w / 2, h / 2);
            let four = |i: usize| {
                let first = 2 * (i / half_w) * w + 2 * (i % half_w);
                [first, first + 1, first + w, first + w + 1]
            };
            let next: Vec<f32> = (0..half_w * half_h)
                .map(|i| four(i).iter().map(|&k| values[k]).sum())
                .collect();
            mask = mask.map(|m| {
                (0..half_w * half_h)
                    .map(|i| four(i).iter().all(|&k| m[k]))
                    .collect()
            });
            (w, h, values) = (half_w, half_h, next);
            match Template::new(w, h, &values, mask.as_deref()) {
                Ok(level) => levels.push(level),
                Err(_) => break, // all contrast is fine detail: the finer levels must do
            }
        }
        Ok(Self { levels })
    }

    /// The template at full resolution.
    #[must_use]
    pub fn full(&self) -> &Template {
        &self.levels[0]
    }
}

/// A rectangle of pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// First column.
    pub left: u32,
    /// First row.
    pub top: u32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

impl Window {
    /// The whole of an image.
    #[must_use]
    pub fn whole(image: &Image8) -> Self {
        Self {
            left: 0,
            top: 0,
            width: image.width_px,
            height: image.height_px,
        }
    }

    /// The part of this window inside an image.
    #[must_use]
    pub fn clipped(&self, image: &Image8) -> Self {
        let (left, top) = (self.left.min(image.width_px), self.top.min(image.height_px));
        let right = self.left.saturating_add(self.width).min(image.width_px);
        let bottom = self.top.saturating_add(self.height).min(image.height_px);
        Self {
            left,
            top,
            width: right - left,
            height: bottom - top,
        }
    }
}

/// Finds a template in a window of the image, from the coarsest level of its pyramid to the
/// finest, and refines the peak by a quadratic. The template lies wholly inside the window. `None`
/// if the window (cut at the image border) is smaller than the template.
#[must_use]
pub fn search(image: &Image8, template: &TemplatePyramid, window: Window) -> Option<Peak> {
    let window = window.clipped(image);
    let top_level = template.levels.len() - 1;
    let coarse = SearchImage::new(
        image,
        window.left,
        window.top,
        window.width,
        window.height,
        top_level as u32,
    );
    let map = score_map(
        &coarse,
        &template.levels[top_level],
        0,
        0,
        coarse.width,
        coarse.height,
    )?;
    if top_level == 0 {
        let (i, j, score) = map.best()?;
        return Some(finish(&template.levels[0], window, &map, i, j, score));
    }
    let mut candidates: Vec<(usize, usize, f32)> = map.peaks(COARSE_CANDIDATES);
    for level in (0..top_level).rev() {
        let at_level = &template.levels[level];
        let mut next = Vec::with_capacity(candidates.len());
        for &(x, y, _) in &candidates {
            let left = (2 * x).saturating_sub(2);
            let top = (2 * y).saturating_sub(2);
            let step = 1u32 << level;
            let part = SearchImage::new(
                image,
                window.left + left as u32 * step,
                window.top + top as u32 * step,
                (at_level.width as u32 + 5) * step,
                (at_level.height as u32 + 5) * step,
                level as u32,
            );
            let limit = |start: usize, size: u32, length: usize| {
                ((size as usize >> level) + 1)
                    .saturating_sub(start + length)
                    .min(6)
            };
            let columns = limit(left, window.width, at_level.width);
            let rows = limit(top, window.height, at_level.height);
            let Some(local) = score_map(&part, at_level, 0, 0, columns, rows) else {
                continue;
            };
            let Some((i, j, score)) = local.best() else {
                continue;
            };
            if level == 0 {
                let corner = Window {
                    left: window.left + left as u32,
                    top: window.top + top as u32,
                    ..window
                };
                let peak = finish(at_level, corner, &local, i, j, score);
                next.push(((left + i, top + j, score), Some(peak)));
            } else {
                next.push(((left + i, top + j, score), None));
            }
        }
        next.sort_by(|(a, _), (b, _)| b.2.total_cmp(&a.2).then((a.1, a.0).cmp(&(b.1, b.0))));
        if level == 0 {
            return next.first().and_then(|(_, peak)| *peak);
        }
        // a clear winner is followed alone
        let keep = next
            .iter()
            .filter(|(c, _)| c.2 >= next[0].0.2 - 0.15)
            .count();
        candidates = next.into_iter().take(keep).map(|(c, _)| c).collect();
    }
    None
}

fn finish(
    template: &Template,
    corner: Window,
    map: &ScoreMap,
    i: usize,
    j: usize,
    score: f32,
) -> Peak {
    let (du, dv) = map.refine(i, j);
    let middle = |size: usize| (size as f64 - 1.0) / 2.0;
    Peak {
        u_px: f64::from(corner.left) + (map.left + i) as f64 + middle(template.width) + du,
        v_px: f64::from(corner.top) + (map.top + j) as f64 + middle(template.height) + dv,
        score: f64::from(score),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn noise(width: u32, height: u32, seed: u64) -> Image8 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let pixels = (0..width * height).map(|_| rng.random()).collect();
        Image8::from_raw(width, height, pixels).unwrap()
    }

    fn smooth(width: u32, height: u32, seed: u64) -> Image8 {
        let blurred = crate::image::ImageF::from_image8(&noise(width, height, seed))
            .unwrap()
            .blurred(2.0);
        let values = blurred
            .values()
            .iter()
            .map(|x| (x - 127.5) * 6.0 + 127.5)
            .collect();
        crate::image::ImageF::from_raw(width, height, values)
            .unwrap()
            .to_image8()
    }

    /// The definition, in f64.
    fn reference(image: &Image8, x: usize, y: usize, w: usize, t: &[f32], mask: &[bool]) -> f64 {
        let pairs: Vec<(f64, f64)> = (0..t.len())
            .filter(|&i| mask[i])
            .map(|i| {
                let p = image.get((x + i % w) as u32, (y + i / w) as u32).unwrap();
                (f64::from(p), f64::from(t[i]))
            })
            .collect();
        let n = pairs.len() as f64;
        let (ma, mb) = (
            pairs.iter().map(|p| p.0).sum::<f64>() / n,
            pairs.iter().map(|p| p.1).sum::<f64>() / n,
        );
        let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
        for (a, b) in pairs {
            ab += (a - ma) * (b - mb);
            aa += (a - ma).powi(2);
            bb += (b - mb).powi(2);
        }
        ab / (aa * bb).sqrt()
    }

    #[test]
    fn scores_equal_the_definition_with_and_without_a_mask() {
        let image = noise(50, 40, 1);
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let (w, h) = (13, 9);
        let values: Vec<f32> = (0..w * h).map(|_| rng.random_range(0.0..200.0)).collect();
        for masked in [false, true] {
            let mask: Vec<bool> = (0..w * h)
                .map(|_| !masked || rng.random_bool(0.6))
                .collect();
            let template = Template::new(w, h, &values, Some(&mask)).unwrap();
            let search = SearchImage::whole(&image, 0);
            let map = score_map(&search, &template, 3, 2, 100, 100).unwrap();
            assert_eq!((map.left, map.top, map.width, map.height), (3, 2, 35, 30));
            for j in 0..map.height {
                for i in 0..map.width {
                    let expected = reference(&image, 3 + i, 2 + j, w, &values, &mask);
                    let got = f64::from(map.at(i, j));
                    assert!((got - expected).abs() < 2e-4, "{i} {j}: {got} {expected}");
                }
            }
        }
    }

    #[test]
    fn reduced_search_images_hold_means() {
        let image = noise(37, 29, 3);
        for level in 1..=3u32 {
            let reduced = SearchImage::new(&image, 2, 3, 30, 20, level);
            let step = 1u32 << level;
            assert_eq!(reduced.width(), 30 >> level);
            for y in 0..reduced.height() {
                for x in 0..reduced.width() {
                    let mut sum = 0.0;
                    for k in 0..step * step {
                        let u = 2 + x as u32 * step + k % step;
                        let v = 3 + y as u32 * step + k / step;
                        sum += f64::from(image.get(u, v).unwrap());
                    }
                    let mean = sum / f64::from(step * step);
                    let held = f64::from(i32::from(reduced.row(y)[x]) + OFFSET) / 8.0;
                    assert!((held - mean).abs() <= 0.126, "{held} {mean}");
                }
            }
        }
    }

    #[test]
    fn a_cut_out_is_found_where_it_was_through_the_pyramid() {
        let image = smooth(320, 240, 4);
        for (left, top) in [(0u32, 0u32), (101, 57), (200, 150), (289, 209), (33, 180)] {
            let values: Vec<f32> = (0..31 * 31)
                .map(|i| f32::from(image.get(left + i % 31, top + i / 31).unwrap()))
                .collect();
            for levels in 1..=3 {
                let template = TemplatePyramid::new(31, 31, &values, None, levels).unwrap();
                let peak = search(&image, &template, Window::whole(&image)).unwrap();
                assert!(
                    (peak.u_px - f64::from(left + 15)).abs() < 0.2,
                    "{peak:?} {left} {top}"
                );
                assert!(
                    (peak.v_px - f64::from(top + 15)).abs() < 0.2,
                    "{peak:?} {left} {top}"
                );
                assert!(peak.score > 0.999);
            }
        }
    }

    #[test]
    fn gain_and_offset_do_not_matter_and_flat_areas_score_zero() {
        let image = smooth(64, 64, 5);
        let values: Vec<f32> = (0..15 * 15)
            .map(|i| 3.0 + 0.01 * f32::from(image.get(20 + i % 15, 30 + i / 15).unwrap()))
            .collect();
        let template = Template::new(15, 15, &values, None).unwrap();
        let map = score_map(&SearchImage::whole(&image, 0), &template, 20, 30, 1, 1).unwrap();
        assert!(map.at(0, 0) > 0.9995);
        let flat = Image8::from_raw(64, 64, vec![90; 64 * 64]).unwrap();
        let map = score_map(&SearchImage::whole(&flat, 0), &template, 0, 0, 64, 64).unwrap();
        assert!(map.scores.iter().all(|&s| s == 0.0));
    }

    #[test]
    fn vector_units_give_the_same_sums() {
        let image = SearchImage::whole(&noise(90, 60, 6), 0);
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        for width in [3usize, 8, 13, 16, 20, 31, 40] {
            let values: Vec<f32> = (0..width * 11)
                .map(|_| rng.random_range(0.0..9.0))
                .collect();
            let template = Template::new(width, 11, &values, None).unwrap();
            let count = image.width() + 1 - width;
            let (mut fast, mut plain) = (vec![0; count], vec![0; count]);
            dots(&template, &image, 0, 5, &mut fast);
            dots_plain(&template, &image, 5 * image.stride, &mut plain);
            assert_eq!(fast, plain);
            #[cfg(target_arch = "x86_64")]
            {
                // SAFETY: `dots` has just checked the same positions.
                unsafe { dots_sse2(&template, &image, 5 * image.stride, &mut fast) };
                assert_eq!(fast, plain);
            }
        }
    }

    #[test]
    fn unusable_templates_are_refused() {
        assert!(matches!(
            Template::new(3, 3, &[0.0; 8], None),
            Err(TemplateError::WrongLength { .. })
        ));
        assert!(matches!(
            Template::new(3, 3, &[7.0; 9], None),
            Err(TemplateError::NoContrast(_))
        ));
        let mask = [true, false, false, false, false, false, false, false, false];
        assert!(matches!(
            Template::new(3, 3, &[1.0; 9], Some(&mask)),
            Err(TemplateError::BadCount { found: 1, .. })
        ));
        let values = [1.0, f32::NAN, 2.0, 3.0];
        assert!(matches!(
            Template::new(2, 2, &values, None),
            Err(TemplateError::NoContrast(_))
        ));
    }

    #[test]
    fn the_quadratic_peak_is_exact_for_a_quadratic() {
        let f = |x: f64, y: f64| {
            let (a, b) = (x - 0.3, y + 0.2);
            5.0 - 2.0 * a * a - 1.5 * b * b + 0.7 * a * b
        };
        let mut block = [[0.0; 3]; 3];
        for (y, row) in block.iter_mut().enumerate() {
            for (x, cell) in row.iter_mut().enumerate() {
                *cell = f(x as f64 - 1.0, y as f64 - 1.0);
            }
        }
        let (du, dv) = quadratic_peak(&block).unwrap();
        assert!((du - 0.3).abs() < 1e-12 && (dv + 0.2).abs() < 1e-12);
        assert!(quadratic_peak(&[[1.0; 3]; 3]).is_none());
    }
}
