//! The rover that carries the arm: wheels, odometry, mast.

mod drive;
mod mast;
mod odometry;
mod physics;
mod shape;
mod soil;

pub(crate) use drive::Phase;
pub(crate) use mast::Mast;
pub(crate) use physics::{Lump, wheel_centres_m};
pub(crate) use shape::vehicle_parts;

use crate::{
    SimulationError,
    description::{RoverStart, SimulationDescription},
    terrain::Terrain,
    world::levelled,
};
use drive::{Drive, Increment};
use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use odometry::Odometry;
use physics::RoverPhysics;
use rover_messages::mobility::{DriveGoal, DriveResult, DriveStop, WheelsState};
use rover_robot::{MobilityDescription, VehicleDynamics};
use soil::Soil;

/// Longest step of the driving rover, s. What is stiff in it (drives, suspension, contacts) is
/// implicit, and it drives at a tenth of a metre per second: over undulating ground with stones the
/// way after 0.8 m differs by 0.7 % in the mean, 2.5 % at most, from that with steps of 0.5 ms.
const STEP_S: f64 = 0.01;
/// Time between two looks at loads, slip and odometry, s.
const TICK_S: f64 = 0.02;
/// Time below the rest speeds that counts as rest, s.
const REST_S: f64 = 0.05;
const REST_M_S: f64 = 2e-4;
const REST_RAD_S: f64 = 1e-3;
/// Longest wait for rest, s.
const SETTLE_LIMIT_S: f64 = 5.0;

/// The rover on its wheels.
pub(crate) struct Vehicle {
    limits: rover_robot::MobilityLimits,
    physics: RoverPhysics,
    drive: Drive,
    soil: Soil,
    odometry: Odometry,
    world_from_site: Isometry3<f64>,
    world_step_s: f64,
    /// Steps of the world in one of its own.
    world_steps: u64,
    /// Its steps between two looks.
    tick_steps: u64,
    weight_n: f64,
    goal: Option<DriveGoal>,
    pending: Increment,
    /// Pull of each wheel over its load, smoothed.
    pull: [f64; 6],
    slip_estimate: f64,
    ticks: u64,
    calm_s: f64,
    settling_s: f64,
}

/// What a vehicle is made from.
pub(crate) struct Parts<'a> {
    pub mobility: &'a MobilityDescription,
    pub dynamics: &'a VehicleDynamics,
    /// The arm as it is carried.
    pub arm: Lump,
    pub gravity_m_s2: Vector3<f64>,
}

impl Vehicle {
    /// Lets the rover down on the terrain and waits until it stands.
    ///
    /// # Errors
    /// [`SimulationError`] when a collider cannot be made or the rover does not come to rest.
    pub fn new(
        parts: &Parts<'_>,
        terrain: &Terrain,
        d: &SimulationDescription,
        seed: u64,
    ) -> Result<Self, SimulationError> {
        let start = d.rover.unwrap_or_default();
        let world_from_rover = above_ground(parts.mobility, terrain, &start);
        let world_steps = whole_steps(STEP_S, d.step_s);
        let step_s = d.step_s * world_steps as f64;
        let mut physics = RoverPhysics::new(
            parts.mobility,
            parts.dynamics,
            &parts.arm,
            &parts.gravity_m_s2,
            step_s,
            terrain,
            &world_from_rover,
        )?;
        let mut drive = Drive::new(parts.mobility, step_s);
        settle(&mut physics, &mut drive, step_s)?;
        let soil = d.terrain.soil.clone().unwrap_or_default();
        let scale = d.truth.mobility_scale.unwrap_or(1.0);
        let standing = physics.world_from_rover();
        let v = parts.dynamics;
        let mass_kg = v.body_kg
            + parts.arm.mass_kg
            + 2.0 * (v.rocker_kg + v.bogie_kg)
            + 4.0 * v.steer_kg
            + 6.0 * v.wheel_kg;
        Ok(Self {
            limits: parts.mobility.limits,
            drive,
            soil: Soil::new(soil, seed),
            odometry: Odometry::new(parts.mobility.odometry, scale, seed, &standing),
            world_from_site: levelled(&standing),
            world_step_s: d.step_s,
            world_steps,
            tick_steps: whole_steps(TICK_S, step_s),
            weight_n: mass_kg * parts.gravity_m_s2.norm(),
            goal: None,
            pending: Increment::default(),
            pull: [0.0; 6],
            slip_estimate: 0.0,
            ticks: 0,
            calm_s: 0.0,
            settling_s: 0.0,
            physics,
        })
    }

    pub fn is_moving(&self) -> bool {
        self.drive.phase != Phase::Idle
    }

    /// Takes up a goal whose numbers have been checked; `step` is the present control step.
    pub fn start(&mut self, goal: &DriveGoal, step: u64) {
        self.odometry.begin(&self.physics.world_from_rover(), step);
        self.drive.start(goal);
        self.goal = Some(*goal);
        self.pull = [0.0; 6];
        self.slip_estimate = soil::slip(self.soil.mean_resistance());
        (self.ticks, self.calm_s, self.settling_s) = (0, 0.0, 0.0);
    }

    pub fn stop(&mut self, reason: DriveStop) {
        self.drive.stop(reason);
    }

    /// One step of the world; `step` is its number. The outcome when the drive has ended.
    pub fn advance(&mut self, step: u64) -> Option<Result<DriveResult, DriveStop>> {
        if !step.is_multiple_of(self.world_steps) {
            return None;
        }
        let increment = self.drive.advance();
        self.pending.way_m += increment.way_m;
        self.pending.turn_rad += increment.turn_rad;
        let stalled = self.physics.command(
            &self.drive.steer_rad,
            &self.drive.steer_rate,
            &mut self.drive.wheel_rad,
            &self.drive.wheel_rate,
        );
        self.physics.step();
        self.drive.watch_stall(&stalled);
        self.ticks += 1;
        if self.ticks.is_multiple_of(self.tick_steps) {
            self.tick(step);
        }
        if self.drive.phase != Phase::Settling {
            return None;
        }
        let step_s = self.world_steps as f64 * self.world_step_s;
        self.settling_s += step_s;
        self.calm_s = if is_calm(&self.physics) {
            self.calm_s + step_s
        } else {
            0.0
        };
        if self.calm_s < REST_S && self.settling_s < SETTLE_LIMIT_S {
            return None;
        }
        self.tick(step);
        self.drive.finish();
        let state = self.state(step);
        let reason = self.drive.stop_reason.clone();
        Some(match reason {
            None
            | Some(DriveStop::Slip { .. } | DriveStop::Tilt { .. } | DriveStop::Stalled { .. }) => {
                Ok(DriveResult {
                    before: self.odometry.before(),
                    covariance: self.odometry.drive_covariance(),
                    completed: reason.is_none(),
                    stop_reason: reason,
                    state,
                })
            }
            Some(other) => Err(other),
        })
    }

    /// Looks at loads and torques, works out slip and odometry, minds the limits.
    fn tick(&mut self, step: u64) {
        let loads = self.physics.loads_n();
        let direction = self.drive.direction();
        let centres = self.physics.wheel_centres_m();
        let radius = self.drive.wheel_radius_m();
        let mut torque = 0.0;
        for i in 0..6 {
            let load = loads[i].max(0.02 * self.weight_n);
            let ratio = self.physics.torque_nm[i] * direction[i] / (radius * load);
            self.pull[i] += 0.2 * (ratio.clamp(-1.0, 1.5) - self.pull[i]);
            self.drive.slip[i] = self.soil.slip(&centres[i], self.pull[i]);
            // The drive feels its track's resistance too.
            torque += self.pull[i] * load + self.soil.resistance(&centres[i]) * load;
        }
        // The rover knows its weight, not the loads.
        let ratio = torque / self.weight_n;
        self.slip_estimate += 0.3 * (soil::slip(ratio) - self.slip_estimate);
        let pose = self.physics.world_from_rover();
        let pending = std::mem::take(&mut self.pending);
        let slip = self.slip_estimate;
        self.odometry.update(&pending, slip, &pose, step);
        self.watch_limits(step);
    }

    fn watch_limits(&mut self, step: u64) {
        let Some(goal) = self.goal else { return };
        let limit = goal.guard.max_slip.unwrap_or(self.limits.slip);
        let found = self.odometry.slip();
        if found > limit && self.odometry.slip_is_settled() {
            self.drive.stop(DriveStop::Slip { found, limit });
        }
        let limit_rad = goal.guard.max_tilt_rad.unwrap_or(self.limits.tilt_rad);
        let pose = self.odometry.pose(&self.physics.world_from_rover(), step);
        let found_rad = (pose.roll_rad.cos() * pose.pitch_rad.cos()).acos();
        if found_rad > limit_rad {
            self.drive.stop(DriveStop::Tilt {
                found_rad,
                limit_rad,
            });
        }
    }

    /// Odometry and attitude; `world_from_rover` is the true pose, that of a rover that stands
    /// and whose arm tilts it included.
    pub fn state_at(&self, world_from_rover: &Isometry3<f64>, step: u64) -> WheelsState {
        let covariance = self.odometry.covariance();
        WheelsState {
            sim_time_s: step as f64 * self.world_step_s,
            step,
            pose: self.odometry.pose(world_from_rover, step),
            covariance: [0, 1, 2].map(|i| [0, 1, 2].map(|j| covariance[(i, j)])),
            tilt_sigma_rad: self.odometry.tilt_sigma_rad(),
            driven_m: self.odometry.driven_m,
            slip: self.odometry.slip(),
            suspension_rad: self.physics.suspension_rad(),
            driving: self.drive.driving(),
        }
    }

    /// As [`Self::state_at`], on the wheels.
    pub fn state(&self, step: u64) -> WheelsState {
        self.state_at(&self.world_from_rover(), step)
    }

    /// How far the rover moves while its drives hold, m.
    pub fn creep_m(&mut self, steps: u32) -> f64 {
        let before = self.world_from_rover().translation.vector;
        for _ in 0..u64::from(steps) / self.world_steps {
            self.physics.command(
                &self.drive.steer_rad,
                &[0.0; 4],
                &mut self.drive.wheel_rad,
                &[0.0; 6],
            );
            self.physics.step();
        }
        (self.world_from_rover().translation.vector - before).norm()
    }

    pub fn progress(&self) -> f64 {
        self.drive.progress()
    }

    /// True pose of the rover on its wheels.
    pub fn world_from_rover(&self) -> Isometry3<f64> {
        self.physics.world_from_rover()
    }

    /// The levelled starting pose.
    pub fn world_from_site(&self) -> Isometry3<f64> {
        self.world_from_site
    }

    /// Poses of rockers, bogies and wheels, world frame.
    pub fn part_poses(&self) -> Vec<Isometry3<f64>> {
        self.physics.part_poses()
    }

    pub fn remove_surface(&mut self, index: usize) {
        self.physics.remove_surface(index);
    }
}

/// The starting pose, high enough above the ground for every wheel.
fn above_ground(d: &MobilityDescription, terrain: &Terrain, start: &RoverStart) -> Isometry3<f64> {
    let turn = UnitQuaternion::from_scaled_axis(Vector3::z() * start.heading_deg.to_radians());
    let [x, y] = start.position_m;
    let highest = wheel_centres_m(d)
        .iter()
        .map(|c| {
            let at = turn * c + Vector3::new(x, y, 0.0);
            terrain.height_near_m(at.x, at.y)
        })
        .fold(f64::MIN, f64::max);
    Isometry3::from_parts(Vector3::new(x, y, highest + 0.02).into(), turn)
}

/// Whole steps of `step_s` that fit in `most_s`, at least one.
fn whole_steps(most_s: f64, step_s: f64) -> u64 {
    ((most_s / step_s + 1e-9).floor() as u64).max(1)
}

fn is_calm(physics: &RoverPhysics) -> bool {
    let (speed, turning) = physics.speeds();
    speed < REST_M_S && turning < REST_RAD_S
}

fn settle(
    physics: &mut RoverPhysics,
    drive: &mut Drive,
    step_s: f64,
) -> Result<(), SimulationError> {
    let (mut calm_s, mut waited_s) = (0.0, 0.0);
    while waited_s < 2.0 * SETTLE_LIMIT_S {
        physics.command(&[0.0; 4], &[0.0; 4], &mut drive.wheel_rad, &[0.0; 6]);
        physics.step();
        waited_s += step_s;
        calm_s = if is_calm(physics) {
            calm_s + step_s
        } else {
            0.0
        };
        // It starts at rest, in the air.
        if calm_s >= REST_S && waited_s > 4.0 * REST_S {
            return Ok(());
        }
    }
    let (speed, turning) = physics.speeds();
    Err(SimulationError::field(
        "rover",
        format!("a rover that still moves at {speed} m/s and {turning} rad/s"),
        "a place where it stands",
    ))
}
