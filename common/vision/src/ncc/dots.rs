//! Sums of products, the same on every vector unit.

#[cfg(target_arch = "x86_64")]
use super::{
    LANES,
    narrow::{self, POSITIONS, WIDE_POSITIONS},
};
use super::{SearchImage, Template};

/// Sums of products of the template with the image at positions `x..x + out.len()` of row `y`.
///
/// The caller guarantees that the template lies inside the image at all of them; rows are padded so
/// that whole vectors can be read.
pub(super) fn dots(template: &Template, image: &SearchImage, x: usize, y: usize, out: &mut [i32]) {
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
        let (is_narrow, wide) = (
            template.stride == LANES,
            std::arch::is_x86_feature_detected!("avx2"),
        );
        if is_narrow && wide && out.len() >= WIDE_POSITIONS {
            // SAFETY: AVX2 is there, and the assertion covers every read.
            unsafe { narrow::dots_avx2(template, image, start, out) };
        } else if is_narrow && out.len() >= POSITIONS {
            // SAFETY: SSE2 belongs to every x86-64, and the assertion covers every read.
            unsafe { narrow::dots_sse2(template, image, start, out) };
        } else if wide {
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

/// The sum of four numbers.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
pub(super) fn total(x: std::arch::x86_64::__m128i) -> i32 {
    use std::arch::x86_64::{_mm_add_epi32, _mm_cvtsi128_si32, _mm_shuffle_epi32};
    // SAFETY: SSE2 belongs to every x86-64.
    unsafe {
        let half = _mm_add_epi32(x, _mm_shuffle_epi32(x, 0b01_00_11_10));
        _mm_cvtsi128_si32(_mm_add_epi32(half, _mm_shuffle_epi32(half, 0b10_11_00_01)))
    }
}

/// The same without vector instructions.
#[cfg(any(test, not(target_arch = "x86_64")))]
pub(super) fn dots_plain(template: &Template, image: &SearchImage, start: usize, out: &mut [i32]) {
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
pub(super) unsafe fn dots_sse2(
    template: &Template,
    image: &SearchImage,
    start: usize,
    out: &mut [i32],
) {
    use std::arch::x86_64::{
        __m128i, _mm_add_epi32, _mm_loadu_si128, _mm_madd_epi16, _mm_setzero_si128,
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
            *o = total(sum);
        }
    }
}

/// Positions that [`dots_avx2`] works out together, so that each template value is read once for all.
#[cfg(target_arch = "x86_64")]
const TOGETHER: usize = 4;

/// # Safety
/// The processor must have AVX2; for every position `start + i` and every template row,
/// `template.stride` values must follow.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
pub(super) unsafe fn dots_avx2(
    template: &Template,
    image: &SearchImage,
    start: usize,
    out: &mut [i32],
) {
    let (fours, rest) = out.as_chunks_mut::<TOGETHER>();
    let done = fours.len() * TOGETHER;
    for (k, four) in fours.iter_mut().enumerate() {
        // SAFETY: as the caller guarantees.
        *four = unsafe { neighbours_avx2(template, image, start + k * TOGETHER) };
    }
    for (i, o) in rest.iter_mut().enumerate() {
        // SAFETY: as the caller guarantees.
        [*o] = unsafe { neighbours_avx2(template, image, start + done + i) };
    }
}

/// Sums of products at N neighbouring positions.
///
/// # Safety
/// As for [`dots_avx2`], for N positions from `start` on.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
unsafe fn neighbours_avx2<const N: usize>(
    template: &Template,
    image: &SearchImage,
    start: usize,
) -> [i32; N] {
    use std::arch::x86_64::{
        __m128i, __m256i, _mm_add_epi32, _mm_loadu_si128, _mm_madd_epi16, _mm_setzero_si128,
        _mm256_add_epi32, _mm256_castsi256_si128, _mm256_extracti128_si256, _mm256_loadu_si256,
        _mm256_madd_epi16, _mm256_setzero_si256,
    };
    let stride = template.stride;
    let (wide, is_odd) = (stride / 16 * 16, !stride.is_multiple_of(16));
    let mut sums = [_mm256_setzero_si256(); N];
    let mut rests = [_mm_setzero_si128(); N];
    let mut a = template.values.as_ptr();
    let mut line = image.values.as_ptr().wrapping_add(start);
    for _ in 0..template.height {
        // SAFETY: as the caller guarantees.
        unsafe {
            let mut k = 0;
            while k < wide {
                let t = _mm256_loadu_si256(a.add(k).cast::<__m256i>());
                for (i, sum) in sums.iter_mut().enumerate() {
                    let p = _mm256_loadu_si256(line.add(k + i).cast::<__m256i>());
                    *sum = _mm256_add_epi32(*sum, _mm256_madd_epi16(t, p));
                }
                k += 16;
            }
            if is_odd {
                let t = _mm_loadu_si128(a.add(wide).cast::<__m128i>());
                for (i, rest) in rests.iter_mut().enumerate() {
                    let p = _mm_loadu_si128(line.add(wide + i).cast::<__m128i>());
                    *rest = _mm_add_epi32(*rest, _mm_madd_epi16(t, p));
                }
            }
        }
        a = a.wrapping_add(stride);
        line = line.wrapping_add(image.stride);
    }
    let mut out = [0; N];
    for ((o, sum), rest) in out.iter_mut().zip(sums).zip(rests) {
        let halves = _mm_add_epi32(
            _mm256_castsi256_si128(sum),
            _mm256_extracti128_si256(sum, 1),
        );
        *o = total(_mm_add_epi32(halves, rest));
    }
    out
}
