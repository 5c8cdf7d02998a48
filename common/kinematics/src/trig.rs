//! Sine and cosine of several angles at once, the same on every machine.
//!
//! The arm needs one sine and one cosine per joint and nothing else that is transcendental. The
//! platform's `sin` costs more than the rest of forward kinematics and differs in the last bit
//! from one C library to the next; this one uses only IEEE additions and multiplications, has no
//! branch per angle, and so is both vectorised by the compiler and bit-for-bit reproducible.
//!
//! Method: Cody-Waite reduction by multiples of pi/2 in two parts, then the Taylor series of
//! sine (to x^17) and cosine (to x^16) on [-pi/4, pi/4], whose remainders are below 1e-19 and
//! 3e-18, summed in pairs of pairs (Estrin) for short chains. The arc tangent reduces by a table
//! of 17 angles to arguments below 1/32 and sums five terms. Error against the exact value: about
//! 1 ulp of 1 (2.2e-16) for angles up to [`DOMAIN_RAD`], and 2 ulp of the arc tangent.

/// Largest magnitude for which the reduction keeps full accuracy, radians. Beyond it the
/// standard library answers.
pub(crate) const DOMAIN_RAD: f64 = 1.0e3;

/// Lanes that the compiler may treat together.
const LANES: usize = 2;

// pi/2 in two parts of 33 significant bits each, so that their products with an integer below
// 2^20 are exact; what is missing is below 1e-20 per quarter turn.
const HALF_PI_HIGH: f64 = f64::from_bits(0x3FF9_21FB_5440_0000);
const HALF_PI_LOW: f64 = f64::from_bits(0x3DD0_B461_1A60_0000);
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
        let r = (x - turns * HALF_PI_HIGH) - turns * HALF_PI_LOW;
        let z = r * r;
        let z2 = z * z;
        let z4 = z2 * z2;
        let odd = ((SINE[0] + SINE[1] * z) + (SINE[2] + SINE[3] * z) * z2)
            + ((SINE[4] + SINE[5] * z) + (SINE[6] + SINE[7] * z) * z2) * z4;
        let even = ((COSINE[0] + COSINE[1] * z) + (COSINE[2] + COSINE[3] * z) * z2)
            + ((COSINE[4] + COSINE[5] * z) + COSINE[6] * z2) * z4;
        let sine = r + (r * z) * odd;
        let cosine = (1.0 - 0.5 * z) + z2 * even;
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

/// Sine and cosine of the first `count` (at most `N`, which is even) of `angles`; the rest of the
/// answer is unspecified. Non-finite angles give NaN.
#[inline(always)]
pub(crate) fn sin_cos<const N: usize>(angles: &[f64; N], count: usize) -> ([f64; N], [f64; N]) {
    let mut sines = [0.0; N];
    let mut cosines = [0.0; N];
    let mut within = true;
    for x in &angles[..count] {
        within &= x.abs() <= DOMAIN_RAD;
    }
    if !within {
        return beyond_domain(angles, count);
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

#[cold]
fn beyond_domain<const N: usize>(angles: &[f64; N], count: usize) -> ([f64; N], [f64; N]) {
    let mut sines = [0.0; N];
    let mut cosines = [0.0; N];
    for i in 0..count {
        (sines[i], cosines[i]) = angles[i].sin_cos();
    }
    (sines, cosines)
}

/// `atan(k / 16)`.
const ARC: [f64; 17] = [
    0.0,
    0.06241880999595735,
    0.12435499454676144,
    0.18534794999569476,
    0.24497866312686414,
    0.3028848683749714,
    0.35877067027057225,
    0.4124104415973873,
    0.4636476090008061,
    0.5123894603107377,
    0.5585993153435624,
    0.6022873461349642,
    0.6435011087932844,
    0.6823165548747481,
    0.7188299996216245,
    0.7531512809621944,
    std::f64::consts::FRAC_PI_4,
];

/// The angle of the vector `(x, y)`, radians in `-pi..=pi`; zero for the zero vector, NaN where a
/// component is NaN. The signs of zeros are not told apart.
#[inline]
pub(crate) fn atan2(y: f64, x: f64) -> f64 {
    use std::f64::consts::{FRAC_PI_2, PI};
    let (ax, ay) = (x.abs(), y.abs());
    let (low, high) = if ay > ax { (ax, ay) } else { (ay, ax) };
    if high == 0.0 {
        return 0.0;
    }
    // The nearest sixteenth of the slope, and the tangent of what is left.
    let slope = (16.0 * (low / high) + ROUNDER) - ROUNDER;
    let step = slope * 0.0625;
    let t = (low - step * high) / (high + step * low);
    let z = t * t;
    let tail = (-1.0 / 3.0 + z * (1.0 / 5.0)) + (-1.0 / 7.0 + z * (1.0 / 9.0)) * (z * z);
    // A slope that is NaN casts to zero and leaves `t` NaN.
    let octant = ARC[(slope as usize).min(16)] + (t + (t * z) * tail);
    let quadrant = if ay > ax { FRAC_PI_2 - octant } else { octant };
    let half = if x < 0.0 { PI - quadrant } else { quadrant };
    if y < 0.0 { -half } else { half }
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
        for i in 0_i32..1_000 {
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

    #[test]
    fn the_arc_tangent_agrees_with_the_standard_library() {
        let mut worst: f64 = 0.0;
        for i in 0..200_000_i32 {
            let angle = f64::from(i) * 3.2e-5 - 3.1;
            for scale in [1e-12, 0.7, 3e5] {
                let (y, x) = (angle.sin() * scale, angle.cos() * scale);
                worst = worst.max((atan2(y, x) - y.atan2(x)).abs());
            }
        }
        for small in [1e-300, 1e-20, 1e-9, 1e-3] {
            worst = worst.max((atan2(small, 1.0) / small.atan2(1.0) - 1.0).abs());
            worst = worst.max((atan2(1.0, small) - 1.0_f64.atan2(small)).abs());
            worst = worst.max((atan2(-small, -1.0) - (-small).atan2(-1.0)).abs());
        }
        assert!(worst < 9e-16, "worst {worst:e}");
        assert_eq!(
            (atan2(0.0, 0.0), atan2(0.0, -1.0)),
            (0.0, std::f64::consts::PI)
        );
        assert!(atan2(f64::NAN, 1.0).is_nan() && atan2(1.0, f64::NAN).is_nan());
    }
}
