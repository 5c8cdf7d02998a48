//! Every other method in the servo: it places better than kinematics, and the bound on its error,
//! which the servo's filter gives, holds. The truth comes from perturbed kinematics.

use super::support::{ANGLE_RAD, LENGTH_M, Truth, bluestreak, station};
use nalgebra::{Matrix3, Vector2, Vector3};
use rover_epec_servo::{
    driven::Driven,
    estimator::{Estimator, EstimatorRules},
    observe::Sighting,
    place::error_model,
};
use rover_kinematics::{AxisGoal, closest_solution};
use rover_methods::Kind;
use rover_robot::Robot;

const TARGET: Vector3<f64> = Vector3::new(0.54, 0.0, 0.40);
const SIGMA_M: f64 = 0.05e-3;

fn joints(robot: &Robot, tip: Vector3<f64>, near: &[f64]) -> Vec<f64> {
    let base = robot.rover_from_arm_base.isometry.inverse();
    let goal = AxisGoal {
        point: (base * nalgebra::Point3::from(tip)).coords,
        axis: base.rotation * -Vector3::z_axis(),
    };
    closest_solution(&robot.arm, &robot.tool, &goal, near).unwrap()
}

/// Lateral error at the target, m, and the bound on it, after looks from 16 to 3 cm.
fn placed(robot: &Robot, kind: Kind, seed: u64) -> (f64, f64) {
    let mut truth = Truth::new(robot, seed);
    let cameras = &robot.pair("body").unwrap().cameras;
    let rules = EstimatorRules::default();
    let mut filter = Estimator::new(error_model(robot), kind, ANGLE_RAD, LENGTH_M, rules);
    let mut driven = Driven::new(kind, &TARGET, &Vector3::z_axis());
    let mut look = |truth: &mut Truth, q: &[f64], driven: &mut Driven, reference| {
        let sighting = Sighting {
            seen: truth.pose(robot, q, SIGMA_M, 1e-3),
            left_px: Vector2::zeros(),
            right_px: Vector2::zeros(),
            rms_px: None,
        };
        filter.observe(q, &sighting.seen).unwrap();
        driven
            .observe(robot, cameras, q, &sighting, reference)
            .unwrap();
        filter.adopt(driven.at_target(q).unwrap());
    };
    let mut q = station(robot, 0.16);
    for i in 0..kind.initial_poses() {
        // Spread in all three directions: a linear camera needs points that lie in no plane.
        let i = i as f64;
        let at = Vector3::new(
            0.44 + 0.035 * (5.0 * i % 7.0),
            -0.12 + 0.022 * i,
            0.50 + 0.04 * (i * i % 5.0),
        );
        q = joints(robot, at, &q);
        look(&mut truth, &q, &mut driven, None);
    }
    for height in [0.16, 0.12, 0.09, 0.06, 0.03] {
        let reference = driven.reference(height);
        q = joints(robot, driven.command(&reference, &q).unwrap(), &q);
        if kind.looks_on_approach() {
            look(&mut truth, &q, &mut driven, Some(reference));
        }
    }
    q = joints(
        robot,
        driven.command(&driven.reference(0.0), &q).unwrap(),
        &q,
    );
    let bound = filter
        .predicted_lateral_error(&q, &Vector3::z_axis(), &Matrix3::zeros())
        .unwrap();
    ((truth.tip(robot, &q) - TARGET).xy().norm(), bound)
}

#[test]
fn every_method_beats_kinematics_and_its_bound_holds() {
    let robot = bluestreak();
    const RUNS: u64 = 40;
    let median = |kind| {
        let runs: Vec<_> = (0..RUNS).map(|seed| placed(&robot, kind, seed)).collect();
        let held = runs.iter().filter(|(error, bound)| error <= bound).count();
        let mut errors: Vec<_> = runs.iter().map(|r| r.0 * 1e3).collect();
        errors.sort_by(f64::total_cmp);
        (errors[errors.len() / 2], held as f64 / RUNS as f64)
    };
    let open_loop = {
        let mut errors: Vec<_> = (0..RUNS)
            .map(|seed| {
                let truth = Truth::new(&robot, seed);
                let q = station(&robot, 0.0);
                (truth.tip(&robot, &q) - TARGET).xy().norm() * 1e3
            })
            .collect();
        errors.sort_by(f64::total_cmp);
        errors[errors.len() / 2]
    };
    println!("kinematic: {open_loop:.2} mm");
    for kind in Kind::ALL {
        if matches!(kind, Kind::Kinematic | Kind::Epec | Kind::EpecField) {
            continue;
        }
        let (error, held) = median(kind);
        println!("{}: {error:.2} mm, bound held {held:.2}", kind.name());
        assert!(error < 0.5 * open_loop, "{}: {error} mm", kind.name());
        assert!(held >= 0.9, "{}: bound held {held}", kind.name());
    }
}

#[test]
fn a_method_without_a_sighting_commands_the_reference() {
    let driven = Driven::new(Kind::HipsFull, &TARGET, &Vector3::z_axis());
    let reference = driven.reference(0.1);
    assert_eq!(reference.tip_in_rover, TARGET + Vector3::z() * 0.1);
    assert_eq!(
        driven.command(&reference, &[0.0; 5]).unwrap(),
        reference.tip_in_rover
    );
    assert_eq!(driven.at_target(&[0.0; 5]).unwrap().offset_m, [0.0; 3]);
}

#[test]
fn cameras_that_moved_are_refused() {
    let robot = bluestreak();
    let mut truth = Truth::new(&robot, 1);
    let cameras = &robot.pair("body").unwrap().cameras;
    let q = station(&robot, 0.1);
    let sighting = Sighting {
        seen: truth.pose(&robot, &q, SIGMA_M, 1e-3),
        left_px: Vector2::zeros(),
        right_px: Vector2::zeros(),
        rms_px: None,
    };
    let mut driven = Driven::new(Kind::CameraSpace, &TARGET, &Vector3::z_axis());
    let reference = Some(driven.reference(0.1));
    driven
        .observe(&robot, cameras, &q, &sighting, reference.clone())
        .unwrap();
    let mut moved = cameras.clone();
    moved.left = moved
        .left
        .transformed(&nalgebra::Isometry3::translation(1e-3, 0.0, 0.0));
    let refusal = driven
        .observe(&robot, &moved, &q, &sighting, reference)
        .unwrap_err();
    assert!(refusal.contains("camera models"), "{refusal}");
}
