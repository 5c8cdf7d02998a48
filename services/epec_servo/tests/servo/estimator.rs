//! The estimator against perturbed robots: what it predicts where nothing was seen, and whether
//! its bound holds. The truth comes from perturbed kinematics, not from the estimator's own
//! linearisation.
use super::support::{ANGLE_RAD, LENGTH_M, Truth, bluestreak, quantile, station};
use nalgebra::{Matrix3, Vector3};
use rover_epec_servo::{
    estimator::{Estimator, EstimatorError, EstimatorRules, Seen},
    place::error_model,
};
use rover_messages::placement::Method;
use rover_robot::Robot;

fn estimator(robot: &Robot, method: Method) -> Estimator {
    Estimator::new(
        error_model(robot),
        method,
        ANGLE_RAD,
        LENGTH_M,
        EstimatorRules::default(),
    )
}

/// Error of the tip (mm) at the target after looks at the given heights, and the share of runs in
/// which the 95 % bound held.
fn blind_runs(method: Method, heights_m: &[f64], sigma_m: f64, runs: u64) -> (Vec<f64>, f64) {
    let robot = bluestreak();
    let target = station(&robot, 0.0);
    let mut held = 0;
    let errors = (0..runs)
        .map(|seed| {
            let mut truth = Truth::new(&robot, seed);
            let mut estimator = estimator(&robot, method);
            for &height in heights_m {
                let q = station(&robot, height);
                let seen = truth.pose(&robot, &q, sigma_m, sigma_m / 0.05);
                estimator.observe(&q, &seen).unwrap();
            }
            let model = error_model(&robot);
            let (predicted, _) = model.error_at(&estimator.compensation(), &target).unwrap();
            let believed = robot.rover_from_link(&target).unwrap().isometry;
            let tip = believed
                .transform_point(&robot.tool.tip_in_link.into())
                .coords;
            let error = truth.tip(&robot, &target) - tip - predicted;
            let bound = estimator
                .predicted_lateral_error(&target, &Vector3::z_axis(), &Matrix3::zeros())
                .unwrap();
            held += u32::from(error.xy().norm() <= bound);
            error.norm() * 1e3
        })
        .collect();
    (errors, f64::from(held) / runs as f64)
}

#[test]
fn the_field_predicts_ten_blind_centimetres_several_times_better_than_the_last_vector() {
    let heights = [0.22, 0.196, 0.172, 0.148, 0.124, 0.10];
    let (mut last, held_last) = blind_runs(Method::Epec, &heights, 0.3e-3, 200);
    let (mut field, held_field) = blind_runs(Method::EpecField, &heights, 0.3e-3, 200);
    let (last, field) = (quantile(&mut last, 0.5), quantile(&mut field, 0.5));
    println!("blind for 10 cm: last vector {last:.2} mm, field {field:.2} mm (medians)");
    println!("95 % bound held: last vector {held_last:.3}, field {held_field:.3}");
    assert!(
        (2.0..5.0).contains(&last),
        "{last} mm, published around 3.2 mm"
    );
    assert!(
        field < last / 2.5,
        "field {field} mm, last vector {last} mm"
    );
    assert!(held_field >= 0.93 && held_last >= 0.93);
}

#[test]
fn a_pose_seen_at_the_target_leaves_only_its_noise() {
    let (mut errors, held) = blind_runs(Method::EpecField, &[0.15, 0.08, 0.0], 0.05e-3, 200);
    let median = quantile(&mut errors, 0.5);
    println!("seen at the target: {median:.3} mm, bound held {held:.3}");
    assert!(median < 0.12, "{median} mm");
    assert!(held >= 0.93);
}

#[test]
fn a_sighting_far_from_anything_known_is_refused_and_changes_nothing() {
    let robot = bluestreak();
    let mut truth = Truth::new(&robot, 1);
    let mut estimator = estimator(&robot, Method::EpecField);
    let q = station(&robot, 0.1);
    let seen = truth.pose(&robot, &q, 1e-4, 2e-3);
    estimator.observe(&q, &seen).unwrap();
    let before = estimator.compensation();
    let Seen::Pose {
        tip_in_rover,
        rotation_error,
        covariance,
    } = seen
    else {
        unreachable!()
    };
    let elsewhere = Seen::Pose {
        tip_in_rover: tip_in_rover + Vector3::new(0.03, 0.0, 0.0),
        rotation_error,
        covariance,
    };
    let refusal = estimator.observe(&q, &elsewhere).unwrap_err();
    assert!(
        matches!(refusal, EstimatorError::Inconsistent { .. }),
        "{refusal}"
    );
    assert_eq!(estimator.compensation(), before);
}
