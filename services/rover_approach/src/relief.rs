//! Relief correction: where the designated point itself is, not the mean plane of its window.
//!
//! A template moves with the mean plane of its window. A point that lies above or below that plane
//! is seen, after the rover has moved, beside the place to which the plane carries it. Stereo at
//! the present stop knows the relief; so every point of a grid about the hit is re-projected into
//! the anchor image twice, at its own range and at the plane's, and the hit moves to where the
//! corrected re-projection is the anchor pixel.

use crate::surface::{PlaneRules, SurfacePlane};
use crate::view::View;
use crate::warp::PlaneWarp;
use nalgebra::{Isometry3, Matrix3, Point3, Vector2, Vector3};
use rover_cameras::Camera;
use rover_vision::match_point;

/// How the relief is measured.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReliefRules {
    /// Grid points on each side of the hit.
    pub half_grid: i32,
    /// Their distance, px.
    pub step_px: f64,
    /// Half side of the matching window, px.
    pub half_window_px: u32,
    /// Range searched about the plane's, as a fraction of it.
    pub range_fraction: f64,
    /// Radius within which points decide, px.
    pub radius_px: f64,
    /// Farthest that the hit may move, px.
    pub max_shift_px: f64,
}

impl Default for ReliefRules {
    fn default() -> Self {
        Self {
            half_grid: 5,
            step_px: 2.0,
            half_window_px: 5,
            range_fraction: 0.08,
            radius_px: 6.0,
            max_shift_px: 8.0,
        }
    }
}

/// What is compared: the anchor's camera and its template's warp, in the present rover frame.
#[derive(Clone, Copy, Debug)]
pub struct AnchorGeometry<'a> {
    /// Left camera of the anchor, in its own rover frame.
    pub camera: &'a Camera,
    /// Present rover frame to the anchor's.
    pub anchor_from_rover: &'a Isometry3<f64>,
    /// The template's warp, present rover frame.
    pub warp: &'a PlaneWarp,
}

struct Node {
    offset: Vector2<f64>,
    template: Vector2<f64>,
}

/// The pixel of the present left image that shows the anchor pixel's own surface point; `None` if
/// too little of the relief could be measured or the answer lies out of bounds.
#[must_use]
pub fn corrected_pixel(
    view: &View,
    hit_px: &Vector2<f64>,
    plane: &SurfacePlane,
    anchor: &AnchorGeometry<'_>,
    rules: &ReliefRules,
) -> Option<Vector2<f64>> {
    let nodes = measure(view, hit_px, plane, anchor, rules);
    let mut at = Vector2::<f64>::zeros();
    for _ in 0..3 {
        at = solve(&nodes, &at, rules)?;
        if !(at.norm() <= rules.max_shift_px) {
            return None;
        }
    }
    Some(hit_px + at)
}

fn measure(
    view: &View,
    hit_px: &Vector2<f64>,
    plane: &SurfacePlane,
    anchor: &AnchorGeometry<'_>,
    rules: &ReliefRules,
) -> Vec<Node> {
    let camera = &view.cameras.left;
    let matching = PlaneRules {
        half_window_px: rules.half_window_px,
        ..PlaneRules::default()
    };
    let in_anchor = |x: &Vector3<f64>| {
        let x = anchor.anchor_from_rover * Point3::from(*x);
        anchor.camera.project(&x.coords).ok()
    };
    let node = |i: i32, j: i32| -> Option<Node> {
        let offset = Vector2::new(f64::from(i), f64::from(j)) * rules.step_px;
        let pixel = hit_px + offset;
        let ray = camera.ray(&pixel).ok()?;
        let facing = plane.normal.dot(ray.direction.as_ref());
        let range = plane.normal.dot(&(plane.point - ray.origin)) / facing;
        if !(range.is_finite() && range > 0.0) {
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
        let found = match_point(&view.left, &view.right, &view.cameras, &pixel, &rules).ok()?;
        let shift = in_anchor(&ray.at(found.range_m))? - in_anchor(&ray.at(range))?;
        Some(Node {
            offset,
            template: anchor.warp.offset(camera, &pixel)? + shift,
        })
    };
    let n = rules.half_grid;
    (-n..=n)
        .flat_map(|j| (-n..=n).map(move |i| (i, j)))
        .filter_map(|(i, j)| node(i, j))
        .collect()
}

/// Fits `template = a + b offset` to the nodes near `at` and solves for template zero.
fn solve(nodes: &[Node], at: &Vector2<f64>, rules: &ReliefRules) -> Option<Vector2<f64>> {
    const MIN_NODES: usize = 8;
    let mut normal = Matrix3::zeros();
    let mut right = [Vector3::zeros(), Vector3::zeros()];
    let mut used = 0;
    for node in nodes {
        let r = (node.offset - at).norm() / rules.radius_px;
        if r > 1.0 {
            continue;
        }
        used += 1;
        let weight = (1.0 - r * r).powi(2);
        let row = Vector3::new(1.0, node.offset.x, node.offset.y);
        normal += row * row.transpose() * weight;
        for (k, right) in right.iter_mut().enumerate() {
            *right += row * (weight * node.template[k]);
        }
    }
    if used < MIN_NODES {
        return None;
    }
    let inverse = normal.try_inverse()?;
    let (x, y) = (inverse * right[0], inverse * right[1]);
    let slope = nalgebra::Matrix2::new(x[1], x[2], y[1], y[2]);
    let found = -(slope.try_inverse()? * Vector2::new(x[0], y[0]));
    found.iter().all(|x| x.is_finite()).then_some(found)
}
