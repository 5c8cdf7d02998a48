//! Arms without a closed form: whole poses, all answers, rows with a tilt.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rover_kinematics::{
    Arm, AxisGoal, DhRow, IkError, JacobianBuffer, JointLimits, PoseGoal, Tool, all_poses,
    all_solutions, closest_pose, pose_error_jacobian, solve_axis,
};
use std::f64::consts::FRAC_PI_2;

fn limits(n: usize, limit: f64) -> Vec<JointLimits> {
    let one = JointLimits {
        lower_rad: -limit,
        upper_rad: limit,
        max_rate_rad_s: 0.5,
        max_acceleration_rad_s2: 1.0,
    };
    vec![one; n]
}

fn rows(rows: &[(f64, f64, f64)]) -> Vec<DhRow> {
    let row = |&(a_m, alpha_rad, d_m): &(f64, f64, f64)| DhRow {
        a_m,
        alpha_rad,
        d_m,
        theta_offset_rad: 0.0,
    };
    rows.iter().map(row).collect()
}

fn family_rows() -> Vec<DhRow> {
    rows(&[
        (0.06, FRAC_PI_2, 0.05),
        (0.35, 0.0, 0.0),
        (0.33, 0.0, 0.0),
        (0.0, -FRAC_PI_2, -0.1),
        (0.0, FRAC_PI_2, -0.08),
    ])
}

/// Six joints with a wrist whose axes do not meet, and seven like a human arm.
fn long_arms() -> [Arm; 2] {
    let six = rows(&[
        (0.05, FRAC_PI_2, 0.3),
        (0.4, 0.0, 0.0),
        (0.05, FRAC_PI_2, 0.02),
        (0.01, -FRAC_PI_2, 0.4),
        (0.02, FRAC_PI_2, 0.05),
        (0.0, 0.0, 0.1),
    ]);
    let seven = rows(&[
        (0.0, FRAC_PI_2, 0.3),
        (0.0, -FRAC_PI_2, 0.0),
        (0.03, FRAC_PI_2, 0.4),
        (-0.03, -FRAC_PI_2, 0.0),
        (0.0, FRAC_PI_2, 0.4),
        (0.08, FRAC_PI_2, 0.0),
        (0.0, 0.0, 0.1),
    ]);
    [
        Arm::new(six, limits(6, 2.9)).unwrap(),
        Arm::new(seven, limits(7, 2.9)).unwrap(),
    ]
}

fn random(rng: &mut ChaCha8Rng, n: usize, limit: f64) -> Vec<f64> {
    (0..n).map(|_| rng.random_range(-limit..limit)).collect()
}

fn flange() -> Isometry3<f64> {
    Isometry3::from_parts(
        Vector3::new(0.02, -0.01, 0.13).into(),
        UnitQuaternion::from_euler_angles(0.3, -0.2, 0.9),
    )
}

#[test]
fn whole_poses_are_met_from_anywhere() {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    for arm in long_arms() {
        let n = arm.joint_count();
        let mut met = 0;
        for _ in 0..60 {
            let q = random(&mut rng, n, 2.6);
            let goal = PoseGoal {
                link_from_tool: flange(),
                base_from_tool: arm.forward(&q).unwrap() * flange(),
            };
            let near = random(&mut rng, n, 2.6);
            let Ok(answer) = closest_pose(&arm, &goal, &near) else {
                continue;
            };
            arm.check_limits(&answer).unwrap();
            let there = arm.forward(&answer).unwrap() * flange();
            let apart = (there.translation.vector - goal.base_from_tool.translation.vector).norm();
            let turned = there.rotation.angle_to(&goal.base_from_tool.rotation);
            assert!(apart <= 1e-10 && turned <= 1e-9, "{apart:e} {turned:e}");
            met += 1;
        }
        assert!(met >= 58, "{met} of 60");
    }
}

#[test]
fn a_pose_that_five_joints_cannot_take_says_what_is_lacking() {
    let arm = Arm::new(family_rows(), limits(5, 3.0)).unwrap();
    let q = [0.2, -0.4, 1.0, 0.3, 0.8];
    let pose = arm.forward(&q).unwrap();
    let goal = |base_from_tool| PoseGoal {
        link_from_tool: Isometry3::identity(),
        base_from_tool,
    };
    let near = [0.1, -0.3, 0.9, 0.2, 0.7];
    let answer = closest_pose(&arm, &goal(pose), &near).unwrap();
    assert!(answer.iter().zip(&q).all(|(a, b)| (a - b).abs() < 1e-6));
    let turned = pose * Isometry3::rotation(Vector3::new(0.1, 0.2, 0.1));
    match closest_pose(&arm, &goal(turned), &near).unwrap_err() {
        IkError::AxisInfeasible { by_rad } => assert!(by_rad > 1e-3 && by_rad < 0.3, "{by_rad}"),
        other => panic!("{other}"),
    }
    let far = Isometry3::translation(3.0, 0.0, 0.0);
    assert!(matches!(
        closest_pose(&arm, &goal(far), &near).unwrap_err(),
        IkError::OutOfReach { by_m, .. } if by_m > 1.0
    ));
    let mut not = pose;
    not.translation.x = f64::NAN;
    assert_eq!(
        closest_pose(&arm, &goal(not), &near),
        Err(IkError::NotFinite)
    );
}

/// The same arm twice: once with its closed form, once with a tilt far below rounding that hides it.
#[test]
fn descents_find_the_branches_of_the_closed_form() {
    let known = Arm::new(family_rows(), limits(5, 3.1)).unwrap();
    let tilts = vec![0.0, 0.0, 0.0, 0.0, 1e-18];
    let hidden = Arm::with_tilts(family_rows(), tilts, limits(5, 3.1)).unwrap();
    let tool = Tool::on_turret(0.13, 0.0);
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    let (mut there, mut found) = (0, 0);
    for _ in 0..12 {
        let q = random(&mut rng, 5, 2.2);
        let goal = AxisGoal::at(&known, &tool, &q).unwrap();
        assert!(matches!(
            solve_axis(&hidden, &tool, &goal),
            Err(IkError::NotThisFamily(_))
        ));
        let exact = all_solutions(&known, &tool, &goal).unwrap();
        let by_descent = all_solutions(&hidden, &tool, &goal).unwrap();
        assert_eq!(by_descent, all_solutions(&hidden, &tool, &goal).unwrap());
        let same = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5);
        for answer in &by_descent {
            assert!(
                exact.iter().any(|e| same(e, answer)),
                "{answer:?} {exact:?}"
            );
        }
        there += exact.len();
        found += exact
            .iter()
            .filter(|e| by_descent.iter().any(|a| same(e, a)))
            .count();
    }
    assert!(10 * found >= 9 * there, "{found} of {there}");
}

#[test]
fn an_arm_of_six_joints_has_several_answers_to_a_pose_and_each_is_one() {
    let [arm, _] = long_arms();
    let q = [0.4, 0.5, 0.8, -0.6, 0.9, 0.3];
    let goal = PoseGoal {
        link_from_tool: flange(),
        base_from_tool: arm.forward(&q).unwrap() * flange(),
    };
    let all = all_poses(&arm, &goal).unwrap();
    assert!(all.len() >= 2, "{}", all.len());
    for answer in &all {
        let there = arm.forward(answer).unwrap() * flange();
        let apart = (there.translation.vector - goal.base_from_tool.translation.vector).norm();
        assert!(apart < 1e-9);
    }
    let distance = |a: &[f64]| {
        a.iter()
            .zip(&q)
            .map(|(a, b)| (a - b).abs())
            .fold(0.0, f64::max)
    };
    assert!(all.iter().any(|a| distance(a) < 1e-6));
}

/// `Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(tilt)`, multiplied out.
fn product(rows: &[DhRow], tilts: &[f64], q: &[f64]) -> Isometry3<f64> {
    let about = |x, y, z| Isometry3::rotation(Vector3::new(x, y, z));
    rows.iter()
        .zip(tilts)
        .zip(q)
        .fold(Isometry3::identity(), |pose, ((r, tilt), q)| {
            pose * about(0.0, 0.0, q + r.theta_offset_rad)
                * Isometry3::translation(r.a_m, 0.0, r.d_m)
                * about(r.alpha_rad, 0.0, 0.0)
                * about(0.0, *tilt, 0.0)
        })
}

#[test]
fn rows_with_a_tilt_agree_with_their_product_and_their_derivatives() {
    let tilts = vec![0.0, 0.03, -0.2, 1e-5, 0.4];
    let arm = Arm::with_tilts(family_rows(), tilts.clone(), limits(5, 3.1)).unwrap();
    let point = Vector3::new(0.02, 0.03, 0.1);
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for _ in 0..100 {
        let q = random(&mut rng, 5, 3.0);
        let expected = product(arm.rows(), &tilts, &q);
        let mut jacobian = JacobianBuffer::zeros();
        let poses = [
            arm.forward(&q).unwrap(),
            arm.link_poses(&q).unwrap()[5],
            arm.forward_with_jacobian(&q, &point, &mut jacobian)
                .unwrap(),
        ];
        for pose in poses {
            assert!((pose.translation.vector - expected.translation.vector).norm() < 1e-14);
            assert!(pose.rotation.angle_to(&expected.rotation) < 1e-7);
        }
        let errors = pose_error_jacobian(&arm, &q, &point).unwrap();
        let h = 1e-6;
        let at = |arm: &Arm, q: &[f64]| arm.point(q, &point).unwrap();
        for joint in 0..5 {
            let (mut high, mut low) = (q.clone(), q.clone());
            (high[joint], low[joint]) = (q[joint] + h, q[joint] - h);
            let slope = (at(&arm, &high) - at(&arm, &low)) / (2.0 * h);
            assert!((jacobian.fixed_view::<3, 1>(0, joint) - slope).norm() < 1e-8);
        }
        for parameter in 0..20 {
            let moved = |by: f64| {
                let mut e = vec![0.0; 20];
                e[parameter] = by;
                at(&arm.perturbed(&e).unwrap(), &q)
            };
            let slope = (moved(h) - moved(-h)) / (2.0 * h);
            let column = errors.fixed_view::<3, 1>(0, parameter);
            assert!((column - slope).norm() < 1e-8, "parameter {parameter}");
        }
    }
    assert!(Arm::with_tilts(family_rows(), vec![0.1; 3], limits(5, 3.1)).is_err());
    assert!(Arm::with_tilts(family_rows(), vec![f64::NAN; 5], limits(5, 3.1)).is_err());
}
