//! Plans: from where the arm is to where it shall be, within its limits and clear of obstacles.

use crate::SERVICE;
use crate::collision::{CollisionModel, ContactZone, Margins};
use crate::leg::{Leaving, Scene};
use crate::search::{connect, travel_time_s};
use crate::straight::{refused, straight};
use crate::terrain_map::{MapError, MapRules, TerrainMap};
use crate::visibility::view;
use nalgebra::{Point3, Vector3};
use rover_kinematics::{
    AxisGoal, IkError, JointTrajectory, TimingOptions, closest_solution, solve_axis, through_with,
};
use rover_messages::{
    Fault,
    planning::{Plan, PlanGoal, PlanRequest, ToolPose},
};
use rover_robot::{CameraPairDescription, Robot, RobotError};
use rover_service::{joints_refusal, reach_refusal};
use std::sync::Arc;

/// How far outside its limits an encoder may find a joint at the start, rad.
const START_TOLERANCE_RAD: f64 = 5e-3;
/// Heights by which a detour lifts the tip, m.
const DETOURS_M: [f64; 5] = [0.05, 0.1, 0.15, 0.2, 0.3];
/// A detour that takes a joint longer than this is on another branch, s.
const MAX_DETOUR_S: f64 = 4.0;
/// Branches whose facing angles differ by less count as equally visible, rad.
const FACING_CLASS_RAD: f64 = 0.15;
/// Distance from a joint limit below which a branch costs more, rad, and how much, s.
const NEAR_LIMIT: (f64, f64) = (0.15, 3.0);
/// What a singular configuration costs, s.
const SINGULAR_COST_S: f64 = 10.0;
/// Stereo points this near to the robot are the robot, m.
const SELF_SEEN_M: f64 = 0.05;
/// Stereo points further beyond the arm's reach than this do not matter, m.
const BEYOND_REACH_M: f64 = 0.2;
/// The largest distance that is reported as clearance, m.
const CLEARANCE_LOOK_M: f64 = 0.5;
/// Turn in joint space above which a free motion stops at a way-point, rad: everywhere, so that
/// the motion is on the legs that were checked.
const FREE_CORNER_RAD: f64 = 1e-6;
/// How far the way-points of a straight line may be rounded off in joint space, rad.
const STRAIGHT_TOLERANCE_RAD: f64 = 1e-3;

/// The arm planner. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Planner {
    robot: Arc<Robot>,
    model: Arc<CollisionModel>,
    terrain: Option<Arc<TerrainMap>>,
}

/// A branch that may be taken; the smaller, the better, field by field.
struct Candidate {
    /// Whether an approach from here leaves the branch.
    ends_here: bool,
    /// How well the plate is seen, 0 best.
    facing_class: u32,
    /// Time to get there, and what is wrong with being there, s.
    cost_s: f64,
    joints: Vec<f64>,
}

fn fault(name: &str, message: String) -> Fault {
    Fault::new(SERVICE, name, message)
}

fn unknown(error: &RobotError) -> Fault {
    fault("unknown_name", error.to_string())
}

impl Planner {
    /// A planner for `robot` with default margins and without a map.
    pub fn new(robot: Arc<Robot>) -> Self {
        Self::with_margins(robot, Margins::default())
    }

    /// A planner that keeps other distances.
    pub fn with_margins(robot: Arc<Robot>, margins: Margins) -> Self {
        let model = Arc::new(CollisionModel::new(robot.clone(), margins));
        Self {
            robot,
            model,
            terrain: None,
        }
    }

    /// The planner with a map of the terrain.
    #[must_use]
    pub fn with_terrain(mut self, map: TerrainMap) -> Self {
        self.terrain = Some(Arc::new(map));
        self
    }

    /// The map, if there is one.
    pub fn terrain(&self) -> Option<&TerrainMap> {
        self.terrain.as_deref()
    }

    /// The shapes that are checked.
    pub fn collision_model(&self) -> &CollisionModel {
        &self.model
    }

    /// A map from stereo points (rover frame, m), without those on the robot itself, whose arm is
    /// at `joints` (rad), and those far out of reach.
    ///
    /// # Errors
    /// Fault `no_map` when nothing is left to make a map of, `bad_joints`.
    pub fn map_of(&self, points: &[Vector3<f64>], joints: &[f64]) -> Result<TerrainMap, Fault> {
        let placed = self
            .model
            .place(joints)
            .map_err(|e| joints_refusal(&self.robot, SERVICE, "the present joints", &e))?;
        let base = self.robot.rover_from_arm_base.isometry.translation.vector;
        let rows = self.robot.arm.rows().iter().map(|r| r.a_m.hypot(r.d_m));
        let reach = rows.sum::<f64>() + self.robot.tool.tip_in_link.norm() + BEYOND_REACH_M;
        let kept: Vec<_> = points
            .iter()
            .filter(|p| (*p - base).norm() <= reach)
            .filter(|p| self.model.distance_to_arm_m(&placed, p) > SELF_SEEN_M)
            .copied()
            .collect();
        TerrainMap::from_points(&kept, &MapRules::default()).map_err(|error| {
            let message = match error {
                MapError::NoPoints { .. } => format!(
                    "{error}; of {} stereo points {} are within reach and not on the robot",
                    points.len(),
                    kept.len()
                ),
                _ => error.to_string(),
            };
            fault("no_map", message).with("points_n", points.len() as f64)
        })
    }

    /// A motion from `request.start_rad`, or `current_joints` (rad), to the goal.
    ///
    /// # Errors
    /// A fault that names what is in the way: `joint_limit`, `target_out_of_reach`,
    /// `axis_infeasible`, `no_solution`, `fiducial_not_visible`, `no_collision_free_path`,
    /// `branch_change`, `axis_reversal`, `unknown_name`, `bad_joints`.
    pub fn plan(&self, request: &PlanRequest, current_joints: &[f64]) -> Result<Plan, Fault> {
        let start = self.start(request.start_rad.as_deref().unwrap_or(current_joints))?;
        let zone = |pose: &ToolPose| ContactZone {
            centre: pose.tip_m.coords,
            radius_m: request.contact_radius_m,
        };
        let options = TimingOptions {
            speed_scale: request.speed_fraction,
            ..Default::default()
        };
        match &request.goal {
            PlanGoal::Posture(name) => {
                let goal = self.robot.posture(name).map_err(|e| unknown(&e))?;
                let route = self.route(&self.scene(None), &start, goal)?;
                self.free_motion(&route, options, None)
            }
            PlanGoal::Joints(goal) => {
                self.check_joints("the goal", goal)?;
                let route = self.route(&self.scene(None), &start, goal)?;
                self.free_motion(&route, options, None)
            }
            PlanGoal::Tool { pose, visible_to } => {
                let zone = zone(pose);
                let route = self.to_tool(&start, pose, visible_to.as_deref(), &zone)?;
                self.free_motion(&route, options, Some(&zone))
            }
            PlanGoal::Straight(poses) => {
                let Some(last) = poses.last() else {
                    return Err(fault("bad_request", "goal.straight: no pose".into()));
                };
                let zone = zone(last);
                let goals: Vec<_> = poses.iter().map(|p| self.axis_goal(p)).collect();
                let path = straight(&self.scene(Some(&zone)), &start, &goals)?;
                let options = TimingOptions {
                    path_tolerance_rad: STRAIGHT_TOLERANCE_RAD,
                    max_tool_speed_m_s: request.max_tip_speed_m_s,
                    path_lengths_m: Some(path.lengths_m),
                    ..options
                };
                self.motion(&path.waypoints, &options, Some(&zone))
            }
        }
    }

    fn scene<'a>(&'a self, zone: Option<&'a ContactZone>) -> Scene<'a> {
        Scene {
            model: &self.model,
            terrain: self.terrain.as_deref(),
            zone,
        }
    }

    fn axis_goal(&self, pose: &ToolPose) -> AxisGoal {
        let base_from_rover = self.robot.rover_from_arm_base.inverse();
        AxisGoal {
            point: (base_from_rover * pose.tip_m).coords,
            axis: (base_from_rover * pose.axis).unit,
        }
    }

    fn check_joints(&self, what: &str, q: &[f64]) -> Result<(), Fault> {
        self.robot
            .arm
            .check_limits(q)
            .map_err(|e| joints_refusal(&self.robot, SERVICE, what, &e))
    }

    /// The start, moved into the limits if an encoder finds it a little outside.
    fn start(&self, q: &[f64]) -> Result<Vec<f64>, Fault> {
        let limits = self.robot.arm.limits();
        let inside: Vec<f64> = q
            .iter()
            .zip(limits)
            .map(|(q, l)| {
                let inside = q.clamp(l.lower_rad, l.upper_rad);
                if (q - inside).abs() <= START_TOLERANCE_RAD {
                    inside
                } else {
                    *q
                }
            })
            .collect();
        let start = if inside.len() == q.len() {
            inside
        } else {
            q.to_vec()
        };
        self.check_joints("the start", &start)?;
        Ok(start)
    }

    fn bad_joints(&self) -> impl Fn(rover_kinematics::ArmError) -> Fault + '_ {
        |e| joints_refusal(&self.robot, SERVICE, "on the way", &e)
    }

    /// A collision-free path to a tool pose, on the best branch that has one.
    fn to_tool(
        &self,
        start: &[f64],
        pose: &ToolPose,
        visible_to: Option<&str>,
        zone: &ContactZone,
    ) -> Result<Vec<Vec<f64>>, Fault> {
        let pair = visible_to
            .map(|name| self.robot.pair(name))
            .transpose()
            .map_err(|e| unknown(&e))?;
        let scene = self.scene(Some(zone));
        let branches = self.branches(start, pose)?;
        let count = branches.len();
        let mut candidates = Vec::new();
        let mut refusals = Vec::new();
        for (joints, singular) in branches {
            match self.candidate(&scene, start, joints, singular, pair) {
                Ok(candidate) => candidates.push(candidate),
                Err(refusal) => refusals.push(refusal),
            }
        }
        candidates.sort_by(|a, b| {
            (a.ends_here, a.facing_class)
                .cmp(&(b.ends_here, b.facing_class))
                .then(a.cost_s.total_cmp(&b.cost_s))
        });
        for candidate in &candidates {
            match self.route(&scene, start, &candidate.joints) {
                Ok(route) => return Ok(route),
                Err(refusal) => refusals.push(refusal),
            }
        }
        Err(summary(refusals, count))
    }

    /// The joint angles within the limits that take the pose, and whether they are singular.
    fn branches(&self, start: &[f64], pose: &ToolPose) -> Result<Vec<(Vec<f64>, bool)>, Fault> {
        let goal = self.axis_goal(pose);
        let (arm, tool) = (&self.robot.arm, &self.robot.tool);
        let refusal = |e: &IkError| reach_refusal(&self.robot, SERVICE, "the pose", e);
        let solutions = match solve_axis(arm, tool, &goal) {
            Ok(solutions) => solutions,
            Err(IkError::NotThisFamily(_)) => return self.numeric_branches(start, &goal),
            Err(error) => return Err(refusal(&error)),
        };
        let within: Vec<_> = solutions
            .into_iter()
            .filter(|s| s.within_limits)
            .map(|s| (self.nearest_turns(&s.joints_rad, start), s.singular))
            .collect();
        if within.is_empty() {
            // Names the joint that breaks its limit least.
            return match closest_solution(arm, tool, &goal, start) {
                Ok(joints) => Ok(vec![(joints, true)]),
                Err(error) => Err(refusal(&error)),
            };
        }
        Ok(within)
    }

    fn numeric_branches(
        &self,
        start: &[f64],
        goal: &AxisGoal,
    ) -> Result<Vec<(Vec<f64>, bool)>, Fault> {
        let (arm, tool) = (&self.robot.arm, &self.robot.tool);
        let postures = self
            .robot
            .description()
            .postures
            .values()
            .map(Vec::as_slice);
        let mut found: Vec<(Vec<f64>, bool)> = Vec::new();
        let mut first_error = None;
        for seed in std::iter::once(start).chain(postures) {
            match closest_solution(arm, tool, goal, seed) {
                Ok(q) => {
                    let is_new = |(other, _): &(Vec<f64>, bool)| {
                        travel_time_s(arm.limits(), other, &q) > 1e-2
                    };
                    if found.iter().all(is_new) {
                        found.push((q, false));
                    }
                }
                Err(error) => first_error = first_error.or(Some(error)),
            }
        }
        match first_error {
            Some(error) if found.is_empty() => {
                Err(reach_refusal(&self.robot, SERVICE, "the pose", &error))
            }
            _ => Ok(found),
        }
    }

    /// Each joint shifted by whole turns to where it is nearest to `start` within its limits.
    fn nearest_turns(&self, q: &[f64], start: &[f64]) -> Vec<f64> {
        let turn = std::f64::consts::TAU;
        let joints = q.iter().zip(start).zip(self.robot.arm.limits());
        joints
            .map(|((&q, start), l)| {
                let shifted = [q - turn, q + turn]
                    .into_iter()
                    .filter(|x| (l.lower_rad..=l.upper_rad).contains(x));
                shifted.fold(q, |best, x| {
                    if (x - start).abs() < (best - start).abs() {
                        x
                    } else {
                        best
                    }
                })
            })
            .collect()
    }

    fn candidate(
        &self,
        scene: &Scene,
        start: &[f64],
        joints: Vec<f64>,
        singular: bool,
        pair: Option<&CameraPairDescription>,
    ) -> Result<Candidate, Fault> {
        let checked = scene
            .check_configuration(&joints)
            .map_err(self.bad_joints())?;
        checked.map_err(|b| refused(scene, &b, "at the goal"))?;
        let facing_class = match pair {
            None => 0,
            Some(pair) => {
                let placed = self.model.place(&joints).map_err(self.bad_joints())?;
                let view = view(&self.model, &placed, scene.terrain, pair).map_err(|hidden| {
                    fault(
                        "fiducial_not_visible",
                        format!("to the pair `{}`: {hidden}", pair.name),
                    )
                })?;
                (view.facing_rad / FACING_CLASS_RAD) as u32
            }
        };
        let ends_here = scene
            .zone
            .is_some_and(|zone| !self.can_approach(&joints, zone.radius_m));
        let limits = self.robot.arm.limits();
        let room = joints
            .iter()
            .zip(limits)
            .map(|(q, l)| (q - l.lower_rad).min(l.upper_rad - q));
        let mut cost_s = travel_time_s(limits, start, &joints);
        if room.fold(f64::INFINITY, f64::min) < NEAR_LIMIT.0 {
            cost_s += NEAR_LIMIT.1;
        }
        if singular {
            cost_s += SINGULAR_COST_S;
        }
        Ok(Candidate {
            ends_here,
            facing_class,
            cost_s,
            joints,
        })
    }

    /// Whether the tip can go on straight along its axis: a pose with room for contact is the first
    /// of an approach. Terrain is left to that approach's own plan.
    fn can_approach(&self, joints: &[f64], distance_m: f64) -> bool {
        let Ok(here) = AxisGoal::at(&self.robot.arm, &self.robot.tool, joints) else {
            return false;
        };
        let there = AxisGoal {
            point: here.point + here.axis.into_inner() * distance_m,
            axis: here.axis,
        };
        let scene = Scene {
            model: &self.model,
            terrain: None,
            zone: None,
        };
        straight(&scene, joints, &[there]).is_ok()
    }

    /// A collision-free path of straight legs: direct, over a detour, or searched for.
    fn route(&self, scene: &Scene, start: &[f64], goal: &[f64]) -> Result<Vec<Vec<f64>>, Fault> {
        let at_goal = scene.check_configuration(goal).map_err(self.bad_joints())?;
        at_goal.map_err(|b| refused(scene, &b, "at the goal"))?;
        let leaving = Leaving::from(scene, start).map_err(self.bad_joints())?;
        let direct = vec![start.to_vec(), goal.to_vec()];
        let checked = scene
            .check_path(&direct, &mut leaving.clone())
            .map_err(self.bad_joints())?;
        let Err(blocked) = checked else {
            return Ok(direct);
        };
        let (away_from_start, away_from_goal) = (self.detours(start), self.detours(goal));
        let mut detours: Vec<Vec<Vec<f64>>> = Vec::new();
        let mut propose = |via: &[&Vec<f64>]| {
            let mut path = vec![start.to_vec()];
            path.extend(via.iter().map(|q| (*q).clone()));
            path.push(goal.to_vec());
            detours.push(path);
        };
        let postures: Vec<_> = self.robot.description().postures.values().collect();
        away_from_start
            .iter()
            .chain(&away_from_goal)
            .for_each(|q| propose(&[q]));
        postures.iter().for_each(|q| propose(&[q]));
        for a in &away_from_start {
            away_from_goal.iter().for_each(|b| propose(&[a, b]));
            postures.iter().for_each(|b| propose(&[a, b]));
        }
        for b in &away_from_goal {
            postures.iter().for_each(|a| propose(&[a, b]));
        }
        let limits = self.robot.arm.limits();
        let time = |path: &Vec<Vec<f64>>| -> f64 {
            path.windows(2)
                .map(|l| travel_time_s(limits, &l[0], &l[1]))
                .sum()
        };
        detours.sort_by(|a, b| time(a).total_cmp(&time(b)));
        for path in detours {
            let checked = scene.check_path(&path, &mut leaving.clone());
            if checked.map_err(self.bad_joints())?.is_ok() {
                return Ok(path);
            }
        }
        if let Some(path) = self.searched(scene, start, goal, &leaving, &away_from_start)? {
            return Ok(path);
        }
        let place = "no way round was found; on the direct way";
        Err(refused(scene, &blocked, place))
    }

    /// A searched path; if the start is too near to something, from where it is left first.
    fn searched(
        &self,
        scene: &Scene,
        start: &[f64],
        goal: &[f64],
        leaving: &Leaving,
        away: &[Vec<f64>],
    ) -> Result<Option<Vec<Vec<f64>>>, Fault> {
        if leaving.is_done() {
            return connect(scene, start, goal).map_err(self.bad_joints());
        }
        for free in away {
            let mut left = leaving.clone();
            let checked = scene
                .check_leg(start, free, &mut left)
                .map_err(self.bad_joints())?;
            if checked.is_ok() && left.is_done() {
                let path = connect(scene, free, goal).map_err(self.bad_joints())?;
                return Ok(path.map(|mut path| {
                    path.insert(0, start.to_vec());
                    path
                }));
            }
        }
        Ok(None)
    }

    /// Configurations near `q` with the tip moved up, and back along its axis.
    fn detours(&self, q: &[f64]) -> Vec<Vec<f64>> {
        let (arm, tool) = (&self.robot.arm, &self.robot.tool);
        let Ok(here) = AxisGoal::at(arm, tool, q) else {
            return Vec::new();
        };
        let up = self.robot.rover_from_arm_base.isometry.rotation.inverse() * Vector3::z();
        let back = -here.axis.into_inner();
        let goals = DETOURS_M.iter().flat_map(|&by| {
            [up, back].map(|way| AxisGoal {
                point: here.point + way * by,
                axis: here.axis,
            })
        });
        goals
            .filter_map(|goal| closest_solution(arm, tool, &goal, q).ok())
            .filter(|there| travel_time_s(arm.limits(), q, there) < MAX_DETOUR_S)
            .collect()
    }

    fn free_motion(
        &self,
        route: &[Vec<f64>],
        options: TimingOptions,
        zone: Option<&ContactZone>,
    ) -> Result<Plan, Fault> {
        let options = TimingOptions {
            corner_rad: FREE_CORNER_RAD,
            ..options
        };
        self.motion(route, &options, zone)
    }

    fn motion(
        &self,
        waypoints: &[Vec<f64>],
        options: &TimingOptions,
        zone: Option<&ContactZone>,
    ) -> Result<Plan, Fault> {
        let trajectory = through_with(&self.robot.arm, waypoints, options)
            .map_err(|e| fault("no_trajectory", e.to_string()))?;
        let end_rad = trajectory
            .points
            .last()
            .map(|p| p.q_rad.clone())
            .unwrap_or_default();
        let clearance_m = self.clearance_m(&trajectory, zone)?;
        Ok(Plan {
            trajectory,
            end_rad,
            clearance_m,
        })
    }

    /// Smallest distance of any checked pair at the points of a trajectory, m.
    fn clearance_m(
        &self,
        trajectory: &JointTrajectory,
        zone: Option<&ContactZone>,
    ) -> Result<Option<f64>, Fault> {
        let mut smallest: Option<f64> = None;
        for point in &trajectory.points {
            let placed = self.model.place(&point.q_rad).map_err(self.bad_joints())?;
            let look_m = smallest.unwrap_or(CLEARANCE_LOOK_M).max(0.0);
            self.model
                .visit(&placed, self.terrain(), zone, look_m, |p| {
                    smallest = Some(smallest.map_or(p.distance_m, |s| s.min(p.distance_m)));
                });
        }
        Ok(smallest)
    }

    /// The instrument's tip and axis at joint angles `q` (rad), rover frame.
    ///
    /// # Errors
    /// Fault `bad_joints`.
    pub fn tool_pose(&self, q: &[f64]) -> Result<ToolPose, Fault> {
        let rover_from_link = self
            .robot
            .rover_from_link(q)
            .map_err(self.bad_joints())?
            .isometry;
        let tool = &self.robot.tool;
        Ok(ToolPose {
            tip_m: (rover_from_link * Point3::from(tool.tip_in_link))
                .coords
                .into(),
            axis: (rover_from_link.rotation * tool.axis_in_link).into(),
        })
    }
}

/// One fault for all branches: the one that came furthest speaks, the others are counted.
fn summary(refusals: Vec<Fault>, branches: usize) -> Fault {
    let is_hidden = |f: &Fault| f.name == "fiducial_not_visible";
    let hidden = refusals.iter().filter(|f| is_hidden(f)).count();
    let blocked = refusals.len() - hidden;
    // A branch is looked at for collisions at its end, then for visibility, then for a way there.
    let furthest = refusals
        .iter()
        .rev()
        .find(|f| !is_hidden(f) && !f.message.starts_with("at the goal"))
        .or_else(|| refusals.iter().find(|f| is_hidden(f)))
        .or_else(|| refusals.first());
    let Some(furthest) = furthest else {
        return fault("no_solution", "the pose has no joint angles".into());
    };
    let mut fault = furthest.clone();
    fault.message = format!(
        "{} ({branches} branches within limits: {blocked} in collision, {hidden} with the \
         fiducial hidden)",
        fault.message
    );
    fault
        .with("branches_n", branches as f64)
        .with("in_collision_n", blocked as f64)
        .with("hidden_n", hidden as f64)
}
