//! Wheels and mast: goals, stops, and the hand-over between driving and standing.

use super::{REST_STEPS, World, build};
use crate::{SimulationError, statics};
use nalgebra::{Isometry3, UnitQuaternion};
use rover_messages::{
    Fault,
    arm::StopReason,
    keys::service::HARDWARE,
    mobility::{
        DriveArc, DriveGoal, DriveResult, DriveStop, MastState, PointGoal, PointResult, SitePose,
        WheelsState,
    },
    simulation::TrueRover,
};

/// How far a joint may be from the stowed posture on a drive, rad.
const STOWED_RAD: f64 = 0.05;

impl World {
    /// Whether the wheels are under way.
    pub fn is_driving(&self) -> bool {
        self.vehicle.as_ref().is_some_and(|v| v.is_moving())
    }

    /// Whether the mast is moving.
    pub fn is_pointing(&self) -> bool {
        self.mast.as_ref().is_some_and(|m| m.is_moving())
    }

    /// Begins a drive.
    ///
    /// # Errors
    /// Fault `busy`, `no_wheels`, `arm_not_stowed` (with the joint) or `curvature_too_sharp`.
    pub fn start_drive(&mut self, goal: &DriveGoal) -> Result<(), Fault> {
        if self.is_moving() {
            let message = "a motion is under way; stop it or wait for its end";
            return Err(Fault::new(HARDWARE, "busy", message));
        }
        let robot = self.robot.clone();
        let limits = match robot.mobility() {
            Ok(mobility) => mobility.limits,
            Err(e) => return Err(Fault::new(HARDWARE, "no_wheels", e.to_string())),
        };
        if let DriveArc::Arc { curvature_1_m, .. } = goal.arc
            && curvature_1_m.abs() > limits.curvature_1_m
        {
            let message = format!(
                "curvature {curvature_1_m} 1/m, expected at most {} 1/m",
                limits.curvature_1_m
            );
            return Err(Fault::new(HARDWARE, "curvature_too_sharp", message)
                .with("curvature_1_m", curvature_1_m)
                .with("limit_1_m", limits.curvature_1_m));
        }
        if let Ok(stow) = robot.posture("stow") {
            for (joint, (found, expected)) in self.driver.motor_rad.iter().zip(stow).enumerate() {
                if (found - expected).abs() > STOWED_RAD {
                    let message = format!(
                        "joint {joint} of the arm is at {found:.3} rad, expected {expected:.3} \
                         rad as stowed"
                    );
                    return Err(Fault::new(HARDWARE, "arm_not_stowed", message)
                        .with("joint_n", joint as f64)
                        .with("apart_rad", found - expected));
                }
            }
        }
        let parts = self.arm_part_poses();
        let rover_from_world = self
            .world_from_rover()
            .unwrap_or_else(Isometry3::identity)
            .inverse();
        self.carried = Some(parts.iter().map(|p| rover_from_world * p).collect());
        let step = self.step;
        if let Some(vehicle) = &mut self.vehicle {
            vehicle.start(goal, step);
        }
        Ok(())
    }

    /// Stops a drive.
    pub fn stop_drive(&mut self, reason: DriveStop) {
        if let Some(vehicle) = &mut self.vehicle {
            vehicle.stop(reason);
        }
    }

    /// Begins to point the mast.
    ///
    /// # Errors
    /// Fault `busy`, `no_mast` or `mast_limit` (with the angle and its limits).
    pub fn start_pointing(&mut self, goal: &PointGoal) -> Result<(), Fault> {
        if self.is_moving() {
            let message = "a motion is under way; stop it or wait for its end";
            return Err(Fault::new(HARDWARE, "busy", message));
        }
        let Some(mast) = &mut self.mast else {
            let message = format!("the robot `{}` has no mast", self.robot.name());
            return Err(Fault::new(HARDWARE, "no_mast", message));
        };
        self.mast_stop = None;
        mast.start(goal).map_err(|(joint, found, [low, high])| {
            let name = ["pan", "tilt"][joint];
            let message = format!("{name} {found} rad, expected {low} to {high} rad");
            Fault::new(HARDWARE, "mast_limit", message)
                .with("found_rad", found)
                .with("lower_rad", low)
                .with("upper_rad", high)
        })
    }

    /// Stops the mast.
    pub fn stop_pointing(&mut self, reason: StopReason) {
        if let Some(mast) = &mut self.mast
            && mast.is_moving()
        {
            mast.stop();
            self.mast_stop = Some(reason);
        }
    }

    /// One control step of a drive.
    pub(super) fn drive_step(&mut self) -> Option<Result<DriveResult, Fault>> {
        self.step += 1;
        let now = self.sim_time_s();
        self.vanish(|when| matches!(when, crate::FaultMoment::AtTimeS(t) if *t <= now));
        let step = self.step;
        let ended = self.vehicle.as_mut()?.advance(step)?;
        if let Err(e) = self.park() {
            return Some(Err(Fault::new(HARDWARE, "internal_error", e.to_string())));
        }
        Some(ended.map_err(|stop| {
            let name = match stop {
                DriveStop::Cancelled => "cancelled",
                DriveStop::StopCommand => "stopped",
                _ => "commander_lost",
            };
            Fault::new(HARDWARE, name, format!("the rover was stopped: {stop}"))
        }))
    }

    /// One control step of the mast.
    pub(super) fn mast_step(&mut self) -> Option<Result<PointResult, Fault>> {
        if !self.mast.as_mut()?.advance() {
            return None;
        }
        let Some(reason) = self.mast_stop.take() else {
            return self.mast_state().map(|state| Ok(PointResult { state }));
        };
        let name = match reason {
            StopReason::Cancelled => "cancelled",
            StopReason::StopCommand => "stopped",
            _ => "commander_lost",
        };
        let message = format!("the mast was stopped: {reason}");
        Some(Err(Fault::new(HARDWARE, name, message)))
    }

    /// From the wheels to the springs: the arm's world is made anew where the rover stands, without
    /// the terrain until the arm moves, and the arm settles. No simulated time passes.
    fn park(&mut self) -> Result<(), SimulationError> {
        let Some(vehicle) = &self.vehicle else {
            return Ok(());
        };
        let pose = vehicle.world_from_rover();
        let rest = self.driver.rest_rad.clone();
        build::stand(&mut self.model, &self.robot, &self.truth, &pose, &rest)?;
        let drooped = statics::drooped_angles_rad(&self.model, &rest)?;
        self.arm = crate::ArmPhysics::new(&self.model, &[], &drooped)?;
        self.surrounded = false;
        self.arm.set_rest(&rest);
        let limit = (self.description.driver.settle_limit_s / self.description.step_s) as u64;
        let mut calm = 0;
        for _ in 0..limit {
            self.arm.step();
            self.arm.read(&mut self.joints_rad, &mut self.rates_rad_s);
            calm = if self.is_calm() { calm + 1 } else { 0 };
            if calm >= REST_STEPS {
                break;
            }
        }
        self.carried = None;
        self.observe_contacts();
        Ok(())
    }

    /// True pose of the rover, world frame, if it drives.
    pub fn world_from_rover(&self) -> Option<Isometry3<f64>> {
        let vehicle = self.vehicle.as_ref()?;
        if self.carried.is_some() {
            Some(vehicle.world_from_rover())
        } else {
            self.arm.world_from_rover()
        }
    }

    /// True pose of the mast's head, world frame, if there is a mast.
    pub fn world_from_head(&self) -> Option<Isometry3<f64>> {
        let mast = self.mast.as_ref()?;
        Some(self.world_from_rover()? * mast.rover_from_head())
    }

    /// The true arm as it is mounted now.
    pub fn arm_model(&self) -> &crate::ArmModel {
        &self.model
    }

    /// The arm's links and plunger, world frame.
    pub(super) fn arm_part_poses(&self) -> Vec<Isometry3<f64>> {
        if let (Some(carried), Some(pose)) = (&self.carried, self.world_from_rover()) {
            return carried.iter().map(|p| pose * p).collect();
        }
        let mut poses: Vec<_> = (0..self.model.links.len())
            .map(|i| self.arm.world_from_link(i))
            .collect();
        poses.push(self.arm.world_from_plunger());
        poses
    }

    /// Odometry and attitude, if the robot drives.
    pub fn wheels_state(&self) -> Option<WheelsState> {
        let pose = self.world_from_rover()?;
        let vehicle = self.vehicle.as_ref()?;
        Some(vehicle.state_at(&pose, self.step))
    }

    /// The mast's encoders, if the robot has a mast.
    pub fn mast_state(&self) -> Option<MastState> {
        let mast = self.mast.as_ref()?;
        let [pan_rad, tilt_rad] = mast.angles_rad;
        Some(MastState {
            sim_time_s: self.sim_time_s(),
            step: self.step,
            pan_rad,
            tilt_rad,
            moving: mast.is_moving(),
        })
    }

    /// Part of the drive under way that is done, 0 to 1.
    pub fn drive_progress(&self) -> f64 {
        self.vehicle.as_ref().map_or(0.0, |v| v.progress())
    }

    /// Where the rover really is, and how far off its odometry.
    pub(super) fn true_rover(&self) -> Option<TrueRover> {
        let pose = self.world_from_rover()?;
        let vehicle = self.vehicle.as_ref()?;
        let (roll, pitch, yaw) = pose.rotation.euler_angles();
        let site = self.world_from_site()?;
        let truly = SitePose::from_transform(&(site.inverse() * pose).into());
        let believed = vehicle.state_at(&pose, self.step).pose;
        let left = vehicle.world_from_rover();
        let tau = std::f64::consts::TAU;
        let off = believed.heading_rad - truly.heading_rad;
        Some(TrueRover {
            position_m: pose.translation.vector.into(),
            rpy_rad: [roll, pitch, yaw],
            tilt_by_arm_deg: left.rotation.angle_to(&pose.rotation).to_degrees(),
            position_error_m: believed.position_m.distance(&truly.position_m),
            heading_error_rad: off - tau * (off / tau).round(),
        })
    }

    /// How far the rover, on its wheels with its drives holding, moves in so many control steps,
    /// mm: it should not.
    pub fn creep_mm(&mut self, steps: u32) -> f64 {
        let Some(vehicle) = &mut self.vehicle else {
            return 0.0;
        };
        vehicle.creep_m(steps) * 1e3
    }

    /// The site frame: where the rover stood at the start, levelled.
    pub(crate) fn world_from_site(&self) -> Option<Isometry3<f64>> {
        self.vehicle.as_ref().map(|v| v.world_from_site())
    }
}

/// The pose of a levelled frame at a pose's origin and yaw.
pub(crate) fn levelled(pose: &Isometry3<f64>) -> Isometry3<f64> {
    let yaw = pose.rotation.euler_angles().2;
    Isometry3::from_parts(
        pose.translation,
        UnitQuaternion::from_scaled_axis(nalgebra::Vector3::z() * yaw),
    )
}
