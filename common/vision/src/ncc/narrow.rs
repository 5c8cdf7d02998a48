//! Sums of products for narrow templates: neighbouring positions side by side in a vector.
//!
//! A template of at most [`LANES`](super::LANES) columns fills less than a vector, so that adding a
//! vector's lanes up would cost as much as the products. Here every lane is a position of its own:
//! pairs of neighbouring pixels are multiplied by the same pair of template values.

#[cfg(target_arch = "x86_64")]
use super::{SearchImage, Template};

/// Positions that one step works out.
#[cfg(target_arch = "x86_64")]
pub(super) const POSITIONS: usize = 8;
/// The same with AVX2.
#[cfg(target_arch = "x86_64")]
pub(super) const WIDE_POSITIONS: usize = 16;

/// The template's pixels 2 k and 2 k + 1 of a row as one value.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn pair(line: &[i16], k: usize) -> i32 {
    i32::from(line[2 * k] as u16) | i32::from(line[2 * k + 1]) << 16
}

/// Starts of steps of `step` positions that cover `count` of them; the last may overlap the one
/// before it.
#[cfg(target_arch = "x86_64")]
fn starts(count: usize, step: usize) -> impl Iterator<Item = usize> {
    (0..count.div_ceil(step)).map(move |k| (k * step).min(count - step))
}

/// # Safety
/// For every position `start + i` and every template row, `template.stride` values must follow;
/// at least [`POSITIONS`] positions.
#[cfg(target_arch = "x86_64")]
pub(super) unsafe fn dots_sse2(
    template: &Template,
    image: &SearchImage,
    start: usize,
    out: &mut [i32],
) {
    use std::arch::x86_64::{
        __m128i, _mm_add_epi32, _mm_loadu_si128, _mm_madd_epi16, _mm_set1_epi32, _mm_setzero_si128,
        _mm_storeu_si128, _mm_unpackhi_epi16, _mm_unpacklo_epi16,
    };
    assert!(out.len() >= POSITIONS, "too few positions for a step");
    for first in starts(out.len(), POSITIONS) {
        // SAFETY: a step reads up to `stride` values from each of its positions, as the caller
        // guarantees, and writes `POSITIONS` values from `first` on, which `starts` keeps inside.
        unsafe {
            let (mut low, mut high) = (_mm_setzero_si128(), _mm_setzero_si128());
            for (row, line) in template.values.chunks_exact(template.stride).enumerate() {
                let pixels = image
                    .values
                    .as_ptr()
                    .add(start + first + row * image.stride);
                for k in 0..template.width.div_ceil(2) {
                    let weights = _mm_set1_epi32(pair(line, k));
                    let a = _mm_loadu_si128(pixels.add(2 * k).cast::<__m128i>());
                    let b = _mm_loadu_si128(pixels.add(2 * k + 1).cast::<__m128i>());
                    let products = _mm_madd_epi16(_mm_unpacklo_epi16(a, b), weights);
                    low = _mm_add_epi32(low, products);
                    let products = _mm_madd_epi16(_mm_unpackhi_epi16(a, b), weights);
                    high = _mm_add_epi32(high, products);
                }
            }
            let at = out.as_mut_ptr().add(first);
            _mm_storeu_si128(at.cast::<__m128i>(), low);
            _mm_storeu_si128(at.add(4).cast::<__m128i>(), high);
        }
    }
}

/// # Safety
/// The processor must have AVX2; for every position `start + i` and every template row,
/// `template.stride` values must follow; at least [`WIDE_POSITIONS`] positions.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
pub(super) unsafe fn dots_avx2(
    template: &Template,
    image: &SearchImage,
    start: usize,
    out: &mut [i32],
) {
    use std::arch::x86_64::{
        __m256i, _mm256_add_epi32, _mm256_loadu_si256, _mm256_madd_epi16,
        _mm256_permute2x128_si256, _mm256_set1_epi32, _mm256_setzero_si256, _mm256_storeu_si256,
        _mm256_unpackhi_epi16, _mm256_unpacklo_epi16,
    };
    assert!(out.len() >= WIDE_POSITIONS, "too few positions for a step");
    for first in starts(out.len(), WIDE_POSITIONS) {
        // SAFETY: as in `dots_sse2`, with twice the positions.
        unsafe {
            // positions 0-3 and 8-11, and 4-7 and 12-15
            let (mut low, mut high) = (_mm256_setzero_si256(), _mm256_setzero_si256());
            for (row, line) in template.values.chunks_exact(template.stride).enumerate() {
                let pixels = image
                    .values
                    .as_ptr()
                    .add(start + first + row * image.stride);
                for k in 0..template.width.div_ceil(2) {
                    let weights = _mm256_set1_epi32(pair(line, k));
                    let a = _mm256_loadu_si256(pixels.add(2 * k).cast::<__m256i>());
                    let b = _mm256_loadu_si256(pixels.add(2 * k + 1).cast::<__m256i>());
                    let products = _mm256_madd_epi16(_mm256_unpacklo_epi16(a, b), weights);
                    low = _mm256_add_epi32(low, products);
                    let products = _mm256_madd_epi16(_mm256_unpackhi_epi16(a, b), weights);
                    high = _mm256_add_epi32(high, products);
                }
            }
            let at = out.as_mut_ptr().add(first).cast::<__m256i>();
            _mm256_storeu_si256(at, _mm256_permute2x128_si256(low, high, 0x20));
            _mm256_storeu_si256(at.add(1), _mm256_permute2x128_si256(low, high, 0x31));
        }
    }
}
