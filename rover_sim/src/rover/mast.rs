//! The mast: two drives with limited rate and acceleration, and where the head really is.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use rover_messages::mobility::PointGoal;
use rover_robot::MastDescription;

const STREAM_BASE: u64 = 24;
const STREAM_STOP: u64 = 25;

/// A movement of both joints along a straight line.
#[derive(Clone, Copy)]
struct Movement {
    from_rad: [f64; 2],
    to_rad: [f64; 2],
    /// Way of the joint that moves farther, what is done of it, and its rate.
    length_rad: f64,
    done_rad: f64,
    rate_rad_s: f64,
    stopping: bool,
}

pub(crate) struct Mast {
    description: MastDescription,
    scale: f64,
    seed: u64,
    step_s: f64,
    /// Encoder angles, rad: pan, tilt.
    pub angles_rad: [f64; 2],
    movement: Option<Movement>,
    /// Movements so far: each ends with pointing errors of its own.
    stops_n: u64,
    /// True minus believed pose of the base: rotation and translation about the base's origin.
    base_error: Isometry3<f64>,
}

fn normals<const N: usize>(seed: u64, stream: u64, index: u64) -> [f64; N] {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(stream);
    random.set_word_pos(u128::from(index) << 8);
    std::array::from_fn(|_| random.sample(StandardNormal))
}

impl Mast {
    pub fn new(description: MastDescription, scale: f64, seed: u64, step_s: f64) -> Self {
        let [x, y, z, rx, ry, rz] = normals(seed, STREAM_BASE, 0);
        let length_m = description.quality.length_mm * 1e-3 * scale;
        let angle_rad = description.quality.angle_deg.to_radians() * scale;
        let centre = Vector3::from(description.base.xyz_m);
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(rx, ry, rz) * angle_rad);
        let moved = Vector3::new(x, y, z) * length_m;
        Self {
            base_error: Isometry3::from_parts(
                Translation3::from(centre + moved - turn * centre),
                turn,
            ),
            angles_rad: [description.pan_rad, description.tilt_rad]
                .map(|[low, high]| 0.0_f64.clamp(low, high)),
            description,
            scale,
            seed,
            step_s,
            movement: None,
            stops_n: 0,
        }
    }

    /// Takes up a goal; the joint (0 pan, 1 tilt), angle and limits if it is out of reach.
    pub fn start(&mut self, goal: &PointGoal) -> Result<(), (usize, f64, [f64; 2])> {
        let goal = [goal.pan_rad, goal.tilt_rad];
        let limits = [self.description.pan_rad, self.description.tilt_rad];
        for (i, (angle, [low, high])) in goal.iter().zip(limits).enumerate() {
            if !(low..=high).contains(angle) {
                return Err((i, *angle, [low, high]));
            }
        }
        let from_rad = self.angles_rad;
        let length_rad = (goal[0] - from_rad[0])
            .abs()
            .max((goal[1] - from_rad[1]).abs());
        self.movement = Some(Movement {
            from_rad,
            to_rad: goal,
            length_rad,
            done_rad: 0.0,
            rate_rad_s: 0.0,
            stopping: false,
        });
        self.stops_n += 1;
        Ok(())
    }

    /// Slows down and stops short of the goal.
    pub fn stop(&mut self) {
        if let Some(movement) = &mut self.movement {
            movement.stopping = true;
        }
    }

    pub fn is_moving(&self) -> bool {
        self.movement.is_some()
    }

    /// One control step. Returns whether the movement ended in it.
    pub fn advance(&mut self) -> bool {
        let Some(m) = &mut self.movement else {
            return false;
        };
        let limit = self.description.max_acceleration_rad_s2;
        let change = limit * self.step_s;
        let left_rad = m.length_rad - m.done_rad;
        // The fastest rate from which the joint can stop in time.
        let wanted = if m.stopping {
            0.0
        } else {
            (2.0 * limit * left_rad)
                .sqrt()
                .min(self.description.max_rate_rad_s)
        };
        m.rate_rad_s = wanted.clamp(m.rate_rad_s - 1.5 * change, m.rate_rad_s + change);
        m.done_rad = (m.done_rad + m.rate_rad_s * self.step_s).min(m.length_rad);
        let there = m.length_rad - m.done_rad < 1e-7;
        let part = if there {
            1.0
        } else {
            m.done_rad / m.length_rad
        };
        self.angles_rad = [0, 1].map(|i| {
            if there {
                m.to_rad[i]
            } else {
                m.from_rad[i] + (m.to_rad[i] - m.from_rad[i]) * part
            }
        });
        let ended = there || (m.stopping && m.rate_rad_s <= 0.0);
        if ended {
            self.movement = None;
        }
        ended
    }

    /// The true pose of the head in the rover frame.
    pub fn rover_from_head(&self) -> Isometry3<f64> {
        let [pan, tilt] = self.true_angles_rad();
        self.base_error * self.description.rover_from_head(pan, tilt).isometry
    }

    /// The pose of the part that only pan turns, rover frame.
    pub fn rover_from_pan(&self) -> Isometry3<f64> {
        let [pan, _] = self.true_angles_rad();
        let base = Vector3::from(self.description.base.xyz_m);
        let turn = UnitQuaternion::from_scaled_axis(Vector3::z() * pan);
        self.base_error * Isometry3::from_parts(base.into(), turn)
    }

    fn true_angles_rad(&self) -> [f64; 2] {
        let errors: [f64; 2] = normals(self.seed, STREAM_STOP, self.stops_n);
        let sigma = self.description.quality.pointing_deg.to_radians() * self.scale;
        [0, 1].map(|i| self.angles_rad[i] + errors[i] * sigma)
    }
}
