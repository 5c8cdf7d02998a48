//! The pattern of a plate as one pixel sees it: 8x8 samples through the exact plane.

use crate::optics::TileRays;
use crate::resolve::Fragment;
use crate::scene::Plate;
use crate::shading::{BodyFrame, Light, Point, REACH_PX};
use crate::simd::{Portable, Simd};
use nalgebra::{Isometry3, Vector3};

/// Cells of the table of even places, across and down.
const CELLS: usize = 128;
/// Samples per cell side by which a cell is judged.
const PROBES: usize = 6;
/// Samples per pixel side.
const SIDE: usize = 8;

/// A plate ready for drawing.
pub(crate) struct PlateFace {
    plate: Plate,
    /// Albedo where a cell is even, NaN where it must be sampled.
    even: Vec<f32>,
}

/// Where a plate is, as one camera sees it.
pub(crate) struct PlateFrame {
    /// Camera centre in the plate frame.
    origin: Vector3<f64>,
    plate_from_axis: Isometry3<f64>,
    pub pattern_visible: bool,
    pub frame: BodyFrame,
}

impl PlateFrame {
    pub(crate) fn new(
        plate_from_axis: Isometry3<f64>,
        frame: BodyFrame,
        pattern_visible: bool,
    ) -> Self {
        Self {
            origin: plate_from_axis.translation.vector,
            plate_from_axis,
            pattern_visible,
            frame,
        }
    }
}

impl PlateFace {
    pub(crate) fn new(plate: &Plate) -> Self {
        let cell = |index: usize| {
            let (i, j) = (index % CELLS, index / CELLS);
            let mut value = None;
            for p in 0..PROBES * PROBES {
                let place = |cell: usize, probe: usize, half: f64| {
                    let f = (cell as f64 + (probe as f64 + 0.5) / PROBES as f64) / CELLS as f64;
                    (2.0 * f - 1.0) * half
                };
                let x = place(i, p % PROBES, plate.half_width_m);
                let y = place(j, p / PROBES, plate.half_height_m);
                let a = (plate.albedo)(x, y).unwrap_or(plate.blank_albedo) as f32;
                if *value.get_or_insert(a) != a {
                    return f32::NAN;
                }
            }
            value.unwrap_or(f32::NAN)
        };
        Self {
            plate: plate.clone(),
            even: (0..CELLS * CELLS).map(cell).collect(),
        }
    }

    /// The cell of a place on the plate, `None` outside.
    fn cell(&self, x: f64, y: f64) -> Option<(usize, usize)> {
        let scale = |v: f64, half: f64| (v / half + 1.0) * 0.5 * CELLS as f64;
        let (u, v) = (
            scale(x, self.plate.half_width_m),
            scale(y, self.plate.half_height_m),
        );
        let within = |w: f64| w >= 0.0 && w <= CELLS as f64;
        (within(u) && within(v)).then(|| ((u as usize).min(CELLS - 1), (v as usize).min(CELLS - 1)))
    }

    /// The one albedo of a small rectangle, if it is even.
    fn even_over(&self, low: [f64; 2], high: [f64; 2]) -> Option<f32> {
        let (a, b) = (self.cell(low[0], low[1])?, self.cell(high[0], high[1])?);
        if (b.0 - a.0 + 1) * (b.1 - a.1 + 1) > SIDE * SIDE {
            return None;
        }
        let first = self.even[a.1 * CELLS + a.0];
        let same = (a.1..=b.1).all(|j| (a.0..=b.0).all(|i| self.even[j * CELLS + i] == first));
        same.then_some(first)
    }

    fn albedo(&self, x: f64, y: f64) -> Option<f32> {
        let (i, j) = self.cell(x, y)?;
        let even = self.even[j * CELLS + i];
        if even.is_nan() {
            return Some((self.plate.albedo)(x, y).unwrap_or(self.plate.blank_albedo) as f32);
        }
        Some(even)
    }

    /// Where the ray `(x, y, 1)` of the axis frame meets the plane: place and depth.
    fn meet(frame: &PlateFrame, x: f64, y: f64) -> ([f64; 2], f64) {
        let d = frame.plate_from_axis.rotation * Vector3::new(x, y, 1.0);
        let depth = -frame.origin.z / d.z;
        (
            [frame.origin.x + depth * d.x, frame.origin.y + depth * d.y],
            depth,
        )
    }

    /// Mean albedo of the plate within the pixel at `ray`.
    fn mean(&self, frame: &PlateFrame, tile: &TileRays, ray: [f32; 2]) -> f32 {
        let at = |u: f64, v: f64| {
            let ray = [0, 1]
                .map(|k| f64::from(ray[k]) + u * f64::from(tile.du[k]) + v * f64::from(tile.dv[k]));
            Self::meet(frame, ray[0], ray[1]).0
        };
        let corners = [at(-0.5, -0.5), at(0.5, -0.5), at(-0.5, 0.5), at(0.5, 0.5)];
        let low = [0, 1].map(|k| corners.iter().fold(f64::MAX, |m, c| m.min(c[k])));
        let high = [0, 1].map(|k| corners.iter().fold(f64::MIN, |m, c| m.max(c[k])));
        if let Some(albedo) = self.even_over(low, high) {
            return albedo;
        }
        let (mut sum, mut count) = (0.0, 0.0);
        for s in 0..SIDE * SIDE {
            let offset = |i: usize| (i as f64 + 0.5) / SIDE as f64 - 0.5;
            let [x, y] = at(offset(s % SIDE), offset(s / SIDE));
            if let Some(albedo) = self.albedo(x, y) {
                sum += albedo;
                count += 1.0;
            }
        }
        if count > 0.0 {
            sum / count
        } else {
            self.plate.blank_albedo as f32
        }
    }

    /// Shades the fragments of the plate.
    pub(crate) fn shade(
        &self,
        frame: &PlateFrame,
        light: &Light,
        tile: &TileRays,
        fragments: &[Fragment],
        out: &mut Vec<Point>,
    ) {
        // the side that the camera sees
        let side = if frame.origin.z > 0.0 { 1.0_f32 } else { -1.0 };
        let height = side * frame.frame.to_sun[2];
        let rise = side * frame.frame.up[2];
        let around = one_lane(light.around::<Portable>(Portable::splat(rise)));
        for fragment in fragments {
            let ray = tile.ray(usize::from(fragment.pixel));
            let albedo = if side < 0.0 {
                self.plate.back_albedo as f32
            } else if frame.pattern_visible {
                self.mean(frame, tile, ray)
            } else {
                self.plate.blank_albedo as f32
            };
            let [u, v] = crate::resolve::centroid(fragment.mask);
            let at = [0, 1].map(|k| ray[k] + u * tile.du[k] + v * tile.dv[k]);
            let ([x, y], depth) = Self::meet(frame, f64::from(at[0]), f64::from(at[1]));
            let place = [
                Portable::splat(x as f32),
                Portable::splat(y as f32),
                Portable::splat(0.0),
            ];
            let sun = frame
                .frame
                .sun_from_body
                .apply::<Portable>(place)
                .map(one_lane);
            out.push(Point {
                facet: fragment.facet,
                pixel: fragment.pixel,
                mask: fragment.mask,
                shade: albedo * around,
                sunlight: albedo * height.max(0.0) * light.sun,
                edges: height > 0.02,
                sun,
                reach: depth as f32 * tile.pixel * REACH_PX,
            });
        }
    }
}

fn one_lane(x: <Portable as Simd>::F) -> f32 {
    let mut lanes = [0.0; 8];
    Portable::store(x, &mut lanes);
    lanes[0]
}
