//! Sixteen disparities at once, with AVX2 and without.

/// Disparities worked on together.
pub(super) const LANES: usize = 16;
/// Their sums.
pub(super) type Block = [u16; LANES];

/// What the matcher does with sixteen whole numbers, lane by lane.
pub(super) trait Lanes: Copy {
    fn load(block: &Block) -> Self;
    fn store(self, block: &mut Block);
    /// Absolute differences of one byte to sixteen.
    fn differences(one: u8, others: &[u8; LANES]) -> Self;
    fn plus(self, other: Self) -> Self;
    fn minus(self, other: Self) -> Self;
    fn or(self, other: Self) -> Self;
    fn lesser(self, other: Self) -> Self;
    /// All ones where the lanes are equal.
    fn equal(self, other: Self) -> Self;
    /// Every lane one further, the last one of `before` in the first.
    fn shifted(self, before: Self) -> Self;
    /// `other` where all bits of `mask` are set, else `self`.
    fn replaced(self, mask: Self, other: Self) -> Self;
    fn splat(one: u16) -> Self {
        Self::load(&[one; LANES])
    }
    fn lane(self, lane: usize) -> u16 {
        let mut block = [0; LANES];
        self.store(&mut block);
        block[lane]
    }
    fn last(self) -> u16 {
        self.lane(LANES - 1)
    }
}

/// The least of all lanes.
#[inline(always)]
pub(super) fn least<L: Lanes>(lanes: L) -> u16 {
    let mut block = [0; LANES];
    lanes.store(&mut block);
    block.iter().copied().fold(u16::MAX, u16::min)
}

/// For every processor.
#[derive(Clone, Copy)]
pub(super) struct Plain(Block);

impl Plain {
    #[inline(always)]
    fn with(self, other: Self, f: impl Fn(u16, u16) -> u16) -> Self {
        Self(std::array::from_fn(|i| f(self.0[i], other.0[i])))
    }
}

impl Lanes for Plain {
    #[inline(always)]
    fn load(block: &Block) -> Self {
        Self(*block)
    }
    #[inline(always)]
    fn store(self, block: &mut Block) {
        *block = self.0;
    }
    #[inline(always)]
    fn differences(one: u8, others: &[u8; LANES]) -> Self {
        Self(std::array::from_fn(|i| u16::from(one.abs_diff(others[i]))))
    }
    #[inline(always)]
    fn plus(self, other: Self) -> Self {
        self.with(other, u16::wrapping_add)
    }
    #[inline(always)]
    fn minus(self, other: Self) -> Self {
        self.with(other, u16::wrapping_sub)
    }
    #[inline(always)]
    fn or(self, other: Self) -> Self {
        self.with(other, |a, b| a | b)
    }
    #[inline(always)]
    fn lesser(self, other: Self) -> Self {
        self.with(other, u16::min)
    }
    #[inline(always)]
    fn equal(self, other: Self) -> Self {
        self.with(other, |a, b| u16::from(a == b).wrapping_neg())
    }
    #[inline(always)]
    fn shifted(self, before: Self) -> Self {
        Self(std::array::from_fn(|i| match i {
            0 => before.0[LANES - 1],
            _ => self.0[i - 1],
        }))
    }
    #[inline(always)]
    fn replaced(self, mask: Self, other: Self) -> Self {
        Self(std::array::from_fn(|i| {
            (self.0[i] & !mask.0[i]) | (other.0[i] & mask.0[i])
        }))
    }
}

/// With AVX2. Only functions that have asked for it may use this type.
#[cfg(target_arch = "x86_64")]
pub(super) mod avx2 {
    use super::{Block, LANES, Lanes};
    use std::arch::x86_64::{
        __m128i, __m256i, _mm_loadu_si128, _mm_or_si128, _mm_set1_epi8, _mm_subs_epu8,
        _mm256_add_epi16, _mm256_alignr_epi8, _mm256_blendv_epi8, _mm256_cmpeq_epi16,
        _mm256_cvtepu8_epi16, _mm256_extract_epi16, _mm256_loadu_si256, _mm256_min_epu16,
        _mm256_or_si256, _mm256_permute2x128_si256, _mm256_set1_epi16, _mm256_storeu_si256,
        _mm256_sub_epi16,
    };

    #[derive(Clone, Copy)]
    pub(in super::super) struct Avx2(__m256i);

    // SAFETY: every block here is as long as the instruction reads or writes, unaligned access is
    // allowed, and the processor has AVX2 where this type is used.
    impl Lanes for Avx2 {
        #[inline(always)]
        fn load(block: &Block) -> Self {
            Self(unsafe { _mm256_loadu_si256(block.as_ptr().cast()) })
        }
        #[inline(always)]
        fn store(self, block: &mut Block) {
            unsafe { _mm256_storeu_si256(block.as_mut_ptr().cast(), self.0) }
        }
        #[inline(always)]
        fn differences(one: u8, others: &[u8; LANES]) -> Self {
            unsafe {
                let one = _mm_set1_epi8(one as i8);
                let others: __m128i = _mm_loadu_si128(others.as_ptr().cast());
                let (above, below) = (_mm_subs_epu8(one, others), _mm_subs_epu8(others, one));
                Self(_mm256_cvtepu8_epi16(_mm_or_si128(above, below)))
            }
        }
        #[inline(always)]
        fn plus(self, other: Self) -> Self {
            Self(unsafe { _mm256_add_epi16(self.0, other.0) })
        }
        #[inline(always)]
        fn minus(self, other: Self) -> Self {
            Self(unsafe { _mm256_sub_epi16(self.0, other.0) })
        }
        #[inline(always)]
        fn or(self, other: Self) -> Self {
            Self(unsafe { _mm256_or_si256(self.0, other.0) })
        }
        #[inline(always)]
        fn lesser(self, other: Self) -> Self {
            Self(unsafe { _mm256_min_epu16(self.0, other.0) })
        }
        #[inline(always)]
        fn equal(self, other: Self) -> Self {
            Self(unsafe { _mm256_cmpeq_epi16(self.0, other.0) })
        }
        #[inline(always)]
        fn shifted(self, before: Self) -> Self {
            unsafe {
                // the upper half of the one before and the own lower half
                let halves = _mm256_permute2x128_si256::<0x21>(before.0, self.0);
                Self(_mm256_alignr_epi8::<14>(self.0, halves))
            }
        }
        #[inline(always)]
        fn replaced(self, mask: Self, other: Self) -> Self {
            Self(unsafe { _mm256_blendv_epi8(self.0, other.0, mask.0) })
        }
        #[inline(always)]
        fn last(self) -> u16 {
            unsafe { _mm256_extract_epi16::<15>(self.0) as u16 }
        }
        #[inline(always)]
        fn splat(one: u16) -> Self {
            Self(unsafe { _mm256_set1_epi16(one as i16) })
        }
    }
}
