//! The simulated world: the true robot, its driver, what it touches and what it sees.
//!
//! A plain value: no network, no threads, no clock but the steps that it is told to make. Two
//! worlds built from the same description and seed and told the same give the same bits.

mod build;
mod mobility;
mod motion;
mod observation;
mod targets;

use crate::{
    SimulationError,
    arm::{ArmModel, ArmPhysics, TipContact},
    check,
    contact_switch::Switch,
    description::{Moment as FaultMoment, SimulationDescription},
    driver::{Driver, Phase},
    eyes::Eyes,
    rover::{Mast, Vehicle},
    statics,
    terrain::Terrain,
    truth::Truth,
};
pub(crate) use build::arm_model;
pub(crate) use mobility::levelled;
use motion::Record;
use nalgebra::{Isometry3, Unit, Vector3};
use rover_messages::{
    Fault,
    arm::{ExecuteResult, StopReason},
    keys::service::HARDWARE,
    mobility::{DriveResult, PointResult},
};
use rover_robot::Robot;
use std::{
    sync::{Arc, Mutex, MutexGuard, PoisonError, atomic::AtomicU64},
    time::Instant,
};

/// Consecutive steps below the rest rate that count as rest.
const REST_STEPS: u32 = 5;
/// Force on a link above which it counts as touching something, N.
const TOUCH_N: f64 = 0.01;

/// What a granted period led to.
#[derive(Clone, Debug, PartialEq)]
pub enum Advance {
    /// No motion was under way; time has passed.
    Idle,
    /// The motion goes on.
    Moving,
    /// The motion has ended and the arm is at rest.
    Ended(Result<ExecuteResult, Fault>),
    /// The drive has ended and the rover stands.
    Parked(Result<DriveResult, Fault>),
    /// The mast's movement has ended.
    Pointed(Result<PointResult, Fault>),
}

/// The first touch of the instrument on the terrain.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Touch {
    /// Where the ball touched, world frame, m.
    pub point_m: Vector3<f64>,
    /// The instrument's axis at that moment, world frame.
    pub axis: Unit<Vector3<f64>>,
}

/// Something other than the plunger's ball touched the terrain or the robot's body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Collision {
    /// Simulated time of the first touch, s.
    pub sim_time_s: f64,
    /// The link, from 0.
    pub link_n: usize,
    /// Largest force so far, N.
    pub force_n: f64,
}

/// The simulated world.
pub struct World {
    pub(crate) robot: Arc<Robot>,
    pub(crate) truth: Truth,
    pub(crate) model: ArmModel,
    description: SimulationDescription,
    terrain: Arc<Terrain>,
    arm: ArmPhysics,
    /// Whether the arm's world holds the terrain that it can reach.
    surrounded: bool,
    driver: Driver,
    switch: Switch,
    eyes: Arc<Mutex<Eyes>>,
    step: u64,
    joints_rad: Vec<f64>,
    rates_rad_s: Vec<f64>,
    tip: Option<TipContact>,
    touch: Option<Touch>,
    pub(crate) contact: Option<Touch>,
    collision: Option<Collision>,
    record: Record,
    gone: Vec<usize>,
    fiducial_hidden: bool,
    has_moved: bool,
    designated: Vec<targets::Designation>,
    mast: Option<Mast>,
    /// Why the mast was told to stop.
    mast_stop: Option<StopReason>,
    vehicle: Option<Vehicle>,
    /// Poses of the arm's parts in the rover frame while the rover drives.
    carried: Option<Vec<Isometry3<f64>>>,
    physics_wall_s: f64,
    rendering_wall: Arc<AtomicU64>,
    /// What the world was built from.
    origin: (u64, Vec<f64>),
}

impl World {
    /// Builds the world with the arm at rest at encoder angles `start_rad`.
    ///
    /// # Errors
    /// [`SimulationError`] with the field, what was found and what was expected.
    pub fn new(
        robot: Arc<Robot>,
        description: &SimulationDescription,
        seed: u64,
        start_rad: &[f64],
    ) -> Result<Self, SimulationError> {
        check::description(description, &robot, start_rad)?;
        let truth = Truth::draw(&robot, &description.truth, seed)?;
        let mut model = build::arm_model(&robot, &truth, description)?;
        let terrain = Arc::new(Terrain::new(&description.terrain));
        let vehicle = build::vehicle(&robot, &model, &terrain, description, seed, start_rad)?;
        if let Some(vehicle) = &vehicle {
            let pose = vehicle.world_from_rover();
            build::stand(&mut model, &robot, &truth, &pose, start_rad)?;
        }
        let scale = description.truth.mobility_scale.unwrap_or(1.0);
        let mast = robot
            .description()
            .mast
            .map(|mast| Mast::new(mast, scale, seed, description.step_s));
        let drooped = statics::drooped_angles_rad(&model, start_rad)?;
        let mut arm = build::arm_physics(&model, &terrain, &drooped)?;
        arm.set_rest(start_rad);
        let driver = Driver::new(
            model.arm.limits(),
            &model.links,
            description.driver,
            description.step_s,
            truth.backlash_rad,
            start_rad,
        );
        let s = &model.switch;
        let switch = Switch {
            closes_at_m: s.closes_at_m,
            opens_at_m: s.closes_at_m - description.contact.hysteresis_m,
            dead: description.faults.switch_dead,
            closed: false,
        };
        let eyes = Eyes::new(&robot, &truth, terrain.clone(), description, seed)?;
        let rendering_wall = eyes.wall_ns.clone();
        let mut world = Self {
            robot,
            truth,
            model,
            description: description.clone(),
            terrain,
            arm,
            surrounded: true,
            driver,
            switch,
            eyes: Arc::new(Mutex::new(eyes)),
            step: 0,
            joints_rad: drooped,
            rates_rad_s: vec![0.0; start_rad.len()],
            tip: None,
            touch: None,
            contact: None,
            collision: None,
            record: Record::default(),
            gone: Vec::new(),
            fiducial_hidden: description.faults.fiducial_hidden,
            has_moved: false,
            designated: Vec::new(),
            mast,
            mast_stop: None,
            vehicle,
            carried: None,
            physics_wall_s: 0.0,
            rendering_wall,
            origin: (seed, start_rad.to_vec()),
        };
        world.come_to_rest();
        if let Some(target) = &description.target {
            let found = world.designate(&target.pair, target.pixel_px).map(|_| ());
            // Only occlusion needs the point from the start; a pixel in the sky is for target
            // selection to refuse.
            if description.occlusion.is_some() {
                found?;
            }
        }
        Ok(world)
    }

    /// Lets the arm settle before time begins.
    fn come_to_rest(&mut self) {
        let limit = (self.description.driver.settle_limit_s / self.description.step_s) as u64;
        for _ in 0..limit {
            self.physics_step();
            self.record.calm_steps = if self.is_calm() {
                self.record.calm_steps + 1
            } else {
                0
            };
            if self.record.calm_steps >= REST_STEPS {
                break;
            }
        }
        self.step = 0;
        self.record = Record::default();
        (self.touch, self.collision) = (None, None);
        self.observe_contacts();
    }

    /// Starts all over: the same world, truth and arm posture, time zero.
    ///
    /// # Errors
    /// Fault `busy` while a motion is under way.
    pub fn reset(&mut self) -> Result<(), Fault> {
        if self.is_moving() {
            return Err(Fault::new(HARDWARE, "busy", "a motion is under way"));
        }
        let (seed, start_rad) = &self.origin;
        *self = Self::new(self.robot.clone(), &self.description, *seed, start_rad)
            .map_err(|e| Fault::new(HARDWARE, "reset_failed", e.to_string()))?;
        Ok(())
    }

    /// The believed robot.
    pub fn robot(&self) -> &Arc<Robot> {
        &self.robot
    }

    /// The effective description.
    pub fn description(&self) -> &SimulationDescription {
        &self.description
    }

    /// Simulated time, s.
    pub fn sim_time_s(&self) -> f64 {
        self.step as f64 * self.description.step_s
    }

    /// Control steps since the start.
    pub fn step_count(&self) -> u64 {
        self.step
    }

    /// Whether a motion of the arm is under way.
    pub fn is_arm_moving(&self) -> bool {
        self.driver.phase != Phase::Idle
    }

    /// Whether arm, wheels or mast are moving.
    pub fn is_moving(&self) -> bool {
        self.is_arm_moving() || self.is_driving() || self.is_pointing()
    }

    /// Grants heartbeat periods; ends early, in the very step, when a motion ends.
    pub fn advance(&mut self, periods: u32) -> Advance {
        let start = Instant::now();
        let steps = u64::from(periods) * self.steps_per_period();
        let mut outcome = if self.is_moving() {
            Advance::Moving
        } else {
            Advance::Idle
        };
        for _ in 0..steps {
            let ended = if self.is_driving() {
                self.drive_step().map(Advance::Parked)
            } else {
                self.physics_step();
                if self.is_arm_moving() {
                    self.supervise().map(Advance::Ended)
                } else {
                    self.mast_step().map(Advance::Pointed)
                }
            };
            if let Some(ended) = ended {
                outcome = ended;
                break;
            }
        }
        self.physics_wall_s += start.elapsed().as_secs_f64();
        outcome
    }

    /// Control steps in one heartbeat period of what is under way: wheels, mast, else arm.
    pub fn steps_per_period(&self) -> u64 {
        let d = self.robot.description();
        let heartbeat_s = match (&d.mobility, &d.mast) {
            (Some(mobility), _) if self.is_driving() => mobility.heartbeat_s,
            (_, Some(mast)) if self.is_pointing() => mast.heartbeat_s,
            _ => d.arm.heartbeat_s,
        };
        (heartbeat_s / self.description.step_s).round() as u64
    }

    /// One step of driver and physics, and what contacts and switch do in it.
    fn physics_step(&mut self) {
        self.driver.advance(&self.joints_rad);
        self.arm.set_rest(&self.driver.rest_rad);
        self.arm.step();
        self.step += 1;
        self.arm.read(&mut self.joints_rad, &mut self.rates_rad_s);
        self.observe_contacts();
        let now = self.sim_time_s();
        self.vanish(|when| matches!(when, FaultMoment::AtTimeS(t) if *t <= now));
    }

    fn observe_contacts(&mut self) {
        let contacts = self.arm.contacts();
        self.tip = contacts.tip;
        self.touch = match (contacts.tip, self.touch) {
            (None, _) => None,
            (Some(_), Some(touch)) => Some(touch),
            (Some(tip), None) => {
                let axis = self.arm.world_from_plunger().rotation * Vector3::z_axis();
                Some(Touch {
                    point_m: tip.point_m,
                    axis,
                })
            }
        };
        if let Some((link_n, force_n)) = contacts.elsewhere.filter(|(_, f)| *f > TOUCH_N) {
            let sim_time_s = self.sim_time_s();
            let collision = self.collision.get_or_insert(Collision {
                sim_time_s,
                link_n,
                force_n,
            });
            collision.force_n = collision.force_n.max(force_n);
        }
        if self.switch.update(self.arm.switch_travel_m()) {
            // The first closing is the placement; a retract and another approach replace it.
            self.contact = self.touch;
            if !self.record.started_closed && self.record.joints_at_contact_rad.is_none() {
                self.record.joints_at_contact_rad = Some(self.encoder_angles_rad());
                self.stop(StopReason::Contact);
            }
        }
    }

    fn tip_force_n(&self) -> f64 {
        self.tip.map_or(0.0, |t| t.axial_force_n.max(0.0))
    }

    fn encoder_angles_rad(&self) -> Vec<f64> {
        let noise = self.truth.encoder_noise(self.step);
        self.driver
            .motor_rad
            .iter()
            .zip(noise)
            .map(|(q, n)| q + n)
            .collect()
    }

    /// Lets the described rock vanish if its moment has come.
    fn vanish(&mut self, has_come: impl Fn(&FaultMoment) -> bool) {
        if let Some(fault) = self.description.faults.rock_vanishes
            && has_come(&fault.when)
            && let Some(body) = self.terrain.rock(fault.rock_n)
        {
            self.remove_body(body);
        }
    }

    fn remove_body(&mut self, body: usize) {
        let is_new = !self.gone.contains(&body);
        self.arm.remove_surface(body);
        if let Some(vehicle) = &mut self.vehicle {
            vehicle.remove_surface(body);
        }
        if is_new {
            self.gone.push(body);
        }
    }
}

/// The lock even if a thread panicked while it held it: every picture is made anew.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
