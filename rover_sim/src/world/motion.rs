//! Motions: how they begin, are stopped, watched and ended.

use super::{REST_STEPS, World, build};
use crate::{description::Moment, driver::Phase};
use rover_kinematics::JointTrajectory;
use rover_messages::{
    Fault,
    arm::{ExecuteResult, Guard, StopReason},
    keys::service::HARDWARE,
};

/// Trajectories must begin and end slower than this, rad/s.
const REST_RATE_RAD_S: f64 = 1e-3;

/// What is kept of the motion under way.
#[derive(Default)]
pub(super) struct Record {
    pub started_closed: bool,
    pub peak_force_n: f64,
    pub joints_at_contact_rad: Option<Vec<f64>>,
    stopped_at_s: Option<f64>,
    still_at_s: Option<f64>,
    pub calm_steps: u32,
    settling_steps: u64,
}

impl World {
    /// Begins a motion.
    ///
    /// # Errors
    /// Fault `busy`, `trajectory_invalid` (with the kinematics' words) or `start_mismatch` (with
    /// the joint, the angle found and the angle expected).
    pub fn start(&mut self, trajectory: JointTrajectory, guard: Guard) -> Result<(), Fault> {
        let refuse = |name, message| Err(Fault::new(HARDWARE, name, message));
        if self.is_moving() {
            return refuse(
                "busy",
                "a motion is under way; stop it or wait for its end".into(),
            );
        }
        if let Err(e) = trajectory.validate(&self.robot.arm) {
            return refuse("trajectory_invalid", e.to_string());
        }
        if !self.surrounded {
            build::surround(&mut self.arm, &self.model, &self.terrain, &self.gone)
                .map_err(|e| Fault::new(HARDWARE, "internal_error", e.to_string()))?;
            self.surrounded = true;
        }
        let (Some(first), Some(last)) = (trajectory.points.first(), trajectory.points.last())
        else {
            return refuse("trajectory_invalid", "no points".into());
        };
        for (what, point) in [("first", first), ("last", last)] {
            if let Some(j) = point
                .qd_rad_s
                .iter()
                .position(|r| r.abs() > REST_RATE_RAD_S)
            {
                let rate = point.qd_rad_s[j];
                let message =
                    format!("the {what} point moves joint {j} at {rate} rad/s, expected rest");
                return refuse("trajectory_invalid", message);
            }
        }
        let tolerance =
            self.description.driver.start_tolerance_rad + 6.0 * self.truth.encoder_noise_rad;
        for (joint, (found, &present)) in first.q_rad.iter().zip(&self.driver.motor_rad).enumerate()
        {
            let apart = found - present;
            if apart.abs() > tolerance {
                let message = format!(
                    "the trajectory starts joint {joint} at {found} rad, the encoder reads \
                     {present} rad; expected within {tolerance} rad"
                );
                return Err(Fault::new(HARDWARE, "start_mismatch", message)
                    .with("joint_n", joint as f64)
                    .with("apart_rad", apart));
            }
        }
        self.driver.start(trajectory, guard);
        self.record = Record {
            started_closed: self.switch.closed,
            ..Record::default()
        };
        if !self.has_moved {
            self.has_moved = true;
            self.vanish(|when| matches!(when, Moment::FirstArmMotion));
        }
        Ok(())
    }

    /// Stops a motion: the motors slow down along the trajectory, within their acceleration if
    /// that takes no longer than the driver's stop ramp. Time must be granted by
    /// [`Self::advance`] until the motion has ended.
    pub fn stop(&mut self, reason: StopReason) {
        if self.driver.phase == Phase::Following {
            self.record.stopped_at_s = Some(self.sim_time_s());
            self.driver.stop(reason);
        }
    }

    /// Watches force and rest; the outcome when the motion has ended.
    pub(super) fn supervise(&mut self) -> Option<Result<ExecuteResult, Fault>> {
        let force_n = self.tip_force_n();
        self.record.peak_force_n = self.record.peak_force_n.max(force_n);
        if let Some(limit_n) = self.driver.max_force_n()
            && force_n > limit_n
        {
            self.stop(StopReason::Force {
                found_n: force_n,
                limit_n,
            });
        }
        if self.driver.phase != Phase::Settling {
            return None;
        }
        let now = self.sim_time_s();
        self.record.still_at_s.get_or_insert(now);
        self.record.settling_steps += 1;
        self.record.calm_steps = if self.is_calm() {
            self.record.calm_steps + 1
        } else {
            0
        };
        if self.record.calm_steps >= REST_STEPS {
            return Some(self.conclude());
        }
        let waited_s = self.record.settling_steps as f64 * self.description.step_s;
        if waited_s < self.description.driver.settle_limit_s {
            return None;
        }
        let fastest = self
            .rates_rad_s
            .iter()
            .fold(0.0, |m: f64, r| m.max(r.abs()));
        self.driver.finish();
        let message = format!("the arm does not come to rest: {fastest} rad/s after {waited_s} s");
        Some(Err(Fault::new(HARDWARE, "arm_not_at_rest", message)
            .with("rate_rad_s", fastest)
            .with("waited_s", waited_s)))
    }

    pub(super) fn is_calm(&self) -> bool {
        let limit = self.description.driver.rest_rate_rad_s;
        let tilt = self.arm.tilt_rates_rad_s().unwrap_or_default();
        self.rates_rad_s
            .iter()
            .chain(&tilt)
            .all(|r| r.abs() < limit)
    }

    /// Ends the motion; a stop on contact or force is a result, any other stop a fault.
    fn conclude(&mut self) -> Result<ExecuteResult, Fault> {
        self.driver.finish();
        let record = std::mem::take(&mut self.record);
        let state = self.state();
        let reason = state.stop_reason.clone();
        let name = match &reason {
            None | Some(StopReason::Contact | StopReason::Force { .. }) => {
                return Ok(ExecuteResult {
                    completed: reason.is_none(),
                    peak_force_n: record.peak_force_n,
                    joints_at_contact_rad: record.joints_at_contact_rad,
                    state,
                });
            }
            Some(StopReason::Deviation { .. }) => "path_deviation",
            Some(StopReason::Cancelled) => "cancelled",
            Some(StopReason::StopCommand) => "stopped",
            Some(StopReason::CommanderLost { .. }) => "commander_lost",
        };
        let message = reason.map_or_else(String::new, |r| format!("the arm was stopped: {r}"));
        let mut fault = Fault::new(HARDWARE, name, message);
        if let (Some(stop), Some(still)) = (record.stopped_at_s, record.still_at_s) {
            fault = fault
                .with("still_after_ms", (still - stop) * 1e3)
                .with("rest_after_ms", (self.sim_time_s() - stop) * 1e3);
        }
        Err(fault)
    }
}
