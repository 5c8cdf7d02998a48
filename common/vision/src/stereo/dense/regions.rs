//! Small connected regions of a disparity image, which are mismatches more often than things.

use super::{Disparity, NONE, STEPS};

/// Neighbours whose disparities differ by at most this belong to one region, steps.
const REGION_STEP: i32 = STEPS;

/// Connected pixels of one row, from `start` to `end`, exclusive.
#[derive(Clone, Copy)]
struct Run {
    start: usize,
    end: usize,
}

fn joined(a: i16, b: i16) -> bool {
    a != NONE && b != NONE && (i32::from(a) - i32::from(b)).abs() <= REGION_STEP
}

fn root(parent: &mut [u32], mut i: u32) -> u32 {
    while parent[i as usize] != i {
        let up = parent[parent[i as usize] as usize];
        parent[i as usize] = up;
        i = up;
    }
    i
}

/// Drops connected regions of fewer than `least` pixels. Regions are put together from runs.
pub(super) fn drop_small(disparity: &mut Disparity, least: usize) {
    if least < 2 {
        return;
    }
    let w = disparity.width_px as usize;
    let held = &mut disparity.held;
    let mut runs: Vec<Run> = Vec::new();
    let mut parent: Vec<u32> = Vec::new();
    let mut above = 0..0;
    for row in (0..held.len()).step_by(w) {
        let first = runs.len();
        let end = row + w;
        let mut at = row;
        while at < end {
            if held[at] == NONE {
                at += 1;
                continue;
            }
            let start = at;
            at += 1;
            while at < end && joined(held[at - 1], held[at]) {
                at += 1;
            }
            parent.push(runs.len() as u32);
            runs.push(Run { start, end: at });
        }
        let (mut upper, mut lower) = (above.start, first);
        while upper < above.end && lower < runs.len() {
            let (a, b) = (runs[upper], runs[lower]);
            let from = (a.start + w).max(b.start);
            let to = (a.end + w).min(b.end);
            if (from..to).any(|i| joined(held[i - w], held[i])) {
                let (a, b) = (
                    root(&mut parent, upper as u32),
                    root(&mut parent, lower as u32),
                );
                parent[a.max(b) as usize] = a.min(b);
            }
            if a.end + w <= b.end {
                upper += 1;
            } else {
                lower += 1;
            }
        }
        above = first..runs.len();
    }
    let mut sizes = vec![0; runs.len()];
    for (i, run) in runs.iter().enumerate() {
        sizes[root(&mut parent, i as u32) as usize] += run.end - run.start;
    }
    for (i, run) in runs.iter().enumerate() {
        if sizes[root(&mut parent, i as u32) as usize] < least {
            held[run.start..run.end].fill(NONE);
        }
    }
}
