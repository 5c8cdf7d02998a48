//! What the rover believes of its own movement: wheel odometry, gyro heading, attitude sensor.
//!
//! Errors are drawn from the quality that the robot file states, anew for every drive (ground and
//! load differ), as a random walk of the heading over the way, and as bias and noise of the
//! attitude sensor. Every draw is a hash of the run's seed and of what it belongs to.

use super::drive::Increment;
use nalgebra::{Isometry3, Matrix3, UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use rover_geometry::Point;
use rover_messages::mobility::SitePose;
use rover_robot::OdometryQuality;

/// Part of the attitude sensor's error that stays the same over a run.
const BIAS_PART: f64 = 0.8;

/// Random streams, away from those of the true arm and cameras.
#[derive(Clone, Copy)]
enum Kind {
    Drive = 16,
    Heading = 17,
    AttitudeBias = 18,
    AttitudeNoise = 19,
}

fn normals<const N: usize>(seed: u64, kind: Kind, index: u64) -> [f64; N] {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(kind as u64);
    random.set_word_pos(u128::from(index) << 8);
    std::array::from_fn(|_| random.sample(StandardNormal))
}

pub(crate) struct Odometry {
    quality: OdometryQuality,
    scale: f64,
    seed: u64,
    /// World yaw of the site frame.
    site_yaw_rad: f64,
    position_m: Vector3<f64>,
    /// Believed minus true heading.
    heading_error_rad: f64,
    /// Believed heading at the last update.
    heading_rad: f64,
    drives_n: u64,
    ticks_n: u64,
    /// Errors of the drive under way: along, across, turn.
    fractions: [f64; 3],
    /// Way and turn of the drive under way, without sign.
    way_m: f64,
    turn_rad: f64,
    pub driven_m: f64,
    before: SitePose,
    covariance_before: Matrix3<f64>,
    /// Estimated slip over the last ways: (way, slip).
    slips: Vec<(f64, f64)>,
}

/// Way over which the slip is averaged, m.
const SLIP_WINDOW_M: f64 = 0.2;

impl Odometry {
    /// Starts at the true pose given.
    pub fn new(
        quality: OdometryQuality,
        scale: f64,
        seed: u64,
        world_from_rover: &Isometry3<f64>,
    ) -> Self {
        let mut new = Self {
            quality,
            scale,
            seed,
            site_yaw_rad: world_from_rover.rotation.euler_angles().2,
            position_m: Vector3::zeros(),
            heading_error_rad: 0.0,
            heading_rad: 0.0,
            drives_n: 0,
            ticks_n: 0,
            fractions: [0.0; 3],
            way_m: 0.0,
            turn_rad: 0.0,
            driven_m: 0.0,
            before: SitePose {
                position_m: Point::new(0.0, 0.0, 0.0),
                roll_rad: 0.0,
                pitch_rad: 0.0,
                heading_rad: 0.0,
            },
            covariance_before: Matrix3::zeros(),
            slips: Vec::new(),
        };
        new.before = new.pose(world_from_rover, 0);
        new
    }

    /// A drive begins at the true pose given.
    pub fn begin(&mut self, world_from_rover: &Isometry3<f64>, step: u64) {
        let pose = self.pose(world_from_rover, step);
        self.covariance_before = self.covariance();
        self.before = pose;
        self.drives_n += 1;
        let q = &self.quality;
        let [along, across, turn] = normals(self.seed, Kind::Drive, self.drives_n);
        self.fractions = [
            along * q.along_fraction * self.scale,
            across * q.across_fraction * self.scale,
            turn * q.turn_fraction * self.scale,
        ];
        (self.way_m, self.turn_rad) = (0.0, 0.0);
        self.slips.clear();
    }

    /// Takes in what the wheels did since the last call; `slip` is the estimated one.
    pub fn update(
        &mut self,
        increment: &Increment,
        slip: f64,
        world_from_rover: &Isometry3<f64>,
        step: u64,
    ) {
        let [along, across, turn] = self.fractions;
        let way_m = increment.way_m * (1.0 - slip);
        self.ticks_n += 1;
        let [walk] = normals(self.seed, Kind::Heading, self.ticks_n);
        let sigma = self.quality.heading_deg_sqrt_m.to_radians() * self.scale;
        self.heading_error_rad += walk * sigma * way_m.abs().sqrt() + turn * increment.turn_rad;
        let pose = self.pose(world_from_rover, step);
        self.heading_rad = pose.heading_rad;
        let (sin, cos) = pose.heading_rad.sin_cos();
        let level = pose.pitch_rad.cos();
        let forward = Vector3::new(cos * level, sin * level, -pose.pitch_rad.sin());
        let left = Vector3::new(-sin, cos, 0.0);
        self.position_m += forward * (way_m * (1.0 + along)) + left * (way_m * across);
        self.way_m += way_m.abs();
        self.driven_m += way_m.abs();
        self.turn_rad += increment.turn_rad.abs();
        if increment.way_m != 0.0 {
            self.slips.push((increment.way_m.abs(), slip));
            let mut sum = 0.0;
            let keep = self
                .slips
                .iter()
                .rev()
                .take_while(|(way, _)| {
                    sum += way;
                    sum <= SLIP_WINDOW_M
                })
                .count();
            self.slips.drain(..self.slips.len() - keep.max(1));
        }
    }

    /// The pose as the rover believes it in control step `step`.
    pub fn pose(&self, world_from_rover: &Isometry3<f64>, step: u64) -> SitePose {
        let (roll, pitch, yaw) = world_from_rover.rotation.euler_angles();
        let sigma = self.quality.tilt_deg.to_radians() * self.scale;
        let bias: [f64; 2] = normals(self.seed, Kind::AttitudeBias, 0);
        let noise: [f64; 2] = normals(self.seed, Kind::AttitudeNoise, step);
        let rest = (1.0 - BIAS_PART * BIAS_PART).sqrt();
        let [roll_error, pitch_error] =
            [0, 1].map(|i| sigma * (BIAS_PART * bias[i] + rest * noise[i]));
        let tau = std::f64::consts::TAU;
        let heading = yaw - self.site_yaw_rad + self.heading_error_rad;
        SitePose {
            position_m: self.position_m.into(),
            roll_rad: roll + roll_error,
            pitch_rad: pitch + pitch_error,
            heading_rad: heading - tau * (heading / tau).round(),
        }
    }

    /// The pose at the start of the last drive.
    pub fn before(&self) -> SitePose {
        self.before
    }

    /// Stated sigma of roll and pitch, rad.
    pub fn tilt_sigma_rad(&self) -> f64 {
        self.quality.tilt_deg.to_radians()
    }

    /// Mean estimated slip over the last ways.
    pub fn slip(&self) -> f64 {
        let way: f64 = self.slips.iter().map(|s| s.0).sum();
        if way > 0.0 {
            self.slips.iter().map(|s| s.0 * s.1).sum::<f64>() / way
        } else {
            0.0
        }
    }

    /// Whether the slip has been averaged over the whole window.
    pub fn slip_is_settled(&self) -> bool {
        self.slips.iter().map(|s| s.0).sum::<f64>() > 0.5 * SLIP_WINDOW_M
    }

    /// Covariance of the drive under way, or the last one, in the axes of its start.
    pub fn drive_covariance(&self) -> [[f64; 3]; 3] {
        self.quality.covariance(self.way_m, self.turn_rad)
    }

    /// Covariance since the start of the run, in the rover's present axes.
    pub fn covariance(&self) -> Matrix3<f64> {
        let q = self.drive_covariance();
        let q = Matrix3::from_fn(|i, j| q[i][j]);
        // Where the rover is now in the axes of the drive's start.
        let turn = UnitQuaternion::from_scaled_axis(Vector3::z() * -self.before.heading_rad);
        let d = turn * (self.position_m - self.before.position_m.coords);
        let carried = Matrix3::new(1.0, 0.0, -d.y, 0.0, 1.0, d.x, 0.0, 0.0, 1.0);
        let there = carried * self.covariance_before * carried.transpose() + q;
        let turned = self.heading_rad - self.before.heading_rad;
        let (sin, cos) = turned.sin_cos();
        let axes = Matrix3::new(cos, sin, 0.0, -sin, cos, 0.0, 0.0, 0.0, 1.0);
        axes * there * axes.transpose()
    }
}
