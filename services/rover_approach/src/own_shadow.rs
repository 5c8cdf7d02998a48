//! The rover's own shadow in its pictures, as its shape and the sun predict it.
//!
//! The shadow goes with the rover, so a template compared over its edge compares two lights. Of a
//! template only those pixels are compared that lie on the same side of the edge as most do, in
//! both pictures, and not near it.

use crate::error::TrackError;
use crate::shade::Shade;
use nalgebra::Vector3;
use std::sync::Arc;

/// How far on both sides of its predicted place the edge may lie, m: believed mounts, attitude,
/// the surface that it falls on, half-shadow.
const EDGE_M: f64 = 0.03;
/// Least part of a template's weight that must be left.
const LEAST_PART: f64 = 0.4;

/// Where the rover's shadow falls, in the rover frame of one view.
#[derive(Clone, Debug)]
pub struct OwnShadow {
    shade: Arc<Shade>,
    /// Unit vector towards the sun, rover frame.
    sun: Vector3<f64>,
}

/// What light a point gets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Light {
    Sun,
    Shadow,
    Edge,
}

impl OwnShadow {
    /// The shadow of `shade` under a sun in direction `sun` (unit, rover frame).
    #[must_use]
    pub fn new(shade: Arc<Shade>, sun: Vector3<f64>) -> Self {
        Self { shade, sun }
    }

    /// Whether a point (rover frame, m) lies on the shadow's edge, as well as that is known.
    #[must_use]
    pub fn has_edge_at(&self, point_m: &Vector3<f64>) -> bool {
        self.light(point_m) == Light::Edge
    }

    fn light(&self, point_m: &Vector3<f64>) -> Light {
        if self.shade.covers(point_m, &self.sun, -EDGE_M) {
            Light::Shadow
        } else if self.shade.covers(point_m, &self.sun, EDGE_M) {
            Light::Edge
        } else {
            Light::Sun
        }
    }
}

/// Which pixels of a template are lit alike in two views; none if all are. `places` gives each
/// pixel's point (m) in the rover frame of the first and of the second view, or nothing where it
/// has none; `weights` sum to one.
///
/// # Errors
/// [`TrackError::OwnShadow`] if too few are left to compare.
pub fn lit_alike(
    shadows: [Option<&OwnShadow>; 2],
    places: impl Iterator<Item = Option<[Vector3<f64>; 2]>>,
    weights: &[f64],
) -> Result<Option<Vec<bool>>, TrackError> {
    if shadows.iter().all(Option::is_none) {
        return Ok(None);
    }
    let light = |k: usize, point: &Vector3<f64>| shadows[k].map_or(Light::Sun, |s| s.light(point));
    let lights: Vec<Option<[Light; 2]>> = places
        .map(|place| place.map(|[a, b]| [light(0, &a), light(1, &b)]))
        .collect();
    if lights.iter().all(|l| *l == Some([Light::Sun; 2])) {
        return Ok(None);
    }
    let sides = [Light::Sun, Light::Shadow];
    let (kept, part) = sides
        .iter()
        .flat_map(|a| sides.iter().map(move |b| [*a, *b]))
        .map(|side| {
            let alike = lights.iter().zip(weights);
            let part: f64 = alike
                .filter(|(l, _)| **l == Some(side))
                .map(|(_, w)| w)
                .sum();
            (side, part)
        })
        .fold(([Light::Edge; 2], 0.0), |best, next| {
            if next.1 > best.1 { next } else { best }
        });
    if part < LEAST_PART {
        return Err(TrackError::OwnShadow {
            part,
            limit: LEAST_PART,
        });
    }
    Ok(Some(lights.iter().map(|l| *l == Some(kept)).collect()))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use rover_robot::Robot;

    const ROCKY: &str = include_str!("../../../scenarios/robots/rocky8.toml");

    /// The Rocky 8 under a sun straight above, and the place on the ground below its body.
    fn shadow() -> (OwnShadow, Vector3<f64>) {
        let robot = Robot::parse(ROCKY, "rocky8").unwrap();
        let stowed = robot.posture("stow").unwrap();
        let body = &robot.description().body[0];
        let middle = (Vector3::from(body.from_m) + Vector3::from(body.to_m)) / 2.0;
        let shade = Arc::new(Shade::of(&robot, stowed));
        let below = Vector3::new(middle.x, middle.y, 0.0);
        (OwnShadow::new(shade, Vector3::z()), below)
    }

    /// A row of points on the ground from `from` along y.
    fn row(from: &Vector3<f64>, n: usize, to_m: f64) -> Vec<Vector3<f64>> {
        (0..n)
            .map(|i| from + Vector3::y() * (to_m * i as f64 / n as f64))
            .collect()
    }

    #[test]
    fn with_the_sun_overhead_the_ground_below_the_body_is_dark_and_beside_it_lit() {
        let (shadow, below) = shadow();
        assert_eq!(shadow.light(&below), Light::Shadow);
        assert_eq!(shadow.light(&Vector3::new(0.0, 3.0, 0.0)), Light::Sun);
        let lights: Vec<Light> = row(&below, 300, 3.0)
            .iter()
            .map(|p| shadow.light(p))
            .collect();
        assert!(lights.contains(&Light::Edge));
    }

    #[test]
    fn pixels_across_the_edge_are_left_out_and_a_template_mostly_on_it_is_refused() {
        let (shadow, below) = shadow();
        let still = |points: Vec<Vector3<f64>>| {
            let weights = vec![1.0 / points.len() as f64; points.len()];
            let places = points.into_iter().map(|p| Some([p, p]));
            lit_alike([Some(&shadow), Some(&shadow)], places, &weights)
        };
        // from the outside inwards, the first place that is not lit
        let edge = row(&below, 3000, 3.0)
            .into_iter()
            .rev()
            .find(|p| shadow.light(p) != Light::Sun)
            .unwrap();
        let mostly_lit = row(&below, 500, 5.0 * (edge.y - below.y));
        let kept = still(mostly_lit.clone()).unwrap().unwrap();
        for (point, kept) in mostly_lit.iter().zip(kept) {
            assert_eq!(kept, shadow.light(point) == Light::Sun, "{point}");
        }
        let on_it = vec![edge; 9];
        assert!(matches!(still(on_it), Err(TrackError::OwnShadow { .. })));
        let beyond = vec![Vector3::new(0.0, 9.0, 0.0); 9];
        assert_eq!(still(beyond).unwrap(), None);
    }

    #[test]
    fn what_was_lit_and_now_is_dark_is_compared_with_its_like() {
        let (shadow, dark) = shadow();
        let lit = Vector3::new(0.0, 9.0, 0.0);
        let places = [[lit, dark], [lit, dark], [lit, dark], [lit, lit]];
        let kept = lit_alike(
            [Some(&shadow), Some(&shadow)],
            places.into_iter().map(Some),
            &[0.25; 4],
        );
        assert_eq!(kept.unwrap().unwrap(), [true, true, true, false]);
    }
}
