//! Scores of templates with a mask at a few positions, all sums by products with the mask.
//!
//! The same formula on the same whole numbers as in [`super::score`]; running sums over the mask's
//! runs, as used there, pay off from some positions in a row on.

#[cfg(target_arch = "x86_64")]
use super::dots::total;
use super::small::{Extent, Scale};
use super::{SearchImage, Template, VALUE_LIMIT};

/// Most positions in a row.
const FEW: usize = 12;

/// Whether this is the way for a template over so many positions.
pub(super) fn is_for(template: &Template, extent: &Extent) -> bool {
    !template.mask.is_empty()
        && extent.width <= FEW
        && template.count as i64 * VALUE_LIMIT * VALUE_LIMIT <= i64::from(i32::MAX)
}

/// Appends the scores of all positions, row by row. The template is inside the image at all of them.
pub(super) fn scores(
    image: &SearchImage,
    template: &Template,
    extent: Extent,
    scale: &Scale,
    out: &mut Vec<f32>,
) {
    let start = extent.top * image.stride + extent.left;
    let last = (extent.height + template.height - 2) * image.stride + extent.width - 1;
    let length = template.stride * template.height;
    assert!(
        start + last + template.stride <= image.values.len()
            && template.values.len() == length
            && template.mask.len() == length,
        "a template position reads beyond the search image"
    );
    for y in 0..extent.height {
        for x in 0..extent.width {
            // SAFETY: the assertion covers every read.
            let sums = unsafe { sums(image, template, start + y * image.stride + x) };
            let [product, sum, square] = sums;
            out.push(scale.score(product, f64::from(sum), f64::from(square)));
        }
    }
}

/// Sums over the mask of image times template, of the image and of its squares.
///
/// # Safety
/// From `start`, for every template row, `template.stride` values must follow, the rows
/// `image.stride` apart; values and mask of the template are as long as its rows.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
unsafe fn sums(image: &SearchImage, template: &Template, start: usize) -> [i32; 3] {
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2; the rest is the caller's promise.
        return unsafe { sums_avx2(image, template, start) };
    }
    // SAFETY: as the caller promises.
    unsafe { sums_sse2(image, template, start) }
}

/// # Safety
/// As [`sums`].
#[cfg(target_arch = "x86_64")]
unsafe fn sums_sse2(image: &SearchImage, template: &Template, start: usize) -> [i32; 3] {
    use std::arch::x86_64::{
        __m128i, _mm_add_epi32, _mm_loadu_si128, _mm_madd_epi16, _mm_mullo_epi16, _mm_setzero_si128,
    };
    // SAFETY: SSE2 belongs to every x86-64; the caller guarantees the reads.
    unsafe {
        let mut all = [_mm_setzero_si128(); 3];
        for row in 0..template.height {
            let (line, at) = (start + row * image.stride, row * template.stride);
            for k in (0..template.stride).step_by(8) {
                let load =
                    |p: *const i16, i: usize| _mm_loadu_si128(p.add(i + k).cast::<__m128i>());
                let pixels = load(image.values.as_ptr(), line);
                let mask = load(template.mask.as_ptr(), at);
                let inside = _mm_mullo_epi16(pixels, mask);
                let values = load(template.values.as_ptr(), at);
                all[0] = _mm_add_epi32(all[0], _mm_madd_epi16(values, pixels));
                all[1] = _mm_add_epi32(all[1], _mm_madd_epi16(mask, pixels));
                all[2] = _mm_add_epi32(all[2], _mm_madd_epi16(inside, pixels));
            }
        }
        all.map(total)
    }
}

/// # Safety
/// As [`sums`], and the processor must have AVX2.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
unsafe fn sums_avx2(image: &SearchImage, template: &Template, start: usize) -> [i32; 3] {
    use std::arch::x86_64::{
        __m128i, __m256i, _mm_add_epi32, _mm_loadu_si128, _mm_madd_epi16, _mm_mullo_epi16,
        _mm_setzero_si128, _mm256_add_epi32, _mm256_castsi256_si128, _mm256_extracti128_si256,
        _mm256_loadu_si256, _mm256_madd_epi16, _mm256_mullo_epi16, _mm256_setzero_si256,
    };
    let wide = template.stride / 16 * 16;
    // SAFETY: the caller guarantees the reads.
    unsafe {
        let mut all = [_mm256_setzero_si256(); 3];
        let mut rest = [_mm_setzero_si128(); 3];
        for row in 0..template.height {
            let (line, at) = (start + row * image.stride, row * template.stride);
            let pixels_at = image.values.as_ptr().add(line);
            let (values_at, mask_at) = (
                template.values.as_ptr().add(at),
                template.mask.as_ptr().add(at),
            );
            let mut k = 0;
            while k < wide {
                let load = |p: *const i16| _mm256_loadu_si256(p.add(k).cast::<__m256i>());
                let (pixels, mask) = (load(pixels_at), load(mask_at));
                let inside = _mm256_mullo_epi16(pixels, mask);
                let product = _mm256_madd_epi16(load(values_at), pixels);
                all[0] = _mm256_add_epi32(all[0], product);
                all[1] = _mm256_add_epi32(all[1], _mm256_madd_epi16(mask, pixels));
                all[2] = _mm256_add_epi32(all[2], _mm256_madd_epi16(inside, pixels));
                k += 16;
            }
            if wide < template.stride {
                let load = |p: *const i16| _mm_loadu_si128(p.add(wide).cast::<__m128i>());
                let (pixels, mask) = (load(pixels_at), load(mask_at));
                let inside = _mm_mullo_epi16(pixels, mask);
                let product = _mm_madd_epi16(load(values_at), pixels);
                rest[0] = _mm_add_epi32(rest[0], product);
                rest[1] = _mm_add_epi32(rest[1], _mm_madd_epi16(mask, pixels));
                rest[2] = _mm_add_epi32(rest[2], _mm_madd_epi16(inside, pixels));
            }
        }
        [0, 1, 2].map(|i| {
            let (low, high) = (
                _mm256_castsi256_si128(all[i]),
                _mm256_extracti128_si256(all[i], 1),
            );
            total(_mm_add_epi32(rest[i], _mm_add_epi32(low, high)))
        })
    }
}

/// The same without vector instructions; safe wherever the caller's promise holds.
///
/// # Safety
/// As above; a read outside panics.
#[cfg(not(target_arch = "x86_64"))]
unsafe fn sums(image: &SearchImage, template: &Template, start: usize) -> [i32; 3] {
    let mut all = [0i32; 3];
    for row in 0..template.height {
        for k in 0..template.stride {
            let pixel = i32::from(image.values[start + row * image.stride + k]);
            let at = row * template.stride + k;
            let mask = i32::from(template.mask[at]);
            all[0] = all[0].wrapping_add(pixel * i32::from(template.values[at]));
            all[1] += pixel * mask;
            all[2] += pixel * pixel * mask;
        }
    }
    all
}
