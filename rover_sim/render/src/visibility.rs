//! Which triangle each of the sixteen samples of each pixel sees.

use crate::optics::{RUNS, SAMPLE_U, SAMPLE_V, TILE_HEIGHT, TILE_PIXELS, TileRays};
use crate::simd::{Lanes, Simd, dispatched};
use crate::view::Facet;

/// The identity of a sample that sees nothing.
pub(crate) const NOTHING: u32 = u32::MAX;

/// Samples of one tile: inverse depth and identity of what is seen, two groups of eight per pixel.
pub(crate) struct Samples {
    pub inverse_depth: Box<[[Lanes; 2]; TILE_PIXELS]>,
    pub seen: Box<[[[u32; 8]; 2]; TILE_PIXELS]>,
}

impl Samples {
    pub(crate) fn new() -> Self {
        Self {
            inverse_depth: Box::new([[[0.0; 8]; 2]; TILE_PIXELS]),
            seen: Box::new([[[NOTHING; 8]; 2]; TILE_PIXELS]),
        }
    }

    pub(crate) fn clear(&mut self) {
        self.inverse_depth.fill([[0.0; 8]; 2]);
        self.seen.fill([[NOTHING; 8]; 2]);
    }
}

dispatched! {
    /// Draws `facets[refs]` over what is there; facet `r` is recorded as `r | mark`.
    pub(crate) fn draw = draw_kernel(
        tile: &TileRays,
        facets: &[Facet],
        refs: &[u32],
        mark: u32,
        samples: &mut Samples,
    )
}

/// Edges overlap by this much, in pixels, against rounding where many edges meet.
const SLACK_PX: f32 = 1e-4;

#[inline(always)]
fn draw_kernel<S: Simd>(
    tile: &TileRays,
    facets: &[Facet],
    refs: &[u32],
    mark: u32,
    samples: &mut Samples,
) {
    for &r in refs {
        draw_facet::<S>(tile, &facets[r as usize], r | mark, samples);
    }
}

/// Bit `i` is set if `[low[i], high[i]]` meets `[range[0], range[1]]`.
#[inline(always)]
fn meets<S: Simd>(low: &Lanes, high: &Lanes, range: [f32; 2]) -> u32 {
    S::bits(S::and(
        S::ge(S::splat(range[1]), S::load(low)),
        S::ge(S::load(high), S::splat(range[0])),
    ))
}

#[inline(always)]
fn draw_facet<S: Simd>(tile: &TileRays, facet: &Facet, id: u32, samples: &mut Samples) {
    let y = facet.bounds.y;
    let mut rows = meets::<S>(&tile.row_low[0], &tile.row_high[0], y)
        | meets::<S>(&tile.row_low[1], &tile.row_high[1], y) << 8;
    let runs = meets::<S>(&tile.run_low, &tile.run_high, facet.bounds.x);
    if rows == 0 || runs == 0 {
        return;
    }
    let (u, v) = (
        [S::load(&SAMPLE_U[0]), S::load(&SAMPLE_U[1])],
        [S::load(&SAMPLE_V[0]), S::load(&SAMPLE_V[1])],
    );
    // change of each plane's value per column and per row
    let du = |n: &[f32; 3]| n[0] * tile.du[0] + n[1] * tile.du[1];
    let dv = |n: &[f32; 3]| n[0] * tile.dv[0] + n[1] * tile.dv[1];
    let mut offset = [[S::splat(0.0); 2]; 3];
    let mut reach = [0.0_f32; 3];
    for i in 0..3 {
        let (a, b) = (du(&facet.edge[i]), dv(&facet.edge[i]));
        let slack = S::splat(SLACK_PX * (a.abs() + b.abs()));
        let (a8, b8) = (S::splat(a), S::splat(b));
        offset[i] = [a8 * u[0] + b8 * v[0] + slack, a8 * u[1] + b8 * v[1] + slack];
        // a little more than the farthest sample (0.375)
        reach[i] = 0.376 * (a.abs() + b.abs());
    }
    let (a8, b8) = (
        S::splat(du(&facet.inverse_depth)),
        S::splat(dv(&facet.inverse_depth)),
    );
    let depth_offset = [a8 * u[0] + b8 * v[0], a8 * u[1] + b8 * v[1]];
    let id8 = S::splat_i(id);
    while rows != 0 {
        let row = rows.trailing_zeros() as usize;
        rows &= rows - 1;
        if row >= TILE_HEIGHT {
            break;
        }
        let mut left = runs;
        while left != 0 {
            let run = left.trailing_zeros() as usize;
            left &= left - 1;
            let at = row * RUNS + run;
            let (x, y) = (S::load(&tile.x[at]), S::load(&tile.y[at]));
            let mut centre = [[0.0_f32; 8]; 4];
            let mut touched = u32::MAX;
            let mut inside = u32::MAX;
            for i in 0..3 {
                let n = &facet.edge[i];
                let e = S::splat(n[0]) * x + S::splat(n[1]) * y + S::splat(n[2]);
                touched &= S::bits(S::ge(e, S::splat(-reach[i])));
                inside &= S::bits(S::ge(e, S::splat(reach[i])));
                S::store(e, &mut centre[i]);
            }
            touched &= 0xff;
            if touched == 0 {
                continue;
            }
            let n = &facet.inverse_depth;
            let w = S::splat(n[0]) * x + S::splat(n[1]) * y + S::splat(n[2]);
            S::store(w, &mut centre[3]);
            while touched != 0 {
                let lane = touched.trailing_zeros() as usize;
                touched &= touched - 1;
                let pixel = at * 8 + lane;
                let w8 = S::splat(centre[3][lane]);
                for half in 0..2 {
                    let depth = w8 + depth_offset[half];
                    let old = S::load(&samples.inverse_depth[pixel][half]);
                    let mut hit = S::gt(depth, old);
                    if inside >> lane & 1 == 0 {
                        for i in 0..3 {
                            let e = S::splat(centre[i][lane]) + offset[i][half];
                            hit = S::and(hit, S::ge(e, S::splat(0.0)));
                        }
                    }
                    let seen = S::load_i(&samples.seen[pixel][half]);
                    S::store(
                        S::select(hit, depth, old),
                        &mut samples.inverse_depth[pixel][half],
                    );
                    S::store_i(S::select_i(hit, id8, seen), &mut samples.seen[pixel][half]);
                }
            }
        }
    }
}
