//! The pixels around a mark's centre, summed up for its fit eight at a time.

use nalgebra::Vector2;

use super::PointKind;
use super::lanes::{LANES, Lane, MarkModel, add_products, each, larger, ramp, smaller, total};
use super::local_map::LocalMap;
use crate::image::Image8;
use crate::plate::PlateLayout;

/// Width of the strip along the plate's border that the surroundings blur into, px.
const EDGE_STRIP_PX: f64 = 1.2;

/// The pixels around a mark's centre and what they are compared with.
pub(super) struct Window {
    pub model: MarkModel,
    pub edge: EdgeDistance,
    pub kind: PointKind,
    pub centre: Vector2<f64>,
    pub reach_px: f64,
    /// White beyond a disc's edge, px.
    pub margin_px: f32,
    /// Strip along the checker's border that is left out, px.
    pub rim_px: f32,
    /// Radius of the checker's window, px.
    pub radius_px: f32,
    /// See [`DetectionRules::saturation_dn`], less [`MIDDLE_DN`].
    pub saturation_dn: f32,
}

/// Subtracted from the grey values, to keep the sums of their squares small, DN.
pub(super) const MIDDLE_DN: f32 = 128.0;

/// Lower triangle of the normal equations, row by row: du, dv, darkness, one, grey value, blur.
pub(super) type Sums = [f64; 21];
/// Place of the grey value among them.
pub(super) const GREY: usize = 4;

/// Rows whose sums are held in single precision.
const ROWS_AT_ONCE: usize = 4;

impl Window {
    /// The sums over the window, those with the blur only if it is free, and the fraction of the
    /// pixels that are saturated.
    pub fn accumulate(&self, image: &Image8, free_blur: bool) -> (Sums, f64) {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            return unsafe {
                if free_blur {
                    self.accumulate_avx2::<true>(image)
                } else {
                    self.accumulate_avx2::<false>(image)
                }
            };
        }
        if free_blur {
            self.accumulate_plain::<true>(image)
        } else {
            self.accumulate_plain::<false>(image)
        }
    }

    /// The same with wider vectors.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn accumulate_avx2<const BLUR: bool>(&self, image: &Image8) -> (Sums, f64) {
        self.accumulate_plain::<BLUR>(image)
    }

    #[inline(always)]
    fn accumulate_plain<const BLUR: bool>(&self, image: &Image8) -> (Sums, f64) {
        let width = image.width_px as usize;
        // no pixel further away counts
        let reach = match self.kind {
            PointKind::Disc => self.reach_px,
            PointKind::Saddle => self.reach_px.min(f64::from(self.radius_px)),
        };
        let centre = self.centre;
        let (top, bottom) = (
            (centre.y - reach).ceil() as usize,
            (centre.y + reach) as usize,
        );
        let (mut saturated, mut counted) = ([0.0f32; LANES], [0.0f32; LANES]);
        let mut sums = [0.0f64; 21];
        for first_row in (top..=bottom).step_by(ROWS_AT_ONCE) {
            let mut rows = [[0.0f32; LANES]; 21];
            for v in first_row..=bottom.min(first_row + ROWS_AT_ONCE - 1) {
                let offset = v as f64 - centre.y;
                let half = (reach * reach - offset * offset).max(0.0).sqrt();
                let (first, last) = (
                    (centre.x - half).ceil() as usize,
                    (centre.x + half) as usize,
                );
                let dv = offset as f32;
                for u in (first..=last).step_by(LANES) {
                    let du = ramp((u as f64 - centre.x) as f32, 1.0);
                    let d = self.model.at(&du, dv);
                    let weight = self.weights(&d.edge_px, &du, dv, (last - u) as f32);
                    let grey = greys(&image.pixels, v * width + u);
                    let on = each(|k| if weight[k] > 0.0 { 1.0 } else { 0.0 });
                    let clipped = each(|k| {
                        if grey[k] >= self.saturation_dn {
                            1.0
                        } else {
                            0.0
                        }
                    });
                    counted = each(|k| counted[k] + on[k]);
                    saturated = each(|k| saturated[k] + on[k] * clipped[k]);
                    let a = [
                        each(|k| -d.du[k]),
                        each(|k| -d.dv[k]),
                        d.value,
                        [1.0; LANES],
                        grey,
                        d.dsigma,
                    ];
                    let weighted = |p: usize| each(|k| weight[k] * a[p][k]);
                    add_products::<0>(&mut rows, &a, &weighted(0));
                    add_products::<1>(&mut rows, &a, &weighted(1));
                    add_products::<2>(&mut rows, &a, &weighted(2));
                    add_products::<3>(&mut rows, &a, &weight);
                    add_products::<4>(&mut rows, &a, &weighted(4));
                    if BLUR {
                        add_products::<5>(&mut rows, &a, &weighted(5));
                    }
                }
            }
            for (s, r) in sums.iter_mut().zip(&rows) {
                *s += f64::from(total(r));
            }
        }
        let fraction = f64::from(total(&saturated)) / f64::from(total(&counted)).max(1.0);
        (sums, fraction)
    }

    /// What pixels count for, 0 to 1; 0 from the lane after `last` on.
    #[inline(always)]
    fn weights(&self, edge_px: &Lane, du: &Lane, dv: f32, last: f32) -> Lane {
        let lane = ramp(0.0, 1.0);
        let own = match self.kind {
            PointKind::Disc => each(|k| self.margin_px - edge_px[k]),
            PointKind::Saddle => each(|k| {
                let inside = self.radius_px - (du[k] * du[k] + dv * dv).sqrt();
                smaller(-edge_px[k] - self.rim_px, inside)
            }),
        };
        let border = self.edge.at(du, dv);
        each(|k| {
            let weight = smaller(larger(smaller(own[k], border[k]), 0.0), 1.0);
            if lane[k] <= last { weight } else { 0.0 }
        })
    }
}

/// Grey values less [`MIDDLE_DN`] from `start` on; the last one again beyond the end.
#[inline(always)]
fn greys(pixels: &[u8], start: usize) -> Lane {
    let bytes = match pixels[start..].first_chunk::<LANES>() {
        Some(bytes) => *bytes,
        None => std::array::from_fn(|k| pixels[(start + k).min(pixels.len() - 1)]),
    };
    each(|k| f32::from(bytes[k]) - MIDDLE_DN)
}

/// Distance (px, less the blurred strip) of a pixel from the plate's border, to first order.
pub(super) struct EdgeDistance {
    along: [[f32; 2]; 2],
    at: [f32; 2],
    half: [f32; 2],
}

impl EdgeDistance {
    /// With a map around the mark's middle.
    pub fn new(layout: &PlateLayout, map: &LocalMap) -> Self {
        let row = |i: usize| {
            let r = map.inverse.row(i);
            (r[0] as f32, r[1] as f32, r.norm())
        };
        let ((xu, xv, xn), (yu, yv, yn)) = (row(0), row(1));
        let scale = |value: f64, norm: f64| (value / norm) as f32;
        Self {
            along: [
                [xu / xn as f32, xv / xn as f32],
                [yu / yn as f32, yv / yn as f32],
            ],
            at: [scale(map.centre_m.x, xn), scale(map.centre_m.y, yn)],
            half: [
                scale(layout.half_width_m, xn),
                scale(layout.half_height_m, yn),
            ],
        }
    }

    #[inline(always)]
    fn at(&self, du: &Lane, dv: f32) -> Lane {
        let axis = |i: usize, k: usize| {
            let x = self.at[i] + self.along[i][0] * du[k] + self.along[i][1] * dv;
            self.half[i] - x.abs()
        };
        each(|k| smaller(axis(0, k), axis(1, k)) - EDGE_STRIP_PX as f32)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

    use super::*;

    fn maps() -> Vec<(PlateLayout, usize, LocalMap)> {
        let camera = &crate::synthetic::pair().left;
        let layout = PlateLayout::standard(0.08);
        let turn = |angle: f64| UnitQuaternion::from_scaled_axis(Vector3::new(0.3, angle, 0.2));
        let facing =
            crate::synthetic::facing_pose(camera, Vector2::new(310.0, 240.0), 0.5, 0.0, 0.0, 0.4);
        let mut all = Vec::new();
        for (index, angle) in [(0, 0.0), (4, 0.5), (11, 0.0), (11, -0.6)] {
            let pose = facing * Isometry3::from_parts(Translation3::identity(), turn(angle));
            let at = layout.point(index).unwrap();
            let map = LocalMap::new(camera, &pose, &at).unwrap();
            all.push((layout.clone(), index, map));
        }
        all
    }

    fn model(layout: &PlateLayout, index: usize, map: &LocalMap, blur_px: f64) -> MarkModel {
        match layout.discs.get(index) {
            Some(disc) => MarkModel::disc(map, disc, blur_px),
            None => MarkModel::saddle(map, layout.saddle.as_ref().unwrap(), blur_px),
        }
    }

    #[test]
    fn derivatives_of_the_darkness_are_its_differences() {
        for (layout, index, map) in maps() {
            let value = |du: f32, dv: f32, blur_px: f64| {
                model(&layout, index, &map, blur_px).at(&[du; LANES], dv)
            };
            let h = 0.02f32;
            let mut changes = 0;
            for k in 0..400 {
                let du = -9.0 + 18.0 * (k as f32 * 0.618_034).fract();
                let dv = -9.0 + 18.0 * (k as f32 * 0.414_214).fract();
                let d = value(du, dv, 0.8);
                let slope = |a: &Lane, b: &Lane| (a[3] - b[3]) / (2.0 * h);
                let by_u = slope(&value(du + h, dv, 0.8).value, &value(du - h, dv, 0.8).value);
                let by_v = slope(&value(du, dv + h, 0.8).value, &value(du, dv - h, 0.8).value);
                let step = f64::from(h);
                let blurs = [0.8 + step, 0.8 - step].map(|blur| value(du, dv, blur).value);
                let by_blur = slope(&blurs[0], &blurs[1]);
                // to first order in the curvature of the outline
                for (name, got, expected) in [
                    ("u", d.du[3], by_u),
                    ("v", d.dv[3], by_v),
                    ("blur", d.dsigma[3], by_blur),
                ] {
                    let off = (got - expected).abs();
                    assert!(
                        off < 0.06,
                        "{index} {name} at ({du}, {dv}): {got} {expected}"
                    );
                }
                changes += usize::from(by_u.abs() > 0.1);
            }
            assert!(changes > 20, "{index}: {changes}");
        }
    }

    #[test]
    fn the_sums_do_not_depend_on_the_vector_unit() {
        let pixels = (0..640 * 480).map(|i| (i * 7 % 251) as u8).collect();
        let image = Image8::from_raw(640, 480, pixels).unwrap();
        for (layout, index, map) in maps() {
            let window = Window {
                model: model(&layout, index, &map, 0.7),
                edge: EdgeDistance::new(&layout, &map),
                kind: if index == 11 {
                    PointKind::Saddle
                } else {
                    PointKind::Disc
                },
                centre: map.pixel_px + Vector2::new(0.3, -0.2),
                reach_px: 10.0,
                margin_px: 3.0,
                rim_px: 1.0,
                radius_px: 9.5,
                saturation_dn: 240.0 - MIDDLE_DN,
            };
            let (sums, saturated) = window.accumulate(&image, true);
            assert_eq!((sums, saturated), window.accumulate_plain::<true>(&image));
            assert!(sums[9] > 20.0 && saturated > 0.0, "{sums:?}");
            let (known_blur, _) = window.accumulate(&image, false);
            assert_eq!(sums[..15], known_blur[..15]);
        }
    }
}
