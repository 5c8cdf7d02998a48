//! The Bluestreak testbed of the paper's experiment in pictures: the simulator's renderer shows the
//! true arm, the servo's own detector and loop place it, and the true tip is read off the truth, as
//! the paper's laser tracker did.
//!
//! Nothing moves through time: the arm is where a finished motion would leave it. Around it is a
//! flat floor with no rock, so that whatever a method sees or misses is its own doing.

use super::StudyError;
use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Unit, UnitQuaternion, Vector3};
use rover_compensation::{Compensation, ErrorModel};
use rover_epec_servo::{
    estimator::{EstimatorRules, Seen},
    observe::{SearchWindow, look},
    place::{Placement, Step, error_model},
};
use rover_geometry::{Direction, Rover};
use rover_kinematics::{AxisGoal, closest_solution};
use rover_messages::{
    Fault,
    imaging::{RawPair, StereoFrame},
    placement::{Method, Observation, PlaceGoal, PlaceResult},
    planning::{PlanGoal, ToolPose},
    target::Target,
};
use rover_robot::Robot;
use rover_sim::{IntrinsicsError, SimulationDescription, SimulationError, StillWorld};
use serde::Deserialize;
use std::{collections::BTreeMap, sync::Arc, time::Instant};

/// The pair that sees the arm.
pub const PAIR: &str = "body";
/// The posture from which every placement starts.
const START: &str = "ready";
/// Height of the floor, m: below everything that the arm is sent to.
const FLOOR_M: f64 = 0.0;
/// Tolerance that ends the servo's loop with its first look at a station, m.
const ANY_M: f64 = 0.1;
/// No placement is refused for what is predicted of it.
const NO_LIMIT_M: f64 = 1.0;
/// Steps after which a placement that has not ended is a fault.
const MOST_STEPS: u32 = 400;

/// The shipped robot of the testbed.
const ROBOT: &str = include_str!("../../robots/bluestreak.toml");
/// The shipped scenario of the testbed.
const SCENARIO: &str = include_str!("../../bluestreak.toml");

/// What a study takes of a scenario: the simulated world.
#[derive(Deserialize)]
struct World {
    simulation: SimulationDescription,
}

/// What all draws of the testbed have in common.
#[derive(Clone, Debug)]
pub struct Testbed {
    /// The believed robot.
    pub robot: Arc<Robot>,
    description: SimulationDescription,
}

impl Testbed {
    /// The shipped robot and scenario `bluestreak` on a flat floor, its arm and mount wrong by
    /// what the scenario says (1 deg, 2.5 mm), its lenses by `intrinsics`.
    ///
    /// # Errors
    /// [`StudyError::Shipped`] never, for a binary that passes its tests.
    pub fn bluestreak(intrinsics: IntrinsicsError) -> Result<Self, StudyError> {
        let unusable = |e: &dyn std::fmt::Display| StudyError::Shipped(e.to_string());
        let robot = Robot::parse(ROBOT, "robots/bluestreak.toml").map_err(|e| unusable(&e))?;
        let world: World = toml::from_str(SCENARIO).map_err(|e| unusable(&e))?;
        let mut description = world.simulation;
        description.truth.intrinsics = intrinsics;
        description.terrain.rocks.clear();
        description.terrain.scattered.count_n = 0;
        description.terrain.relief_m = 0.0;
        description.terrain.height_m = FLOOR_M;
        Ok(Self {
            robot: Arc::new(robot),
            description,
        })
    }

    /// The description of the simulated world.
    pub fn description(&self) -> &SimulationDescription {
        &self.description
    }

    /// The same testbed in another world.
    pub fn altered(&self, change: impl FnOnce(&mut SimulationDescription)) -> Self {
        let mut other = self.clone();
        change(&mut other.description);
        other
    }

    /// The believed robot's error model with the plate's central mark as the tip.
    ///
    /// # Errors
    /// [`StudyError::Shipped`] never, for a binary that passes its tests.
    pub fn model_of_mark(&self) -> Result<ErrorModel, StudyError> {
        let layout = &self.robot.description().fiducial.layout;
        let mark = layout.point(layout.discs.len());
        let mark = mark.ok_or_else(|| StudyError::Shipped("bluestreak has no mark".into()))?;
        let mut model = error_model(&self.robot);
        model.tool.tip_in_link = (self.robot.link_from_plate * Point3::from(mark)).coords;
        Ok(model)
    }

    /// One draw of the true robot.
    ///
    /// # Errors
    /// [`StudyError::Simulation`].
    pub fn draw(&self, seed: u64) -> Result<Drawn, StudyError> {
        let world = StillWorld::new(&self.robot, &self.description, seed)?;
        let missing = || StudyError::Shipped(format!("bluestreak has no pair {PAIR}"));
        let believed_from_true = world.pair(PAIR).ok_or_else(missing)?.believed_from_true;
        Ok(Drawn {
            robot: self.robot.clone(),
            model: error_model(&self.robot),
            model_of_mark: self.model_of_mark()?,
            world,
            believed_from_true,
            frames: BTreeMap::new(),
        })
    }
}

/// A placement with one look at each of these heights above the target (m), which nothing that is
/// predicted of it refuses.
pub fn single_looks(
    target: &Target,
    (method, observation): (Method, Observation),
    stations_m: Vec<f64>,
) -> PlaceGoal {
    PlaceGoal {
        target: target.clone(),
        stations_m,
        method,
        observation,
        tolerance_m: ANY_M,
        max_corrections_n: 1,
        max_predicted_error_m: NO_LIMIT_M,
    }
}

/// One true robot before its cameras.
pub struct Drawn {
    robot: Arc<Robot>,
    model: ErrorModel,
    /// The same with the plate's central mark as the tip.
    model_of_mark: ErrorModel,
    world: StillWorld,
    believed_from_true: Isometry3<f64>,
    /// Pictures by the bits of the joint angles that they show.
    frames: BTreeMap<Vec<u64>, StereoFrame>,
}

/// A placement that came to its end.
#[derive(Clone, Debug)]
pub struct Placed {
    /// The servo's result.
    pub result: PlaceResult,
    /// Commanded joint angles at the target, rad.
    pub joints_rad: Vec<f64>,
    /// Computing of the servo, from images to commands, us.
    pub computing_us: f64,
    /// Cycles of looking and commanding.
    pub cycles: u32,
}

fn fault(name: &str, message: impl Into<String>) -> Fault {
    Fault::new("study", name, message)
}

fn arm_fault(error: rover_kinematics::ArmError) -> Fault {
    fault("internal", error.to_string())
}

fn simulation_fault(error: &SimulationError) -> Fault {
    fault("no_picture", error.to_string())
}

impl Drawn {
    /// The true tip where a laser tracker finds it, m.
    ///
    /// # Errors
    /// [`StudyError::Arm`] for joint angles that do not fit the arm.
    pub fn true_tip(&self, q: &[f64]) -> Result<Vector3<f64>, StudyError> {
        Ok(self.world.arm().tip_in_world(q)?)
    }

    /// Brings the plate's mark itself to a target with the vector seen of it, and measures where
    /// it truly is, m; none if that is out of reach.
    ///
    /// # Errors
    /// [`StudyError::Arm`] never, for joint angles from the inverse kinematics.
    pub fn placed_mark(
        &self,
        vector: &Compensation,
        target: &Target,
        near: &[f64],
    ) -> Result<Option<Vector3<f64>>, StudyError> {
        let (at, axis) = (&target.position_m.coords, -target.normal.unit);
        let Ok(solved) = self.model_of_mark.solve(vector, at, &axis, near) else {
            return Ok(None);
        };
        let link = self.world.arm().world_from_link(&solved.joints_rad)?;
        let mark = Point3::from(self.model_of_mark.tool.tip_in_link);
        Ok(Some((link * mark).coords))
    }

    /// The target that the tip is sent to so that the believed mark stands where `target` has the
    /// tip: the servo, which places the tip, then looks at the mark there.
    ///
    /// # Errors
    /// `out_of_reach`.
    pub fn under_mark(&self, target: &Target) -> Result<Target, Fault> {
        let q = self.command(&self.model_of_mark, &Compensation::none(), target)?;
        let believed = self.model.rover_from_link(&q).map_err(arm_fault)?;
        Ok(Target {
            position_m: (believed * Point3::from(self.model.tool.tip_in_link))
                .coords
                .into(),
            ..target.clone()
        })
    }

    /// A target at a true place as sight without any error designates it: through the true mount.
    pub fn exact_target(&self, at: &Vector3<f64>, normal: &Unit<Vector3<f64>>) -> Target {
        Target {
            pair: PAIR.into(),
            pixel_px: [0.0; 2],
            right_pixel_px: [0.0; 2],
            position_m: (self.believed_from_true * Point3::from(*at)).coords.into(),
            normal: Direction::<Rover>::from(self.seen_direction(normal)),
            covariance_m2: [[0.0; 3]; 3],
            plane_rms_mm: 0.0,
            roughness_mm: 0.0,
            points_n: 1,
            sim_time_s: 0.0,
        }
    }

    /// The vectors taken at a target if sight had no error at all: of the mark there, of the mark
    /// where that vector brings it, of the mark with the tip there, and of the plate's pose with
    /// the tip there.
    ///
    /// # Errors
    /// `out_of_reach`.
    pub fn exact_vectors(&self, target: &Target) -> Result<[Compensation; 4], Fault> {
        let (tip, mark) = (&self.model, &self.model_of_mark);
        let none = Compensation::none();
        let position_only = |c: Compensation| Compensation::constant(c.offset_m);
        let first = position_only(self.exact_vector(mark, mark, &none, target)?);
        let second = position_only(self.exact_vector(mark, mark, &first, target)?);
        let from_tip = position_only(self.exact_vector(tip, mark, &none, target)?);
        let plate = self.exact_vector(tip, tip, &none, target)?;
        Ok([first, second, from_tip, plate])
    }

    /// Position and orientation error of the point that `seen` has as its tip, when `sent` places
    /// its own on the target with `vector`.
    fn exact_vector(
        &self,
        sent: &ErrorModel,
        seen: &ErrorModel,
        vector: &Compensation,
        target: &Target,
    ) -> Result<Compensation, Fault> {
        let q = self.command(sent, vector, target)?;
        let truth = self.world.arm().world_from_link(&q).map_err(arm_fault)?;
        let looks_like = self.believed_from_true * truth;
        let believed = seen.rover_from_link(&q).map_err(arm_fault)?;
        let point = Point3::from(seen.tool.tip_in_link);
        let turn = looks_like.rotation * believed.rotation.inverse();
        Ok(Compensation {
            offset_m: (looks_like * point - believed * point).into(),
            offset_rad: turn.scaled_axis().into(),
            parameters: Vec::new(),
        })
    }

    /// Joint angles, nearest to the start, that put a model's tip on a target.
    fn command(
        &self,
        model: &ErrorModel,
        vector: &Compensation,
        target: &Target,
    ) -> Result<Vec<f64>, Fault> {
        let near = self.start().map_err(|e| fault("internal", e.to_string()))?;
        let (at, axis) = (&target.position_m.coords, -target.normal.unit);
        let solved = model.solve(vector, at, &axis, &near);
        solved
            .map(|s| s.joints_rad)
            .map_err(|e| fault("out_of_reach", e.to_string()))
    }

    /// Turns a true direction into the one that the believed cameras see.
    pub fn seen_direction(&self, direction: &Unit<Vector3<f64>>) -> Unit<Vector3<f64>> {
        self.believed_from_true.rotation * direction
    }

    fn frame(&mut self, images: RawPair) -> Result<StereoFrame, Fault> {
        let pair = self
            .robot
            .pair(PAIR)
            .map_err(|e| fault("unknown_camera_pair", e.to_string()))?;
        Ok(StereoFrame {
            images,
            cameras: pair.cameras.clone(),
        })
    }

    /// The stereo frame with the arm at `q`.
    fn frame_at(&mut self, q: &[f64]) -> Result<StereoFrame, Fault> {
        let key: Vec<u64> = q.iter().map(|x| x.to_bits()).collect();
        if let Some(frame) = self.frames.get(&key) {
            return Ok(frame.clone());
        }
        let images = self.world.grab(PAIR, q).map_err(|e| simulation_fault(&e))?;
        let frame = self.frame(images)?;
        self.frames.insert(key, frame.clone());
        Ok(frame)
    }

    /// Forgets the pictures taken so far.
    pub fn forget(&mut self) {
        self.frames.clear();
    }

    /// A target designated by a fiducial like the arm's own that somebody holds at a true place,
    /// turned to the cameras; found and triangulated in a stereo pair like any other.
    ///
    /// # Errors
    /// `target_not_found` with the detector's words.
    pub fn target(
        &mut self,
        at: &Vector3<f64>,
        normal: &Unit<Vector3<f64>>,
    ) -> Result<Target, Fault> {
        let believed_centre = self.robot.mount_centre();
        let centre = (self.believed_from_true.inverse() * Point3::from(believed_centre)).coords;
        let front = (centre - at).normalize();
        let right = Vector3::z().cross(&front).normalize();
        let axes = Matrix3::from_columns(&[right, front.cross(&right), front]);
        let rotation = Rotation3::from_matrix_unchecked(axes);
        let world_from_plate = Isometry3::from_parts(
            (*at).into(),
            UnitQuaternion::from_rotation_matrix(&rotation),
        );
        let held = world_from_plate * self.robot.link_from_plate.inverse();
        let images = self
            .world
            .grab_held(PAIR, &held)
            .map_err(|e| simulation_fault(&e))?;
        let frame = self.frame(images)?;
        let seen_link = self.believed_from_true * held;
        let window = SearchWindow { sigma_m: 2e-3 };
        let sighting = look(
            &self.robot,
            &frame,
            Observation::Position,
            &seen_link,
            &seen_link,
            window,
        )
        .map_err(|reason| fault("target_not_found", reason))?;
        let Seen::Position {
            seen_in_rover,
            covariance,
            ..
        } = sighting.seen
        else {
            return Err(fault("target_not_found", "no position was observed"));
        };
        Ok(Target {
            pair: PAIR.into(),
            pixel_px: sighting.left_px.into(),
            right_pixel_px: sighting.right_px.into(),
            position_m: seen_in_rover.into(),
            normal: Direction::<Rover>::from(self.seen_direction(normal)),
            covariance_m2: [0, 1, 2].map(|i| [0, 1, 2].map(|j| covariance[(i, j)])),
            plane_rms_mm: 0.0,
            roughness_mm: 0.0,
            points_n: 1,
            sim_time_s: 0.0,
        })
    }

    /// Joint angles with which the believed arm takes the last pose of a plan's goal.
    fn reach(&self, goal: &PlanGoal, near: &[f64]) -> Result<Vec<f64>, Fault> {
        let pose: Option<&ToolPose> = match goal {
            PlanGoal::Tool { pose, .. } => Some(pose),
            PlanGoal::Straight(poses) => poses.last(),
            _ => None,
        };
        let pose = pose.ok_or_else(|| fault("bad_request", "the servo asked for no tool pose"))?;
        let base_from_rover = self.robot.rover_from_arm_base.inverse();
        let goal = AxisGoal {
            point: (base_from_rover * pose.tip_m).coords,
            axis: (base_from_rover * pose.axis).unit,
        };
        closest_solution(&self.robot.arm, &self.robot.tool, &goal, near)
            .map_err(|e| fault("out_of_reach", e.to_string()))
    }

    /// The posture in which placements start, rad.
    ///
    /// # Errors
    /// [`StudyError::Shipped`] never.
    pub fn start(&self) -> Result<Vec<f64>, StudyError> {
        let start = self.robot.posture(START);
        Ok(start
            .map_err(|e| StudyError::Shipped(e.to_string()))?
            .to_vec())
    }

    /// Runs the servo's loop to its end, and then the last way to the target without a look.
    ///
    /// # Errors
    /// The servo's fault.
    pub fn place(&mut self, goal: &PlaceGoal, rules: EstimatorRules) -> Result<Placed, Fault> {
        let mut placement = Placement::new(self.robot.clone(), goal.clone(), rules);
        let mut q = self.start().map_err(|e| fault("internal", e.to_string()))?;
        let (mut busy_s, mut cycles) = (0.0, 0);
        for _ in 0..MOST_STEPS {
            let started = Instant::now();
            let step = placement.next(&q)?;
            busy_s += started.elapsed().as_secs_f64();
            match step {
                Step::Move(request) => q = self.reach(&request.goal, &q)?,
                Step::Try(request) => match self.reach(&request.goal, &q) {
                    Ok(next) => q = next,
                    Err(_) => placement.leave_out(),
                },
                Step::Look => {
                    let frame = self.frame_at(&q)?;
                    let started = Instant::now();
                    placement.look(&q, &frame)?;
                    busy_s += started.elapsed().as_secs_f64();
                    cycles += 1;
                }
                Step::Done(result) => {
                    let joints_rad = self.corrected(&result.compensation, &goal.target, &q)?;
                    return Ok(Placed {
                        result,
                        joints_rad,
                        computing_us: busy_s * 1e6,
                        cycles,
                    });
                }
            }
        }
        Err(fault(
            "no_end",
            format!("not placed after {MOST_STEPS} steps"),
        ))
    }

    /// Joint angles that put the tip on a target with this compensation.
    ///
    /// # Errors
    /// `out_of_reach`.
    pub fn corrected(
        &self,
        compensation: &Compensation,
        target: &Target,
        near: &[f64],
    ) -> Result<Vec<f64>, Fault> {
        let axis = -target.normal.unit;
        self.model
            .solve(compensation, &target.position_m.coords, &axis, near)
            .map(|solved| solved.joints_rad)
            .map_err(|e| fault("out_of_reach", e.to_string()))
    }
}
