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
pub(super) unsafe fn dots_avx2(
    template: &Template,
    image: &SearchImage,
    start: usize,
    out: &mut [i32],
) {
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
