//! The arm's driver: follows a trajectory with the motors, stops them, minds their limits.
//!
//! The driver knows the motors' side of the drives only. Between motor and link lie the backlash
//! (a play operator: the link follows when the slack is used up) and the joint's spring.

use crate::description::DriverDescription;
use rover_kinematics::{JointLimits, JointTrajectory};
use rover_messages::arm::{Guard, StopReason};
use rover_robot::LinkDynamics;

/// Time over which a difference between the present angles and the first point of a trajectory is
/// taken up, s.
const BLEND_S: f64 = 0.2;

/// What the driver is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Phase {
    /// Holding.
    Idle,
    /// On its trajectory.
    Following,
    /// Slowing down along its trajectory after a stop.
    Ramping,
    /// Command stands still; the arm comes to rest.
    Settling,
}

/// A motion under way.
struct Motion {
    trajectory: JointTrajectory,
    guard: Guard,
    /// Present angles minus first point.
    offset_rad: Vec<f64>,
    /// Time along the trajectory, s.
    path_s: f64,
    /// Trajectory seconds per second.
    pace: f64,
    /// Pace lost per second.
    brake: f64,
    elapsed_s: f64,
}

pub(crate) struct Driver {
    limits: Vec<JointLimits>,
    links: Vec<LinkDynamics>,
    settings: DriverDescription,
    step_s: f64,
    half_play_rad: f64,
    command_rad: Vec<f64>,
    /// Motor angles, the encoders' true reading, rad.
    pub motor_rad: Vec<f64>,
    /// Motor rates, rad/s.
    pub motor_rate_rad_s: Vec<f64>,
    /// Angles behind the backlash, rad.
    output_rad: Vec<f64>,
    /// Rest angles of the joint springs, rad: output angle plus what makes up for the damping.
    pub rest_rad: Vec<f64>,
    motion: Option<Motion>,
    pub phase: Phase,
    /// Why the last motion ended early, if it did.
    pub stop_reason: Option<StopReason>,
}

impl Driver {
    pub fn new(
        limits: &[JointLimits],
        links: &[LinkDynamics],
        settings: DriverDescription,
        step_s: f64,
        backlash_rad: f64,
        start_rad: &[f64],
    ) -> Self {
        Self {
            limits: limits.to_vec(),
            links: links.to_vec(),
            settings,
            step_s,
            half_play_rad: backlash_rad / 2.0,
            command_rad: start_rad.to_vec(),
            motor_rad: start_rad.to_vec(),
            motor_rate_rad_s: vec![0.0; start_rad.len()],
            output_rad: start_rad.to_vec(),
            rest_rad: start_rad.to_vec(),
            motion: None,
            phase: Phase::Idle,
            stop_reason: None,
        }
    }

    /// Takes up a trajectory that has been checked.
    pub fn start(&mut self, trajectory: JointTrajectory, guard: Guard) {
        let (first, _) = trajectory.sample(trajectory.points.first().map_or(0.0, |p| p.t_s));
        let offset_rad = self
            .command_rad
            .iter()
            .zip(&first)
            .map(|(q, f)| q - f)
            .collect();
        self.motion = Some(Motion {
            trajectory,
            guard,
            offset_rad,
            path_s: 0.0,
            pace: 1.0,
            brake: 0.0,
            elapsed_s: 0.0,
        });
        self.phase = Phase::Following;
        self.stop_reason = None;
    }

    /// Begins to stop; a motion that stops already keeps its reason.
    pub fn stop(&mut self, reason: StopReason) {
        let Some(motion) = &mut self.motion else {
            return;
        };
        if self.phase != Phase::Following {
            return;
        }
        let stalled = matches!(reason, StopReason::Deviation { .. });
        let mut ramp_s = self.step_s;
        for (rate, limit) in self.motor_rate_rad_s.iter().zip(&self.limits) {
            ramp_s = ramp_s.max(rate.abs() / limit.max_acceleration_rad_s2);
        }
        motion.brake = motion.pace / ramp_s.min(self.settings.stop_ramp_s.max(self.step_s));
        self.stop_reason = Some(reason);
        self.phase = Phase::Ramping;
        if stalled {
            // The motors cannot follow: hold where they are.
            self.command_rad.copy_from_slice(&self.motor_rad);
            self.phase = Phase::Settling;
        }
    }

    /// Ends the motion: the arm is at rest.
    pub fn finish(&mut self) {
        self.motion = None;
        self.phase = Phase::Idle;
    }

    /// Time since the start of the motion, s.
    pub fn elapsed_s(&self) -> f64 {
        self.motion.as_ref().map_or(0.0, |m| m.elapsed_s)
    }

    /// The limit on the tip's force, N.
    pub fn max_force_n(&self) -> Option<f64> {
        self.motion.as_ref().and_then(|m| m.guard.max_force_n)
    }

    /// One control step: moves the motors and sets the springs' rest angles; `joints_rad` are the
    /// true joint angles.
    pub fn advance(&mut self, joints_rad: &[f64]) {
        self.advance_command();
        for (i, link) in self.links.iter().enumerate() {
            let before = (self.motor_rad[i], self.output_rad[i]);
            let mut motor = self.command_rad[i];
            let play = self.half_play_rad;
            let mut output = before.1.clamp(motor - play, motor + play);
            // The motor stalls where the spring would take more than its torque.
            let wind_up = link.max_torque_nm / link.stiffness_nm_rad;
            let possible = output.clamp(joints_rad[i] - wind_up, joints_rad[i] + wind_up);
            motor += possible - output;
            output = possible;
            self.motor_rad[i] = motor;
            self.motor_rate_rad_s[i] = (motor - before.0) / self.step_s;
            self.output_rad[i] = output;
            // The joint's damping acts on the absolute rate; without this it would lag behind.
            let rate = (output - before.1) / self.step_s;
            self.rest_rad[i] = output + link.damping_nms_rad * rate / link.stiffness_nm_rad;
        }
        self.watch_deviation();
    }

    fn advance_command(&mut self) {
        let Some(motion) = &mut self.motion else {
            return;
        };
        if self.phase == Phase::Idle {
            return;
        }
        motion.elapsed_s += self.step_s;
        if self.phase == Phase::Settling {
            return;
        }
        let before = motion.pace;
        motion.pace = (motion.pace - motion.brake * self.step_s).max(0.0);
        motion.path_s += 0.5 * (before + motion.pace) * self.step_s;
        let (angles, _) = motion.trajectory.sample(motion.path_s);
        // Smooth from 1 to 0 with rests at both ends.
        let u = (motion.path_s / BLEND_S).min(1.0);
        let blend = (1.0 - u) * (1.0 - u) * (1.0 + 2.0 * u);
        for ((command, angle), offset) in self
            .command_rad
            .iter_mut()
            .zip(&angles)
            .zip(&motion.offset_rad)
        {
            *command = angle + offset * blend;
        }
        let end_s =
            motion
                .trajectory
                .duration_s()
                .max(if motion.offset_rad.iter().any(|&o| o != 0.0) {
                    BLEND_S
                } else {
                    0.0
                });
        // Rounding must not add a step.
        if motion.pace <= 1e-9 || motion.path_s >= end_s {
            self.phase = Phase::Settling;
        }
    }

    fn watch_deviation(&mut self) {
        let Some(motion) = &self.motion else { return };
        if self.phase != Phase::Following {
            return;
        }
        let own = self.settings.max_following_error_rad;
        let limit_rad = motion.guard.max_deviation_rad.map_or(own, |x| x.min(own));
        let worst = self
            .command_rad
            .iter()
            .zip(&self.motor_rad)
            .map(|(c, m)| (c - m).abs())
            .enumerate()
            .fold(
                (0, 0.0),
                |worst, (i, x)| if x > worst.1 { (i, x) } else { worst },
            );
        if worst.1 > limit_rad {
            self.stop(StopReason::Deviation {
                joint_n: worst.0 as u32,
                found_rad: worst.1,
                limit_rad,
            });
        }
    }
}
