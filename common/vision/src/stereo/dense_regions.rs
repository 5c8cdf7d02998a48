//! Small connected regions of a disparity image, which are mismatches more often than things.

use super::dense::{Disparity, NONE, STEPS};

/// Neighbours whose disparities differ by at most this belong to one region, steps.
const REGION_STEP: i32 = STEPS;

/// Drops connected regions of fewer than `least` pixels.
pub(super) fn drop_small(disparity: &mut Disparity, least: usize) {
    if least < 2 {
        return;
    }
    let (w, h) = (disparity.width_px as usize, disparity.height_px as usize);
    let held = &mut disparity.held;
    let mut parent: Vec<u32> = (0..held.len() as u32).collect();
    fn root(parent: &mut [u32], mut i: u32) -> u32 {
        while parent[i as usize] != i {
            let up = parent[parent[i as usize] as usize];
            parent[i as usize] = up;
            i = up;
        }
        i
    }
    for v in 0..h {
        for u in 0..w {
            let i = v * w + u;
            if held[i] == NONE {
                continue;
            }
            let joined = |j: usize| {
                held[j] != NONE && (i32::from(held[j]) - i32::from(held[i])).abs() <= REGION_STEP
            };
            let left = u > 0 && joined(i - 1);
            if left {
                parent[i] = parent[i - 1];
            }
            if v > 0 && joined(i - w) {
                let (a, b) = (
                    root(&mut parent, i as u32),
                    root(&mut parent, (i - w) as u32),
                );
                if a != b {
                    parent[a.max(b) as usize] = a.min(b);
                }
            }
        }
    }
    let mut sizes = vec![0u32; held.len()];
    for i in 0..held.len() {
        if held[i] != NONE {
            let r = root(&mut parent, i as u32);
            parent[i] = r;
            sizes[r as usize] += 1;
        }
    }
    for (i, d) in held.iter_mut().enumerate() {
        if *d != NONE && (sizes[parent[i] as usize] as usize) < least {
            *d = NONE;
        }
    }
}
