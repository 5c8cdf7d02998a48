//! Many values of a spline at once: on an affine grid, a vector of them at a time.

use nalgebra::Vector2;

use super::{SplineImage, spline_weights};

/// The largest whole number not above `x`, or the one before it if `x` is whole or within 1e-4 of
/// it (the spline's polynomials join smoothly there), for |x| below 1024. A sum that pushes the
/// fraction out of the significand: unlike a cast, vectors have it.
#[inline(always)]
fn near_floor(x: f32) -> i32 {
    const PUSH: f32 = 12_582_912.0; // 1.5 * 2^23
    ((x - 0.5) + PUSH)
        .to_bits()
        .wrapping_sub(PUSH.to_bits())
        .cast_signed()
}

/// Samples of a grid that are worked out together. A buffer with so much room behind its last row
/// is filled fastest.
pub(crate) const CHUNK: usize = 8;

/// Neighbourhoods and weights of a chunk of samples.
struct Chunk {
    /// Second column and row of each one's 4 x 4 coefficients.
    iu: [i32; CHUNK],
    iv: [i32; CHUNK],
    /// Weights of the four columns and of the four rows.
    wu: [[f32; CHUNK]; 4],
    wv: [[f32; CHUNK]; 4],
}

/// Places of samples: an affine grid, px.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Grid {
    /// The first place.
    pub origin: Vector2<f64>,
    /// Step from one column to the next.
    pub step_u: Vector2<f64>,
    /// Step from one row to the next.
    pub step_v: Vector2<f64>,
}

/// One row of a grid of samples: the first place and the step, px from `base`.
struct Line {
    at: [f32; 2],
    step: [f32; 2],
    base: [i32; 2],
}

/// The samples of a chunk, from 4 x 4 coefficients each.
///
/// # Safety
/// Every sample's 4 x 4 coefficients must lie in `values`, whose rows are `width` apart.
#[inline(always)]
unsafe fn weigh(values: &[f32], width: usize, chunk: &Chunk, samples: &mut [f32; CHUNK]) {
    let start = |s: usize| (chunk.iv[s] as usize - 1) * width + chunk.iu[s] as usize - 1;
    #[cfg(target_arch = "x86_64")]
    for i in [0, 4] {
        use std::arch::x86_64::{
            _MM_TRANSPOSE4_PS, _mm_add_ps, _mm_loadu_ps, _mm_mul_ps, _mm_set1_ps, _mm_storeu_ps,
        };
        // SAFETY: SSE belongs to every x86-64; the caller guarantees that the reads are inside.
        unsafe {
            let column = |s: usize| {
                let first = values.as_ptr().add(start(s));
                let row = |k: usize| {
                    _mm_mul_ps(
                        _mm_set1_ps(chunk.wv[k][s]),
                        _mm_loadu_ps(first.add(k * width)),
                    )
                };
                _mm_add_ps(_mm_add_ps(_mm_add_ps(row(0), row(1)), row(2)), row(3))
            };
            let (mut a, mut b) = (column(i), column(i + 1));
            let (mut c, mut d) = (column(i + 2), column(i + 3));
            _MM_TRANSPOSE4_PS(&mut a, &mut b, &mut c, &mut d);
            let part = |k: usize, x| _mm_mul_ps(x, _mm_loadu_ps(chunk.wu[k].as_ptr().add(i)));
            let sum = _mm_add_ps(
                _mm_add_ps(part(0, a), part(1, b)),
                _mm_add_ps(part(2, c), part(3, d)),
            );
            _mm_storeu_ps(samples.as_mut_ptr().add(i), sum);
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    for (s, sample) in samples.iter_mut().enumerate() {
        let column = |x: usize| {
            let row = |j: usize| chunk.wv[j][s] * values[start(s) + j * width + x];
            ((row(0) + row(1)) + row(2)) + row(3)
        };
        *sample = (column(0) * chunk.wu[0][s] + column(1) * chunk.wu[1][s])
            + (column(2) * chunk.wu[2][s] + column(3) * chunk.wu[3][s]);
    }
}

/// [`weigh`] for samples side by side: every row of coefficients is read once for all and dealt
/// out. Same sums in the same order. Returns `false` and does nothing if the samples spread over
/// more than eight columns or two rows.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn weigh_side_by_side(
    values: &[f32],
    width: usize,
    chunk: &Chunk,
    samples: &mut [f32; CHUNK],
) -> bool {
    use std::arch::x86_64::{
        __m256, __m256i, _mm256_add_ps, _mm256_blendv_ps, _mm256_castsi256_ps, _mm256_cmpeq_epi32,
        _mm256_loadu_ps, _mm256_loadu_si256, _mm256_mul_ps, _mm256_permutevar8x32_ps,
        _mm256_set1_epi32, _mm256_storeu_ps, _mm256_sub_epi32, _mm256_testz_si256,
    };
    let first_u = chunk.iu[0];
    let first_v = chunk.iv[0].min(chunk.iv[CHUNK - 1]);
    // SAFETY: arrays of eight values.
    let (iu, iv) = unsafe {
        (
            _mm256_loadu_si256(chunk.iu.as_ptr().cast::<__m256i>()),
            _mm256_loadu_si256(chunk.iv.as_ptr().cast::<__m256i>()),
        )
    };
    let across = _mm256_sub_epi32(iu, _mm256_set1_epi32(first_u));
    let down = _mm256_sub_epi32(iv, _mm256_set1_epi32(first_v));
    let is_near = _mm256_testz_si256(across, _mm256_set1_epi32(!7)) != 0
        && _mm256_testz_si256(down, _mm256_set1_epi32(!1)) != 0;
    if !is_near {
        return false;
    }
    let is_one_row = _mm256_testz_si256(down, down) != 0;
    let last = if is_one_row { 3 } else { 4 };
    let start = (first_v as usize - 1) * width + first_u as usize - 1;
    if start + last * width + CHUNK + 3 > values.len() {
        return false;
    }
    let lower = _mm256_castsi256_ps(_mm256_cmpeq_epi32(down, _mm256_set1_epi32(1)));
    // coefficient of row `k` and column `x` of every sample whose rows start at `first_v - 1`
    let dealt = |k: usize, x: usize| -> __m256 {
        // SAFETY: k is at most `last` and x at most 3, and eight values follow as checked above.
        let read = unsafe { _mm256_loadu_ps(values.as_ptr().add(start + k * width + x)) };
        _mm256_permutevar8x32_ps(read, across)
    };
    // SAFETY: arrays of eight values.
    let weight = |w: &[f32; CHUNK]| unsafe { _mm256_loadu_ps(w.as_ptr()) };
    let column = |x: usize| {
        let mut rows = [dealt(0, x), dealt(1, x), dealt(2, x), dealt(3, x)];
        if !is_one_row {
            let after = [rows[1], rows[2], rows[3], dealt(4, x)];
            for (row, after) in rows.iter_mut().zip(after) {
                *row = _mm256_blendv_ps(*row, after, lower);
            }
        }
        let part = |k: usize| _mm256_mul_ps(weight(&chunk.wv[k]), rows[k]);
        _mm256_add_ps(
            _mm256_add_ps(_mm256_add_ps(part(0), part(1)), part(2)),
            part(3),
        )
    };
    let part = |k: usize| _mm256_mul_ps(column(k), weight(&chunk.wu[k]));
    let sum = _mm256_add_ps(
        _mm256_add_ps(part(0), part(1)),
        _mm256_add_ps(part(2), part(3)),
    );
    // SAFETY: an array of eight values.
    unsafe { _mm256_storeu_ps(samples.as_mut_ptr(), sum) };
    true
}

impl SplineImage {
    /// Values on the affine grid `origin + i * step_u + j * step_v`, i < `columns`, j < `rows`,
    /// written to `out[j * stride + i]`; what lies between and behind the rows is undefined
    /// afterwards. Returns `false` if one of the four corners is not covered, see
    /// [`SplineImage::covers`].
    ///
    /// # Panics
    /// If `out` is too short or `stride` smaller than `columns`.
    pub(crate) fn sample_grid(
        &self,
        grid: &Grid,
        columns: usize,
        rows: usize,
        stride: usize,
        out: &mut [f32],
    ) -> bool {
        let Grid {
            origin,
            step_u,
            step_v,
        } = grid;
        let (last_u, last_v) = (columns as f64 - 1.0, rows as f64 - 1.0);
        for (i, j) in [(0.0, 0.0), (last_u, 0.0), (0.0, last_v), (last_u, last_v)] {
            let at = origin + step_u * i + step_v * j;
            if !self.covers(at.x, at.y) {
                return false;
            }
        }
        if self.width() < 4 || self.height() < 4 {
            return false;
        }
        assert!(
            0 < columns
                && columns <= stride
                && 0 < rows
                && (rows - 1) * stride + columns <= out.len(),
            "a grid of {columns} x {rows} samples does not fit"
        );
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            unsafe { self.sample_lines_avx2(grid, columns, rows, stride, out) };
            return true;
        }
        // SAFETY: no instruction is asked for that a processor may lack.
        unsafe { self.sample_lines::<false>(grid, columns, rows, stride, out) };
        true
    }

    /// The same with wider vectors.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn sample_lines_avx2(
        &self,
        grid: &Grid,
        columns: usize,
        rows: usize,
        stride: usize,
        out: &mut [f32],
    ) {
        // SAFETY: this function is for processors with AVX2.
        unsafe { self.sample_lines::<true>(grid, columns, rows, stride, out) };
    }

    /// Samples row by row.
    ///
    /// # Safety
    /// With `AVX2` the processor must have it.
    #[inline(always)]
    unsafe fn sample_lines<const AVX2: bool>(
        &self,
        grid: &Grid,
        columns: usize,
        rows: usize,
        stride: usize,
        out: &mut [f32],
    ) {
        // relative to the first sample's pixel, so that single precision holds 1e-5 px
        let base = [grid.origin.x.floor(), grid.origin.y.floor()];
        let first = [grid.origin.x - base[0], grid.origin.y - base[1]];
        let step_v = [grid.step_v.x, grid.step_v.y];
        for j in 0..rows {
            let line = Line {
                at: [0, 1].map(|k| (first[k] + j as f64 * step_v[k]) as f32),
                step: [grid.step_u.x as f32, grid.step_u.y as f32],
                base: base.map(|x| x as i32),
            };
            for done in (0..columns).step_by(CHUNK) {
                let at = j * stride + done;
                // a whole chunk where there is room: what is too much, the next row overwrites
                if let Some(whole) = out[at..].first_chunk_mut() {
                    // SAFETY: as the caller guarantees.
                    unsafe { self.sample_chunk::<AVX2>(&line, done, whole) };
                } else {
                    let mut samples = [0.0f32; CHUNK];
                    // SAFETY: as the caller guarantees.
                    unsafe { self.sample_chunk::<AVX2>(&line, done, &mut samples) };
                    let rest = &mut out[at..j * stride + columns];
                    rest.copy_from_slice(&samples[..rest.len()]);
                }
            }
        }
    }

    /// Samples `first..first + CHUNK` of a row. The image has 4 x 4 px at least.
    ///
    /// # Safety
    /// With `AVX2` the processor must have it.
    #[inline(always)]
    unsafe fn sample_chunk<const AVX2: bool>(
        &self,
        line: &Line,
        first: usize,
        samples: &mut [f32; CHUNK],
    ) {
        let (width, height) = (self.width(), self.height());
        let values = self.coefficients.values();
        assert!(width >= 4 && height >= 4 && values.len() == width * height);
        let (max_u, max_v) = (width as i32 - 3, height as i32 - 3);
        let mut chunk = Chunk {
            iu: [0; CHUNK],
            iv: [0; CHUNK],
            wu: [[0.0; CHUNK]; 4],
            wv: [[0.0; CHUNK]; 4],
        };
        for i in 0..CHUNK {
            let k = (first as i32 + i as i32) as f32; // which vectors convert, unlike usize
            let (u, v) = (line.at[0] + k * line.step[0], line.at[1] + k * line.step[1]);
            let iu = near_floor(u).wrapping_add(line.base[0]).clamp(1, max_u);
            let iv = near_floor(v).wrapping_add(line.base[1]).clamp(1, max_v);
            let wu = spline_weights(u - (iu - line.base[0]) as f32);
            let wv = spline_weights(v - (iv - line.base[1]) as f32);
            (chunk.iu[i], chunk.iv[i]) = (iu, iv);
            for k in 0..4 {
                chunk.wu[k][i] = wu[k];
                chunk.wv[k][i] = wv[k];
            }
        }
        #[cfg(target_arch = "x86_64")]
        // SAFETY: the processor has AVX2.
        if AVX2 && unsafe { weigh_side_by_side(values, width, &chunk, samples) } {
            return;
        }
        // SAFETY: columns and rows of all samples are held between 1 and size - 3 above, so that
        // one before and two after them exist.
        unsafe { weigh(values, width, &chunk, samples) };
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::tests::wave_image;
    use super::*;

    #[test]
    fn a_grid_equals_its_single_samples() {
        let image = wave_image();
        let spline = SplineImage::new(&image);
        for (stride, length) in [(7, 35), (7, 60), (16, 80)] {
            let mut out = vec![0.0; length];
            let grid = Grid {
                origin: Vector2::new(6.3, 7.1),
                step_u: Vector2::new(1.1, 0.05),
                step_v: Vector2::new(-0.1, 0.95),
            };
            assert!(spline.sample_grid(&grid, 7, 5, stride, &mut out));
            for j in 0..5 {
                for i in 0..7 {
                    let at = grid.origin + grid.step_u * i as f64 + grid.step_v * j as f64;
                    let s = spline.sample(at.x, at.y).unwrap();
                    assert!((s.value - out[j * stride + i]).abs() < 1e-3);
                }
            }
            let outside = Grid {
                origin: Vector2::new(35.0, 7.0),
                ..grid
            };
            assert!(!spline.sample_grid(&outside, 7, 5, stride, &mut out));
        }
    }

    /// On processors without AVX2 both are the same code.
    #[test]
    fn samples_are_the_same_to_the_last_bit_on_any_processor() {
        let image = wave_image();
        let spline = SplineImage::new(&image);
        let (columns, rows) = (13, 9);
        let mut compared = 0;
        for (step_u, step_v) in [
            ([1.0, 0.0], [0.0, 1.0]),
            ([0.93, 0.04], [-0.05, 1.04]),
            ([1.12, -0.13], [0.1, 0.9]),
            ([1.4, 0.02], [0.0, 1.0]),
            ([0.9, 0.5], [-0.5, 0.9]),
            ([-0.8, 0.1], [-0.1, 0.8]),
            ([0.01, 0.002], [0.003, 0.01]),
        ] {
            for k in 0..24 {
                let grid = Grid {
                    origin: Vector2::new(8.0 + 0.37 * f64::from(k), 6.0 + 0.61 * f64::from(k)),
                    step_u: step_u.into(),
                    step_v: step_v.into(),
                };
                let mut here = vec![0.0; columns * rows];
                if !spline.sample_grid(&grid, columns, rows, columns, &mut here) {
                    continue;
                }
                let mut plain = vec![0.0; columns * rows];
                // SAFETY: no instruction is asked for that a processor may lack.
                unsafe { spline.sample_lines::<false>(&grid, columns, rows, columns, &mut plain) };
                assert_eq!(here, plain, "{grid:?}");
                compared += 1;
            }
        }
        assert!(compared > 100, "{compared}");
    }

    #[cfg(target_arch = "x86_64")]
    #[test]
    fn samples_side_by_side_are_dealt_out_from_rows_read_once() {
        if !std::arch::is_x86_feature_detected!("avx2") {
            return;
        }
        let (width, values) = (40, vec![1.0; 40 * 30]);
        let takes = |iu: [i32; CHUNK], iv: [i32; CHUNK]| {
            let chunk = Chunk {
                iu,
                iv,
                wu: [[0.25; CHUNK]; 4],
                wv: [[0.25; CHUNK]; 4],
            };
            let mut samples = [0.0; CHUNK];
            // SAFETY: the processor has AVX2.
            let taken = unsafe { weigh_side_by_side(&values, width, &chunk, &mut samples) };
            assert_eq!(samples, [if taken { 1.0 } else { 0.0 }; CHUNK]);
            taken
        };
        let line = [5, 6, 7, 8, 9, 10, 11, 12];
        assert!(takes(line, [7; CHUNK]));
        assert!(takes(line, [7, 7, 7, 8, 8, 8, 8, 8]));
        assert!(takes(line, [8, 8, 7, 7, 7, 7, 7, 7]));
        assert!(!takes([5, 6, 7, 8, 9, 10, 11, 13], [7; CHUNK]), "too wide");
        assert!(!takes([5, 4, 3, 2, 1, 1, 1, 1], [7; CHUNK]), "leftwards");
        assert!(!takes(line, [7, 7, 8, 8, 9, 9, 9, 9]), "three rows");
        // eight values from the last row on would leave the image
        let corner = [33, 34, 35, 36, 37, 37, 37, 37];
        assert!(!takes(corner, [27; CHUNK]) && takes(corner, [26; CHUNK]));
    }
}
