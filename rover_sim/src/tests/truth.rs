//! The drawn truth: statistics, streams, and where the errors sit.

use super::support::{robot, scene};
use crate::{Truth, TruthDescription};
use nalgebra::{Point3, Vector3};

fn draw(angle_deg: f64, length_mm: f64, seed: u64) -> Truth {
    let errors = TruthDescription {
        angle_deg,
        length_mm,
        ..scene().truth
    };
    Truth::draw(&robot(), &errors, seed).unwrap()
}

/// The 26 errors of a truth in units of their sigmas.
fn errors(truth: &Truth, angle_rad: f64, length_m: f64) -> Vec<f64> {
    let robot = robot();
    let mut e = Vec::new();
    for (t, b) in truth.arm.rows().iter().zip(robot.arm.rows()) {
        e.push((t.theta_offset_rad - b.theta_offset_rad) / angle_rad);
        e.push((t.d_m - b.d_m) / length_m);
        e.push((t.a_m - b.a_m) / length_m);
        e.push((t.alpha_rad - b.alpha_rad) / angle_rad);
    }
    let moved = truth.pairs[0].believed_from_true;
    let centre = robot.mount_centre();
    let shift = (moved * Point3::from(centre)).coords - centre;
    e.extend(moved.rotation.scaled_axis().iter().map(|w| w / angle_rad));
    e.extend(shift.iter().map(|t| t / length_m));
    e
}

#[test]
fn no_error_is_the_believed_robot_exactly() {
    let robot = robot();
    let truth = draw(0.0, 0.0, 5);
    assert_eq!(truth.arm.rows(), robot.arm.rows());
    let pair = &robot.description().cameras[0].cameras;
    let p = Vector3::new(0.6, 0.05, 0.3);
    assert!(
        (truth.pairs[0].cameras.left.project(&p).unwrap() - pair.left.project(&p).unwrap()).norm()
            < 1e-9
    );
}

#[test]
fn every_parameter_has_the_stated_spread_and_no_bias() {
    let (angle_deg, length_mm) = (1.0_f64, 2.5);
    let runs = 600;
    let mut sums = vec![(0.0, 0.0); 26];
    let mut products = 0.0;
    for seed in 0..runs {
        let e = errors(
            &draw(angle_deg, length_mm, seed),
            angle_deg.to_radians(),
            length_mm * 1e-3,
        );
        assert_eq!(e.len(), 26);
        for (sum, x) in sums.iter_mut().zip(&e) {
            *sum = (sum.0 + x, sum.1 + x * x);
        }
        products += e[0] * e[20] + e[1] * e[23];
    }
    let n = runs as f64;
    for (i, (sum, squares)) in sums.iter().enumerate() {
        // Five standard errors of mean and of variance.
        assert!(
            (sum / n).abs() < 5.0 / n.sqrt(),
            "parameter {i}: mean {}",
            sum / n
        );
        assert!(
            (squares / n - 1.0).abs() < 5.0 * (2.0 / n).sqrt(),
            "parameter {i}: {squares}"
        );
    }
    assert!((products / (2.0 * n)).abs() < 5.0 / (2.0 * n).sqrt());
}

#[test]
fn the_same_seed_scales_and_switching_one_kind_on_does_not_change_another() {
    let one = errors(&draw(0.5, 1.0, 9), 0.5_f64.to_radians(), 1e-3);
    let two = errors(&draw(1.0, 2.5, 9), 1.0_f64.to_radians(), 2.5e-3);
    for (a, b) in one.iter().zip(&two) {
        assert!((a - b).abs() < 1e-6);
    }
    let robot = robot();
    let mut noisy = TruthDescription {
        angle_deg: 1.0,
        length_mm: 2.5,
        ..scene().truth
    };
    let plain = Truth::draw(&robot, &noisy, 3).unwrap();
    noisy.intrinsics.focal_fraction = 0.002;
    noisy.encoder_noise_rad = 1e-4;
    let truth = Truth::draw(&robot, &noisy, 3).unwrap();
    assert_eq!(truth.arm, plain.arm);
    assert_eq!(
        truth.pairs[0].believed_from_true,
        plain.pairs[0].believed_from_true
    );
    assert_ne!(truth.pairs[0].cameras, plain.pairs[0].cameras);
}

#[test]
fn the_true_cameras_see_a_point_where_the_believed_ones_see_its_believed_place() {
    let robot = robot();
    let truth = draw(1.0, 2.5, 4);
    let pair = &truth.pairs[0];
    let believed = &robot.description().cameras[0].cameras;
    for p in [Vector3::new(0.6, 0.05, 0.3), Vector3::new(0.8, -0.1, 0.2)] {
        let moved = (pair.believed_from_true * Point3::from(p)).coords;
        for (t, b) in [
            (&pair.cameras.left, &believed.left),
            (&pair.cameras.right, &believed.right),
        ] {
            assert!((t.project(&p).unwrap() - b.project(&moved).unwrap()).norm() < 1e-9);
        }
    }
}

#[test]
fn encoder_noise_is_the_same_whenever_it_is_asked_for() {
    let errors = TruthDescription {
        encoder_noise_rad: 1e-4,
        ..scene().truth
    };
    let truth = Truth::draw(&robot(), &errors, 11).unwrap();
    assert_eq!(truth.encoder_noise(17), truth.encoder_noise(17));
    assert_ne!(truth.encoder_noise(17), truth.encoder_noise(18));
    let all: Vec<f64> = (0..400)
        .flat_map(|step| truth.encoder_noise(step))
        .collect();
    let sigma = (all.iter().map(|x| x * x).sum::<f64>() / all.len() as f64).sqrt();
    assert!((sigma - 1e-4).abs() < 1e-5, "{sigma}");
}
