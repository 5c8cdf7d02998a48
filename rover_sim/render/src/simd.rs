//! Eight-lane arithmetic behind one trait, so that every kernel is written once.
//!
//! Two implementations: plain arrays, and AVX2 intrinsics chosen at run time. Both give the same
//! bits: only IEEE operations that are exactly rounded (add, sub, mul, div, sqrt) are used, no
//! fused multiply-add and no reciprocal estimates.
//!
//! All functions are `inline(always)`: an intrinsic that is not inlined into a function compiled
//! with AVX2 becomes a call, fifty times slower. For the same reason kernels hold no closures (not
//! even those of `array::map`): a closure is a function of its own.

use std::ops::{Add, Div, Mul, Sub};

/// Eight values.
pub(crate) type Lanes = [f32; 8];

/// The operations the kernels need, on eight lanes.
pub(crate) trait Simd: Copy {
    type F: Copy
        + Add<Output = Self::F>
        + Sub<Output = Self::F>
        + Mul<Output = Self::F>
        + Div<Output = Self::F>;
    type I: Copy;
    type M: Copy;

    fn splat(x: f32) -> Self::F;
    fn load(x: &Lanes) -> Self::F;
    fn store(x: Self::F, out: &mut Lanes);
    fn sqrt(x: Self::F) -> Self::F;
    /// `a < b ? a : b`, lane by lane (the second operand for a NaN).
    fn min(a: Self::F, b: Self::F) -> Self::F;
    /// `a > b ? a : b`, lane by lane (the second operand for a NaN).
    fn max(a: Self::F, b: Self::F) -> Self::F;
    fn ge(a: Self::F, b: Self::F) -> Self::M;
    fn gt(a: Self::F, b: Self::F) -> Self::M;
    fn and(a: Self::M, b: Self::M) -> Self::M;
    /// One bit per lane, lane 0 in bit 0.
    fn bits(m: Self::M) -> u32;
    /// `m ? a : b`, lane by lane.
    fn select(m: Self::M, a: Self::F, b: Self::F) -> Self::F;
    fn select_i(m: Self::M, a: Self::I, b: Self::I) -> Self::I;

    fn eq_i(a: Self::I, b: Self::I) -> Self::M;
    fn splat_i(x: u32) -> Self::I;
    fn load_i(x: &[u32; 8]) -> Self::I;
    fn store_i(x: Self::I, out: &mut [u32; 8]);
    fn add_i(a: Self::I, b: Self::I) -> Self::I;
    fn mul_i(a: Self::I, b: Self::I) -> Self::I;
    fn xor_i(a: Self::I, b: Self::I) -> Self::I;
    /// Logical shift right.
    fn shr_i<const N: i32>(a: Self::I) -> Self::I;
    /// From signed 32-bit integers.
    fn to_f(a: Self::I) -> Self::F;
    /// Towards zero, to signed 32-bit integers; `|x| < 2^31`.
    fn trunc(a: Self::F) -> Self::I;
}

/// Which implementation runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Level {
    /// Arrays of eight, any machine.
    Portable,
    /// AVX2 intrinsics; exists only where the machine has been asked.
    #[cfg(target_arch = "x86_64")]
    Avx2(Detected),
}

/// Proof that the machine has the instructions of [`Level::Avx2`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Detected(());

impl Level {
    /// The fastest implementation of this machine.
    pub(crate) fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        if std::is_x86_feature_detected!("avx2") && std::is_x86_feature_detected!("popcnt") {
            return Self::Avx2(Detected(()));
        }
        Self::Portable
    }
}

/// Defines `fn $name(level, args)` that runs `$kernel::<S>(args)` with the implementation chosen.
macro_rules! dispatched {
    ($(#[$meta:meta])* $vis:vis fn $name:ident = $kernel:ident($($arg:ident: $ty:ty),* $(,)?)) => {
        $(#[$meta])*
        #[allow(clippy::too_many_arguments)] // a kernel's arguments, listed once
        $vis fn $name(level: $crate::simd::Level, $($arg: $ty),*) {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2,popcnt")]
                #[allow(clippy::too_many_arguments)] // as above
                fn with_avx2($($arg: $ty),*) {
                    $kernel::<$crate::simd_avx2::Avx2>($($arg),*);
                }
                if let $crate::simd::Level::Avx2(_) = level {
                    // SAFETY: the level carries the proof that the machine has AVX2 and POPCNT.
                    return unsafe { with_avx2($($arg),*) };
                }
            }
            let _ = level;
            $kernel::<$crate::simd::Portable>($($arg),*);
        }
    };
}
pub(crate) use dispatched;

/// The implementation with plain arrays.
#[derive(Clone, Copy)]
pub(crate) struct Portable;

/// Eight lanes of the portable implementation.
#[derive(Clone, Copy)]
pub(crate) struct F8(Lanes);

macro_rules! lanewise {
    ($trait:ident, $method:ident, $op:tt) => {
        impl $trait for F8 {
            type Output = F8;
            #[inline(always)]
            fn $method(self, rhs: F8) -> F8 {
                let mut out = self.0;
                for i in 0..8 {
                    out[i] = self.0[i] $op rhs.0[i];
                }
                F8(out)
            }
        }
    };
}
lanewise!(Add, add, +);
lanewise!(Sub, sub, -);
lanewise!(Mul, mul, *);
lanewise!(Div, div, /);

#[inline(always)]
fn map2<A: Copy, B: Copy, C: Copy + Default>(
    a: &[A; 8],
    b: &[B; 8],
    f: impl Fn(A, B) -> C,
) -> [C; 8] {
    let mut out = [C::default(); 8];
    for i in 0..8 {
        out[i] = f(a[i], b[i]);
    }
    out
}

impl Simd for Portable {
    type F = F8;
    type I = [u32; 8];
    type M = [u32; 8];

    #[inline(always)]
    fn splat(x: f32) -> F8 {
        F8([x; 8])
    }
    #[inline(always)]
    fn load(x: &Lanes) -> F8 {
        F8(*x)
    }
    #[inline(always)]
    fn store(x: F8, out: &mut Lanes) {
        *out = x.0;
    }
    #[inline(always)]
    fn sqrt(x: F8) -> F8 {
        F8(x.0.map(f32::sqrt))
    }
    #[inline(always)]
    fn min(a: F8, b: F8) -> F8 {
        F8(map2(&a.0, &b.0, |x, y| if x < y { x } else { y }))
    }
    #[inline(always)]
    fn max(a: F8, b: F8) -> F8 {
        F8(map2(&a.0, &b.0, |x, y| if x > y { x } else { y }))
    }
    #[inline(always)]
    fn ge(a: F8, b: F8) -> [u32; 8] {
        map2(&a.0, &b.0, |x, y| if x >= y { u32::MAX } else { 0 })
    }
    #[inline(always)]
    fn gt(a: F8, b: F8) -> [u32; 8] {
        map2(&a.0, &b.0, |x, y| if x > y { u32::MAX } else { 0 })
    }
    #[inline(always)]
    fn and(a: [u32; 8], b: [u32; 8]) -> [u32; 8] {
        map2(&a, &b, |x, y| x & y)
    }
    #[inline(always)]
    fn bits(m: [u32; 8]) -> u32 {
        let mut out = 0;
        for (i, lane) in m.iter().enumerate() {
            out |= (lane & 1) << i;
        }
        out
    }
    #[inline(always)]
    fn select(m: [u32; 8], a: F8, b: F8) -> F8 {
        let mut out = b.0;
        for i in 0..8 {
            out[i] = f32::from_bits((a.0[i].to_bits() & m[i]) | (b.0[i].to_bits() & !m[i]));
        }
        F8(out)
    }
    #[inline(always)]
    fn select_i(m: [u32; 8], a: [u32; 8], b: [u32; 8]) -> [u32; 8] {
        let mut out = b;
        for i in 0..8 {
            out[i] = (a[i] & m[i]) | (b[i] & !m[i]);
        }
        out
    }
    #[inline(always)]
    fn eq_i(a: [u32; 8], b: [u32; 8]) -> [u32; 8] {
        map2(&a, &b, |x, y| if x == y { u32::MAX } else { 0 })
    }
    #[inline(always)]
    fn splat_i(x: u32) -> [u32; 8] {
        [x; 8]
    }
    #[inline(always)]
    fn load_i(x: &[u32; 8]) -> [u32; 8] {
        *x
    }
    #[inline(always)]
    fn store_i(x: [u32; 8], out: &mut [u32; 8]) {
        *out = x;
    }
    #[inline(always)]
    fn add_i(a: [u32; 8], b: [u32; 8]) -> [u32; 8] {
        map2(&a, &b, u32::wrapping_add)
    }
    #[inline(always)]
    fn mul_i(a: [u32; 8], b: [u32; 8]) -> [u32; 8] {
        map2(&a, &b, u32::wrapping_mul)
    }
    #[inline(always)]
    fn xor_i(a: [u32; 8], b: [u32; 8]) -> [u32; 8] {
        map2(&a, &b, |x, y| x ^ y)
    }
    #[inline(always)]
    fn shr_i<const N: i32>(a: [u32; 8]) -> [u32; 8] {
        a.map(|x| x >> N)
    }
    #[inline(always)]
    fn to_f(a: [u32; 8]) -> F8 {
        F8(a.map(|x| x as i32 as f32))
    }
    #[inline(always)]
    fn trunc(a: F8) -> [u32; 8] {
        a.0.map(|x| x as i32 as u32)
    }
}

/// Three coordinates of eight points.
pub(crate) type V3<S> = [<S as Simd>::F; 3];

#[inline(always)]
pub(crate) fn dot<S: Simd>(a: V3<S>, b: V3<S>) -> S::F {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
pub(crate) fn splat3<S: Simd>(v: [f32; 3]) -> V3<S> {
    [S::splat(v[0]), S::splat(v[1]), S::splat(v[2])]
}

#[inline(always)]
pub(crate) fn scale3<S: Simd>(v: V3<S>, s: S::F) -> V3<S> {
    [v[0] * s, v[1] * s, v[2] * s]
}

#[inline(always)]
pub(crate) fn add3<S: Simd>(a: V3<S>, b: V3<S>) -> V3<S> {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

#[inline(always)]
pub(crate) fn sub3<S: Simd>(a: V3<S>, b: V3<S>) -> V3<S> {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
pub(crate) fn load3<S: Simd>(v: &[Lanes; 3]) -> V3<S> {
    [S::load(&v[0]), S::load(&v[1]), S::load(&v[2])]
}
