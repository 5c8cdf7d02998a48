//! What the plate looks like around a point: the map from plate to pixels and the blurred image of
//! discs and saddle, with derivatives.

use std::sync::OnceLock;

use nalgebra::{Isometry3, Matrix2, Matrix3x2, Vector2, Vector3};
use rover_cameras::Camera;

use super::NotFound;
use crate::plate::{Disc, PlateLayout, Saddle};

/// Least cosine between the plate's normal and the direction to the camera: 80 degrees.
const MIN_FACING: f64 = 0.17;

/// The plate's image around one of its points.
///
/// With p the offset from the point on the plate (m) and d the offset from its pixel (px):
/// d = M p / (1 + g.p), which is exact for a perspective camera and off by the curvature of the
/// distortion otherwise; back: p = q / (1 - g.q), q = M^-1 d.
#[derive(Clone, Copy, Debug)]
pub(super) struct LocalMap {
    /// The point, plate x and y, m.
    pub centre_m: Vector2<f64>,
    /// Its pixel.
    pub pixel_px: Vector2<f64>,
    /// M, px/m.
    pub m: Matrix2<f64>,
    /// M^-1, m/px.
    pub inverse: Matrix2<f64>,
    /// g, 1/m.
    pub g: Vector2<f64>,
}

impl LocalMap {
    /// The map around `point` (plate frame) of a plate at `pose` (camera model's frame).
    pub fn new(
        camera: &Camera,
        pose: &Isometry3<f64>,
        point: &Vector3<f64>,
    ) -> Result<Self, NotFound> {
        let rotation = pose.rotation.to_rotation_matrix();
        let axes: Matrix3x2<f64> = rotation.matrix().fixed_columns::<2>(0).into_owned();
        let at = pose.rotation * point + pose.translation.vector;
        let seen = camera
            .project_with_jacobian(&at)
            .map_err(|e| NotFound::NotVisible(e.to_string()))?;
        let m = seen.jacobian * axes;
        let normal = rotation.matrix().column(2).into_owned();
        let ray = camera
            .ray(&seen.pixel_px)
            .map_err(|e| NotFound::NotVisible(e.to_string()))?;
        let facing = -normal.dot(ray.direction.as_ref());
        if !(facing >= MIN_FACING) {
            return Err(NotFound::NotVisible(format!(
                "the cosine between its normal and the direction to the camera is {facing:.3}, at \
                 least {MIN_FACING} is needed"
            )));
        }
        let [_, axis, _, _] = camera.model.cahv();
        let g = axes.transpose() * axis / seen.range_m;
        Self::from_parts(Vector2::new(point.x, point.y), seen.pixel_px, m, g)
            .ok_or_else(|| NotFound::NotVisible("it is seen edge on".into()))
    }

    pub fn from_parts(
        centre_m: Vector2<f64>,
        pixel_px: Vector2<f64>,
        m: Matrix2<f64>,
        g: Vector2<f64>,
    ) -> Option<Self> {
        Some(Self {
            centre_m,
            pixel_px,
            m,
            inverse: m.try_inverse()?,
            g,
        })
    }

    /// Pixel of a point on the plate (plate x and y, m).
    pub fn project(&self, plate_m: &Vector2<f64>) -> Vector2<f64> {
        let p = plate_m - self.centre_m;
        self.pixel_px + self.m * p / (1.0 + self.g.dot(&p))
    }

    /// The map around another point of the plate.
    pub fn at(&self, plate_m: &Vector2<f64>) -> Option<Self> {
        let p = plate_m - self.centre_m;
        let w = 1.0 + self.g.dot(&p);
        let moved = self.m * p / w;
        let m = (self.m - moved * self.g.transpose()) / w;
        Self::from_parts(*plate_m, self.pixel_px + moved, m, self.g / w)
    }

    /// Smallest and largest image length of a unit length on the plate, px/m.
    pub fn scales(&self) -> (f64, f64) {
        let s = self.m.singular_values();
        (s.min(), s.max())
    }
}

/// Standard normal distribution function and density from a table: error below 3e-6.
#[derive(Debug)]
struct Normal {
    table: Vec<(f32, f32)>,
}

const NORMAL_REACH: f32 = 5.0;
const NORMAL_STEPS: f32 = 128.0;

fn normal() -> &'static Normal {
    static TABLE: OnceLock<Normal> = OnceLock::new();
    TABLE.get_or_init(|| {
        // Integrate the density by Simpson's rule from the middle outwards.
        let density = |x: f64| (-0.5 * x * x).exp() / (2.0 * std::f64::consts::PI).sqrt();
        let half = (NORMAL_REACH * NORMAL_STEPS) as usize;
        let h = 1.0 / f64::from(NORMAL_STEPS);
        let mut above = vec![0.5f64];
        for i in 0..half + 1 {
            let x = i as f64 * h;
            let area = h / 6.0 * (density(x) + 4.0 * density(x + h / 2.0) + density(x + h));
            above.push(above[i] + area);
        }
        let table = (0..=2 * half + 1)
            .map(|i| {
                let k = i as isize - half as isize;
                let p = if k >= 0 {
                    above[k as usize]
                } else {
                    1.0 - above[(-k) as usize]
                };
                (p as f32, density(k as f64 * h) as f32)
            })
            .collect();
        Normal { table }
    })
}

impl Normal {
    /// (distribution function, density) at `x`.
    #[inline]
    fn at(&self, x: f32) -> (f32, f32) {
        if x <= -NORMAL_REACH {
            return (0.0, 0.0);
        }
        if x >= NORMAL_REACH {
            return (1.0, 0.0);
        }
        let t = (x + NORMAL_REACH) * NORMAL_STEPS;
        let i = t as usize;
        let f = t - i as f32;
        let (a, b) = (self.table[i], self.table[i + 1]);
        (a.0 + (b.0 - a.0) * f, a.1 + (b.1 - a.1) * f)
    }
}

/// Standard normal distribution function and density at `x`, from the table.
pub(crate) fn normal_at(x: f32) -> (f32, f32) {
    normal().at(x)
}

/// Blurred darkness (0 white, 1 black) at a pixel, its derivatives with respect to the pixel and
/// to the blur, and the distance from the mark's edge (negative inside).
#[derive(Clone, Copy, Debug)]
pub(super) struct Darkness {
    pub value: f32,
    pub du: f32,
    pub dv: f32,
    pub dsigma: f32,
    pub edge_px: f32,
}

/// Evaluates a mark's image around its centre in single precision.
#[derive(Clone, Copy, Debug)]
pub(super) struct MarkModel {
    inverse: [[f32; 2]; 2],
    g: [f32; 2],
    sigma: f32,
    size_m: f32,
    kind: MarkKind,
    normal: &'static Normal,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum MarkKind {
    Disc,
    Saddle,
}

impl MarkModel {
    /// `map` must be centred on the disc.
    pub fn disc(map: &LocalMap, disc: &Disc, sigma_px: f64) -> Self {
        Self::new(map, disc.radius_m, sigma_px, MarkKind::Disc)
    }

    /// `map` must be centred on the saddle.
    pub fn saddle(map: &LocalMap, saddle: &Saddle, sigma_px: f64) -> Self {
        Self::new(map, saddle.half_size_m, sigma_px, MarkKind::Saddle)
    }

    fn new(map: &LocalMap, size_m: f64, sigma_px: f64, kind: MarkKind) -> Self {
        let i = map.inverse.map(|x| x as f32);
        Self {
            inverse: [[i.m11, i.m12], [i.m21, i.m22]],
            g: [map.g.x as f32, map.g.y as f32],
            sigma: sigma_px as f32,
            size_m: size_m as f32,
            kind,
            normal: normal(),
        }
    }

    /// At an offset (px) from the mark's centre.
    #[inline]
    pub fn at(&self, du: f32, dv: f32) -> Darkness {
        match self.kind {
            MarkKind::Disc => self.disc_at(du, dv),
            MarkKind::Saddle => self.saddle_at(du, dv),
        }
    }

    /// Offset on the plate (m) and the factor that perspective puts on the inverse map there.
    #[inline]
    fn on_plate(&self, du: f32, dv: f32) -> (f32, f32, f32) {
        let i = &self.inverse;
        let qx = i[0][0] * du + i[0][1] * dv;
        let qy = i[1][0] * du + i[1][1] * dv;
        let w = 1.0 / (1.0 - self.g[0] * qx - self.g[1] * qy);
        (qx * w, qy * w, w)
    }

    #[inline]
    fn disc_at(&self, du: f32, dv: f32) -> Darkness {
        let (x, y, w) = self.on_plate(du, dv);
        let i = &self.inverse;
        let radius = (x * x + y * y).sqrt();
        if radius < 1e-3 * self.size_m {
            return Darkness {
                value: 1.0,
                du: 0.0,
                dv: 0.0,
                dsigma: 0.0,
                edge_px: -1e3,
            };
        }
        let (nx, ny) = (x / radius, y / radius);
        // gradient of the radius in the image, m/px
        let (gu, gv) = (
            (nx * i[0][0] + ny * i[1][0]) * w,
            (nx * i[0][1] + ny * i[1][1]) * w,
        );
        let slope = (gu * gu + gv * gv).sqrt();
        let edge_px = (radius - self.size_m) / slope;
        let z = edge_px / self.sigma;
        let (p, density) = self.normal.at(-z);
        let rate = density / self.sigma;
        Darkness {
            value: p,
            du: -rate * gu / slope,
            dv: -rate * gv / slope,
            dsigma: rate * z,
            edge_px,
        }
    }

    #[inline]
    fn saddle_at(&self, du: f32, dv: f32) -> Darkness {
        let (x, y, w) = self.on_plate(du, dv);
        let i = &self.inverse;
        let line = |value: f32, row: [f32; 2]| {
            let slope = (row[0] * row[0] + row[1] * row[1]).sqrt() * w;
            let z = value / slope / self.sigma;
            let (p, density) = self.normal.at(z);
            let rate = 2.0 * density / self.sigma;
            let unit = [row[0] * w / slope, row[1] * w / slope];
            (2.0 * p - 1.0, rate, unit, -rate * z, slope)
        };
        let (ex, rate_x, unit_x, ex_s, slope_x) = line(x, i[0]);
        let (ey, rate_y, unit_y, ey_s, slope_y) = line(y, i[1]);
        let edge_x = (x.abs() - self.size_m) / slope_x;
        let edge_y = (y.abs() - self.size_m) / slope_y;
        let (edge_px, outward) = if edge_x >= edge_y {
            (edge_x, unit_x.map(|c| c * x.signum()))
        } else {
            (edge_y, unit_y.map(|c| c * y.signum()))
        };
        let inner = 0.5 + 0.5 * ex * ey;
        let inner_u = 0.5 * (rate_x * unit_x[0] * ey + ex * rate_y * unit_y[0]);
        let inner_v = 0.5 * (rate_x * unit_x[1] * ey + ex * rate_y * unit_y[1]);
        // the checker ends at the square's border, blurred like any edge
        let z = edge_px / self.sigma;
        let (inside, density) = self.normal.at(-z);
        let fade = density / self.sigma;
        Darkness {
            value: inner * inside,
            du: inner_u * inside - inner * fade * outward[0],
            dv: inner_v * inside - inner * fade * outward[1],
            dsigma: 0.5 * (ex_s * ey + ex * ey_s) * inside + inner * fade * z,
            edge_px,
        }
    }
}

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
    /// Derivatives per image px.
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

/// Draws a part. The grid starts at `origin_px`; `sigma_px` is the blur in image px. `None` if the
/// map is degenerate.
pub(super) fn draw(
    layout: &PlateLayout,
    part: Part,
    map: &LocalMap,
    sigma_px: f64,
    origin_px: Vector2<f64>,
    step_px: f64,
    (width, height): (usize, usize),
) -> Option<Picture> {
    let count = width * height;
    let mut picture = Picture {
        width,
        height,
        origin_px,
        step_px,
        values: vec![0.0; count],
        du: vec![0.0; count],
        dv: vec![0.0; count],
        mask: vec![false; count],
    };
    let (centre, half) = extent(layout, part);
    let inset = sigma_px.max(0.5 * step_px);
    let around = map.at(&centre)?;
    let frame = MarkModel::new(&around, half.x.max(half.y), sigma_px, MarkKind::Saddle);
    let (hx, hy) = (half.x as f32, half.y as f32);
    for j in 0..height {
        let dv = (origin_px.y + j as f64 * step_px - around.pixel_px.y) as f32;
        for i in 0..width {
            let du = (origin_px.x + i as f64 * step_px - around.pixel_px.x) as f32;
            let (x, y, w) = frame.on_plate(du, dv);
            let slope = |row: [f32; 2]| (row[0] * row[0] + row[1] * row[1]).sqrt() * w;
            let inside_x = (hx - x.abs()) / slope(frame.inverse[0]);
            let inside_y = (hy - y.abs()) / slope(frame.inverse[1]);
            picture.mask[j * width + i] = inside_x.min(inside_y) >= inset as f32;
        }
    }
    let mut paint = |mark: MarkModel, local: &LocalMap, reach_m: f64| {
        let reach = reach_m * local.scales().1 * 1.1 + 3.5 * sigma_px;
        let from = (local.pixel_px - origin_px).map(|x| (x - reach) / step_px);
        let to = (local.pixel_px - origin_px).map(|x| (x + reach) / step_px);
        let range = |a: f64, b: f64, size: usize| {
            (a.ceil().clamp(0.0, size as f64) as usize)
                ..((b.floor() + 1.0).clamp(0.0, size as f64) as usize)
        };
        for j in range(from.y, to.y, height) {
            let dv = (origin_px.y + j as f64 * step_px - local.pixel_px.y) as f32;
            for i in range(from.x, to.x, width) {
                let du = (origin_px.x + i as f64 * step_px - local.pixel_px.x) as f32;
                let d = mark.at(du, dv);
                let k = j * width + i;
                picture.values[k] += d.value;
                picture.du[k] += d.du;
                picture.dv[k] += d.dv;
            }
        }
    };
    if part == Part::Plate {
        for disc in &layout.discs {
            let local = map.at(&Vector2::new(disc.x_m, disc.y_m))?;
            paint(
                MarkModel::disc(&local, disc, sigma_px),
                &local,
                disc.radius_m,
            );
        }
    }
    if let Some(s) = &layout.saddle {
        let local = map.at(&Vector2::new(s.x_m, s.y_m))?;
        paint(
            MarkModel::saddle(&local, s, sigma_px),
            &local,
            s.half_size_m * std::f64::consts::SQRT_2,
        );
    }
    Some(picture)
}
