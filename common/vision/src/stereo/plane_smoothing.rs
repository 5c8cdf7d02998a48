//! A plane through the agreeing disparities around every pixel: the slanted support of the dense
//! matcher, in whole numbers.

use super::dense::{Disparity, NONE};

/// Replaces every disparity by the value that the least-squares plane through its window takes
/// there, if at least half of the window's pixels agree with it (differ by at most `agreement`
/// steps per window half). Windows are symmetric about their pixel, and a missing or disagreeing
/// pixel takes its mirror image out too, so the plane's value in the middle is the mean.
pub(super) fn smooth(disparity: &mut Disparity, half: usize, agreement: i32) {
    let (w, h) = (disparity.width_px as usize, disparity.height_px as usize);
    if w <= 2 * half || h <= 2 * half {
        return;
    }
    let source = disparity.held.clone();
    let need = ((2 * half + 1) * (2 * half + 1) / 4) as i32;
    let n = w - 2 * half;
    let (mut sums, mut counts) = (vec![0i32; n], vec![0i32; n]);
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
                accumulate(middle, a, b, agreement, &mut sums, &mut counts);
            }
        }
        let out = &mut disparity.held[v * w + half..v * w + half + n];
        for (((o, &m), &sum), &count) in out.iter_mut().zip(middle).zip(&sums).zip(&counts) {
            if m != NONE && 2 * count >= need {
                // each pair counts twice, the middle once
                let total = sum + i32::from(m);
                let number = 2 * count + 1;
                *o = (total + (number >> 1)).div_euclid(number) as i16;
            }
        }
    }
}

/// Adds the pairs of opposite pixels whose mean agrees with the middle.
fn accumulate(
    middle: &[i16],
    a: &[i16],
    b: &[i16],
    agreement: i32,
    sums: &mut [i32],
    counts: &mut [i32],
) {
    let pairs = middle.iter().zip(a).zip(b);
    for (((&m, &a), &b), (sum, count)) in pairs.zip(sums.iter_mut().zip(counts)) {
        let (m, pair) = (i32::from(m), i32::from(a) + i32::from(b));
        // a missing pixel is far below every disparity
        let agrees = (pair - 2 * m).abs() <= agreement
            && i32::from(a) > i32::from(NONE)
            && i32::from(b) > i32::from(NONE);
        *sum += if agrees { pair } else { 0 };
        *count += i32::from(agrees);
    }
}
