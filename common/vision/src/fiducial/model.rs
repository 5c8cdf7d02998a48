//! What the plate looks like around a point: the blurred image of discs and saddle, with derivatives.

use std::ops::Range;

use super::lanes::{Inverse, LANES, Lane, MarkModel, each, ramp, smaller};
use super::local_map::LocalMap;
use crate::plate::PlateLayout;
use nalgebra::Vector2;

/// Which part of the plate a picture shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Part {
    Plate,
    /// The saddle with a rim of white.
    Saddle,
}

/// White rim around a saddle searched alone, as a fraction of its half size.
const SADDLE_RIM: f64 = 0.25;

/// The appearance of the plate (or its saddle) on a grid of pixels `step` image px apart.
#[derive(Clone, Debug)]
pub(super) struct Picture {
    pub width: usize,
    pub height: usize,
    /// Image coordinates of the first grid pixel's centre.
    pub origin_px: Vector2<f64>,
    pub step_px: f64,
    /// Darkness, 0 to 1.
    pub values: Vec<f32>,
    /// Derivatives per image px; empty if they were not asked for.
    pub du: Vec<f32>,
    pub dv: Vec<f32>,
    /// Whether the pixel shows the part, at least one blur radius inside its edge.
    pub mask: Vec<bool>,
}

/// Half sizes and centre of a part on the plate, m.
fn extent(layout: &PlateLayout, part: Part) -> (Vector2<f64>, Vector2<f64>) {
    match (part, &layout.saddle) {
        (Part::Saddle, Some(s)) => {
            let reach = s.half_size_m * (1.0 + SADDLE_RIM);
            (
                Vector2::new(s.x_m, s.y_m),
                Vector2::new(
                    reach.min(layout.half_width_m - s.x_m.abs()),
                    reach.min(layout.half_height_m - s.y_m.abs()),
                ),
            )
        }
        _ => (
            Vector2::zeros(),
            Vector2::new(layout.half_width_m, layout.half_height_m),
        ),
    }
}

/// Corners of the bounding box of a part in the image, px.
pub(super) fn bounds(
    layout: &PlateLayout,
    part: Part,
    map: &LocalMap,
) -> (Vector2<f64>, Vector2<f64>) {
    let (centre, half) = extent(layout, part);
    let mut low = Vector2::repeat(f64::INFINITY);
    let mut high = Vector2::repeat(f64::NEG_INFINITY);
    for (sx, sy) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
        let corner = map.project(&(centre + Vector2::new(sx * half.x, sy * half.y)));
        low = low.inf(&corner);
        high = high.sup(&corner);
    }
    (low, high)
}

/// Variance of the box that makes one pixel of unit side, px^2.
const BOX_VARIANCE: f64 = 1.0 / 12.0;

/// Blur of an image reduced `level` times, in full-resolution px.
pub(super) fn level_sigma(sigma_px: f64, level: u32) -> f64 {
    let step = f64::from(1u32 << level);
    // the full-resolution blur already holds one pixel's box
    (sigma_px * sigma_px + (step * step - 1.0) * BOX_VARIANCE).sqrt()
}

/// Draws a part, with its derivatives if `slopes`. The grid starts at `origin_px`; `sigma_px` is the
/// blur in image px. `None` if the map is degenerate.
#[allow(clippy::too_many_arguments)] // what a picture is made of
pub(super) fn draw(
    layout: &PlateLayout,
    part: Part,
    map: &LocalMap,
    sigma_px: f64,
    origin_px: Vector2<f64>,
    step_px: f64,
    (width, height): (usize, usize),
    slopes: bool,
) -> Option<Picture> {
    let count = width * height;
    let sloped = if slopes { count } else { 0 };
    let mut picture = Picture {
        width,
        height,
        origin_px,
        step_px,
        values: vec![0.0; count],
        du: vec![0.0; sloped],
        dv: vec![0.0; sloped],
        mask: vec![false; count],
    };
    let (centre, half) = extent(layout, part);
    let frame = Frame {
        half_m: [half.x as f32, half.y as f32],
        inset_px: sigma_px.max(0.5 * step_px) as f32,
    };
    picture.frame(&map.at(&centre)?, &frame);
    if part == Part::Plate {
        for disc in &layout.discs {
            let local = map.at(&Vector2::new(disc.x_m, disc.y_m))?;
            let mark = MarkModel::disc(&local, disc, sigma_px);
            picture.paint(&mark, &local, disc.radius_m, sigma_px);
        }
    }
    if let Some(s) = &layout.saddle {
        let local = map.at(&Vector2::new(s.x_m, s.y_m))?;
        let mark = MarkModel::saddle(&local, s, sigma_px);
        let reach_m = s.half_size_m * std::f64::consts::SQRT_2;
        picture.paint(&mark, &local, reach_m, sigma_px);
    }
    Some(picture)
}

/// The outline of a part around its centre.
struct Frame {
    half_m: [f32; 2],
    inset_px: f32,
}

impl Picture {
    /// Offsets (px) of the grid's column `i` and row `j` from a pixel.
    fn offset(&self, from_px: &Vector2<f64>, i: usize, j: usize) -> (f32, f32) {
        let at =
            |k: usize, n: usize| (self.origin_px[k] + n as f64 * self.step_px - from_px[k]) as f32;
        (at(0, i), at(1, j))
    }

    /// Fills the mask.
    fn frame(&mut self, around: &LocalMap, frame: &Frame) {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            return unsafe { self.frame_avx2(around, frame) };
        }
        self.frame_plain(around, frame);
    }

    /// The same with wider vectors.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn frame_avx2(&mut self, around: &LocalMap, frame: &Frame) {
        self.frame_plain(around, frame);
    }

    #[inline(always)]
    fn frame_plain(&mut self, around: &LocalMap, frame: &Frame) {
        let inverse = Inverse::new(around);
        let (half, inset) = (frame.half_m, frame.inset_px);
        // half size (m) times D less |q| is to be that large
        let least = inverse.slopes.map(|s| s * inset);
        for j in 0..self.height {
            for i in (0..self.width).step_by(LANES) {
                let (du, dv) = self.offset(&around.pixel_px, i, j);
                let [x, y, d] = inverse.at(&ramp(du, self.step_px as f32), dv);
                let inside: Lane = each(|k| {
                    let a = half[0] * d[k] - x[k].abs() - least[0];
                    smaller(a, half[1] * d[k] - y[k].abs() - least[1])
                });
                let last = (i + LANES).min(self.width);
                let out = &mut self.mask[j * self.width + i..j * self.width + last];
                if let Some(whole) = out.first_chunk_mut::<LANES>() {
                    *whole = inside.map(|x| x >= 0.0);
                    continue;
                }
                for (o, x) in out.iter_mut().zip(inside) {
                    *o = x >= 0.0;
                }
            }
        }
    }

    /// Adds a mark's image around the place that `local` is centred on.
    fn paint(&mut self, mark: &MarkModel, local: &LocalMap, reach_m: f64, sigma_px: f64) {
        let reach = reach_m * local.scales().1 * 1.1 + 3.5 * sigma_px;
        let from = (local.pixel_px - self.origin_px).map(|x| (x - reach) / self.step_px);
        let to = (local.pixel_px - self.origin_px).map(|x| (x + reach) / self.step_px);
        let range = |a: f64, b: f64, size: usize| {
            (a.ceil().clamp(0.0, size as f64) as usize)
                ..((b.floor() + 1.0).clamp(0.0, size as f64) as usize)
        };
        let (columns, rows) = (
            range(from.x, to.x, self.width),
            range(from.y, to.y, self.height),
        );
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            return unsafe { self.add_avx2(mark, &local.pixel_px, columns, rows) };
        }
        self.add_either(mark, &local.pixel_px, columns, rows);
    }

    /// The same with wider vectors.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn add_avx2(
        &mut self,
        mark: &MarkModel,
        at_px: &Vector2<f64>,
        columns: Range<usize>,
        rows: Range<usize>,
    ) {
        self.add_either(mark, at_px, columns, rows);
    }

    #[inline(always)]
    fn add_either(
        &mut self,
        mark: &MarkModel,
        at_px: &Vector2<f64>,
        columns: Range<usize>,
        rows: Range<usize>,
    ) {
        if self.du.is_empty() {
            self.add_plain::<false>(mark, at_px, columns, rows);
        } else {
            self.add_plain::<true>(mark, at_px, columns, rows);
        }
    }

    #[inline(always)]
    fn add_plain<const SLOPES: bool>(
        &mut self,
        mark: &MarkModel,
        at_px: &Vector2<f64>,
        columns: Range<usize>,
        rows: Range<usize>,
    ) {
        for j in rows {
            for i in columns.clone().step_by(LANES) {
                let (du, dv) = self.offset(at_px, i, j);
                let d = mark.at(&ramp(du, self.step_px as f32), dv);
                let cells = j * self.width + i..j * self.width + (i + LANES).min(columns.end);
                add(&mut self.values[cells.clone()], &d.value);
                if SLOPES {
                    add(&mut self.du[cells.clone()], &d.du);
                    add(&mut self.dv[cells], &d.dv);
                }
            }
        }
    }
}

/// Adds as many lanes as there are places.
#[inline(always)]
fn add(out: &mut [f32], lanes: &Lane) {
    if let Some(whole) = out.first_chunk_mut::<LANES>() {
        *whole = each(|k| whole[k] + lanes[k]);
        return;
    }
    for (o, x) in out.iter_mut().zip(lanes) {
        *o += x;
    }
}
