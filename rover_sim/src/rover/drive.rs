//! The wheels' driver: steers for an arc or a turn in place, drives it with limited acceleration,
//! stops.

use super::physics::wheel_centres_m;
use nalgebra::Vector3;
use rover_messages::mobility::{DriveArc, DriveGoal, DriveStop, Driving};
use rover_robot::MobilityDescription;

/// Slowing down after a stop takes so long, s.
const STOP_S: f64 = 0.1;
/// A wheel at its largest torque for longer than this has stalled, s.
const STALL_S: f64 = 0.6;
/// Of the wheels with the steering drives front left, front right, rear left, rear right.
const STEERED: [usize; 4] = [0, 1, 4, 5];

/// What the driver is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Phase {
    Idle,
    Steering,
    Rolling,
    /// Slowing down after a stop.
    Braking,
    /// Commands stand still; the rover comes to rest.
    Settling,
}

/// Steering angles and speeds of the wheels for one kind of movement.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Gait {
    steer_rad: [f64; 4],
    /// Way of each wheel per unit of way: metres per metre of an arc, per radian of a turn.
    ratio: [f64; 6],
    /// Sign times the length (m, or rad).
    length: f64,
    speed: f64,
    acceleration: f64,
    is_turn: bool,
}

pub(crate) struct Drive {
    centres_m: [Vector3<f64>; 6],
    wheel_radius_m: f64,
    steer_rate_rad_s: f64,
    speed_m_s: f64,
    turn_rate_rad_s: f64,
    acceleration_m_s2: f64,
    step_s: f64,
    gait: Option<Gait>,
    pub phase: Phase,
    /// Way done, not negative, and its rate.
    done: f64,
    rate: f64,
    brake: f64,
    stalled_s: [f64; 6],
    pub steer_rad: [f64; 4],
    pub steer_rate: [f64; 4],
    /// Angles of the wheels as far as they grip, rad: what the physics is told.
    pub wheel_rad: [f64; 6],
    pub wheel_rate: [f64; 6],
    /// Slip of each wheel.
    pub slip: [f64; 6],
    pub stop_reason: Option<DriveStop>,
}

/// What a step did: way of the rover by the wheels' turning, m, and turn in place, rad, both
/// before slip.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Increment {
    pub way_m: f64,
    pub turn_rad: f64,
}

impl Drive {
    pub fn new(d: &MobilityDescription, step_s: f64) -> Self {
        Self {
            centres_m: wheel_centres_m(d),
            wheel_radius_m: d.wheel_radius_m,
            steer_rate_rad_s: d.limits.steer_rate_rad_s,
            speed_m_s: d.limits.speed_m_s,
            turn_rate_rad_s: d.limits.turn_rate_rad_s,
            acceleration_m_s2: d.limits.acceleration_m_s2,
            step_s,
            gait: None,
            phase: Phase::Idle,
            done: 0.0,
            rate: 0.0,
            brake: 0.0,
            stalled_s: [0.0; 6],
            steer_rad: [0.0; 4],
            steer_rate: [0.0; 4],
            wheel_rad: [0.0; 6],
            wheel_rate: [0.0; 6],
            slip: [0.0; 6],
            stop_reason: None,
        }
    }

    /// Takes up a goal that has been checked.
    pub fn start(&mut self, goal: &DriveGoal) {
        let mut gait = self.gait(&goal.arc);
        gait.speed *= goal.speed_fraction;
        self.gait = Some(gait);
        (self.done, self.rate, self.brake) = (0.0, 0.0, 0.0);
        self.stalled_s = [0.0; 6];
        self.stop_reason = None;
        self.phase = Phase::Steering;
    }

    fn gait(&self, arc: &DriveArc) -> Gait {
        let mut gait = Gait {
            steer_rad: [0.0; 4],
            ratio: [1.0; 6],
            length: 0.0,
            speed: self.speed_m_s,
            acceleration: self.acceleration_m_s2,
            is_turn: false,
        };
        match *arc {
            DriveArc::Arc {
                length_m,
                curvature_1_m: k,
            } => {
                gait.length = length_m;
                for (i, c) in self.centres_m.iter().enumerate() {
                    // Velocity of the wheel per unit of the origin's: (1 - k y, k x).
                    let (along, aside) = (1.0 - k * c.y, k * c.x);
                    gait.ratio[i] = along.hypot(aside) * along.signum();
                    if let Some(n) = STEERED.iter().position(|&s| s == i) {
                        gait.steer_rad[n] = (aside / along).atan();
                    } else {
                        gait.ratio[i] = along;
                    }
                }
            }
            DriveArc::Turn { angle_rad } => {
                gait.length = angle_rad;
                gait.is_turn = true;
                gait.speed = self.turn_rate_rad_s;
                gait.acceleration = self.acceleration_m_s2 / 0.5;
                for (i, c) in self.centres_m.iter().enumerate() {
                    let (along, aside) = (-c.y, c.x);
                    gait.ratio[i] = along;
                    if let Some(n) = STEERED.iter().position(|&s| s == i) {
                        gait.steer_rad[n] = (aside / along).atan();
                        gait.ratio[i] = along.hypot(aside) * along.signum();
                    }
                }
            }
        }
        gait
    }

    pub fn wheel_radius_m(&self) -> f64 {
        self.wheel_radius_m
    }

    /// Begins to stop; a rover that stops already keeps its reason.
    pub fn stop(&mut self, reason: DriveStop) {
        if matches!(self.phase, Phase::Steering | Phase::Rolling) {
            self.brake = self.rate / STOP_S;
            self.phase = if self.rate > 0.0 {
                Phase::Braking
            } else {
                Phase::Settling
            };
            self.steer_rate = [0.0; 4];
            self.stop_reason = Some(reason);
        }
    }

    pub fn finish(&mut self) {
        self.phase = Phase::Idle;
        self.gait = None;
    }

    /// Part of the way done, 0 to 1.
    pub fn progress(&self) -> f64 {
        match self.gait {
            Some(g) if g.length != 0.0 => (self.done / g.length.abs()).min(1.0),
            Some(_) => 1.0,
            None => 0.0,
        }
    }

    pub fn driving(&self) -> Driving {
        match self.phase {
            Phase::Idle => Driving::Idle,
            Phase::Steering => Driving::Steering,
            Phase::Rolling => Driving::Driving,
            Phase::Braking | Phase::Settling => Driving::Stopping,
        }
    }

    /// One control step: advances steering and wheels.
    pub fn advance(&mut self) -> Increment {
        self.wheel_rate = [0.0; 6];
        let Some(gait) = self.gait else {
            return Increment::default();
        };
        match self.phase {
            Phase::Idle | Phase::Settling => Increment::default(),
            Phase::Steering => {
                self.steer(&gait);
                Increment::default()
            }
            Phase::Rolling | Phase::Braking => self.roll(&gait),
        }
    }

    fn steer(&mut self, gait: &Gait) {
        let most = self.steer_rate_rad_s * self.step_s;
        let mut there = true;
        for (n, goal) in gait.steer_rad.iter().enumerate() {
            let change = (goal - self.steer_rad[n]).clamp(-most, most);
            self.steer_rad[n] += change;
            self.steer_rate[n] = change / self.step_s;
            there &= (goal - self.steer_rad[n]).abs() < 1e-12;
            // A wheel that is steered about its centre does not turn.
        }
        if there {
            self.steer_rate = [0.0; 4];
            self.phase = Phase::Rolling;
        }
    }

    fn roll(&mut self, gait: &Gait) -> Increment {
        let remaining = gait.length.abs() - self.done;
        let before = self.rate;
        if self.phase == Phase::Braking {
            self.rate = (self.rate - self.brake * self.step_s).max(0.0);
        } else {
            let stopping = (2.0 * gait.acceleration * remaining.max(0.0)).sqrt();
            let change = gait.acceleration * self.step_s;
            self.rate = gait
                .speed
                .min(stopping)
                .clamp(self.rate - 2.0 * change, self.rate + change);
        }
        let way = (0.5 * (before + self.rate) * self.step_s).min(remaining.max(0.0));
        self.done += way;
        let signed = way * gait.length.signum();
        for i in 0..6 {
            let turned = signed * gait.ratio[i] / self.wheel_radius_m * (1.0 - self.slip[i]);
            self.wheel_rad[i] += turned;
            self.wheel_rate[i] = turned / self.step_s;
        }
        let ended = gait.length.abs() - self.done <= 1e-9 || self.rate <= 1e-9;
        if ended {
            self.rate = 0.0;
            self.phase = Phase::Settling;
        }
        if gait.is_turn {
            Increment {
                way_m: 0.0,
                turn_rad: signed,
            }
        } else {
            Increment {
                way_m: signed,
                turn_rad: 0.0,
            }
        }
    }

    /// Direction in which each wheel is driven: -1, 0 or 1.
    pub fn direction(&self) -> [f64; 6] {
        self.wheel_rate
            .map(|r| if r == 0.0 { 0.0 } else { r.signum() })
    }

    /// Minds wheels at their largest torque.
    pub fn watch_stall(&mut self, stalled: &[bool; 6]) {
        for (i, &is) in stalled.iter().enumerate() {
            self.stalled_s[i] = if is {
                self.stalled_s[i] + self.step_s
            } else {
                0.0
            };
            if self.stalled_s[i] > STALL_S {
                self.stop(DriveStop::Stalled { wheel_n: i as u32 });
            }
        }
    }
}
