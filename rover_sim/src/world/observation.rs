//! What the world shows: the arm's state, pictures, the truth; and the faults it can be told to
//! show.

use super::{Collision, World, lock};
use crate::{
    driver::Phase,
    eyes::{Eyes, Moment, RoverMoment},
};
use nalgebra::Vector3;
use rover_messages::{
    Fault,
    arm::{ArmState, Motion},
    imaging::RawPair,
    keys::service::HARDWARE,
    simulation::{InjectedFault, TruthState, View, ViewRequest},
};
use rover_render::FrameState;
use std::sync::{Arc, Mutex, atomic::Ordering};

impl World {
    /// The arm as its encoders and switch report it.
    pub fn state(&self) -> ArmState {
        ArmState {
            sim_time_s: self.sim_time_s(),
            step: self.step,
            joints_rad: self.encoder_angles_rad(),
            rates_rad_s: self.driver.motor_rate_rad_s.clone(),
            contact: self.switch.closed,
            switch_travel_m: self.arm.switch_travel_m().max(0.0),
            tip_force_n: self.tip_force_n(),
            motion: match self.driver.phase {
                Phase::Idle => Motion::Idle,
                Phase::Ramping => Motion::Stopping,
                Phase::Settling if self.driver.stop_reason.is_some() => Motion::Stopping,
                Phase::Following | Phase::Settling => Motion::Moving,
            },
            stop_reason: self.driver.stop_reason.clone(),
        }
    }

    /// Time since the start of the motion under way, s.
    pub fn elapsed_s(&self) -> f64 {
        self.driver.elapsed_s()
    }

    /// The first uncontrolled contact so far.
    pub fn collision(&self) -> Option<Collision> {
        self.collision
    }

    /// The scene at this instant.
    pub fn moment(&self) -> Moment {
        let mut part_poses = self.arm_part_poses();
        let rover = self.rover_moment();
        if let (Some(rover), Some(vehicle)) = (&rover, &self.vehicle) {
            part_poses.push(rover.world_from_rover);
            part_poses.extend(vehicle.part_poses());
            if let Some(mast) = &self.mast {
                part_poses.push(rover.world_from_rover * mast.rover_from_pan());
                part_poses.push(rover.world_from_rover * mast.rover_from_head());
            }
        }
        Moment {
            sim_time_s: self.sim_time_s(),
            step: self.step,
            frame: FrameState {
                part_poses,
                pattern_visible: !self.is_fiducial_hidden(),
            },
            gone: self.gone.clone(),
            rover,
        }
    }

    fn rover_moment(&self) -> Option<RoverMoment> {
        let world_from_rover = self.world_from_rover()?;
        let head = self.mast.as_ref().map(|m| m.rover_from_head());
        Some(RoverMoment {
            world_from_rover,
            world_from_head: head.map(|h| world_from_rover * h),
            mast: self.mast_state(),
            wheels: self.wheels_state()?,
        })
    }

    fn is_fiducial_hidden(&self) -> bool {
        let occluded = match (&self.description.occlusion, self.designated.last()) {
            (Some(o), Some(target)) => {
                let apart = (self.arm.tip_in_world() - target.surface.point_m).norm();
                apart < o.fiducial_hidden_within_m
            }
            _ => false,
        };
        self.fiducial_hidden || occluded
    }

    /// The cameras, shared: pictures of a [`Moment`] can be taken while the world goes on.
    pub fn eyes(&self) -> Arc<Mutex<Eyes>> {
        self.eyes.clone()
    }

    /// Takes one stereo pair now.
    ///
    /// # Errors
    /// As [`Eyes::grab`].
    pub fn grab(&self, pair: &str, exposure_n: u32) -> Result<RawPair, Fault> {
        lock(&self.eyes).grab(&self.moment(), pair, exposure_n)
    }

    /// What an outside camera sees now.
    ///
    /// # Errors
    /// As [`Eyes::view`].
    pub fn view(&self, request: &ViewRequest) -> Result<View, Fault> {
        lock(&self.eyes).view(&self.moment(), request)
    }

    /// What the simulator knows about the truth.
    pub fn truth_state(&self) -> TruthState {
        TruthState {
            sim_time_s: self.sim_time_s(),
            tip_in_world_m: self.arm.tip_in_world().into(),
            joints_rad: self.joints_rad.clone(),
            physics_wall_s: self.physics_wall_s,
            rendering_wall_s: self.rendering_wall.load(Ordering::Relaxed) as f64 * 1e-9,
            steps: self.step,
            collision: self.collision.map(|c| (c.sim_time_s, c.link_n as u32)),
            rover: self.true_rover(),
        }
    }

    /// The true position of the tip (plunger released), world frame, m.
    pub fn tip_in_world(&self) -> Vector3<f64> {
        self.arm.tip_in_world()
    }

    /// Shows a fault from now on.
    ///
    /// # Errors
    /// Fault `unknown_rock` with the number of rocks there are.
    pub fn inject(&mut self, fault: &InjectedFault) -> Result<(), Fault> {
        match fault {
            InjectedFault::FiducialHidden(hidden) => self.fiducial_hidden = *hidden,
            InjectedFault::SwitchDead(dead) => self.switch.dead = *dead,
            InjectedFault::RockVanishes(rock_n) => {
                let body = self.terrain.rock(*rock_n).ok_or_else(|| {
                    let message = format!("rock {rock_n}, expected below {}", self.terrain.rocks_n);
                    Fault::new(HARDWARE, "unknown_rock", message)
                })?;
                self.remove_body(body);
            }
        }
        Ok(())
    }
}
