//! One image: tiles are visited (who is where, who stands in the sun), then finished (shadow edges
//! refined, fragments summed), then exposed.
//!
//! The cache is part of this: a tile that no moving facet touches keeps its shaded points, and a
//! tile that no moving body can shade, nor its neighbours, keeps its radiance as well. A tile's
//! result depends on nothing but the scene, the state and its neighbours' sunlight, so that it is
//! the same whether kept or computed again, and on any number of threads.

use crate::geometry::Geometry;
use crate::optics::{Optics, SAMPLE_U, SAMPLE_V, TILE_HEIGHT, TILE_PIXELS, TILE_WIDTH, TileRays};
use crate::plate::{PlateFace, PlateFrame};
use crate::resolve::{Bodies, Fragments, centroid};
use crate::scene::Sky;
use crate::shading::{BodyFrame, Group, Light, MOVING, Material, Motion, Point, shade};
use crate::shadow::{SunBox, SunTree};
use crate::simd::{Lanes, Level, Simd, dispatched, splat3, sub3};
use crate::view::{Facet, View};
use crate::visibility::{Samples, draw};
use rayon::prelude::*;

/// What a tile keeps from frame to frame.
#[derive(Default)]
pub(crate) struct Tile {
    /// Points of the static scene alone, whether the static scene lets the sun on them, and where
    /// they are; meaningful while `still_known`.
    still: Vec<Point>,
    still_lit: Vec<u8>,
    still_box: SunBox,
    still_known: bool,
    /// Points of this frame, if moving facets touch the tile.
    now: Vec<Point>,
    now_box: SunBox,
    now_holds: bool,
    /// Whether the sun reaches each point of this frame.
    lit: Vec<u8>,
    /// Whether anything that moves may change this tile in this frame.
    touched: bool,
    /// Sunlight of each pixel: bit 0 some point lit, bit 1 some point in shadow.
    sunlight: Vec<u8>,
    radiance: Vec<f32>,
    /// `radiance` is that of the static scene alone.
    radiance_still: bool,
}

impl Tile {
    /// Forgets what is known of the static scene; keeps the memory.
    pub(crate) fn forget(&mut self) {
        self.still_known = false;
        self.radiance_still = false;
    }

    fn sun_box(&self) -> &SunBox {
        if self.now_holds {
            &self.now_box
        } else {
            &self.still_box
        }
    }

    fn points(&self) -> &[Point] {
        if self.now_holds {
            &self.now
        } else {
            &self.still
        }
    }
}

/// Everything that one image needs.
pub(crate) struct Frame<'a> {
    pub level: Level,
    pub optics: &'a Optics,
    pub still: &'a View,
    pub moving: &'a View,
    pub still_geometry: &'a Geometry,
    pub moving_geometry: &'a Geometry,
    pub still_frame: BodyFrame,
    pub part_frames: Vec<BodyFrame>,
    pub plate_frames: Vec<PlateFrame>,
    /// Of static bodies, then of parts.
    pub materials: &'a [Material],
    pub plates: &'a [PlateFace],
    pub light: Light,
    pub sky: Sky,
    /// Up, axis frame.
    pub up: [f32; 3],
    pub still_tree: &'a SunTree,
    pub moving_tree: &'a SunTree,
    pub sun_from_axis: Motion,
}

/// What a thread needs for its tiles.
struct Scratch {
    samples: Samples,
    fragments: Fragments,
    entries: Vec<u32>,
}

impl Scratch {
    fn new() -> Self {
        Self {
            samples: Samples::new(),
            fragments: Fragments::default(),
            entries: Vec::new(),
        }
    }
}

impl Frame<'_> {
    /// The radiance of every pixel, row by row.
    pub(crate) fn radiance(&self, tiles: &mut Vec<Tile>) -> Vec<f32> {
        tiles.resize_with(self.optics.tiles.len(), Tile::default);
        tiles
            .par_iter_mut()
            .enumerate()
            .with_min_len(4)
            .for_each_init(Scratch::new, |scratch, (index, tile)| {
                self.visit(index, tile, scratch)
            });
        let sunlight = SunlightMap::new(self.optics, tiles);
        let touched: Vec<bool> = tiles.iter().map(|t| t.touched).collect();
        tiles
            .par_iter_mut()
            .enumerate()
            .with_min_len(4)
            .for_each(|(index, tile)| {
                let clean = self.neighbours(index).all(|n| !touched[n]);
                if !(clean && tile.radiance_still) {
                    finish(self.level, self, index, tile, &sunlight);
                    tile.radiance_still = clean;
                }
            });
        let (width, height) = (self.optics.width, self.optics.height);
        let mut out = vec![0.0; width * height];
        for (index, tile) in tiles.iter().enumerate() {
            let (u, v) = self.corner(index);
            for row in 0..self.optics.tiles[index].rows {
                let n = self.optics.tiles[index].columns;
                let at = (v + row) * width + u;
                out[at..at + n].copy_from_slice(&tile.radiance[row * TILE_WIDTH..][..n]);
            }
        }
        out
    }

    /// The first pixel of a tile.
    fn corner(&self, tile: usize) -> (usize, usize) {
        (
            tile % self.optics.across * TILE_WIDTH,
            tile / self.optics.across * TILE_HEIGHT,
        )
    }

    /// A tile and those around it.
    fn neighbours(&self, tile: usize) -> impl Iterator<Item = usize> {
        let (across, down) = (self.optics.across, self.optics.down);
        let (c, r) = (tile % across, tile / across);
        (r.saturating_sub(1)..(r + 2).min(down)).flat_map(move |r| {
            (c.saturating_sub(1)..(c + 2).min(across)).map(move |c| r * across + c)
        })
    }

    fn visit(&self, index: usize, tile: &mut Tile, scratch: &mut Scratch) {
        let moving = self.moving.touching(index);
        tile.now_holds = !moving.is_empty();
        if tile.now_holds {
            self.find_points(index, moving, scratch, &mut tile.now);
            tile.now_box = sunny_box(&tile.now);
            tile.lit.clear();
            tile.lit.resize(tile.now.len(), 1);
            self.darken(
                self.still_tree,
                &tile.now,
                &tile.now_box,
                scratch,
                &mut tile.lit,
            );
            self.darken(
                self.moving_tree,
                &tile.now,
                &tile.now_box,
                scratch,
                &mut tile.lit,
            );
            tile.touched = true;
        } else {
            if !tile.still_known {
                self.find_points(index, &[], scratch, &mut tile.still);
                tile.still_box = sunny_box(&tile.still);
                let lit = &mut tile.still_lit;
                lit.clear();
                lit.resize(tile.still.len(), 1);
                self.darken(self.still_tree, &tile.still, &tile.still_box, scratch, lit);
                tile.still_known = true;
            }
            tile.lit.clone_from(&tile.still_lit);
            tile.touched = self.moving_tree.may_shade(&tile.still_box);
            if tile.touched {
                let lit = &mut tile.lit;
                self.darken(self.moving_tree, &tile.still, &tile.still_box, scratch, lit);
            }
        }
        tile.sunlight.clear();
        tile.sunlight.resize(TILE_PIXELS, 0);
        let points = if tile.now_holds {
            &tile.now
        } else {
            &tile.still
        };
        for (point, &lit) in points.iter().zip(&tile.lit) {
            if point.edges {
                tile.sunlight[usize::from(point.pixel)] |= if lit == 1 { 1 } else { 2 };
            }
        }
    }

    /// Clears `lit` where a point of a surface turned to the sun is in the shadow of `tree`.
    fn darken(
        &self,
        tree: &SunTree,
        points: &[Point],
        points_box: &SunBox,
        scratch: &mut Scratch,
        lit: &mut [u8],
    ) {
        tree.entries(points_box, &mut scratch.entries);
        if !scratch.entries.is_empty() {
            darken(self.level, tree, &scratch.entries, points, lit);
        }
    }

    /// Draws a tile and shades what is seen.
    fn find_points(
        &self,
        index: usize,
        moving: &[u32],
        scratch: &mut Scratch,
        points: &mut Vec<Point>,
    ) {
        let rays = &self.optics.tiles[index];
        let Scratch {
            samples, fragments, ..
        } = scratch;
        samples.clear();
        draw(
            self.level,
            rays,
            &self.still.facets,
            self.still.touching(index),
            0,
            samples,
        );
        draw(
            self.level,
            rays,
            &self.moving.facets,
            moving,
            MOVING,
            samples,
        );
        let statics = self.still_geometry.bodies.len();
        let bodies = Bodies {
            still: &self.still.body,
            moving: &self.moving.body,
            statics: statics as u16,
            mark: MOVING,
        };
        fragments.find(self.level, rays, samples, bodies);
        points.clear();
        for group in fragments.list.chunk_by(|a, b| a.body == b.body) {
            let body = usize::from(group[0].body);
            let parts = self.part_frames.len();
            if body >= statics + parts {
                let plate = body - statics - parts;
                let frame = &self.plate_frames[plate];
                self.plates[plate].shade(frame, &self.light, rays, group, points);
                continue;
            }
            let (view, geometry, frame) = if body < statics {
                (self.still, self.still_geometry, &self.still_frame)
            } else {
                (
                    self.moving,
                    self.moving_geometry,
                    &self.part_frames[body - statics],
                )
            };
            let material = &self.materials[body];
            let light = &self.light;
            let group_of = Group {
                tile: rays,
                view,
                geometry,
                frame,
                material,
                light,
            };
            shade(self.level, &group_of, group, points);
        }
    }

    /// Radiance of the sky along a ray of the axis frame.
    fn sky(&self, ray: [f32; 2]) -> f32 {
        let length = (ray[0] * ray[0] + ray[1] * ray[1] + 1.0).sqrt();
        let rise = (self.up[0] * ray[0] + self.up[1] * ray[1] + self.up[2]) / length;
        let s = (rise * 1.6).clamp(0.0, 1.0);
        let (low, high) = (self.sky.horizon as f32, self.sky.zenith as f32);
        low + (high - low) * (s * (2.0 - s))
    }

    fn facet(&self, id: u32) -> &Facet {
        if id & MOVING == 0 {
            &self.still.facets[id as usize]
        } else {
            &self.moving.facets[(id & !MOVING) as usize]
        }
    }
}

/// Where the points of a tile that are turned to the sun are, their samples included.
fn sunny_box(points: &[Point]) -> SunBox {
    let mut whole = SunBox::EMPTY;
    for p in points.iter().filter(|p| p.sunlight > 0.0) {
        whole.add(p.sun, p.reach);
    }
    whole
}

dispatched! {
    /// See [`Frame::darken`].
    fn darken = darken_kernel(tree: &SunTree, entries: &[u32], points: &[Point], lit: &mut [u8])
}

#[inline(always)]
fn darken_kernel<S: Simd>(tree: &SunTree, entries: &[u32], points: &[Point], lit: &mut [u8]) {
    for (points, lit) in points.chunks(8).zip(lit.chunks_mut(8)) {
        let mut places = [[0.0_f32; 8]; 3];
        let mut active = 0;
        for (lane, point) in points.iter().enumerate() {
            for k in 0..3 {
                places[k][lane] = point.sun[k];
            }
            active |= u32::from(point.sunlight > 0.0 && lit[lane] == 1) << lane;
        }
        let shaded = tree.shaded::<S>(&places, active, entries);
        for (lane, l) in lit.iter_mut().enumerate() {
            if shaded >> lane & 1 == 1 {
                *l = 0;
            }
        }
    }
}

/// The sunlight of all pixels with a border of one, so that a pixel's neighbourhood is at hand.
struct SunlightMap {
    stride: usize,
    cells: Vec<u8>,
}

impl SunlightMap {
    fn new(optics: &Optics, tiles: &[Tile]) -> Self {
        let stride = optics.across * TILE_WIDTH + 2;
        let mut cells = vec![0; stride * (optics.down * TILE_HEIGHT + 2)];
        for (index, tile) in tiles.iter().enumerate() {
            let u = index % optics.across * TILE_WIDTH + 1;
            let v = index / optics.across * TILE_HEIGHT + 1;
            for (row, bits) in tile.sunlight.chunks_exact(TILE_WIDTH).enumerate() {
                cells[(v + row) * stride + u..][..TILE_WIDTH].copy_from_slice(bits);
            }
        }
        Self { stride, cells }
    }

    /// Whether there is both light and shadow in and around the tile that begins at `(u, v)`.
    fn any_mixed(&self, u: usize, v: usize) -> bool {
        let bits = (v..v + TILE_HEIGHT + 2).fold(0, |all, row| {
            let cells = &self.cells[row * self.stride + u..][..TILE_WIDTH + 2];
            all | cells.iter().fold(0, |b, c| b | c)
        });
        bits == 3
    }

    /// Whether there is both light and shadow in the 3x3 pixels around pixel `(u, v)`.
    #[inline]
    fn mixed(&self, u: usize, v: usize) -> bool {
        let row = |r: usize| {
            let c = &self.cells[(v + r) * self.stride + u..][..3];
            c[0] | c[1] | c[2]
        };
        row(0) | row(1) | row(2) == 3
    }
}

dispatched! {
    /// Refines shadow edges and sums the points of each pixel.
    fn finish = finish_kernel(
        frame: &Frame<'_>,
        index: usize,
        tile: &mut Tile,
        sunlight: &SunlightMap,
    )
}

#[inline(always)]
fn finish_kernel<S: Simd>(
    frame: &Frame<'_>,
    index: usize,
    tile: &mut Tile,
    sunlight: &SunlightMap,
) {
    let rays = &frame.optics.tiles[index];
    let (u, v) = frame.corner(index);
    let mut radiance = std::mem::take(&mut tile.radiance);
    radiance.clear();
    radiance.resize(TILE_PIXELS, 0.0);
    let mut covered = [0_u8; TILE_PIXELS];
    let any_edges = sunlight.any_mixed(u, v);
    let mut begin = [Vec::new(), Vec::new()];
    if any_edges {
        frame.still_tree.entries(tile.sun_box(), &mut begin[0]);
        frame.moving_tree.entries(tile.sun_box(), &mut begin[1]);
    }
    for (point, &lit) in tile.points().iter().zip(&tile.lit) {
        let pixel = usize::from(point.pixel);
        let count = point.mask.count_ones();
        let mut visible = f32::from(lit);
        if any_edges
            && point.edges
            && sunlight.mixed(u + pixel % TILE_WIDTH, v + pixel / TILE_WIDTH)
        {
            let dark = shaded_samples::<S>(frame, rays, point, &begin);
            visible = (count - dark.count_ones()) as f32 / count as f32;
        }
        let weight = count as f32 * (1.0 / 16.0);
        radiance[pixel] += weight * (point.shade + point.sunlight * visible);
        covered[pixel] += count as u8;
    }
    for pixel in 0..TILE_PIXELS {
        if covered[pixel] < 16 {
            let open = f32::from(16 - covered[pixel]) * (1.0 / 16.0);
            radiance[pixel] += open * frame.sky(rays.ray(pixel));
        }
    }
    tile.radiance = radiance;
}

/// Which of a point's samples are in shadow. The samples lie on the plane of the point's facet,
/// shifted as the point itself was. `begin`: where to search in the trees.
#[inline(always)]
fn shaded_samples<S: Simd>(
    frame: &Frame<'_>,
    rays: &TileRays,
    point: &Point,
    begin: &[Vec<u32>; 2],
) -> u16 {
    let facet = frame.facet(point.facet);
    let plane = &facet.inverse_depth;
    let [x, y] = rays.ray(usize::from(point.pixel));
    let [cu, cv] = centroid(point.mask);
    let middle = [
        x + cu * rays.du[0] + cv * rays.dv[0],
        y + cu * rays.du[1] + cv * rays.dv[1],
    ];
    let inverse = plane[0] * middle[0] + plane[1] * middle[1] + plane[2];
    // samples stay within four pixel sizes of the point's own depth, see `Point::reach`
    let length = (middle[0] * middle[0] + middle[1] * middle[1] + 1.0).sqrt();
    let band = 4.0 * rays.pixel / length;
    let limits = (
        S::splat(inverse * (1.0 - band)),
        S::splat(inverse * (1.0 + band)),
    );
    let own = place::<S>(
        frame,
        [S::splat(middle[0]), S::splat(middle[1])],
        S::splat(inverse),
    );
    let shift = sub3::<S>(splat3::<S>(point.sun), own);
    let mut dark = 0;
    for half in 0..2 {
        let active = u32::from(point.mask >> (8 * half)) & 0xff;
        if active == 0 {
            continue;
        }
        let (ou, ov) = (S::load(&SAMPLE_U[half]), S::load(&SAMPLE_V[half]));
        let ray = [
            S::splat(x) + ou * S::splat(rays.du[0]) + ov * S::splat(rays.dv[0]),
            S::splat(y) + ou * S::splat(rays.du[1]) + ov * S::splat(rays.dv[1]),
        ];
        let w = S::splat(plane[0]) * ray[0] + S::splat(plane[1]) * ray[1] + S::splat(plane[2]);
        let near = S::and(S::ge(w, limits.0), S::ge(limits.1, w));
        let w = S::select(near, w, S::splat(inverse));
        let at = place::<S>(frame, ray, w);
        let mut places: [Lanes; 3] = [[0.0; 8]; 3];
        for k in 0..3 {
            S::store(at[k] + shift[k], &mut places[k]);
        }
        let mut shaded = frame.still_tree.shaded::<S>(&places, active, &begin[0]);
        shaded |= frame
            .moving_tree
            .shaded::<S>(&places, active & !shaded, &begin[1]);
        dark |= (shaded as u16) << (8 * half);
    }
    dark
}

/// The sun-frame position on a ray at an inverse depth.
#[inline(always)]
fn place<S: Simd>(frame: &Frame<'_>, ray: [S::F; 2], inverse_depth: S::F) -> [S::F; 3] {
    let depth = S::splat(1.0) / inverse_depth;
    frame
        .sun_from_axis
        .apply::<S>([ray[0] * depth, ray[1] * depth, depth])
}
