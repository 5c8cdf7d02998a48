//! What the rover may stand on: a grid of ground heights from stereo, and how the wheels would
//! rest on it.

use nalgebra::{Matrix3, Vector2, Vector3};
use rover_robot::MobilityDescription;
use std::collections::BTreeMap;

/// How the ground is judged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GroundRules {
    /// Edge of a cell, m.
    pub cell_m: f64,
    /// Least points of a known cell.
    pub min_points: usize,
    /// Height that an obstacle may lack to the belly, m.
    pub belly_margin_m: f64,
    /// Distance of the body's outline from an obstacle, m.
    pub side_margin_m: f64,
}

impl Default for GroundRules {
    fn default() -> Self {
        Self {
            cell_m: 0.08,
            min_points: 1,
            belly_margin_m: 0.04,
            side_margin_m: 0.05,
        }
    }
}

#[derive(Clone, Copy, Debug, Default)]
struct Cell {
    sum_m: f64,
    high_m: f64,
    low_m: f64,
    points_n: usize,
}

/// Ground heights in the rover frame of one stop. Cells that nothing was seen in are unknown; they
/// count as the plane of what is known about them.
#[derive(Clone, Debug)]
pub struct GroundMap {
    rules: GroundRules,
    cells: BTreeMap<[i64; 2], Cell>,
}

/// A pose of the rover on the ground: origin and heading in the map's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlanarPose {
    /// Ahead, m.
    pub x_m: f64,
    /// To the left, m.
    pub y_m: f64,
    /// Heading, rad, positive to the left.
    pub heading_rad: f64,
}

impl PlanarPose {
    /// A point given in the pose's own axes.
    #[must_use]
    pub fn at(&self, x_m: f64, y_m: f64) -> Vector2<f64> {
        let (s, c) = self.heading_rad.sin_cos();
        Vector2::new(self.x_m + c * x_m - s * y_m, self.y_m + s * x_m + c * y_m)
    }

    /// A point of the map's frame in the pose's own axes.
    #[must_use]
    pub fn local(&self, p: &Vector2<f64>) -> Vector2<f64> {
        let (s, c) = self.heading_rad.sin_cos();
        let d = p - Vector2::new(self.x_m, self.y_m);
        Vector2::new(c * d.x + s * d.y, -s * d.x + c * d.y)
    }
}

/// How the rover stands at a pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Standing {
    /// Height of the plane under the wheels at the rover's origin, m.
    pub height_m: f64,
    /// Unit normal of that plane, map's frame.
    pub normal: Vector3<f64>,
    /// Its slope, rad.
    pub slope_rad: f64,
    /// Largest distance of a wheel's ground from it, m.
    pub unevenness_m: f64,
    /// Least height between the belly and what lies under it, m.
    pub belly_m: f64,
    /// Wheels whose ground was seen.
    pub wheels_seen_n: u32,
}

/// Why the rover must not stand somewhere.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Hazard {
    /// Too steep.
    #[error("the slope is {:.1} deg, limit {:.1} deg", .found_rad.to_degrees(), .limit_rad.to_degrees())]
    Slope {
        /// Found, rad.
        found_rad: f64,
        /// Limit, rad.
        limit_rad: f64,
    },
    /// A wheel would stand on or against something.
    #[error("a wheel meets a step of {found_m:.3} m, limit {limit_m:.3} m")]
    Step {
        /// Found, m.
        found_m: f64,
        /// Limit, m.
        limit_m: f64,
    },
    /// Something is higher than the belly.
    #[error("an obstacle {found_m:.3} m high under or beside the body, limit {limit_m:.3} m")]
    Obstacle {
        /// Height over the wheels' plane, m.
        found_m: f64,
        /// Limit, m.
        limit_m: f64,
    },
}

impl Hazard {
    /// Stable name.
    #[must_use]
    pub fn name(&self) -> &'static str {
        match self {
            Self::Slope { .. } => "slope",
            Self::Step { .. } => "step",
            Self::Obstacle { .. } => "obstacle",
        }
    }
}

impl GroundMap {
    /// A map of points, rover frame (gravity upright), m. Points that are not finite are left out,
    /// and so is one alone above its neighbourhood: a false match.
    #[must_use]
    pub fn from_points<'a>(
        points: impl IntoIterator<Item = &'a Vector3<f64>>,
        rules: GroundRules,
    ) -> Self {
        let mut cells: BTreeMap<[i64; 2], Cell> = BTreeMap::new();
        for p in points {
            if !p.iter().all(|x| x.is_finite() && x.abs() < 1e4) {
                continue;
            }
            let cell = cells
                .entry([0, 1].map(|k| (p[k] / rules.cell_m).floor() as i64))
                .or_insert(Cell {
                    sum_m: 0.0,
                    high_m: f64::NEG_INFINITY,
                    low_m: f64::INFINITY,
                    points_n: 0,
                });
            cell.sum_m += p.z;
            cell.high_m = cell.high_m.max(p.z);
            cell.low_m = cell.low_m.min(p.z);
            cell.points_n += 1;
        }
        cells.retain(|_, c| c.points_n >= rules.min_points);
        Self { rules, cells }
    }

    /// Without what lies beside a rover that stands at the map's origin, no nearer than its sides: it
    /// came there without meeting it, and goes on or back along it as well.
    #[must_use]
    pub fn passed(mut self, mobility: &MobilityDescription) -> Self {
        let edge = self.rules.cell_m;
        let [half_x, half_y] = mobility.footprint_half_m;
        let widest = half_y + self.rules.side_margin_m + edge;
        self.cells.retain(|&[i, j], _| {
            let [x, y] = [i, j].map(|k| ((k as f64 + 0.5) * edge).abs());
            !(x <= half_x && (half_y - 0.5 * edge..=widest).contains(&y))
        });
        self
    }

    /// Whether there is hardly a place of a strip that is far from known ground: from `ahead_m[0]` to
    /// `ahead_m[1]` before `pose`, and so far to either side.
    #[must_use]
    pub fn knows(&self, pose: &PlanarPose, ahead_m: [f64; 2], aside_m: f64) -> bool {
        /// Distance between the places looked at, and from there to a known cell, m.
        const STEP_M: f64 = 0.15;
        /// Least part of the places that are known.
        const LEAST: f64 = 0.95;
        let count = |length: f64| (length / STEP_M).ceil().max(1.0) as i32;
        let (along, across) = (count(ahead_m[1] - ahead_m[0]), count(aside_m));
        let mut known = 0;
        for i in 0..=along {
            for j in -across..=across {
                let x = ahead_m[0] + STEP_M * f64::from(i);
                let place = pose.at(x, STEP_M * f64::from(j));
                known += i32::from(self.mean_m(&place, STEP_M).is_some());
            }
        }
        f64::from(known) >= LEAST * f64::from((along + 1) * (2 * across + 1))
    }

    /// Known cells.
    #[must_use]
    pub fn cells_n(&self) -> usize {
        self.cells.len()
    }

    /// Greatest height of the cell at `p`, m, if it is known.
    #[must_use]
    pub fn height_m(&self, p: &Vector2<f64>) -> Option<f64> {
        let key = [0, 1].map(|k| (p[k] / self.rules.cell_m).floor() as i64);
        self.cells.get(&key).map(|c| c.high_m)
    }

    /// Mean height of the known cells within `radius_m` of `p`.
    fn mean_m(&self, p: &Vector2<f64>, radius_m: f64) -> Option<f64> {
        let (mut sum, mut n) = (0.0, 0.0);
        self.around(p, radius_m, |_, cell| {
            sum += cell.sum_m / cell.points_n as f64;
            n += 1.0;
        });
        (n > 0.0).then(|| sum / n)
    }

    fn around(&self, p: &Vector2<f64>, radius_m: f64, mut see: impl FnMut(Vector2<f64>, &Cell)) {
        let edge = self.rules.cell_m;
        let range = |k: usize| {
            let low = ((p[k] - radius_m) / edge).floor() as i64;
            let high = ((p[k] + radius_m) / edge).floor() as i64;
            low..=high
        };
        for i in range(0) {
            for j in range(1) {
                let centre = Vector2::new(i as f64 + 0.5, j as f64 + 0.5) * edge;
                if (centre - p).norm() <= radius_m + 0.5 * edge
                    && let Some(cell) = self.cells.get(&[i, j])
                {
                    see(centre, cell);
                }
            }
        }
    }

    /// How the rover would stand at `pose`.
    ///
    /// # Errors
    /// [`Hazard`]: the ground is too steep, a wheel meets a step, something is higher than the
    /// belly under the body or beside it.
    pub fn standing(
        &self,
        pose: &PlanarPose,
        mobility: &MobilityDescription,
        max_slope_rad: f64,
    ) -> Result<Standing, Hazard> {
        let wheel = mobility.wheel_radius_m;
        let contacts: Vec<(Vector2<f64>, f64)> = mobility
            .axles_x_m
            .iter()
            .flat_map(|&x| [0.5, -0.5].map(|side| pose.at(x, side * mobility.track_m)))
            .filter_map(|p| Some((p, self.mean_m(&p, 0.5 * wheel)?)))
            .collect();
        // what is under the body speaks for wheels on ground that was not seen
        let mut support = contacts.clone();
        if contacts.len() < 4 {
            let centre = Vector2::new(pose.x_m, pose.y_m);
            self.around(&centre, mobility.footprint_half_m[0], |p, cell| {
                support.push((p, cell.sum_m / cell.points_n as f64));
            });
        }
        let (height_m, gradient) = plane_through(&support, pose);
        let over = |p: &Vector2<f64>, z: f64| {
            z - height_m - gradient.dot(&(p - Vector2::new(pose.x_m, pose.y_m)))
        };
        let slope_rad = gradient.norm().atan();
        if !(slope_rad <= max_slope_rad) {
            return Err(Hazard::Slope {
                found_rad: slope_rad,
                limit_rad: max_slope_rad,
            });
        }
        let unevenness_m = contacts
            .iter()
            .fold(0.0_f64, |m, (p, z)| m.max(over(p, *z).abs()));
        let limit_m = mobility.limits.step_m;
        if unevenness_m > 0.5 * limit_m {
            return Err(Hazard::Step {
                found_m: unevenness_m,
                limit_m: 0.5 * limit_m,
            });
        }
        let [half_x, half_y] = mobility
            .footprint_half_m
            .map(|h| h + self.rules.side_margin_m);
        let clear = mobility.limits.clearance_m - self.rules.belly_margin_m;
        let half_track = 0.5 * (mobility.track_m + mobility.wheel_width_m);
        let mut worst: Option<Hazard> = None;
        let mut highest = f64::NEG_INFINITY;
        let centre = Vector2::new(pose.x_m, pose.y_m);
        self.around(&centre, half_x.hypot(half_y), |p, cell| {
            let local = pose.local(&p);
            if local.x.abs() > half_x || local.y.abs() > half_y {
                return;
            }
            let height = over(&p, cell.high_m);
            highest = highest.max(height);
            // wheels run along both sides
            let in_track = (local.y.abs() - 0.5 * mobility.track_m).abs()
                <= half_track - 0.5 * mobility.track_m + self.rules.side_margin_m;
            if in_track && height > limit_m {
                worst = Some(Hazard::Step {
                    found_m: height,
                    limit_m,
                });
            } else if height > clear {
                worst = Some(Hazard::Obstacle {
                    found_m: height,
                    limit_m: clear,
                });
            }
        });
        if let Some(hazard) = worst {
            return Err(hazard);
        }
        Ok(Standing {
            height_m,
            normal: Vector3::new(-gradient.x, -gradient.y, 1.0).normalize(),
            slope_rad,
            unevenness_m,
            belly_m: mobility.limits.clearance_m - highest.max(0.0),
            wheels_seen_n: contacts.len() as u32,
        })
    }
}

/// Height at the pose's origin and gradient of the plane nearest to the points; level through
/// their mean for fewer than three, at height zero for none. A weak pull towards level keeps
/// points on a line from tilting the plane.
fn plane_through(points: &[(Vector2<f64>, f64)], pose: &PlanarPose) -> (f64, Vector2<f64>) {
    let mut normal = Matrix3::from_diagonal(&Vector3::new(1e-9, 1e-3, 1e-3));
    let mut right = Vector3::zeros();
    for (p, z) in points {
        let row = Vector3::new(1.0, p.x - pose.x_m, p.y - pose.y_m);
        normal += row * row.transpose();
        right += row * *z;
    }
    normal
        .try_inverse()
        .map(|n| n * right)
        .map_or((0.0, Vector2::zeros()), |x| (x.x, Vector2::new(x.y, x.z)))
}

#[cfg(test)]
pub(crate) mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use rover_robot::{MobilityLimits, OdometryQuality};

    pub fn mobility() -> MobilityDescription {
        MobilityDescription {
            heartbeat_s: 0.2,
            wheel_radius_m: 0.125,
            wheel_width_m: 0.12,
            track_m: 0.72,
            axles_x_m: [0.4, 0.0, -0.4],
            rocker_pivot_m: [0.0, 0.32],
            bogie_pivot_m: [-0.2, 0.22],
            footprint_half_m: [0.55, 0.44],
            limits: MobilityLimits {
                speed_m_s: 0.1,
                acceleration_m_s2: 0.1,
                turn_rate_rad_s: 0.15,
                curvature_1_m: 0.8,
                steer_rate_rad_s: 0.5,
                slope_rad: 0.35,
                tilt_rad: 0.45,
                step_m: 0.12,
                clearance_m: 0.26,
                slip: 0.6,
            },
            odometry: OdometryQuality {
                along_fraction: 0.03,
                across_fraction: 0.01,
                heading_deg_sqrt_m: 0.5,
                turn_fraction: 0.02,
                tilt_deg: 0.2,
            },
        }
    }

    pub fn ground(height: impl Fn(f64, f64) -> f64) -> GroundMap {
        let points: Vec<Vector3<f64>> = (-60..160)
            .flat_map(|i| (-80..80).map(move |j| (f64::from(i) * 0.04, f64::from(j) * 0.04)))
            .map(|(x, y)| Vector3::new(x, y, height(x, y)))
            .collect();
        GroundMap::from_points(&points, GroundRules::default())
    }

    pub fn at(x_m: f64, y_m: f64, heading_rad: f64) -> PlanarPose {
        PlanarPose {
            x_m,
            y_m,
            heading_rad,
        }
    }

    #[test]
    fn a_strip_is_known_that_points_were_seen_all_over() {
        let seen = |p: &&Vector3<f64>| p.x > 0.4 && p.x < 2.0;
        let points: Vec<Vector3<f64>> = (0..40)
            .flat_map(|i| (0..40).map(move |j| (f64::from(i), f64::from(j))))
            .map(|(i, j)| Vector3::new(0.1 * i, 0.1 * j - 2.0, 0.0))
            .collect();
        let map = GroundMap::from_points(points.iter().filter(seen), GroundRules::default());
        let here = PlanarPose {
            x_m: 0.0,
            y_m: 0.0,
            heading_rad: 0.2,
        };
        assert!(map.knows(&here, [0.6, 1.7], 0.5));
        assert!(!map.knows(&here, [0.6, 3.0], 0.5));
        let away = PlanarPose {
            heading_rad: 2.5,
            ..here
        };
        assert!(!map.knows(&away, [0.6, 1.7], 0.5));
    }

    #[test]
    fn what_the_rover_stands_beside_does_not_keep_it_there() {
        let mobility = mobility();
        let beside = |x: f64, y: f64| {
            let near = (0.1..0.4).contains(&x) && (0.42..0.60).contains(&y);
            if near { 0.3 } else { 0.0 }
        };
        let behind = PlanarPose {
            x_m: -0.3,
            y_m: 0.0,
            heading_rad: 0.0,
        };
        let map = ground(beside);
        assert!(map.standing(&behind, &mobility, 0.3).is_err());
        let map = map.passed(&mobility);
        assert!(map.standing(&behind, &mobility, 0.3).is_ok());
        let ahead = ground(|x, _| if (0.62..0.8).contains(&x) { 0.3 } else { 0.0 });
        let forwards = PlanarPose { x_m: 0.3, ..behind };
        let standing = ahead.passed(&mobility).standing(&forwards, &mobility, 0.3);
        assert!(standing.is_err());
    }

    #[test]
    fn the_rover_stands_on_a_slope_as_the_slope_is() {
        let map = ground(|x, y| 0.1 * x - 0.05 * y + 0.02);
        let s = map.standing(&at(2.0, 0.5, 0.7), &mobility(), 0.35).unwrap();
        let expected = Vector3::new(-0.1, 0.05, 1.0).normalize();
        assert!(s.normal.angle(&expected) < 0.005, "{s:?}");
        assert!((s.height_m - 0.195).abs() < 0.006, "{s:?}");
        assert_eq!(s.wheels_seen_n, 6);
    }

    #[test]
    fn slopes_steps_and_rocks_are_refused_by_name() {
        let steep = ground(|x, _| 0.5 * x);
        let refusal = |map: &GroundMap, pose| map.standing(&pose, &mobility(), 0.35).unwrap_err();
        assert_eq!(refusal(&steep, at(2.0, 0.0, 0.0)).name(), "slope");
        let rock = |cx: f64, cy: f64, h: f64| {
            ground(move |x, y| {
                if f64::hypot(x - cx, y - cy) < 0.1 {
                    h
                } else {
                    0.0
                }
            })
        };
        assert_eq!(
            refusal(&rock(2.0, 0.0, 0.3), at(2.0, 0.0, 0.0)).name(),
            "obstacle"
        );
        assert_eq!(
            refusal(&rock(2.2, 0.36, 0.2), at(2.0, 0.0, 0.0)).name(),
            "step"
        );
        // a stone that fits under the belly, and a rock well beside the rover
        for map in [rock(2.0, 0.0, 0.15), rock(2.0, 0.8, 0.4)] {
            map.standing(&at(2.0, 0.0, 0.0), &mobility(), 0.35).unwrap();
        }
    }

    #[test]
    fn ground_that_was_not_seen_counts_as_level() {
        let map = GroundMap::from_points(&[], GroundRules::default());
        let s = map.standing(&at(0.0, 0.0, 0.0), &mobility(), 0.35).unwrap();
        assert_eq!((s.height_m, s.wheels_seen_n), (0.0, 0));
    }
}
