//! From samples to fragments: the samples of a pixel that see the same smooth piece of the same
//! body are shaded together, once.

use crate::optics::{SAMPLE_U, SAMPLE_V, TILE_PIXELS, TILE_WIDTH, TileRays};
use crate::visibility::{NOTHING, Samples};

/// A piece of surface within one pixel.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Fragment {
    /// The facet that stands for it.
    pub facet: u32,
    /// Pixel of the tile, row by row.
    pub pixel: u16,
    /// Which of the sixteen samples see it.
    pub mask: u16,
    /// The body it belongs to.
    pub body: u16,
}

/// Samples of one body are one piece if their depths agree this well.
const SAME_DEPTH: f32 = 0.03;

/// Mean offset of the samples in `mask` from the pixel's centre, pixels.
#[inline]
pub(crate) fn centroid(mask: u16) -> [f32; 2] {
    if mask == u16::MAX {
        return [0.0; 2];
    }
    let (u, v) = (SAMPLE_U.as_flattened(), SAMPLE_V.as_flattened());
    let mut sum = [0.0_f32; 2];
    let mut left = mask;
    while left != 0 {
        let s = left.trailing_zeros() as usize;
        left &= left - 1;
        sum[0] += u[s];
        sum[1] += v[s];
    }
    let count = mask.count_ones().max(1) as f32;
    [sum[0] / count, sum[1] / count]
}

/// The fragments of a tile, grouped by body; the groups in order of first appearance.
#[derive(Default)]
pub(crate) struct Fragments {
    pub list: Vec<Fragment>,
    found: Vec<Fragment>,
    bodies: Vec<(u16, u32)>,
}

impl Fragments {
    pub(crate) fn find(
        &mut self,
        tile: &TileRays,
        samples: &Samples,
        body_of: impl Fn(u32) -> u16,
    ) {
        self.found.clear();
        self.bodies.clear();
        for pixel in 0..TILE_PIXELS {
            if pixel % TILE_WIDTH >= tile.columns || pixel / TILE_WIDTH >= tile.rows {
                continue;
            }
            let seen: &[u32] = samples.seen[pixel].as_flattened();
            let first = seen[0];
            if seen.iter().fold(0, |d, &s| d | (s ^ first)) == 0 {
                if first != NOTHING {
                    self.add(first, pixel, u16::MAX, body_of(first));
                }
                continue;
            }
            self.split(
                seen,
                samples.inverse_depth[pixel].as_flattened(),
                pixel,
                &body_of,
            );
        }
        self.group();
    }

    fn add(&mut self, facet: u32, pixel: usize, mask: u16, body: u16) {
        self.found.push(Fragment {
            facet,
            pixel: pixel as u16,
            mask,
            body,
        });
        match self.bodies.iter_mut().find(|(b, _)| *b == body) {
            Some((_, count)) => *count += 1,
            None => self.bodies.push((body, 1)),
        }
    }

    fn split(&mut self, seen: &[u32], depth: &[f32], pixel: usize, body_of: &impl Fn(u32) -> u16) {
        let mut left = 0_u16;
        let mut bodies = [0_u16; 16];
        let mut known = (NOTHING, 0);
        for s in 0..16 {
            if seen[s] != NOTHING {
                left |= 1 << s;
                if seen[s] != known.0 {
                    known = (seen[s], body_of(seen[s]));
                }
                bodies[s] = known.1;
            }
        }
        while left != 0 {
            let s = left.trailing_zeros() as usize;
            let (low, high) = (depth[s] * (1.0 - SAME_DEPTH), depth[s] * (1.0 + SAME_DEPTH));
            let mut mask = 0_u16;
            for t in s..16 {
                let same = bodies[t] == bodies[s] && depth[t] >= low && depth[t] <= high;
                mask |= u16::from(same) << t;
            }
            mask &= left;
            left &= !mask;
            self.add(seen[nearest_to_centroid(mask)], pixel, mask, bodies[s]);
        }
    }

    /// Sorts by body, keeping the order within each.
    fn group(&mut self) {
        self.list.clear();
        if self.bodies.len() <= 1 {
            std::mem::swap(&mut self.list, &mut self.found);
            return;
        }
        let blank = Fragment {
            facet: NOTHING,
            pixel: 0,
            mask: 0,
            body: 0,
        };
        self.list.resize(self.found.len(), blank);
        let mut start = 0;
        for (_, count) in &mut self.bodies {
            let n = *count;
            *count = start;
            start += n;
        }
        for f in &self.found {
            if let Some((_, next)) = self.bodies.iter_mut().find(|(b, _)| *b == f.body) {
                self.list[*next as usize] = *f;
                *next += 1;
            }
        }
    }
}

fn nearest_to_centroid(mask: u16) -> usize {
    let (u, v) = (SAMPLE_U.as_flattened(), SAMPLE_V.as_flattened());
    let c = centroid(mask);
    let mut best = (f32::MAX, 0);
    let mut left = mask;
    while left != 0 {
        let s = left.trailing_zeros() as usize;
        left &= left - 1;
        let d = (u[s] - c[0]) * (u[s] - c[0]) + (v[s] - c[1]) * (v[s] - c[1]);
        if d < best.0 {
            best = (d, s);
        }
    }
    best.1
}
