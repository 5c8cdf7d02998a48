//! Sine and cosine of several angles at once, the same on every machine.
//!
//! The arm needs one sine and one cosine per joint and nothing else that is transcendental. The
//! platform's `sin` costs more than the rest of forward kinematics and differs in the last bit
//! from one C library to the next; this one uses only IEEE additions and multiplications, has no
//! branch per angle, and so is both vectorised by the compiler and bit-for-bit reproducible.
//!
//! Method: Cody-Waite reduction by multiples of pi/2 in three parts, then the Taylor series of
//! sine (to x^17) and cosine (to x^16) on [-pi/4, pi/4], whose remainders are below 1e-19 and
//! 3e-18. Error against the exact value: below 1 ulp of 1 (2.3e-16) for |x| <= [`DOMAIN_RAD`].

/// Largest magnitude for which the reduction keeps full accuracy, radians. Beyond it the
/// standard library answers.
pub(crate) const DOMAIN_RAD: f64 = 1.0e5;

/// Lanes that the compiler may treat together.
pub(crate) const LANES: usize = 2;

// pi/2 in three parts; the first two have 33 significant bits, so that their product with an
// integer below 2^20 is exact.
const HALF_PI_HIGH: f64 = f64::from_bits(0x3FF9_21FB_5440_0000);
const HALF_PI_MIDDLE: f64 = f64::from_bits(0x3DD0_B461_1A60_0000);
const HALF_PI_LOW: f64 = f64::from_bits(0x3BA3_198A_2E03_7073);
// 1.5 * 2^52: adding it rounds a small number to an integer and leaves it in the low bits.
const ROUNDER: f64 = 6_755_399_441_055_744.0;

const SINE: [f64; 8] = [
    -1.0 / 6.0,
    1.0 / 120.0,
    -1.0 / 5_040.0,
    1.0 / 362_880.0,
    -1.0 / 39_916_800.0,
    1.0 / 6_227_020_800.0,
    -1.0 / 1_307_674_368_000.0,
    1.0 / 355_687_428_096_000.0,
];
const COSINE: [f64; 7] = [
    1.0 / 24.0,
    -1.0 / 720.0,
    1.0 / 40_320.0,
    -1.0 / 3_628_800.0,
    1.0 / 479_001_600.0,
    -1.0 / 87_178_291_200.0,
    1.0 / 20_922_789_888_000.0,
];

/// Sine and cosine of `angles`, each within [`DOMAIN_RAD`].
#[inline(always)]
fn reduced<const N: usize>(angles: &[f64; N]) -> ([f64; N], [f64; N]) {
    let mut sines = [0.0; N];
    let mut cosines = [0.0; N];
    for i in 0..N {
        let x = angles[i];
        let shifted = x * std::f64::consts::FRAC_2_PI + ROUNDER;
        let quadrant = shifted.to_bits();
        let turns = shifted - ROUNDER;
        let r = ((x - turns * HALF_PI_HIGH) - turns * HALF_PI_MIDDLE) - turns * HALF_PI_LOW;
        let z = r * r;
        let mut odd = SINE[7];
        odd = odd * z + SINE[6];
        odd = odd * z + SINE[5];
        odd = odd * z + SINE[4];
        odd = odd * z + SINE[3];
        odd = odd * z + SINE[2];
        odd = odd * z + SINE[1];
        odd = odd * z + SINE[0];
        let sine = r + r * (z * odd);
        let mut even = COSINE[6];
        even = even * z + COSINE[5];
        even = even * z + COSINE[4];
        even = even * z + COSINE[3];
        even = even * z + COSINE[2];
        even = even * z + COSINE[1];
        even = even * z + COSINE[0];
        let cosine = (1.0 - 0.5 * z) + z * (z * even);
        // Quadrants 1 and 3 exchange the two; 2 and 3 negate the sine, 1 and 2 the cosine.
        let exchange = 0_u64.wrapping_sub(quadrant & 1);
        let (s, c) = (sine.to_bits(), cosine.to_bits());
        let mixed = (s ^ c) & exchange;
        let sine_sign = (quadrant & 2) << 62;
        let cosine_sign = (quadrant.wrapping_add(1) & 2) << 62;
        sines[i] = f64::from_bits((s ^ mixed) ^ sine_sign);
        cosines[i] = f64::from_bits((c ^ mixed) ^ cosine_sign);
    }
    (sines, cosines)
}

/// Sine and cosine of the first `count` of `angles`; the rest of the answer is unspecified.
/// Non-finite angles give NaN.
#[inline]
pub(crate) fn sin_cos<const N: usize>(angles: &[f64; N], count: usize) -> ([f64; N], [f64; N]) {
    let mut sines = [0.0; N];
    let mut cosines = [0.0; N];
    let mut within = true;
    for x in &angles[..count] {
        within &= x.abs() <= DOMAIN_RAD;
    }
    if !within {
        for i in 0..count {
            (sines[i], cosines[i]) = angles[i].sin_cos();
        }
        return (sines, cosines);
    }
    let mut start = 0;
    while start < count {
        let mut lane = [0.0; LANES];
        lane.copy_from_slice(&angles[start..start + LANES]);
        let (s, c) = reduced(&lane);
        sines[start..start + LANES].copy_from_slice(&s);
        cosines[start..start + LANES].copy_from_slice(&c);
        start += LANES;
    }
    (sines, cosines)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn agrees_with_the_standard_library_to_the_last_bit_or_two() {
        let mut worst: f64 = 0.0;
        let mut check = |x: f64| {
            let (s, c) = sin_cos(&[x, -x, 0.5 * x, x + 1.0], 4);
            for (i, y) in [x, -x, 0.5 * x, x + 1.0].into_iter().enumerate() {
                worst = worst
                    .max((s[i] - y.sin()).abs())
                    .max((c[i] - y.cos()).abs());
            }
        };
        for i in -400_000_i32..=400_000 {
            check(f64::from(i) * 2.5e-5);
        }
        for i in 0_i32..100_000 {
            check(f64::from(i) * 0.987_654_321);
            check(f64::from(i) * std::f64::consts::FRAC_PI_4);
        }
        assert!(worst < 3.4e-16, "worst {worst:e}");
    }

    #[test]
    fn large_and_non_finite_angles_are_not_answered_wrongly() {
        let (s, c) = sin_cos(&[1e9, 2e9, f64::NAN, f64::INFINITY], 4);
        assert_eq!((s[0], c[1]), (1e9_f64.sin(), 2e9_f64.cos()));
        assert!(s[2].is_nan() && c[3].is_nan());
    }
}
