//! The methods on a small simulated set-up: signs, identities and convergence.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use crate::{Kind, Method, Reference, Sample, Setup, mount_calibration::rigid_fit};
use nalgebra::{
    Isometry3, Matrix3, Point3, Rotation3, Translation3, Unit, UnitQuaternion, Vector3,
};
use rover_cameras::{Camera, StereoPair};
use rover_compensation::ErrorModel;
use rover_kinematics::{Arm, DhRow, JointLimits, Tool};
use std::{f64::consts::FRAC_PI_2, sync::Arc};

const CENTRE: Vector3<f64> = Vector3::new(0.0, 0.0, -0.3);

/// The flight arm and the paper's cameras, arm base frame (z down).
pub fn setup(fiducial_m: f64) -> Setup {
    let rows = [
        [0.062443, 0.048494, FRAC_PI_2],
        [0.353552, 0.0, 0.0],
        [0.330349, 0.0, 0.0],
        [0.0, -0.098924, -FRAC_PI_2],
        [0.0, -0.077131, FRAC_PI_2],
    ]
    .map(|[a_m, d_m, alpha_rad]| DhRow {
        a_m,
        alpha_rad,
        d_m,
        theta_offset_rad: 0.0,
    });
    let free = JointLimits {
        lower_rad: -6.0,
        upper_rad: 6.0,
        max_rate_rad_s: 1.0,
        max_acceleration_rad_s2: 1.0,
    };
    let z = Vector3::new(1.0, 0.0, 1.0).normalize();
    let axes = Matrix3::from_columns(&[Vector3::y(), z.cross(&Vector3::y()), z]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
    let camera = |y: f64| {
        let at = Translation3::from(CENTRE + Vector3::y() * y);
        let pose = Isometry3::from_parts(at, rotation);
        Camera::pinhole(&pose, [602.15; 2], [319.5, 239.5], [640, 480])
    };
    Setup {
        model: ErrorModel {
            arm: Arm::new(rows.to_vec(), vec![free; 5]).unwrap(),
            tool: Tool::on_turret(0.13, 0.0),
            rover_from_arm_base: Isometry3::identity(),
            mount_centre_in_rover: CENTRE,
        },
        cameras: StereoPair {
            left: camera(-0.04),
            right: camera(0.04),
        },
        fiducial_in_link: Vector3::new(0.0, 0.0, fiducial_m),
        angle_rad: 1f64.to_radians(),
        length_m: 2.5e-3,
        pixel_sigma_px: 0.05,
    }
}

/// A fixed error of about one sigma in arm and mount.
struct Robot {
    arm: Arm,
    seen_from_true: Isometry3<f64>,
}

impl Robot {
    fn new(setup: &Setup, scale: f64) -> Self {
        let e: Vec<f64> = (0..20_u32)
            .map(|i| {
                let s = f64::from(i * 7 % 5) - 2.0 + 0.3;
                let sigma = if i % 4 == 0 || i % 4 == 3 {
                    0.01
                } else {
                    0.0015
                };
                scale * s * sigma
            })
            .collect();
        let centre = Translation3::from(CENTRE);
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.01, -0.015, 0.02) * scale);
        Self {
            arm: setup.model.arm.perturbed(&e).unwrap(),
            seen_from_true: Translation3::new(2e-3 * scale, -3e-3 * scale, 1e-3 * scale)
                * centre
                * turn
                * centre.inverse(),
        }
    }

    fn seen(&self, q: &[f64], in_link: &Vector3<f64>) -> Vector3<f64> {
        (self.seen_from_true * Point3::from(self.arm.point(q, in_link).unwrap())).coords
    }

    fn sample(&self, setup: &Setup, q: &[f64], reference: Option<Reference>) -> Sample {
        let p = self.seen(q, &setup.fiducial_in_link);
        Sample {
            joints_rad: q.to_vec(),
            left_px: setup.cameras.left.project(&p).unwrap(),
            right_px: setup.cameras.right.project(&p).unwrap(),
            reference,
        }
    }
}

fn target() -> Reference {
    Reference {
        tip_in_rover: Vector3::new(0.5, 0.05, 0.2),
        axis_in_rover: Unit::new_normalize(Vector3::new(0.1, -0.1, 1.0)),
    }
}

/// Error of the seen tip after looks at these heights above the target and a last command at it.
fn placed(kind: Kind, setup: &Arc<Setup>, robot: &Robot, heights: &[f64]) -> f64 {
    let goal = target();
    let mut method = kind.start(Arc::clone(setup), goal.clone());
    let mut q = vec![0.0, -1.0, 1.8, 0.8, 1.5];
    for i in 0..kind.initial_poses() {
        let i = i as f64;
        // Spread in all three directions: a linear camera needs points that lie in no plane.
        let at = Vector3::new(
            0.40 + 0.03 * (5.0 * i % 7.0),
            -0.2 + 0.035 * i,
            0.11 - 0.05 * (i * i % 5.0),
        );
        let axis = Unit::new_normalize(Vector3::new(0.2 * (i * 1.7).sin(), 0.2 * i.cos(), 1.0));
        q = setup.joints(&at, &axis, &q).unwrap();
        method.observe(&robot.sample(setup, &q, None)).unwrap();
    }
    let mut last: Option<Sample> = None;
    for height in heights.iter().chain(&[0.0]) {
        if let Some(sample) = &last {
            method.observe(sample).unwrap();
        }
        let mut reference = goal.clone();
        reference.tip_in_rover.z -= height;
        let command = method.command(&reference, &q).unwrap();
        q = setup.joints(&command, &goal.axis_in_rover, &q).unwrap();
        last = Some(robot.sample(setup, &q, Some(reference)));
    }
    (robot.seen(&q, &setup.model.tool.tip_in_link) - goal.tip_in_rover).norm()
}

#[test]
fn a_perfect_robot_is_left_alone_by_every_method() {
    let setup = Arc::new(setup(0.13));
    let robot = Robot::new(&setup, 0.0);
    for kind in Kind::ALL {
        let error = placed(kind, &setup, &robot, &[0.2, 0.1, 0.0]);
        assert!(error < 1e-6, "{}: {error}", kind.name());
    }
}

#[test]
fn every_method_with_images_converges_when_it_looks_at_the_target() {
    let setup = Arc::new(setup(0.13));
    let robot = Robot::new(&setup, 1.0);
    let open_loop = placed(Kind::Kinematic, &setup, &robot, &[]);
    assert!(open_loop > 0.01);
    for kind in Kind::ALL {
        let error = placed(kind, &setup, &robot, &[0.25, 0.0, 0.0, 0.0, 0.0, 0.0]);
        // Fits that cannot express the arm's strain keep a part; so does a gain of one half.
        let limit = match kind {
            Kind::Kinematic => continue,
            Kind::HipsLimited => 0.3,
            Kind::MountKabsch | Kind::PositionBasedHalf => 0.1,
            _ => 0.01,
        };
        assert!(error < limit * open_loop, "{}: {error}", kind.name());
    }
}

#[test]
fn position_based_servoing_with_gain_one_is_the_last_vector() {
    for fiducial in [0.13, 0.04] {
        let setup = Arc::new(setup(fiducial));
        let robot = Robot::new(&setup, 1.0);
        let heights = [0.25, 0.15, 0.1];
        let [a, b] = [Kind::Epec, Kind::PositionBased].map(|k| placed(k, &setup, &robot, &heights));
        assert!((a - b).abs() < 1e-12);
    }
}

#[test]
fn the_vector_is_subtracted_and_is_the_total_one() {
    let setup = Arc::new(setup(0.13));
    let robot = Robot::new(&setup, 1.0);
    let goal = target();
    let mut method = crate::epec::Epec::new(Arc::clone(&setup));
    let mut q = vec![0.0, -1.0, 1.8, 0.8, 1.5];
    let mut errors = Vec::new();
    for _ in 0..4 {
        let command = method.command(&goal, &q).unwrap();
        q = setup.joints(&command, &goal.axis_in_rover, &q).unwrap();
        let sample = robot.sample(&setup, &q, Some(goal.clone()));
        method.observe(&sample).unwrap();
        let expected = robot.seen(&q, &setup.fiducial_in_link) - setup.tip(&q).unwrap();
        assert!((method.vector_m() - expected).norm() < 1e-9);
        errors.push((robot.seen(&q, &setup.model.tool.tip_in_link) - goal.tip_in_rover).norm());
    }
    assert!(errors.windows(2).all(|e| e[1] < 0.2 * e[0]), "{errors:?}");
}

#[test]
fn a_prior_based_field_carries_further_than_the_last_vector() {
    let setup = Arc::new(setup(0.13));
    let robot = Robot::new(&setup, 1.0);
    let heights = [0.25, 0.22, 0.19, 0.16, 0.13, 0.10];
    let vector = placed(Kind::Epec, &setup, &robot, &heights);
    for kind in [Kind::EpecField, Kind::EpecFieldFree] {
        let field = placed(kind, &setup, &robot, &heights);
        assert!(
            field < 0.6 * vector,
            "{}: {field} against {vector}",
            kind.name()
        );
    }
}

#[test]
fn a_rigid_fit_finds_rotation_and_translation_and_stays_proper_on_a_line() {
    let turn = Rotation3::new(Vector3::new(0.1, -0.2, 0.3));
    let shift = Vector3::new(0.01, 0.02, -0.03);
    let points: Vec<_> = (0..6_u32)
        .map(|i| {
            let i = f64::from(i);
            Vector3::new(i.sin(), i.cos(), 0.3 * i)
        })
        .collect();
    let pairs: Vec<_> = points.iter().map(|p| (*p, turn * p + shift)).collect();
    let (rotation, translation) = rigid_fit(&pairs).unwrap();
    assert!((rotation.matrix() - turn.matrix()).norm() < 1e-12);
    assert!((translation - shift).norm() < 1e-12);
    let line: Vec<_> = pairs
        .iter()
        .map(|(p, _)| Vector3::x() * p.z)
        .map(|p| (p, turn * p + shift))
        .collect();
    let (rotation, translation) = rigid_fit(&line).unwrap();
    assert!((rotation.matrix().determinant() - 1.0).abs() < 1e-9);
    for (a, b) in line {
        assert!((rotation * a + translation - b).norm() < 1e-9);
    }
    assert!(rigid_fit(&[]).is_err());
}
