//! Scores of templates with a mask at a few positions, all sums by products with the mask.
//!
//! The same formula on the same whole numbers as in [`super::score`]; running sums over the mask's
//! runs, as used there, pay off from some positions in a row on.

use super::small::{Extent, Scale};
use super::{SearchImage, Template, VALUE_LIMIT};

/// Most positions in a row.
const FEW: usize = 12;

/// Whether this is the way for a template over so many positions.
pub(super) fn is_for(template: &Template, extent: &Extent) -> bool {
    !template.rectangular
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
#[inline]
unsafe fn sums(image: &SearchImage, template: &Template, start: usize) -> [i32; 3] {
    use std::arch::x86_64::{
        __m128i, _mm_add_epi32, _mm_cvtsi128_si32, _mm_loadu_si128, _mm_madd_epi16,
        _mm_mullo_epi16, _mm_setzero_si128, _mm_shuffle_epi32,
    };
    // SAFETY: SSE2 belongs to every x86-64; the caller guarantees the reads.
    unsafe {
        let mut all = [_mm_setzero_si128(); 3];
        let (values, mask) = (template.values.as_ptr(), template.mask.as_ptr());
        for row in 0..template.height {
            let (line, at) = (start + row * image.stride, row * template.stride);
            for k in (0..template.stride).step_by(8) {
                let load = |p: *const i16| _mm_loadu_si128(p.cast::<__m128i>());
                let pixels = load(image.values.as_ptr().add(line + k));
                let (t, m) = (load(values.add(at + k)), load(mask.add(at + k)));
                let inside = _mm_mullo_epi16(pixels, m);
                all[0] = _mm_add_epi32(all[0], _mm_madd_epi16(t, pixels));
                all[1] = _mm_add_epi32(all[1], _mm_madd_epi16(m, pixels));
                all[2] = _mm_add_epi32(all[2], _mm_madd_epi16(inside, pixels));
            }
        }
        all.map(|x| {
            let half = _mm_add_epi32(x, _mm_shuffle_epi32(x, 0b01_00_11_10));
            _mm_cvtsi128_si32(_mm_add_epi32(half, _mm_shuffle_epi32(half, 0b10_11_00_01)))
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
