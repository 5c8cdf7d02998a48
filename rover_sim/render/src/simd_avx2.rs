//! The AVX2 implementation of [`Simd`].
//!
//! Safety: every method calls intrinsics that need AVX2. They are reached only through functions
//! made by `dispatched!`, which run them after the machine has been asked, so the `unsafe` blocks
//! here are sound in this crate; the type is private to it for that reason.

use crate::simd::{Lanes, Simd};
use std::arch::x86_64::*;
use std::ops::{Add, Div, Mul, Sub};

/// The implementation with AVX2 intrinsics.
#[derive(Clone, Copy)]
pub(crate) struct Avx2;

/// Eight lanes in one register.
#[derive(Clone, Copy)]
pub(crate) struct F8(__m256);

macro_rules! lanewise {
    ($trait:ident, $method:ident, $intrinsic:ident) => {
        impl $trait for F8 {
            type Output = F8;
            #[inline(always)]
            fn $method(self, rhs: F8) -> F8 {
                // SAFETY: see the module's text.
                F8(unsafe { $intrinsic(self.0, rhs.0) })
            }
        }
    };
}
lanewise!(Add, add, _mm256_add_ps);
lanewise!(Sub, sub, _mm256_sub_ps);
lanewise!(Mul, mul, _mm256_mul_ps);
lanewise!(Div, div, _mm256_div_ps);

// SAFETY of all blocks below: see the module's text; loads and stores go through references to
// arrays of exactly eight 32-bit values and are unaligned ones.
impl Simd for Avx2 {
    type F = F8;
    type I = __m256i;
    type M = __m256;

    #[inline(always)]
    fn splat(x: f32) -> F8 {
        F8(unsafe { _mm256_set1_ps(x) })
    }
    #[inline(always)]
    fn load(x: &Lanes) -> F8 {
        F8(unsafe { _mm256_loadu_ps(x.as_ptr()) })
    }
    #[inline(always)]
    fn store(x: F8, out: &mut Lanes) {
        unsafe { _mm256_storeu_ps(out.as_mut_ptr(), x.0) }
    }
    #[inline(always)]
    fn sqrt(x: F8) -> F8 {
        F8(unsafe { _mm256_sqrt_ps(x.0) })
    }
    #[inline(always)]
    fn min(a: F8, b: F8) -> F8 {
        F8(unsafe { _mm256_min_ps(a.0, b.0) })
    }
    #[inline(always)]
    fn max(a: F8, b: F8) -> F8 {
        F8(unsafe { _mm256_max_ps(a.0, b.0) })
    }
    #[inline(always)]
    fn ge(a: F8, b: F8) -> __m256 {
        unsafe { _mm256_cmp_ps::<_CMP_GE_OQ>(a.0, b.0) }
    }
    #[inline(always)]
    fn gt(a: F8, b: F8) -> __m256 {
        unsafe { _mm256_cmp_ps::<_CMP_GT_OQ>(a.0, b.0) }
    }
    #[inline(always)]
    fn and(a: __m256, b: __m256) -> __m256 {
        unsafe { _mm256_and_ps(a, b) }
    }
    #[inline(always)]
    fn bits(m: __m256) -> u32 {
        unsafe { _mm256_movemask_ps(m) as u32 }
    }
    #[inline(always)]
    fn select(m: __m256, a: F8, b: F8) -> F8 {
        F8(unsafe { _mm256_blendv_ps(b.0, a.0, m) })
    }
    #[inline(always)]
    fn select_i(m: __m256, a: __m256i, b: __m256i) -> __m256i {
        unsafe {
            _mm256_castps_si256(_mm256_blendv_ps(
                _mm256_castsi256_ps(b),
                _mm256_castsi256_ps(a),
                m,
            ))
        }
    }
    #[inline(always)]
    fn eq_i(a: __m256i, b: __m256i) -> __m256 {
        unsafe { _mm256_castsi256_ps(_mm256_cmpeq_epi32(a, b)) }
    }
    #[inline(always)]
    fn splat_i(x: u32) -> __m256i {
        unsafe { _mm256_set1_epi32(x as i32) }
    }
    #[inline(always)]
    fn load_i(x: &[u32; 8]) -> __m256i {
        unsafe { _mm256_loadu_si256(x.as_ptr().cast()) }
    }
    #[inline(always)]
    fn store_i(x: __m256i, out: &mut [u32; 8]) {
        unsafe { _mm256_storeu_si256(out.as_mut_ptr().cast(), x) }
    }
    #[inline(always)]
    fn add_i(a: __m256i, b: __m256i) -> __m256i {
        unsafe { _mm256_add_epi32(a, b) }
    }
    #[inline(always)]
    fn mul_i(a: __m256i, b: __m256i) -> __m256i {
        unsafe { _mm256_mullo_epi32(a, b) }
    }
    #[inline(always)]
    fn xor_i(a: __m256i, b: __m256i) -> __m256i {
        unsafe { _mm256_xor_si256(a, b) }
    }
    #[inline(always)]
    fn shr_i<const N: i32>(a: __m256i) -> __m256i {
        unsafe { _mm256_srli_epi32::<N>(a) }
    }
    #[inline(always)]
    fn to_f(a: __m256i) -> F8 {
        F8(unsafe { _mm256_cvtepi32_ps(a) })
    }
    #[inline(always)]
    fn trunc(a: F8) -> __m256i {
        unsafe { _mm256_cvttps_epi32(a.0) }
    }
}
