//! Pixels from the true geometry with noise; no images.

use super::{Case, Failed, LOOKS, Outcome, Outcomes, START_M, by_trial, distance_m};
use crate::{
    StudyError,
    draws::Draws,
    workspace::{CAMERA_CENTRE_M, LEVELS},
    world::{TrueRobot, believed},
};
use nalgebra::{Isometry3, Point3, Rotation3, Unit, UnitQuaternion, Vector2, Vector3};
use rover_cameras::{Camera, StereoPair};
use rover_methods::{Kind, Reference, Sample, Setup};
use std::{sync::Arc, time::Instant};

/// Poses over the view before the approach, for the methods that want them.
const INITIAL_POSES: usize = 12;
/// Noise of a pixel coordinate, of the target and of the fiducial, px.
const NOISE_PX: f64 = 0.05;
/// How far from the approach the sightings of the study of cost are, m.
const SIDEWAYS_M: f64 = 0.06;
/// The paper's tool, without the last half millimetre.
const TIP_M: f64 = 0.130;
/// The paper's cameras.
const FOCAL_PX: f64 = 602.15;
const CENTRE_PX: [f64; 2] = [319.5, 239.5];
const SIZE_PX: [u32; 2] = [640, 480];
const BASELINE_M: f64 = 0.08;
/// The true lenses, where they have distortion: coefficients, and tilts of the optical axis
/// (left, right; right and down; rad).
const LENS: [f64; 3] = [0.0, -0.12, 0.03];
const TILTS: [[f64; 2]; 2] = [[0.004, -0.003], [-0.003, 0.005]];
/// The degraded pair: focal length's relative error, rotation between the cameras, one sigma.
const DEGRADED_FOCAL: f64 = 0.03;
const DEGRADED_ROTATION_RAD: f64 = 0.005;

/// What is drawn once for a trial and is common to all methods and blind parts.
struct Truth {
    robot: TrueRobot,
    cameras: StereoPair,
    setup: Arc<Setup>,
    target: Vector3<f64>,
    normal: Unit<Vector3<f64>>,
    believed_target: Reference,
    upward: Unit<Vector3<f64>>,
    initial: Vec<Sample>,
}

fn camera(side: usize, focal_px: f64, turn: &Rotation3<f64>, lens: bool) -> Camera {
    // x right is the rover's y, z looks 45 degrees down, y = z x x.
    let (x, z) = (
        Vector3::y(),
        Vector3::new(1.0, 0.0, 1.0) * std::f64::consts::FRAC_1_SQRT_2,
    );
    let axes = nalgebra::Matrix3::from_columns(&[x, z.cross(&x), z]);
    let rotation = Rotation3::from_matrix_unchecked(axes) * turn;
    let sideways = if side == 0 { -0.5 } else { 0.5 } * BASELINE_M;
    let pose = Isometry3::from_parts(
        (Vector3::from(CAMERA_CENTRE_M) + x * sideways).into(),
        UnitQuaternion::from_rotation_matrix(&rotation),
    );
    let focal = [focal_px; 2];
    if !lens {
        return Camera::pinhole(&pose, focal, CENTRE_PX, SIZE_PX);
    }
    let [right, down] = TILTS[side];
    let axis = Unit::new_normalize(Vector3::new(right, down, 1.0));
    Camera::pinhole_distorted(&pose, focal, CENTRE_PX, SIZE_PX, &axis, LENS)
}

fn cameras(case: Case, draws: &mut Draws) -> StereoPair {
    let lens = matches!(case, Case::UnknownLens | Case::Degraded);
    let degree = if case == Case::Degraded { 1.0 } else { 0.0 };
    let focal = FOCAL_PX * (1.0 + degree * DEGRADED_FOCAL * draws.normal());
    let turn = Rotation3::new(draws.vector(degree * DEGRADED_ROTATION_RAD));
    StereoPair {
        left: camera(0, focal, &Rotation3::identity(), lens),
        right: camera(1, focal, &turn, lens),
    }
}

/// The paper's pair as it is believed to be, arm base frame.
pub fn believed_cameras() -> StereoPair {
    let straight = Rotation3::identity();
    StereoPair {
        left: camera(0, FOCAL_PX, &straight, false),
        right: camera(1, FOCAL_PX, &straight, false),
    }
}

fn believed_setup(case: Case) -> Result<Setup, StudyError> {
    let mut model = believed()?;
    model.tool.tip_in_link = Vector3::new(0.0, 0.0, TIP_M);
    let behind = if case == Case::Behind { 0.09 } else { 0.0 };
    Ok(Setup {
        model,
        cameras: believed_cameras(),
        fiducial_in_link: Vector3::new(0.0, 0.0, TIP_M - behind),
        angle_rad: LEVELS[2].angle_rad(),
        length_m: LEVELS[2].length_m(),
        pixel_sigma_px: NOISE_PX,
    })
}

impl Truth {
    fn draw(setup: &Arc<Setup>, case: Case, seed: u64, trial: usize) -> Result<Self, StudyError> {
        let level = &LEVELS[2];
        let mut draws = Draws::new(seed, &[3, trial as u64]);
        let robot = TrueRobot::draw(
            &setup.model,
            &mut draws,
            level.angle_rad(),
            level.length_m(),
        )?;
        let target = Vector3::new(
            draws.between(0.40, 0.62),
            draws.between(-0.15, 0.15),
            draws.between(0.10, 0.30),
        );
        let tilt = |draws: &mut Draws, sigma: f64| {
            Unit::new_normalize(Vector3::new(
                sigma * draws.normal(),
                sigma * draws.normal(),
                1.0,
            ))
        };
        let normal = tilt(&mut draws, 0.25);
        let upward = -tilt(&mut draws, 0.5);
        let cameras = cameras(case, &mut draws);
        let mut truth = Self {
            believed_target: Reference {
                tip_in_rover: target,
                axis_in_rover: robot.believed_from_true.rotation * normal,
            },
            robot,
            cameras,
            setup: Arc::clone(setup),
            target,
            normal,
            upward,
            initial: Vec::new(),
        };
        let seen = truth.robot.believed_from_true * Point3::from(target);
        let (left_px, right_px) =
            truth
                .pixels(&seen.coords, &mut draws)
                .map_err(|Failed| StudyError::NoTrials {
                    what: "compare: a target out of view",
                })?;
        let at = setup.cameras.triangulate(&left_px, &right_px);
        truth.believed_target.tip_in_rover = at
            .map_err(|_| StudyError::NoTrials {
                what: "compare: a target that cannot be triangulated",
            })?
            .point;
        truth.look_around(&mut draws);
        Ok(truth)
    }

    fn pixels(
        &self,
        seen: &Vector3<f64>,
        draws: &mut Draws,
    ) -> Result<(Vector2<f64>, Vector2<f64>), Failed> {
        let mut noise = || Vector2::new(draws.normal(), draws.normal()) * NOISE_PX;
        let left = self.cameras.left.project(seen).map_err(|_| Failed)?;
        let right = self.cameras.right.project(seen).map_err(|_| Failed)?;
        Ok((left + noise(), right + noise()))
    }

    /// What is seen of the fiducial at joint angles `q`.
    fn sample(
        &self,
        q: &[f64],
        reference: Option<Reference>,
        draws: &mut Draws,
    ) -> Result<Sample, Failed> {
        let seen = self.robot.seen(q, &self.setup.fiducial_in_link);
        let (left_px, right_px) = self.pixels(&seen.map_err(|_| Failed)?, draws)?;
        Ok(Sample {
            joints_rad: q.to_vec(),
            left_px,
            right_px,
            reference,
        })
    }

    /// The poses over the view, none nearer to the target than 10 cm. Their spread in three
    /// directions is that of the independent program. It does not state which directions these are
    /// and where the middle is; both were chosen so that the methods which use the poses agree
    /// with it: how the limited HIPS bears a lens that it does not know depends on what part of
    /// the lens the poses show (4 to 14 mm).
    fn look_around(&mut self, draws: &mut Draws) {
        let mut near = self.first_joints();
        while self.initial.len() < INITIAL_POSES {
            let at = Vector3::new(
                draws.between(0.224, 0.636),
                draws.between(-0.121, 0.121),
                draws.between(-0.028, 0.128),
            );
            let axis = Unit::new_normalize(Vector3::new(
                draws.between(-0.25, 0.25),
                draws.between(-0.25, 0.25),
                1.0,
            ));
            if (at - self.target).norm() < 0.10 {
                continue;
            }
            let Ok(q) = self.setup.joints(&at, &axis, &near) else {
                continue;
            };
            if let Ok(sample) = self.sample(&q, None, draws) {
                self.initial.push(sample);
                near = q;
            }
        }
    }

    /// A deployed posture of the arm from which the search for joint angles starts.
    fn first_joints(&self) -> Vec<f64> {
        vec![0.0, -1.0, 1.8, 0.8, 1.5]
    }
}

/// The plain case's believed robot, a target, and sightings around an approach to it, for
/// measurements of cost.
///
/// # Errors
/// [`StudyError`].
pub fn sightings(
    seed: u64,
    count: usize,
) -> Result<(Arc<Setup>, Reference, Vec<Sample>), StudyError> {
    let setup = Arc::new(believed_setup(Case::Plain)?);
    let truth = Truth::draw(&setup, Case::Plain, seed, 0)?;
    let goal = truth.believed_target.clone();
    let mut q = truth.first_joints();
    let mut draws = Draws::new(seed, &[5]);
    let mut samples = Vec::with_capacity(count);
    let failed = || StudyError::NoTrials {
        what: "cost: a sighting out of reach or view",
    };
    for k in 0..count {
        // Scattered evenly around the approach, so that every
        // method's equations have a solution with the first few, too.
        let along = (0.5 + 0.754_877_666 * k as f64).fract();
        let (sine, cosine) = (2.399_963_229_7 * k as f64).sin_cos();
        let sideways = Vector3::new(SIDEWAYS_M * cosine, SIDEWAYS_M * sine, 0.0);
        let reference = Reference {
            tip_in_rover: goal.tip_in_rover
                + truth.upward.into_inner() * (START_M * along)
                + sideways,
            axis_in_rover: goal.axis_in_rover,
        };
        q = setup
            .joints(&reference.tip_in_rover, &goal.axis_in_rover, &q)
            .map_err(|_| failed())?;
        samples.push(
            truth
                .sample(&q, Some(reference), &mut draws)
                .map_err(|Failed| failed())?,
        );
    }
    Ok((setup, goal, samples))
}

fn place(truth: &Truth, kind: Kind, occlusion_cm: u32, noise: &[u64]) -> Result<Outcome, Failed> {
    let mut method = kind.start(Arc::clone(&truth.setup), truth.believed_target.clone());
    let mut busy_us = 0.0;
    let mut cycles = 0;
    let mut timed = |work: &mut dyn FnMut() -> Result<Vector3<f64>, Failed>| {
        let started = Instant::now();
        let command = work();
        busy_us += started.elapsed().as_secs_f64() * 1e6;
        cycles += 1;
        command
    };
    for sample in truth.initial.iter().take(kind.initial_poses()) {
        timed(&mut || {
            method.observe(sample).map_err(|_| Failed)?;
            Ok(Vector3::zeros())
        })?;
    }
    let goal = &truth.believed_target;
    let axis = goal.axis_in_rover;
    let mut q = truth.first_joints();
    let mut sample: Option<Sample> = None;
    for k in 0..=LOOKS {
        let distance = if k == LOOKS {
            0.0
        } else {
            distance_m(k, occlusion_cm)
        };
        let reference = Reference {
            tip_in_rover: goal.tip_in_rover + truth.upward.into_inner() * distance,
            axis_in_rover: axis,
        };
        let near = q.clone();
        let command = timed(&mut || {
            if let Some(sample) = &sample {
                method.observe(sample).map_err(|_| Failed)?;
            }
            method.command(&reference, &near).map_err(|_| Failed)
        })?;
        q = truth
            .setup
            .joints(&command, &axis, &near)
            .map_err(|_| Failed)?;
        let mut draws = Draws::new(noise[0], &[4, noise[1], k as u64]);
        sample = if k < LOOKS && kind.looks_on_approach() {
            Some(truth.sample(&q, Some(reference), &mut draws)?)
        } else {
            None
        };
    }
    let tip = truth
        .robot
        .arm
        .point(&q, &truth.setup.model.tool.tip_in_link)
        .map_err(|_| Failed)?;
    let times_us = (busy_us / f64::from(cycles), busy_us);
    Outcome::of(&(tip - truth.target), &truth.normal, times_us).ok_or(Failed)
}

/// Runs one case.
///
/// # Errors
/// [`StudyError`].
pub fn outcomes(
    seed: u64,
    trials: usize,
    case: Case,
    occlusions_cm: &[u32],
) -> Result<Vec<Outcomes>, StudyError> {
    let setup = Arc::new(believed_setup(case)?);
    by_trial(
        trials,
        occlusions_cm,
        |trial| Ok((trial as u64, Truth::draw(&setup, case, seed, trial)?)),
        |(trial, truth), kind, occlusion_cm| place(truth, kind, occlusion_cm, &[seed, *trial]).ok(),
    )
}
