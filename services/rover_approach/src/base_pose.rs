//! The base pose from which the arm can serve the target best.
//!
//! Candidates lie on a fan about the target. Each is stood on the measured ground, which tilts the
//! rover; there the target must be reachable along its normal within the joint limits, seen by both
//! body cameras together with the fiducial, and the wheels clear. What is left is ranked by how
//! freely the tip moves, how far the joints are from their limits, and how much lies between the
//! wheels and the limits of the ground.

mod room;

use crate::drive::aim_of;
use crate::obstacles::{GroundMap, PlanarPose, Standing};
use crate::shade::Shade;
use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, UnitQuaternion, Vector2, Vector3};
use room::room_m;
use rover_cameras::StereoPair;
use rover_kinematics::{AxisGoal, solve_axis};
use rover_robot::{CameraMount, CameraPairDescription, MobilityDescription, Robot};
use std::collections::BTreeMap;

/// How base poses are chosen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BaseRules {
    /// Nearest and farthest distance of the target ahead of the rover's origin, m.
    pub ahead_m: [f64; 2],
    /// Farthest to a side, m.
    pub aside_m: f64,
    /// Distance between candidates, m.
    pub step_m: f64,
    /// Headings tried about the direction to the target, rad, and their step.
    pub heading_rad: [f64; 2],
    /// Distances of the tip from the target at which the fiducial is looked at, m.
    pub stations_m: [f64; 2],
    /// Distance of the target from the images' border, px.
    pub border_px: f64,
    /// Distance of the fiducial's plate from the images' border, px.
    pub plate_border_px: f64,
    /// Largest angle between the fiducial's normal and the direction to a camera, rad.
    pub max_facing_rad: f64,
    /// Least ratio of the tip's smallest to its largest free motion.
    pub min_manipulability: f64,
    /// Least distance of the joints from their limits, rad.
    pub min_limit_rad: f64,
    /// Steepest ground to work on, rad.
    pub max_slope_rad: f64,
    /// Distance of the target from the rover's own shadow, m.
    pub shade_margin_m: f64,
    /// Distance of the rover's parts from the line of sight of the mast's cameras, m.
    pub view_margin_m: f64,
    /// Distance that the arm keeps from the target's tangent plane and from the ground where it can,
    /// m: what its planner may ask for.
    pub terrain_margin_m: f64,
    /// Least distance of the arm from there, m.
    pub min_room_m: f64,
    /// Poses that differ by less (m and rad) are the same one.
    pub apart: [f64; 2],
}

impl Default for BaseRules {
    fn default() -> Self {
        Self {
            ahead_m: [0.80, 1.30],
            aside_m: 0.25,
            step_m: 0.05,
            heading_rad: [1.0, 0.125],
            stations_m: [0.12, 0.03],
            border_px: 30.0,
            plate_border_px: 40.0,
            max_facing_rad: 1.0,
            min_manipulability: 0.05,
            min_limit_rad: 0.05,
            max_slope_rad: 0.26,
            shade_margin_m: 0.06,
            view_margin_m: 0.06,
            terrain_margin_m: 0.06,
            min_room_m: 0.035,
            apart: [0.20, 0.30],
        }
    }
}

impl BaseRules {
    /// What is required where the rover stands already: the planner's own limits. A pose that is
    /// still to be reached is chosen with room for the normal to turn out otherwise.
    #[must_use]
    pub fn at_the_limit() -> Self {
        Self {
            plate_border_px: 8.0,
            max_facing_rad: 1.13,
            min_room_m: 0.02,
            ..Self::default()
        }
    }
}

/// How well a base pose serves.
#[derive(Clone, Debug, PartialEq)]
pub struct Serving {
    /// The pose, present rover frame.
    pub pose: PlanarPose,
    /// How the rover stands there; none for the pose it already stands in.
    pub standing: Option<Standing>,
    /// Target in the rover frame there, m.
    pub target_m: Vector3<f64>,
    /// Joint angles at contact, rad.
    pub joints_rad: Vec<f64>,
    /// Ratio of the tip's smallest to its largest free motion at contact.
    pub manipulability: f64,
    /// Least distance of a joint from its limits, rad.
    pub limit_rad: f64,
    /// Angle between the fiducial's normal and the direction to the cameras at the worst station, rad.
    pub facing_rad: f64,
    /// How well the arm works there; more is better.
    pub arm_score: f64,
    /// The sum that candidates are ranked by: the arm's, the ground's and the way's; more is
    /// better.
    pub score: f64,
}

/// Nothing serves the target: the conditions that refused candidates, and how many each.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("none of {candidates_n} base poses serves the target: {}", counted(.refused))]
pub struct NoBase {
    /// Candidates looked at.
    pub candidates_n: u32,
    /// Conditions and counts.
    pub refused: BTreeMap<String, u32>,
}

fn counted(refused: &BTreeMap<String, u32>) -> String {
    let mut all: Vec<_> = refused.iter().collect();
    all.sort_by(|a, b| b.1.cmp(a.1).then(a.0.cmp(b.0)));
    let parts: Vec<String> = all.iter().map(|(name, n)| format!("{name} {n}")).collect();
    parts.join(", ")
}

/// All that serve, best first, and what refused the others.
#[derive(Clone, Debug, PartialEq)]
pub struct BaseChoice {
    /// Poses that serve, best first.
    pub serving: Vec<Serving>,
    /// Candidates looked at.
    pub candidates_n: u32,
    /// Conditions that refused the others, and how many each.
    pub refused: BTreeMap<String, u32>,
}

/// What a base pose is judged with.
#[derive(Clone, Debug)]
pub struct BaseTask<'a> {
    /// The robot as believed.
    pub robot: &'a Robot,
    /// Its wheels.
    pub mobility: &'a MobilityDescription,
    /// The pair that watches the arm.
    pub body: &'a CameraPairDescription,
    /// How to choose.
    pub rules: &'a BaseRules,
    /// What of the rover is in the way of light and view.
    pub shade: &'a Shade,
    /// Unit vector towards the sun in the frame of the target, if it is known.
    pub sun: Option<Vector3<f64>>,
    /// Poses not to be chosen again, frame of the target.
    pub avoid: Vec<PlanarPose>,
}

/// The target in some rover frame.
#[derive(Clone, Debug, PartialEq)]
pub struct TargetSpot {
    /// Position, m.
    pub position_m: Vector3<f64>,
    /// Outward unit normal.
    pub normal: Vector3<f64>,
    /// Places of the surface about it that stereo has measured, m; the tangent plane speaks for it
    /// besides.
    pub around_m: Vec<Vector3<f64>>,
}

impl TargetSpot {
    /// The same in another frame.
    #[must_use]
    pub fn moved(&self, to_from: &Isometry3<f64>) -> Self {
        let place = |p: &Vector3<f64>| (to_from * Point3::from(*p)).coords;
        Self {
            position_m: place(&self.position_m),
            normal: to_from.rotation * self.normal,
            around_m: self.around_m.iter().map(place).collect(),
        }
    }
}

impl BaseTask<'_> {
    /// Looks for base poses from which `target` (present rover frame, gravity upright as `map`)
    /// can be served.
    ///
    /// # Errors
    /// [`NoBase`] with what refused the candidates.
    pub fn choose(&self, target: &TargetSpot, map: &GroundMap) -> Result<BaseChoice, NoBase> {
        let r = self.rules;
        let towards = target.position_m.y.atan2(target.position_m.x);
        let mut refused: BTreeMap<String, u32> = BTreeMap::new();
        let mut serving = Vec::new();
        let mut candidates_n = 0;
        let count = |reach: f64, step: f64| (reach / step).round() as i32;
        let turns = count(r.heading_rad[0], r.heading_rad[1]);
        let aheads = count(r.ahead_m[1] - r.ahead_m[0], r.step_m);
        let asides = count(r.aside_m, r.step_m);
        for turn in -turns..=turns {
            let heading_rad = towards + f64::from(turn) * r.heading_rad[1];
            for i in 0..=aheads {
                for j in -asides..=asides {
                    let ahead = r.ahead_m[0] + f64::from(i) * r.step_m;
                    let aside = f64::from(j) * r.step_m;
                    // the origin from which the target lies ahead and aside by so much
                    let turned = PlanarPose {
                        x_m: 0.0,
                        y_m: 0.0,
                        heading_rad,
                    }
                    .at(ahead, aside);
                    let pose = PlanarPose {
                        x_m: target.position_m.x - turned.x,
                        y_m: target.position_m.y - turned.y,
                        heading_rad,
                    };
                    candidates_n += 1;
                    match self.judge(&pose, target, map) {
                        Ok(found) => serving.push(found),
                        Err(name) => *refused.entry(name).or_default() += 1,
                    }
                }
            }
        }
        if serving.is_empty() {
            return Err(NoBase {
                candidates_n,
                refused,
            });
        }
        serving.sort_by(|a: &Serving, b: &Serving| b.score.total_cmp(&a.score));
        Ok(BaseChoice {
            serving,
            candidates_n,
            refused,
        })
    }

    /// How one pose serves.
    ///
    /// # Errors
    /// The name of the first condition that is not met.
    pub fn judge(
        &self,
        pose: &PlanarPose,
        target: &TargetSpot,
        map: &GroundMap,
    ) -> Result<Serving, String> {
        if self.is_avoided(pose) {
            return Err("tried_before".into());
        }
        let standing = map
            .standing(pose, self.mobility, self.rules.max_slope_rad)
            .map_err(|hazard| hazard.name().to_string())?;
        let here_from_there = placed(pose, &standing);
        let there = here_from_there.inverse();
        let spot = target.moved(&there);
        if self.shades(&spot, &there.rotation) {
            return Err("own_shadow".into());
        }
        let mut found = self.serve(&spot)?;
        let room = 1.0 - standing.slope_rad / self.rules.max_slope_rad;
        // A turn shows the target from another side, which costs more than its way.
        let place = Vector2::new(pose.x_m, pose.y_m);
        let distance_m = place.norm();
        let (aim, _) = aim_of(&place);
        let turns_rad = if distance_m < 0.08 {
            pose.heading_rad.abs()
        } else {
            aim.abs() + (pose.heading_rad - aim).abs()
        };
        let way = distance_m + 2.0 * turns_rad;
        found.score +=
            0.3 * room + 0.5 * standing.belly_m.min(0.2) - 0.1 * way - standing.unevenness_m;
        found.pose = *pose;
        found.standing = Some(standing);
        Ok(found)
    }

    /// How the rover serves a target from where it stands; `spot` is in its own frame.
    ///
    /// # Errors
    /// The name of the first condition that is not met: `target_out_of_view`,
    /// `hidden_by_the_rover`, `target_out_of_reach`, `joint_limit`, `singular`, `fiducial_hidden`,
    /// `arm_in_the_terrain`.
    pub fn serve(&self, spot: &TargetSpot) -> Result<Serving, String> {
        let r = self.rules;
        let pair = &self.body.cameras;
        self.sees(pair, &spot.position_m)
            .then_some(())
            .ok_or("target_out_of_view")?;
        if self.hidden_from_mast(spot) {
            return Err("hidden_by_the_rover".into());
        }
        let robot = self.robot;
        let base_from_rover = robot.rover_from_arm_base.isometry.inverse();
        let axis = nalgebra::Unit::try_new(base_from_rover.rotation * -spot.normal, 1e-9)
            .ok_or("target_out_of_reach")?;
        let goal = |distance_m: f64| AxisGoal {
            point: (base_from_rover * Point3::from(spot.position_m + spot.normal * distance_m))
                .coords,
            axis,
        };
        let contact =
            solve_axis(&robot.arm, &robot.tool, &goal(0.0)).map_err(|_| "target_out_of_reach")?;
        let mut stations = Vec::new();
        for station_m in r.stations_m {
            let solved = solve_axis(&robot.arm, &robot.tool, &goal(station_m));
            stations.push(solved.map_err(|_| "target_out_of_reach")?);
        }
        let mut best: Option<Serving> = None;
        let mut reason = "joint_limit";
        for touch in &contact {
            let before: Vec<_> = stations
                .iter()
                .filter_map(|solved| solved.iter().find(|s| s.branch == touch.branch))
                .collect();
            if before.len() < stations.len() {
                continue;
            }
            let limit_rad = before
                .iter()
                .map(|s| self.limit(&s.joints_rad))
                .fold(self.limit(&touch.joints_rad), f64::min);
            let within = touch.within_limits && before.iter().all(|s| s.within_limits);
            if !(within && limit_rad >= r.min_limit_rad) {
                continue;
            }
            let manipulability = self.manipulability(&touch.joints_rad).unwrap_or(0.0);
            if !(manipulability >= r.min_manipulability) {
                reason = "singular";
                continue;
            }
            let facing: Option<Vec<f64>> = before
                .iter()
                .map(|s| self.facing(pair, &s.joints_rad))
                .collect();
            let Some(facing) = facing else {
                reason = "fiducial_hidden";
                continue;
            };
            let facing_rad = facing.into_iter().fold(0.0, f64::max);
            let postures = before.iter().copied().chain([touch]);
            let room_m = postures
                .filter_map(|s| room_m(robot, spot, &s.joints_rad))
                .fold(r.terrain_margin_m, f64::min);
            if room_m < r.min_room_m {
                reason = "arm_in_the_terrain";
                continue;
            }
            let score = manipulability.min(0.5)
                + 0.5 * limit_rad.min(0.5)
                + 0.5 * (1.0 - facing_rad / r.max_facing_rad)
                + room_m / r.terrain_margin_m;
            if best.as_ref().is_none_or(|b| score > b.score) {
                best = Some(Serving {
                    pose: PlanarPose {
                        x_m: 0.0,
                        y_m: 0.0,
                        heading_rad: 0.0,
                    },
                    standing: None,
                    target_m: spot.position_m,
                    joints_rad: touch.joints_rad.clone(),
                    manipulability,
                    limit_rad,
                    facing_rad,
                    arm_score: score,
                    score,
                });
            }
        }
        best.ok_or_else(|| reason.to_string())
    }

    /// Whether a pose is one of those not to be chosen again, or all but the same.
    #[must_use]
    pub fn is_avoided(&self, pose: &PlanarPose) -> bool {
        let [apart_m, apart_rad] = self.rules.apart;
        self.avoid.iter().any(|other| {
            let away_m = (pose.x_m - other.x_m).hypot(pose.y_m - other.y_m);
            let turn = pose.heading_rad - other.heading_rad;
            away_m < apart_m && turn.sin().atan2(turn.cos()).abs() < apart_rad
        })
    }

    /// Whether the rover shades the target `spot` (frame of the rover that stands there, turned
    /// by `there_from_here` against that of the sun).
    pub fn shades(&self, spot: &TargetSpot, there_from_here: &UnitQuaternion<f64>) -> bool {
        self.sun.as_ref().is_some_and(|sun| {
            let sun = there_from_here * sun;
            let margin_m = self.rules.shade_margin_m;
            self.shade.covers(&spot.position_m, &sun, margin_m)
        })
    }

    /// Whether the rover hides the target `spot` (its own frame) from a camera on its mast.
    fn hidden_from_mast(&self, spot: &TargetSpot) -> bool {
        let d = self.robot.description();
        let Some(mast) = &d.mast else { return false };
        let Some([pan, tilt]) = mast.angles_towards(&spot.position_m.into()) else {
            return true;
        };
        let rover_from_head = mast.rover_from_head(pan, tilt).isometry;
        let pairs = d.cameras.iter().filter(|p| p.mount == CameraMount::Mast);
        pairs
            .flat_map(|pair| [&pair.cameras.left, &pair.cameras.right])
            .any(|camera| {
                let centre = Point3::from(*camera.model.cahv()[0]);
                let eye = (rover_from_head * centre).coords;
                let margin_m = self.rules.view_margin_m;
                self.shade.hides(&spot.position_m, &eye, margin_m)
            })
    }

    fn sees(&self, pair: &StereoPair, point: &Vector3<f64>) -> bool {
        [&pair.left, &pair.right].iter().all(|camera| {
            let range = (point - camera.model.cahv()[0]).norm();
            (self.body.range_min_m..=self.body.range_max_m).contains(&range)
                && camera
                    .project(point)
                    .is_ok_and(|pixel| camera.contains(&pixel, self.rules.border_px))
        })
    }

    /// Least distance of the joints from their limits, rad.
    fn limit(&self, joints_rad: &[f64]) -> f64 {
        let room = self.robot.arm.limits().iter().zip(joints_rad);
        room.map(|(l, q)| (q - l.lower_rad).min(l.upper_rad - q))
            .fold(f64::INFINITY, f64::min)
    }

    /// Ratio of the smallest to the largest singular value of the tip's Jacobian.
    fn manipulability(&self, joints_rad: &[f64]) -> Option<f64> {
        let tip = self.robot.tool.tip_in_link;
        let jacobian = self.robot.arm.jacobian(joints_rad, &tip).ok()?;
        let linear = jacobian.rows(0, 3);
        let values = (linear * linear.transpose())
            .fixed_view::<3, 3>(0, 0)
            .symmetric_eigenvalues();
        let ratio = (values.min().max(0.0) / values.max()).sqrt();
        ratio.is_finite().then_some(ratio)
    }

    /// Angle between the fiducial's normal and the directions to the cameras, if both see the
    /// whole plate.
    fn facing(&self, pair: &StereoPair, joints_rad: &[f64]) -> Option<f64> {
        let rover_from_link = self.robot.rover_from_link(joints_rad).ok()?;
        let plate = rover_from_link.isometry * self.robot.link_from_plate;
        let layout = &self.robot.description().fiducial.layout;
        let (w, h) = (layout.half_width_m, layout.half_height_m);
        let normal = plate.rotation * Vector3::z();
        let mut worst: f64 = 0.0;
        for camera in [&pair.left, &pair.right] {
            for (x, y) in [(-w, -h), (w, -h), (-w, h), (w, h)] {
                let corner = (plate * Point3::new(x, y, 0.0)).coords;
                let pixel = camera.project(&corner).ok()?;
                if !camera.contains(&pixel, self.rules.plate_border_px) {
                    return None;
                }
                worst = worst.max(normal.angle(&(camera.model.cahv()[0] - corner)));
            }
        }
        (worst <= self.rules.max_facing_rad).then_some(worst)
    }
}

/// Present rover frame from the frame of a rover that stands at `pose`.
#[must_use]
pub fn placed(pose: &PlanarPose, standing: &Standing) -> Isometry3<f64> {
    let up = standing.normal;
    let (s, c) = pose.heading_rad.sin_cos();
    let ahead = Vector3::new(c, s, 0.0);
    let x = (ahead - up * ahead.dot(&up)).normalize();
    let axes = Matrix3::from_columns(&[x, up.cross(&x), up]);
    let turn = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    Isometry3::from_parts(
        Vector3::new(pose.x_m, pose.y_m, standing.height_m).into(),
        turn,
    )
}

#[cfg(test)]
mod tests;
