//! The true robot: the believed one with errors that no service knows.
//!
//! The paper's experiment draws twenty Denavit-Hartenberg parameters and six parameters of the
//! camera mount from normal distributions; besides these there are encoder noise, backlash and the
//! cameras' intrinsics. Every kind has a random stream of its own, so that switching one on does
//! not change the draws of another, and every value is drawn whether or not its sigma is zero.

use crate::{
    SimulationError,
    description::{IntrinsicsError, TruthDescription},
};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use rover_cameras::{Camera, StereoPair};
use rover_kinematics::{Arm, ERRORS_PER_JOINT};
use rover_robot::Robot;

/// Random streams, one per kind of error.
#[derive(Clone, Copy)]
enum Kind {
    Arm = 1,
    Mount = 2,
    Intrinsics = 3,
    Encoder = 4,
}

/// A camera pair as it really is.
#[derive(Clone, Debug)]
pub struct TruePair {
    /// Name of the pair.
    pub name: String,
    /// True camera models, in the frame of what the pair is mounted on: the rover frame (which
    /// for a robot that does not drive is the world frame) or the mast's head.
    pub cameras: StereoPair,
    /// Takes a true position to the one that the believed camera models make of it:
    /// `exp(w) (p - c0) + c0 + t` with `c0` the mean of the believed camera centres.
    pub believed_from_true: Isometry3<f64>,
}

/// The true robot.
#[derive(Clone, Debug)]
pub struct Truth {
    /// True kinematics.
    pub arm: Arm,
    /// Pose of the arm's base, rover frame.
    pub rover_from_base: Isometry3<f64>,
    /// Camera pairs in the order of the robot file.
    pub pairs: Vec<TruePair>,
    /// Noise of one encoder reading, rad.
    pub encoder_noise_rad: f64,
    /// Full width of the joints' backlash, rad.
    pub backlash_rad: f64,
    seed: u64,
}

fn stream(seed: u64, kind: Kind) -> ChaCha8Rng {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(kind as u64);
    random
}

fn normals<const N: usize>(random: &mut ChaCha8Rng) -> [f64; N] {
    std::array::from_fn(|_| random.sample(StandardNormal))
}

impl Truth {
    /// Draws the true robot.
    ///
    /// Draws in order: per joint theta, d, a, alpha; per camera pair rotation vector x, y, z about
    /// the mean camera centre, then translation x, y, z; per camera (left, right) focal length,
    /// principal point u, v.
    ///
    /// # Errors
    /// [`SimulationError`] when an error is so large that arm or camera are none any more.
    pub fn draw(
        robot: &Robot,
        errors: &TruthDescription,
        seed: u64,
    ) -> Result<Self, SimulationError> {
        let angle_rad = errors.angle_deg.to_radians();
        let length_m = errors.length_mm * 1e-3;
        let mut random = stream(seed, Kind::Arm);
        let mut rows = Vec::with_capacity(ERRORS_PER_JOINT * robot.arm.joint_count());
        for _ in 0..robot.arm.joint_count() {
            let [theta, d, a, alpha] = normals(&mut random);
            rows.extend([
                theta * angle_rad,
                d * length_m,
                a * length_m,
                alpha * angle_rad,
            ]);
        }
        let mut mounts = stream(seed, Kind::Mount);
        let mut lenses = stream(seed, Kind::Intrinsics);
        let pairs = robot
            .description()
            .cameras
            .iter()
            .map(|pair| {
                let [wx, wy, wz, tx, ty, tz] = normals(&mut mounts);
                // The mast has errors of its own.
                let on_body = f64::from(u8::from(pair.mount.is_body()));
                let rotation = Vector3::new(wx, wy, wz) * (angle_rad * on_body);
                let translation = Vector3::new(tx, ty, tz) * (length_m * on_body);
                let believed = &pair.cameras;
                let [left, right] = [&believed.left, &believed.right].map(|c| *c.model.cahv()[0]);
                let centre = (left + right) / 2.0;
                let believed_from_true = about(&centre, rotation, translation);
                let true_from_believed = believed_from_true.inverse();
                let mut moved = |camera: &Camera, side| {
                    disturbed_camera(camera, &errors.intrinsics, normals(&mut lenses))
                        .map_err(|message| SimulationError::Camera {
                            pair: pair.name.clone(),
                            side,
                            message,
                        })
                        .map(|c| c.transformed(&true_from_believed))
                };
                let cameras = StereoPair {
                    left: moved(&believed.left, "left")?,
                    right: moved(&believed.right, "right")?,
                };
                Ok(TruePair {
                    name: pair.name.clone(),
                    cameras,
                    believed_from_true,
                })
            })
            .collect::<Result<_, SimulationError>>()?;
        Ok(Self {
            arm: robot.arm.perturbed(&rows)?,
            rover_from_base: robot.rover_from_arm_base.isometry,
            pairs,
            encoder_noise_rad: errors.encoder_noise_rad,
            backlash_rad: errors.backlash_rad,
            seed,
        })
    }

    /// The noise of the encoders' readings in control step `step`, rad: the same whenever it is
    /// asked for.
    pub fn encoder_noise(&self, step: u64) -> Vec<f64> {
        let mut random = stream(self.seed, Kind::Encoder);
        // Far more words than the few normals of one step can take.
        random.set_word_pos(u128::from(step) << 10);
        (0..self.arm.joint_count())
            .map(|_| random.sample::<f64, _>(StandardNormal) * self.encoder_noise_rad)
            .collect()
    }

    /// The true pair of that name.
    pub fn pair(&self, name: &str) -> Option<&TruePair> {
        self.pairs.iter().find(|p| p.name == name)
    }
}

/// `exp(rotation) (p - centre) + centre + translation`.
fn about(
    centre: &Vector3<f64>,
    rotation: Vector3<f64>,
    translation: Vector3<f64>,
) -> Isometry3<f64> {
    let turn = UnitQuaternion::from_scaled_axis(rotation);
    Isometry3::from_parts(
        Translation3::from(centre + translation - turn * centre),
        turn,
    )
}

/// The camera with focal length and principal point changed by standard normal draws `[focal, u,
/// v]` times their sigmas.
///
/// # Errors
/// What makes it no camera any more.
pub fn disturbed_camera(
    camera: &Camera,
    errors: &IntrinsicsError,
    [focal, u, v]: [f64; 3],
) -> Result<Camera, String> {
    let scale = 1.0 + focal * errors.focal_fraction;
    let shift = [u * errors.principal_point_px, v * errors.principal_point_px];
    let mut camera = camera.clone();
    if errors == &IntrinsicsError::default() {
        return Ok(camera);
    }
    let [a, h, v] = camera.model.ahv_mut();
    let a = *a;
    for (axis, shift) in [(h, shift[0]), (v, shift[1])] {
        let centre = a.dot(axis) / a.norm_squared();
        *axis = (*axis - a * centre) * scale + a * (centre + shift);
    }
    camera.validate().map_err(|e| e.to_string())?;
    Ok(camera)
}
