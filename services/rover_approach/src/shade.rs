//! What the rover itself keeps from its target: light and view.
//!
//! A template that a moving shadow edge crosses is lost, and where the rover itself casts the edge
//! it moves with every metre driven. The same goes for a target that the rover's own body hides
//! from the mast. So no base pose is chosen from which either happens.

use nalgebra::{Point3, Vector3};
use rover_robot::{Capsule, Robot};

/// What of the rover casts shadows, with the arm stowed.
#[derive(Clone, Debug)]
pub struct Shade {
    /// Ends (rover frame, m) and radius, m.
    capsules: Vec<(Vector3<f64>, Vector3<f64>, f64)>,
}

impl Shade {
    /// The body, and the arm at `joints_rad`. Joint angles that are none for this arm leave it
    /// out.
    #[must_use]
    pub fn of(robot: &Robot, joints_rad: &[f64]) -> Self {
        let ends = |c: &Capsule| (Vector3::from(c.from_m), Vector3::from(c.to_m), c.radius_m);
        let mut capsules: Vec<_> = robot.description().body.iter().map(ends).collect();
        if let Ok(frames) = robot.arm.link_poses(joints_rad) {
            for (frame, joint) in frames.iter().skip(1).zip(&robot.description().arm.joints) {
                let rover_from_link = robot.rover_from_arm_base.isometry * frame;
                capsules.extend(joint.shape.iter().map(|c| {
                    let (a, b, radius) = ends(c);
                    let place = |p: Vector3<f64>| (rover_from_link * Point3::from(p)).coords;
                    (place(a), place(b), radius)
                }));
            }
        }
        Self { capsules }
    }

    /// Whether the rover comes within `margin_m` of the line of sight from a camera at `eye_m` to
    /// `point_m`, rover frame. What carries the camera is left out.
    #[must_use]
    pub fn hides(&self, point_m: &Vector3<f64>, eye_m: &Vector3<f64>, margin_m: f64) -> bool {
        /// Parts so near to the camera carry it, m.
        const CARRIER_M: f64 = 0.15;
        let Some(along) = (eye_m - point_m).try_normalize(1e-9) else {
            return false;
        };
        self.capsules.iter().any(|(a, b, radius)| {
            point_to_segment(eye_m, a, b) > radius + CARRIER_M
                && ray_to_segment(point_m, &along, a, b) < radius + margin_m
        })
    }

    /// Whether a point lies within `margin_m` of a part of the rover, rover frame.
    #[must_use]
    pub fn touches(&self, point_m: &Vector3<f64>, margin_m: f64) -> bool {
        self.capsules
            .iter()
            .any(|(a, b, radius)| point_to_segment(point_m, a, b) < radius + margin_m)
    }

    /// Whether the sun's ray to `point_m` passes within `margin_m` of the rover. Point and `sun`
    /// (unit, towards the sun) in the rover frame.
    #[must_use]
    pub fn covers(&self, point_m: &Vector3<f64>, sun: &Vector3<f64>, margin_m: f64) -> bool {
        self.capsules
            .iter()
            .any(|(a, b, radius)| ray_to_segment(point_m, sun, a, b) < radius + margin_m)
    }
}

/// Distance between a point and a segment, m.
pub(crate) fn point_to_segment(point: &Vector3<f64>, a: &Vector3<f64>, b: &Vector3<f64>) -> f64 {
    let ab = b - a;
    let s = (point - a).dot(&ab) / ab.norm_squared().max(1e-12);
    (point - a - ab * s.clamp(0.0, 1.0)).norm()
}

/// Distance between a ray (unit direction) and a segment, m.
fn ray_to_segment(
    origin: &Vector3<f64>,
    along: &Vector3<f64>,
    a: &Vector3<f64>,
    b: &Vector3<f64>,
) -> f64 {
    let ab = b - a;
    let from_a = origin - a;
    let (length2, cosine) = (ab.norm_squared(), along.dot(&ab));
    let to_ray = |s: f64| {
        let place = a + ab * s;
        let t = (place - origin).dot(along).max(0.0);
        (place - origin - along * t).norm()
    };
    // the nearest place of the segment to the whole line, and where the ray begins
    let across = length2 - cosine * cosine;
    let free = if across > 1e-12 {
        (from_a.dot(&ab) - from_a.dot(along) * cosine) / across
    } else {
        0.0
    };
    let at_origin = if length2 > 1e-12 {
        from_a.dot(&ab) / length2
    } else {
        0.0
    };
    [free, at_origin, 0.0, 1.0]
        .map(|s| to_ray(s.clamp(0.0, 1.0)))
        .into_iter()
        .fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_distance_is_that_of_a_fine_search() {
        let v = Vector3::new;
        let cases = [
            (
                v(0.0, 0.0, 0.0),
                v(0.0, 0.6, 0.8),
                v(0.3, 1.0, 1.0),
                v(-0.4, 0.2, 2.0),
            ),
            (
                v(1.0, 0.0, 0.0),
                v(0.0, 0.0, 1.0),
                v(0.0, 0.0, -1.0),
                v(0.5, 0.1, -0.2),
            ),
            (
                v(0.2, 0.1, 0.0),
                v(1.0, 0.0, 0.0),
                v(0.0, 0.3, 0.1),
                v(3.0, 0.3, 0.1),
            ),
            (
                v(0.0, 0.0, 0.0),
                v(0.0, 0.0, 1.0),
                v(0.1, 0.0, 1.0),
                v(0.1, 0.0, 1.0),
            ),
        ];
        for (origin, along, a, b) in cases {
            let mut least = f64::INFINITY;
            for i in 0..=400 {
                let place = a + (b - a) * (f64::from(i) / 400.0);
                for k in 0..=4000 {
                    let at = origin + along * (f64::from(k) * 1e-3);
                    least = least.min((place - at).norm());
                }
            }
            let found = ray_to_segment(&origin, &along, &a, &b);
            assert!((found - least).abs() < 2e-3, "{found} {least}");
        }
    }

    #[test]
    fn the_camera_bar_hides_what_lies_below_it_and_the_mast_hides_nothing_from_its_own_camera() {
        let text = include_str!("../../../scenarios/robots/rocky8.toml");
        let robot = Robot::parse(text, "rocky8.toml").unwrap();
        let shade = Shade::of(&robot, robot.posture("stow").unwrap());
        let eye = Vector3::new(0.35, 0.1, 1.34);
        let ahead = |x: f64| Vector3::new(x, 0.0, 0.0);
        // the line through the bar at x = 0.43, z = 0.68
        assert!(shade.hides(&ahead(0.51), &eye, 0.0));
        assert!(!shade.hides(&ahead(1.2), &eye, 0.05));
    }

    #[test]
    fn the_mast_shades_what_lies_behind_it_as_seen_from_the_sun() {
        let text = include_str!("../../../scenarios/robots/rocky8.toml");
        let robot = Robot::parse(text, "rocky8.toml").unwrap();
        let shade = Shade::of(&robot, robot.posture("stow").unwrap());
        let sun = Vector3::new(-1.0, 0.0, 1.0).normalize();
        // the shadow of the mast at a height of 1 m falls 1 m ahead of it
        let shaded = Vector3::new(1.3, 0.0, 0.0);
        assert!(shade.covers(&shaded, &sun, 0.0));
        assert!(!shade.covers(&Vector3::new(1.3, 0.5, 0.0), &sun, 0.05));
        assert!(!shade.covers(&shaded, &-Vector3::x(), 0.05));
    }
}
