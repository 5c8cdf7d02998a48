//! The ray first designated, met with the surface as it is seen from close by.
//!
//! A tracked window carries every small error of every stop along; above all the point slides on
//! the relief that no plane knows. But the first image is still there, and now the surface about
//! the target is known to millimetres. So the near map with the near image on it is seen through
//! the first camera, pixel by pixel of the first template, with the map's relief; that picture is
//! aligned with the first image, and the designated pixel's ray is met with the map. What is left
//! is the error of one match at the first range.

use crate::align::{Aligned, Freedom, Template};
use crate::error::TrackError;
use crate::patch::{HalfSize, Patch};
use crate::surface::{PlaneRules, SurfacePlane};
use crate::track::Tracker;
use crate::view::View;
use crate::warp::PlaneWarp;
use nalgebra::{Matrix2, Point3, Vector2, Vector3};
use rover_cameras::Camera;
use rover_vision::match_point;

/// How the first ray is used.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FirstRayRules {
    /// Half side of the compared window, px of the first image.
    pub half_px: usize,
    /// Half side of the matching windows of the near map, px.
    pub map_half_window_px: u32,
    /// Distance of the map's points, px of the near image, at least.
    pub map_step_px: f64,
    /// Most map points on a side.
    pub map_points: usize,
    /// Range searched about the plane's, as a fraction of it.
    pub range_fraction: f64,
    /// Least weighted correlation.
    pub min_score: f64,
    /// Farthest from the tracked point, px of the first image.
    pub max_shift_px: f64,
    /// Least part of the map that must have been measured.
    pub min_coverage: f64,
    /// Least ratio of first to present range: nearer the tracked window is as good.
    pub min_range_ratio: f64,
}

impl Default for FirstRayRules {
    fn default() -> Self {
        Self {
            half_px: 9,
            map_half_window_px: 5,
            map_step_px: 4.0,
            map_points: 61,
            range_fraction: 0.10,
            min_score: 0.85,
            max_shift_px: 1.5,
            min_coverage: 0.6,
            min_range_ratio: 1.6,
        }
    }
}

/// Where the first ray meets the near map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FirstRayFix {
    /// Pixel in the near left image.
    pub pixel_px: Vector2<f64>,
    /// Point of the map, present rover frame, m.
    pub point: Vector3<f64>,
    /// Weighted correlation of the rendered with the first image.
    pub score: f64,
    /// Shift against the tracked point, px of the first image.
    pub shift_px: Vector2<f64>,
    /// Standard deviation along the surface that the alignment leaves, m (worst axis).
    pub sigma_m: f64,
    /// Root mean square height of the map over its plane, m.
    pub relief_m: f64,
    /// Part of the map that was measured.
    pub coverage: f64,
}

/// Heights over a plane, on a grid in the pixels of the near image.
struct NearMap {
    plane: SurfacePlane,
    centre_px: Vector2<f64>,
    step: Vector2<f64>,
    size: [usize; 2],
    heights_m: Vec<f64>,
    limit_m: f64,
    relief_m: f64,
    coverage: f64,
}

impl NearMap {
    fn measure(
        view: &View,
        plane: &SurfacePlane,
        centre_px: Vector2<f64>,
        half_extent_px: Vector2<f64>,
        rules: &FirstRayRules,
    ) -> Option<Self> {
        let half = (rules.map_points / 2).max(2) as f64;
        let step = half_extent_px.map(|e| (e / half).max(rules.map_step_px));
        let count = |k: usize| 2 * (half_extent_px[k] / step[k]).ceil().max(2.0) as usize + 1;
        let size = [count(0), count(1)];
        let camera = &view.cameras.left;
        let matching = PlaneRules {
            half_window_px: rules.map_half_window_px,
            ..PlaneRules::default()
        };
        let height = |pixel: &Vector2<f64>| -> Option<f64> {
            let ray = camera.ray(pixel).ok()?;
            let facing = plane.normal.dot(ray.direction.as_ref());
            let range = plane.normal.dot(&(plane.point - ray.origin)) / facing;
            if !(facing < -0.02 && range > 0.0) {
                return None;
            }
            let limits = [
                range * (1.0 - rules.range_fraction),
                range * (1.0 + rules.range_fraction),
            ];
            let rules = rover_vision::MatchRules {
                min_score: 0.8,
                max_sigma_px: 0.25,
                ..matching.matching(limits, &[plane.normal])
            };
            let found = match_point(&view.left, &view.right, &view.cameras, pixel, &rules).ok()?;
            Some(plane.normal.dot(&(ray.at(found.range_m) - plane.point)))
        };
        let mut heights: Vec<Option<f64>> = Vec::with_capacity(size[0] * size[1]);
        for j in 0..size[1] {
            for i in 0..size[0] {
                let offset = Vector2::new(
                    (i as f64 - (size[0] / 2) as f64) * step.x,
                    (j as f64 - (size[1] / 2) as f64) * step.y,
                );
                heights.push(height(&(centre_px + offset)));
            }
        }
        let known: Vec<f64> = heights.iter().flatten().copied().collect();
        let coverage = known.len() as f64 / heights.len() as f64;
        let relief_m =
            (known.iter().map(|h| h * h).sum::<f64>() / known.len().max(1) as f64).sqrt();
        let limit_m = known.iter().fold(0.0_f64, |m, h| m.max(h.abs())) + 1e-4;
        Some(Self {
            plane: *plane,
            centre_px,
            step,
            size,
            heights_m: filled(&heights, size),
            limit_m,
            relief_m,
            coverage,
        })
    }

    /// Height at a pixel of the near image; beyond the map that of its edge, which lines of sight
    /// pass only well above the surface.
    fn height(&self, pixel: &Vector2<f64>) -> f64 {
        let place = |k: usize| {
            let x = (pixel[k] - self.centre_px[k]) / self.step[k] + (self.size[k] / 2) as f64;
            let x = x.clamp(0.0, self.size[k] as f64 - 1.0);
            let i = (x as usize).min(self.size[k] - 2);
            (i, x - i as f64)
        };
        let ((i, fu), (j, fv)) = (place(0), place(1));
        let at = |i: usize, j: usize| self.heights_m[j * self.size[0] + i];
        let top = at(i, j) * (1.0 - fu) + at(i + 1, j) * fu;
        let bottom = at(i, j + 1) * (1.0 - fu) + at(i + 1, j + 1) * fu;
        top * (1.0 - fv) + bottom * fv
    }

    /// Where the line of sight from `eye` through `on_plane` (a point of the plane) first meets
    /// the map: the near pixel and the point. Seen from the eye the line comes down to the map, so
    /// it is followed from above.
    fn meet(
        &self,
        eye: &Vector3<f64>,
        on_plane: &Vector3<f64>,
        near: &Camera,
    ) -> Option<(Vector2<f64>, Vector3<f64>)> {
        const STEPS: usize = 14;
        let along = on_plane - eye;
        let drop = self.plane.normal.dot(&along);
        if !(drop < 0.0) {
            return None;
        }
        let at = |h: f64| on_plane + along * (h / drop);
        let above = |h: f64| -> Option<(f64, Vector2<f64>, Vector3<f64>)> {
            let point = at(h);
            let pixel = near.project(&point).ok()?;
            Some((h - self.height(&pixel), pixel, point))
        };
        let mut high = self.limit_m;
        let mut over = above(high)?.0;
        for k in 1..=STEPS {
            let low = self.limit_m * (1.0 - 2.0 * k as f64 / STEPS as f64);
            let under = above(low)?.0;
            if under <= 0.0 {
                // two steps of false position close the bracket
                let (mut a, mut fa, mut b, mut fb) = (high, over, low, under);
                for _ in 0..2 {
                    let middle = a - fa * (b - a) / (fb - fa);
                    let value = above(middle)?.0;
                    if value > 0.0 {
                        (a, fa) = (middle, value);
                    } else {
                        (b, fb) = (middle, value);
                    }
                    if fa == fb {
                        break;
                    }
                }
                let best = if fa == fb {
                    b
                } else {
                    a - fa * (b - a) / (fb - fa)
                };
                let (_, pixel, point) = above(best)?;
                return Some((pixel, point));
            }
            (high, over) = (low, under);
        }
        None
    }
}

/// Unknown heights become the mean of their known neighbours, again and again.
fn filled(heights: &[Option<f64>], size: [usize; 2]) -> Vec<f64> {
    let mut now = heights.to_vec();
    for _ in 0..size[0].max(size[1]) {
        if now.iter().all(Option::is_some) {
            break;
        }
        let before = now.clone();
        for j in 0..size[1] {
            for i in 0..size[0] {
                if before[j * size[0] + i].is_some() {
                    continue;
                }
                let (mut sum, mut n) = (0.0, 0);
                for y in j.saturating_sub(1)..=(j + 1).min(size[1] - 1) {
                    for x in i.saturating_sub(1)..=(i + 1).min(size[0] - 1) {
                        if let Some(h) = before[y * size[0] + x] {
                            sum += h;
                            n += 1;
                        }
                    }
                }
                if n > 0 {
                    now[j * size[0] + i] = Some(sum / f64::from(n));
                }
            }
        }
    }
    now.into_iter().map(|h| h.unwrap_or(0.0)).collect()
}

/// Meets the first designated ray with the map of the present view, about the tracked target.
///
/// # Errors
/// [`TrackError`]: too near to the first range for a gain, too little of the map seen, the picture
/// does not agree with the first image.
pub fn first_ray(
    tracker: &Tracker,
    view: &View,
    rules: &FirstRayRules,
) -> Result<FirstRayFix, TrackError> {
    let (pixel_px, surface) = tracker.target();
    let first = tracker.first();
    let ratio = first.range_m / surface.range_m;
    if !(ratio >= rules.min_range_ratio) {
        return Err(TrackError::BadInput {
            what: "the ratio of first to present range".into(),
            found: format!("{ratio:.2}"),
            expected: format!("at least {}", rules.min_range_ratio),
        });
    }
    let near = &view.cameras.left;
    // the tracked target is where the first template's middle is believed to be
    let warp = first
        .warp
        .turned_to(near, pixel_px)
        .and_then(|(warp, _)| warp.onto(near, &surface.plane))
        .ok_or(TrackError::NotVisible)?;
    let half = HalfSize {
        u: rules.half_px,
        v: rules.half_px,
    };
    let footprint = warp.jacobian(near).ok_or(TrackError::NotVisible)?;
    let reach = rules.half_px as f64 + 1.5 + rules.max_shift_px;
    let extent = |k: usize| footprint.row(k).abs().sum() * reach * 1.15 + 8.0;
    let map = NearMap::measure(
        view,
        &surface.plane,
        *pixel_px,
        Vector2::new(extent(0), extent(1)),
        rules,
    )
    .ok_or(TrackError::NotVisible)?;
    if !(map.coverage >= rules.min_coverage) {
        return Err(TrackError::BadInput {
            what: "the measured part of the near map".into(),
            found: format!("{:.2}", map.coverage),
            expected: format!("at least {}", rules.min_coverage),
        });
    }
    let eye =
        first.anchor_from_rover.inverse() * Point3::from(*first.view.cameras.left.model.cahv()[0]);
    let scene = Scene {
        view,
        map: &map,
        warp: &warp,
        eye: eye.coords,
        footprint,
    };
    let template = Template::cut(&first.view.left, &first.pixel_px, half)?;
    let mut align = tracker.rules().align;
    align.max_shift_px = rules.max_shift_px;
    let grown = half.grown(1);
    let aligned: Aligned = template.align(Freedom::Affine, &align, |shift, turn| {
        scene.patch(grown, shift, turn)
    })?;
    if !(aligned.score >= rules.min_score) {
        return Err(TrackError::LowScore {
            score: aligned.score,
            limit: rules.min_score,
            columns: half.columns(),
            rows: half.rows(),
        });
    }
    let met = |d: &Vector2<f64>| scene.meet(d).ok_or(TrackError::NotVisible);
    let (pixel_px, point) = met(&aligned.shift)?;
    let sigma = |k: usize| aligned.covariance_px2[(k, k)].max(0.0).sqrt();
    let step = |d: Vector2<f64>| -> Result<f64, TrackError> {
        Ok((met(&(aligned.shift + d))?.1 - met(&(aligned.shift - d))?.1).norm() / 2.0)
    };
    let sigma_m = (step(Vector2::new(0.5, 0.0))? * 2.0 * sigma(0))
        .max(step(Vector2::new(0.0, 0.5))? * 2.0 * sigma(1));
    Ok(FirstRayFix {
        pixel_px,
        point,
        score: aligned.score,
        shift_px: aligned.shift,
        sigma_m,
        relief_m: map.relief_m,
        coverage: map.coverage,
    })
}

/// The near map as the first camera sees it.
struct Scene<'a> {
    view: &'a View,
    map: &'a NearMap,
    warp: &'a PlaneWarp,
    eye: Vector3<f64>,
    footprint: Matrix2<f64>,
}

impl Scene<'_> {
    /// Near pixel and point seen at template offset `d`.
    fn meet(&self, d: &Vector2<f64>) -> Option<(Vector2<f64>, Vector3<f64>)> {
        let on_plane = self.warp.point(d)?;
        self.map.meet(&self.eye, &on_plane, &self.view.cameras.left)
    }

    /// The picture over a window: every pixel the mean of what its footprint shows.
    fn patch(&self, half: HalfSize, shift: &Vector2<f64>, turn: &Matrix2<f64>) -> Option<Patch> {
        /// Most sub-samples per first pixel and direction.
        const MOST: f64 = 12.0;
        // every second near pixel is enough: the lens joins them
        let count = |k: usize| {
            (self.footprint.column(k).norm() / 1.5)
                .ceil()
                .clamp(1.0, MOST)
        };
        let (nu, nv) = (count(0), count(1));
        let (hu, hv) = (half.u as i64, half.v as i64);
        let mut values = Vec::with_capacity(half.columns() * half.rows());
        for v in -hv..=hv {
            for u in -hu..=hu {
                let (mut sum, mut n) = (0.0, 0.0);
                for j in 0..nv as usize {
                    for i in 0..nu as usize {
                        let part =
                            Vector2::new((i as f64 + 0.5) / nu - 0.5, (j as f64 + 0.5) / nv - 0.5);
                        let d = shift + turn * (Vector2::new(u as f64, v as f64) + part);
                        if let Some((q, _)) = self.meet(&d)
                            && let Some(value) = self.view.left.value(q.x, q.y)
                        {
                            sum += f64::from(value);
                            n += 1.0;
                        }
                    }
                }
                if n < 0.5 * nu * nv {
                    return None;
                }
                values.push(sum / n);
            }
        }
        Some(Patch { half, values })
    }
}
