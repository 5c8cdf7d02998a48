//! A plane through the agreeing disparities around every pixel: the slanted support of the dense
//! matcher, in whole numbers.

use super::{Disparity, NONE};

/// Replaces every disparity by the value that the least-squares plane through its window takes
/// there, if at least a quarter of the window's pixels agree. Windows are symmetric about their
/// pixel, and pixels agree in pairs of opposite ones, whose differences from the middle are
/// `agreement` steps at most in sum (those of a slope cancel): so the plane's value in the middle is
/// the mean.
///
/// `agreement` times the pairs of a window must not exceed 16 bits; disparities are not negative.
pub(super) fn smooth(disparity: &mut Disparity, half: usize, agreement: i16) {
    let (w, h) = (disparity.width_px as usize, disparity.height_px as usize);
    if w <= 2 * half || h <= 2 * half {
        return;
    }
    let source = disparity.held.clone();
    let need = ((2 * half + 1) * (2 * half + 1) / 4) as i16;
    let n = w - 2 * half;
    let inverses = inverses(2 * half * (half + 1));
    let (mut sums, mut counts) = (vec![0; n], vec![0; n]);
    for v in half..h - half {
        sums.fill(0);
        counts.fill(0);
        let middle = &source[v * w + half..v * w + half + n];
        // every pair of opposite pixels once
        for dv in 0..=half {
            for du in 0..=2 * half {
                if dv == 0 && du <= half {
                    continue;
                }
                let below = (v + dv) * w + du;
                let above = (v - dv) * w + 2 * half - du;
                let (a, b) = (&source[below..below + n], &source[above..above + n]);
                accumulate(middle, [a, b], agreement, &mut sums, &mut counts);
            }
        }
        let out = &mut disparity.held[v * w + half..v * w + half + n];
        for (((o, &m), &sum), &count) in out.iter_mut().zip(middle).zip(&sums).zip(&counts) {
            if m != NONE && 2 * count >= need {
                *o = m + rounded_mean(sum, count, &inverses);
            }
        }
    }
}

/// `2^32 / (2 count + 1)`, rounded up, for every count of pairs.
fn inverses(most: usize) -> Vec<u64> {
    let odd = (0..=most as u64).map(|count| 2 * count + 1);
    odd.map(|number| (1_u64 << 32).div_ceil(number)).collect()
}

/// The mean of the middle, 0, and of what its pairs differ by, rounded: each pair counts twice, the
/// middle once. Exact, since `number` is below 2^8 and what is divided below 2^24.
fn rounded_mean(sum: i16, count: i16, inverses: &[u64]) -> i16 {
    const LIFT: i32 = 1 << 15;
    let number = 2 * i32::from(count) + 1;
    let lifted = i32::from(sum) + (number >> 1) + LIFT * number;
    let quotient = (lifted as u64 * inverses[count as usize]) >> 32;
    (quotient as i32 - LIFT) as i16
}

/// Adds the pairs of opposite pixels whose mean agrees with the middle, by what they differ from it.
#[inline(always)]
fn accumulate_plain(
    middle: &[i16],
    [a, b]: [&[i16]; 2],
    agreement: i16,
    sums: &mut [i16],
    counts: &mut [i16],
) {
    let pairs = middle.iter().zip(a).zip(b);
    for (((&m, &a), &b), (sum, count)) in pairs.zip(sums.iter_mut().zip(counts)) {
        // a missing pixel is so far below every disparity that its mirror image cannot make up for it
        let pair = a.saturating_sub(m).saturating_add(b.saturating_sub(m));
        let agrees = pair <= agreement && pair >= -agreement;
        *sum += if agrees { pair } else { 0 };
        *count += i16::from(agrees);
    }
}

/// The same with wider vectors.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn accumulate_avx2(
    middle: &[i16],
    pair: [&[i16]; 2],
    agreement: i16,
    sums: &mut [i16],
    counts: &mut [i16],
) {
    accumulate_plain(middle, pair, agreement, sums, counts);
}

fn accumulate(
    middle: &[i16],
    pair: [&[i16]; 2],
    agreement: i16,
    sums: &mut [i16],
    counts: &mut [i16],
) {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { accumulate_avx2(middle, pair, agreement, sums, counts) };
    }
    accumulate_plain(middle, pair, agreement, sums, counts);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mean_is_that_of_a_division() {
        let inverses = inverses(112);
        for count in 0..=112_i16 {
            for sum in (-28672..=28672_i16).step_by(if count % 7 == 0 { 1 } else { 97 }) {
                let number = 2.0 * f64::from(count) + 1.0;
                let mean = (f64::from(sum) / number + 0.5).floor();
                // halves cannot occur: the number is odd
                assert_eq!(
                    f64::from(rounded_mean(sum, count, &inverses)),
                    mean,
                    "{sum} {count}"
                );
            }
        }
    }
}
