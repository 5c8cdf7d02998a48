//! From samples to fragments: the samples of a pixel that see the same smooth piece of the same
//! body are shaded together, once.

use crate::optics::{SAMPLE_U, SAMPLE_V, TILE_PIXELS, TILE_WIDTH, TileRays};
use crate::simd::{Lanes, Level, Simd, dispatched};
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
/// The first of the four samples nearest to the pixel's centre.
const MIDDLE: usize = 5;

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

/// Which body a facet belongs to: `still[facet]`, or `moving[..]` counted from `statics` for a
/// facet with the bit `mark`.
#[derive(Clone, Copy)]
pub(crate) struct Bodies<'a> {
    pub still: &'a [u16],
    pub moving: &'a [u16],
    pub statics: u16,
    pub mark: u32,
}

impl Bodies<'_> {
    #[inline(always)]
    fn of(&self, facet: u32) -> u16 {
        if facet & self.mark == 0 {
            self.still[facet as usize]
        } else {
            self.moving[(facet & !self.mark) as usize] + self.statics
        }
    }
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
        level: Level,
        tile: &TileRays,
        samples: &Samples,
        bodies: Bodies<'_>,
    ) {
        self.found.clear();
        self.bodies.clear();
        find(level, self, tile, samples, &bodies);
        self.group();
    }

    #[inline(always)]
    fn add(&mut self, facet: u32, pixel: usize, mask: u16, body: u16) {
        self.found.push(Fragment {
            facet,
            pixel: pixel as u16,
            mask,
            body,
        });
        if let Some((last, count)) = self.bodies.last_mut()
            && *last == body
        {
            *count += 1;
            return;
        }
        self.count(body);
    }

    /// Counts a fragment of a body other than the last new one.
    #[cold]
    #[inline(never)]
    fn count(&mut self, body: u16) {
        match self.bodies.iter_mut().find(|(b, _)| *b == body) {
            Some((_, count)) => *count += 1,
            None => self.bodies.push((body, 1)),
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

dispatched! {
    fn find = find_kernel(
        fragments: &mut Fragments,
        tile: &TileRays,
        samples: &Samples,
        bodies: &Bodies<'_>,
    )
}

#[inline(always)]
fn find_kernel<S: Simd>(
    fragments: &mut Fragments,
    tile: &TileRays,
    samples: &Samples,
    bodies: &Bodies<'_>,
) {
    for pixel in 0..TILE_PIXELS {
        if pixel % TILE_WIDTH >= tile.columns || pixel / TILE_WIDTH >= tile.rows {
            continue;
        }
        let seen = &samples.seen[pixel];
        let first = seen[0][0];
        let same = equal::<S>(seen, first);
        if same == 0xffff {
            if first != NOTHING {
                fragments.add(first, pixel, u16::MAX, bodies.of(first));
            }
            continue;
        }
        split::<S>(
            fragments,
            seen,
            &samples.inverse_depth[pixel],
            pixel,
            bodies,
        );
    }
}

/// Which of sixteen identities are `id`.
#[inline(always)]
fn equal<S: Simd>(seen: &[[u32; 8]; 2], id: u32) -> u32 {
    let id = S::splat_i(id);
    S::bits(S::eq_i(S::load_i(&seen[0]), id)) | S::bits(S::eq_i(S::load_i(&seen[1]), id)) << 8
}

/// Which of sixteen depths are near `depth`.
#[inline(always)]
fn near<S: Simd>(depths: &[Lanes; 2], depth: f32) -> u32 {
    let low = S::splat(depth * (1.0 - SAME_DEPTH));
    let high = S::splat(depth * (1.0 + SAME_DEPTH));
    let (a, b) = (S::load(&depths[0]), S::load(&depths[1]));
    S::bits(S::and(S::ge(a, low), S::ge(high, a)))
        | S::bits(S::and(S::ge(b, low), S::ge(high, b))) << 8
}

/// The fragments of a pixel that sees several facets.
#[inline(always)]
fn split<S: Simd>(
    fragments: &mut Fragments,
    seen: &[[u32; 8]; 2],
    depths: &[Lanes; 2],
    pixel: usize,
    bodies: &Bodies<'_>,
) {
    let mut left = 0xffff & !equal::<S>(seen, NOTHING);
    while left != 0 {
        let s = left.trailing_zeros() as usize;
        let body = bodies.of(seen[s / 8][s % 8]);
        // samples near in depth, less those of facets of another body
        let mut mask = near::<S>(depths, depths[s / 8][s % 8]) & left;
        let mut unknown = mask;
        while unknown != 0 {
            let t = unknown.trailing_zeros() as usize;
            let facet = seen[t / 8][t % 8];
            let alike = equal::<S>(seen, facet);
            unknown &= !alike;
            if bodies.of(facet) != body {
                mask &= !alike;
            }
        }
        left &= !mask;
        let middle = if mask == 0xffff {
            MIDDLE
        } else {
            nearest_to_centroid(mask as u16)
        };
        fragments.add(seen[middle / 8][middle % 8], pixel, mask as u16, body);
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
