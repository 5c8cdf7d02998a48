//! The arm as capsules: how near it comes to itself, to the body that carries it, and to the
//! terrain, and how near it may come.
//!
//! Links are capsules fixed to their frames. Links that share a joint are not checked against each
//! other, nor is the first link against the body that it is mounted on. How near two shapes may
//! come follows from the stated quality of the model ([`Margins`]): twice the standard deviation
//! of their distance, to first order, within bounds.

use crate::segment::{Closest, Segment};
use crate::terrain_map::TerrainMap;
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use rover_kinematics::ArmError;
use rover_robot::{Robot, TOOL_REACH_M};
use std::sync::Arc;

/// Smallest and largest required distance, m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MarginBounds {
    /// At least this, however good the model.
    pub low_m: f64,
    /// At most this, however bad the model.
    pub high_m: f64,
}

/// How much distance to keep from obstacles.
///
/// The believed arm is wrong by its calibration errors: with 1 deg and 2.5 mm the tip is off by 2
/// to 4 cm. The required distance is [`Self::sigmas`] standard deviations of the error of the
/// distance between the two nearest points, as the Denavit-Hartenberg rows between them (and the
/// camera mount, for terrain, which the cameras saw) contribute to it, within bounds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Margins {
    /// Standard deviations of the distance.
    pub sigmas: f64,
    /// Between links of the arm.
    pub links: MarginBounds,
    /// Between a link and the robot's body.
    pub body: MarginBounds,
    /// Between a link, but the last, and the terrain.
    pub terrain: MarginBounds,
    /// Between the last link and the terrain: bounded so that the instrument can stand 3 cm
    /// before a surface.
    pub instrument: MarginBounds,
    /// Between the last link and the terrain where the instrument may touch, m: a fixed distance,
    /// kept by all of the link but the tool near its tip.
    pub touching_m: f64,
}

impl Default for Margins {
    fn default() -> Self {
        let bounds = |low_m, high_m| MarginBounds { low_m, high_m };
        Self {
            sigmas: 2.0,
            links: bounds(0.003, 0.01),
            body: bounds(0.005, 0.02),
            terrain: bounds(0.01, 0.05),
            instrument: bounds(0.01, 0.02),
            touching_m: 0.003,
        }
    }
}

/// Two bodies that may collide; indices into the shapes of [`CollisionModel`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pair {
    /// Two shapes of the arm, the one nearer to the base first.
    Links(usize, usize),
    /// A shape of the arm and one of the body.
    Body(usize, usize),
    /// A shape of the arm and the terrain.
    Terrain(usize),
}

/// How near two bodies are.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Proximity {
    /// Which bodies.
    pub pair: Pair,
    /// Distance of their surfaces, m, negative when they overlap.
    pub distance_m: f64,
    /// Distance to be kept, m.
    pub required_m: f64,
    /// Where on the first body's core line, rover frame, m.
    pub at: Vector3<f64>,
}

/// A ball in which the instrument may touch the terrain: while the tip is inside, what lies within
/// [`TOOL_REACH_M`] of it is not checked against the terrain, and the rest of the last link keeps
/// [`Margins::touching_m`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactZone {
    /// Its centre, rover frame, m.
    pub centre: Vector3<f64>,
    /// Its radius, m. The zone holds while the tip is inside.
    pub radius_m: f64,
}

#[derive(Clone, Debug)]
struct Shape {
    /// 1 to n; 0 for the body.
    link: usize,
    /// Link frame; rover frame for the body.
    core: Segment,
    radius_m: f64,
    name: String,
    /// Largest distance of the core line from the axis of joint `m`, m, for `m` up to `link - 1`.
    levers_m: Vec<f64>,
}

/// The robot's shapes and which of them are checked against each other.
#[derive(Clone, Debug)]
pub struct CollisionModel {
    robot: Arc<Robot>,
    margins: Margins,
    shapes: Vec<Shape>,
    body: Vec<Shape>,
    pairs: Vec<Pair>,
    mount_centre: Vector3<f64>,
}

/// The arm in one configuration.
pub(crate) struct Placed {
    /// Pose of each link's frame, base first, rover frame.
    pub rover_from_links: Vec<Isometry3<f64>>,
    /// Core lines of the arm's shapes, rover frame.
    pub cores: Vec<Segment>,
    /// The instrument's tip, rover frame, m.
    pub tip: Vector3<f64>,
}

/// Length of the plunger's capsule behind the tip, m.
const PLUNGER_M: f64 = 0.02;

impl CollisionModel {
    /// The shapes of `robot`.
    pub fn new(robot: Arc<Robot>, margins: Margins) -> Self {
        let description = robot.description();
        let joints = &description.arm.joints;
        let segment = |c: &rover_robot::Capsule| Segment {
            from: c.from_m.into(),
            to: c.to_m.into(),
        };
        let mut shapes = Vec::new();
        for (joint, j) in joints.iter().enumerate() {
            for (i, capsule) in j.shape.iter().enumerate() {
                shapes.push(Shape {
                    link: joint + 1,
                    core: segment(capsule),
                    radius_m: capsule.radius_m,
                    name: format!("link `{}` (shape {i})", j.name),
                    levers_m: Vec::new(),
                });
            }
        }
        let tool = &robot.tool;
        let axis = tool.axis_in_link.into_inner();
        let ball_m = description.tool.switch.ball_radius_m;
        shapes.push(Shape {
            link: joints.len(),
            core: Segment {
                from: tool.tip_in_link - axis * PLUNGER_M.max(2.0 * ball_m),
                to: tool.tip_in_link - axis * ball_m,
            },
            radius_m: ball_m,
            name: "the instrument's plunger".into(),
            levers_m: Vec::new(),
        });
        for shape in &mut shapes {
            shape.levers_m = levers(&robot, shape);
        }
        let body: Vec<_> = (description.body.iter().enumerate())
            .map(|(i, capsule)| Shape {
                link: 0,
                core: segment(capsule),
                radius_m: capsule.radius_m,
                name: format!("body[{i}]"),
                levers_m: Vec::new(),
            })
            .collect();
        let mut pairs = Vec::new();
        for (a, first) in shapes.iter().enumerate() {
            for (b, second) in shapes.iter().enumerate() {
                if first.link + 1 < second.link {
                    pairs.push(Pair::Links(a, b));
                }
            }
            if first.link > 1 {
                pairs.extend((0..body.len()).map(|b| Pair::Body(a, b)));
            }
        }
        let mount_centre = robot.mount_centre();
        Self {
            robot,
            margins,
            shapes,
            body,
            pairs,
            mount_centre,
        }
    }

    /// The robot.
    pub fn robot(&self) -> &Robot {
        &self.robot
    }

    /// The names of two bodies, for messages.
    pub fn names(&self, pair: Pair) -> (String, String) {
        let shape = |i: usize| self.shapes[i].name.clone();
        match pair {
            Pair::Links(a, b) => (shape(a), shape(b)),
            Pair::Body(a, b) => (shape(a), self.body[b].name.clone()),
            Pair::Terrain(a) => (shape(a), "the terrain".into()),
        }
    }

    /// The largest distance that any pair is ever required to keep, m.
    pub(crate) fn largest_margin_m(&self) -> f64 {
        let m = &self.margins;
        [m.links, m.body, m.terrain, m.instrument]
            .iter()
            .map(|b| b.high_m)
            .fold(0.0, f64::max)
    }

    /// Where everything is at joint angles `q` (rad).
    pub(crate) fn place(&self, q: &[f64]) -> Result<Placed, ArmError> {
        let rover_from_base = self.robot.rover_from_arm_base.isometry;
        let rover_from_links: Vec<_> = self
            .robot
            .arm
            .link_poses(q)?
            .iter()
            .map(|pose| rover_from_base * pose)
            .collect();
        let cores = self
            .shapes
            .iter()
            .map(|s| {
                let pose = &rover_from_links[s.link];
                let at = |p: Vector3<f64>| (pose * Point3::from(p)).coords;
                Segment {
                    from: at(s.core.from),
                    to: at(s.core.to),
                }
            })
            .collect();
        let last = &rover_from_links[rover_from_links.len() - 1];
        let tip = (last * Point3::from(self.robot.tool.tip_in_link)).coords;
        Ok(Placed {
            rover_from_links,
            cores,
            tip,
        })
    }

    /// Calls `visit` with every pair: links and body always, the terrain where it is nearer than
    /// `look_m`.
    pub(crate) fn visit(
        &self,
        placed: &Placed,
        terrain: Option<&TerrainMap>,
        zone: Option<&ContactZone>,
        look_m: f64,
        mut visit: impl FnMut(Proximity),
    ) {
        for &pair in &self.pairs {
            let (a, closest, radius_m) = match pair {
                Pair::Links(a, b) => (
                    a,
                    placed.cores[a].closest_to_segment(&placed.cores[b]),
                    self.shapes[b].radius_m,
                ),
                Pair::Body(a, b) => {
                    let body = &self.body[b];
                    (
                        a,
                        placed.cores[a].closest_to_segment(&body.core),
                        body.radius_m,
                    )
                }
                Pair::Terrain(_) => continue,
            };
            visit(self.proximity(pair, placed, &closest, self.shapes[a].radius_m + radius_m));
        }
        let Some(map) = terrain else { return };
        let last = self.robot.arm.joint_count();
        let in_zone = zone.is_some_and(|z| (placed.tip - z.centre).norm() <= z.radius_m);
        for (a, shape) in self.shapes.iter().enumerate() {
            let look_m = look_m + shape.radius_m;
            let core = &placed.cores[a];
            let touches = in_zone && shape.link == last;
            let closest = if touches {
                let parts = core.outside_ball(&placed.tip, TOOL_REACH_M);
                let parts = parts.iter().flatten();
                parts
                    .filter_map(|part| map.closest(part, look_m))
                    .min_by(|a, b| a.distance_m.total_cmp(&b.distance_m))
            } else {
                map.closest(core, look_m)
            };
            let Some(closest) = closest else { continue };
            let mut found = self.proximity(Pair::Terrain(a), placed, &closest, shape.radius_m);
            if touches {
                found.required_m = self.margins.touching_m;
            }
            visit(found);
        }
    }

    fn proximity(&self, pair: Pair, placed: &Placed, closest: &Closest, radii_m: f64) -> Proximity {
        let distance_m = closest.distance_m - radii_m;
        let m = &self.margins;
        let last = self.robot.arm.joint_count();
        let (bounds, link, from, point) = match pair {
            // Errors of the rows between the two links move the outer one against the inner.
            Pair::Links(a, b) => (
                m.links,
                self.shapes[b].link,
                self.shapes[a].link,
                closest.on_second,
            ),
            Pair::Body(a, _) => (m.body, self.shapes[a].link, 0, closest.on_first),
            Pair::Terrain(a) => {
                let link = self.shapes[a].link;
                let bounds = if link == last {
                    m.instrument
                } else {
                    m.terrain
                };
                (bounds, link, 0, closest.on_first)
            }
        };
        let along = closest.on_second - closest.on_first;
        let required_m = if distance_m > bounds.high_m {
            bounds.high_m
        } else if along.norm() > 1e-9 {
            let with_mount = matches!(pair, Pair::Terrain(_));
            let sigma = self.sigma_m(placed, from, link, &point, &along.normalize(), with_mount);
            (m.sigmas * sigma).clamp(bounds.low_m, bounds.high_m)
        } else {
            bounds.high_m
        };
        Proximity {
            pair,
            distance_m,
            required_m,
            at: closest.on_first,
        }
    }

    /// Standard deviation of the position of `point` (on `link`) along `direction`, seen from
    /// link `from`, m: first order in the errors of the rows between them, and of the camera
    /// mount if the point is compared with what the cameras saw.
    fn sigma_m(
        &self,
        placed: &Placed,
        from: usize,
        link: usize,
        point: &Vector3<f64>,
        direction: &Vector3<f64>,
        with_mount: bool,
    ) -> f64 {
        let quality = &self.robot.description().model_quality;
        let (angle, length) = (quality.angle_deg.to_radians(), quality.length_mm * 1e-3);
        let turned = |axis: &Vector3<f64>, origin: &Vector3<f64>| {
            angle * axis.cross(&(point - origin)).dot(direction)
        };
        let mut variance = 0.0;
        for row in from + 1..=link {
            let (before, after) = (
                &placed.rover_from_links[row - 1],
                &placed.rover_from_links[row],
            );
            let (z, x) = (
                before.rotation * Vector3::z(),
                after.rotation * Vector3::x(),
            );
            for part in [
                turned(&z, &before.translation.vector),
                turned(&x, &after.translation.vector),
                length * z.dot(direction),
                length * x.dot(direction),
            ] {
                variance += part * part;
            }
        }
        if with_mount {
            let lever = (point - self.mount_centre).cross(direction).norm();
            variance += (angle * lever).powi(2) + length * length;
        }
        f64::sqrt(variance)
    }

    /// How fast, at most, two bodies approach each other when the joints move by `dq`, m per unit
    /// of that motion.
    pub(crate) fn approach_speed(&self, pair: Pair, dq: &[f64]) -> f64 {
        let (a, from) = match pair {
            Pair::Links(a, b) => (b, self.shapes[a].link),
            Pair::Body(a, _) | Pair::Terrain(a) => (a, 0),
        };
        let levers = &self.shapes[a].levers_m;
        (from..levers.len())
            .map(|joint| dq[joint].abs() * levers[joint])
            .sum()
    }

    /// How far any point of the arm moves, at most, when the joints move by `dq`, m.
    pub(crate) fn displacement_m(&self, dq: &[f64]) -> f64 {
        (0..self.shapes.len())
            .map(|a| self.approach_speed(Pair::Terrain(a), dq))
            .fold(0.0, f64::max)
    }

    /// Distance of a point (rover frame, m) from the arm's surface, m.
    pub(crate) fn distance_to_arm_m(&self, placed: &Placed, point: &Vector3<f64>) -> f64 {
        let spot = Segment {
            from: *point,
            to: *point,
        };
        let arm = self
            .shapes
            .iter()
            .zip(&placed.cores)
            .map(|(s, core)| (core, s.radius_m));
        let body = self.body.iter().map(|s| (&s.core, s.radius_m));
        arm.chain(body)
            .map(|(core, radius_m)| spot.closest_to_segment(core).distance_m - radius_m)
            .fold(f64::INFINITY, f64::min)
    }

    /// The first shape of the arm, its last link excepted, that comes nearer than `margin_m` to a
    /// line of sight (rover frame), with its distance, m.
    pub(crate) fn obstruction(
        &self,
        placed: &Placed,
        sight: &Segment,
        margin_m: f64,
    ) -> Option<(&str, f64)> {
        let last = self.robot.arm.joint_count();
        let links = self
            .shapes
            .iter()
            .zip(&placed.cores)
            .filter(|(s, _)| s.link < last);
        links
            .map(|(s, core)| {
                (
                    s.name.as_str(),
                    core.closest_to_segment(sight).distance_m - s.radius_m,
                )
            })
            .find(|(_, distance_m)| *distance_m < margin_m)
    }
}

/// Largest distance of a shape from the axis of each joint that moves it, over all
/// configurations, m: beyond the joint's own row, which turns about the axis, lengths add up.
fn levers(robot: &Robot, shape: &Shape) -> Vec<f64> {
    let rows = robot.arm.rows();
    let mut levers = vec![0.0; shape.link];
    let Some(own) = shape.link.checked_sub(1) else {
        return levers;
    };
    let row = &rows[own];
    let joint_from_link = Isometry3::translation(row.a_m, 0.0, row.d_m)
        * UnitQuaternion::from_axis_angle(&Vector3::x_axis(), row.alpha_rad);
    let ends =
        [shape.core.from, shape.core.to].map(|end| (joint_from_link * Point3::from(end)).coords);
    levers[own] = ends.iter().map(|p| p.xy().norm()).fold(0.0, f64::max);
    let mut reach = ends.iter().map(|p| p.norm()).fold(0.0, f64::max);
    for joint in (0..own).rev() {
        reach += rows[joint].a_m.hypot(rows[joint].d_m);
        levers[joint] = reach;
    }
    levers
}
