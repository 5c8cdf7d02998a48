#![allow(clippy::unwrap_used, clippy::expect_used)]
// The flight table gives its twists to six decimals, which is not pi/2.
#![allow(clippy::approx_constant)]

use super::*;
use crate::rows::{DhRow, JointLimits};
use crate::{AxisGoal, Tool, closest_solution};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn arm_with(limits: impl FnMut(usize) -> JointLimits) -> Arm {
    let rows = [
        (0.062443, 1.570796, 0.048494),
        (0.353552, 0.0, 0.0),
        (0.330349, 0.0, 0.0),
        (0.0, -1.570796, -0.098924),
        (0.0, 1.570796, -0.077131),
    ];
    let rows = rows.map(|(a_m, alpha_rad, d_m)| DhRow {
        a_m,
        alpha_rad,
        d_m,
        theta_offset_rad: 0.0,
    });
    Arm::new(rows.to_vec(), (0..5).map(limits).collect()).unwrap()
}

fn arm() -> Arm {
    arm_with(|joint| JointLimits {
        lower_rad: -3.0,
        upper_rad: 3.0,
        max_rate_rad_s: 0.3 + 0.1 * joint as f64,
        max_acceleration_rad_s2: 0.6,
    })
}

/// Independent check of the limits: differences of densely sampled angles, no polynomials.
fn check_by_differences(arm: &Arm, trajectory: &JointTrajectory) {
    let h = 1e-3;
    let count = (trajectory.duration_s() / h) as usize;
    let at = |i: usize| trajectory.sample(h * i as f64).0;
    let (mut before, mut now) = (at(0), at(1));
    for i in 2..count {
        let next = at(i);
        for (joint, l) in arm.limits().iter().enumerate() {
            assert!(next[joint] >= l.lower_rad - 1e-9 && next[joint] <= l.upper_rad + 1e-9);
            let rate = (next[joint] - now[joint]) / h;
            let acceleration = (next[joint] - 2.0 * now[joint] + before[joint]) / (h * h);
            assert!(
                rate.abs() <= l.max_rate_rad_s * 1.00001,
                "joint[{joint}] {rate}"
            );
            let limit = l.max_acceleration_rad_s2 * 1.00001 + 1e-6;
            assert!(acceleration.abs() <= limit, "joint[{joint}] {acceleration}");
        }
        before = now;
        now = next;
    }
}

#[test]
fn a_thousand_random_motions_stay_within_the_limits() {
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    for case in 0..1000 {
        let arm = arm_with(|_| JointLimits {
            lower_rad: -3.0,
            upper_rad: 3.0,
            max_rate_rad_s: rng.random_range(0.05..2.0),
            max_acceleration_rad_s2: rng.random_range(0.05..6.0),
        });
        let count = if case % 2 == 0 {
            2
        } else {
            rng.random_range(3..8)
        };
        let mut q: Vec<f64> = (0..5).map(|_| rng.random_range(-2.9..2.9)).collect();
        let spread = [0.01, 0.2, 1.0, 4.0][case / 2 % 4];
        let mut waypoints = vec![q.clone()];
        for _ in 1..count {
            for value in &mut q {
                *value = (*value + rng.random_range(-spread..spread)).clamp(-3.0, 3.0);
            }
            waypoints.push(q.clone());
        }
        let scale = [1.0, 0.3][case / 8 % 2];
        let trajectory = through(&arm, &waypoints, scale).unwrap();
        trajectory.validate(&arm).unwrap();
        if case % 25 == 1 {
            check_by_differences(&arm, &trajectory);
        }
        let ends = [&trajectory.points[0], trajectory.points.last().unwrap()];
        assert_eq!(
            (&ends[0].q_rad, &ends[1].q_rad),
            (&waypoints[0], waypoints.last().unwrap())
        );
        assert!(ends.iter().all(|p| p.qd_rad_s.iter().all(|v| *v == 0.0)));
        assert!(
            trajectory
                .points
                .windows(2)
                .all(|p| p[1].t_s - p[0].t_s <= 0.02 + 1e-12)
        );
    }
}

#[test]
fn a_move_between_two_points_is_straight_and_nearly_as_quick_as_possible() {
    let arm = arm();
    let (a, b) = (vec![0.0; 5], vec![1.0, -0.5, 0.3, 0.0, 0.9]);
    let trajectory = through(&arm, &[a, b.clone()], 1.0).unwrap();
    // Joint 0 decides: 1 rad at 0.3 rad/s and 0.6 rad/s^2 takes 1/0.3 + 0.3/0.6 s.
    let quickest = 1.0 / 0.3 + 0.3 / 0.6;
    let duration = trajectory.duration_s();
    assert!(
        duration >= quickest && duration < quickest * 1.06,
        "{duration} {quickest}"
    );
    for i in 0..=50 {
        let (q, _) = trajectory.sample(duration * f64::from(i) / 50.0);
        for joint in 0..5 {
            assert!((q[joint] - q[0] * b[joint]).abs() < 1e-9);
        }
    }
}

#[test]
fn a_straight_tool_motion_is_followed_to_a_tenth_of_a_millimetre_at_the_tool_speed() {
    let arm = arm();
    let tool = Tool::on_turret(0.1306, 0.0);
    let start = vec![-0.11828, -0.803972, 1.76256, 0.709861, 1.49277];
    let from = AxisGoal::at(&arm, &tool, &start).unwrap();
    let step = nalgebra::Vector3::new(0.3, 0.5, -1.0).normalize() * 0.004;
    let mut waypoints = vec![start];
    for i in 1..=40 {
        let goal = AxisGoal {
            point: from.point + step * f64::from(i),
            axis: from.axis,
        };
        let near = waypoints.last().unwrap();
        waypoints.push(closest_solution(&arm, &tool, &goal, near).unwrap());
    }
    let options = TimingOptions {
        max_tool_speed_m_s: Some(0.05),
        path_lengths_m: Some((0..=40).map(|i| 0.004 * f64::from(i)).collect()),
        ..TimingOptions::default()
    };
    let trajectory = through_with(&arm, &waypoints, &options).unwrap();
    check_by_differences(&arm, &trajectory);
    assert!(
        trajectory.duration_s() < 0.16 / 0.05 + 1.5,
        "{}",
        trajectory.duration_s()
    );
    let along = step.normalize();
    let mut previous: Option<nalgebra::Vector3<f64>> = None;
    let mut fastest: f64 = 0.0;
    let count = (trajectory.duration_s() / 0.01) as usize;
    for i in 0..=count {
        let (q, _) = trajectory.sample(0.01 * i as f64);
        let (tip, axis) = tool.at(&arm, &q).unwrap();
        let off = tip - from.point;
        assert!((off - along * off.dot(&along)).norm() < 1e-4);
        assert!(axis.angle(&from.axis) < 1e-3);
        if let Some(previous) = previous {
            fastest = fastest.max((tip - previous).norm() / 0.01);
        }
        previous = Some(tip);
    }
    assert!(fastest < 0.0505 && fastest > 0.045, "{fastest}");
}

#[test]
fn a_sharp_corner_is_a_stop_and_a_gentle_one_is_not() {
    let arm = arm();
    let corner = |z: f64| {
        vec![
            vec![0.0; 5],
            vec![0.5, 0.0, 0.0, 0.0, 0.0],
            vec![1.0, z, 0.0, 0.0, 0.0],
        ]
    };
    let slowest_inside = |waypoints: &[Vec<f64>]| {
        let trajectory = through(&arm, waypoints, 1.0).unwrap();
        let near = |p: &&TrajectoryPoint| (p.q_rad[0] - 0.5).abs() < 0.05;
        let speed = |p: &TrajectoryPoint| p.qd_rad_s[0].abs();
        trajectory
            .points
            .iter()
            .filter(near)
            .map(speed)
            .fold(f64::INFINITY, f64::min)
    };
    assert!(slowest_inside(&corner(0.5)) < 0.05);
    assert!(slowest_inside(&corner(0.02)) > 0.25);
}

#[test]
fn repeated_waypoints_and_no_motion_at_all_are_handled() {
    let arm = arm();
    let q = vec![0.1; 5];
    let still = through(&arm, &[q.clone(), q.clone(), q.clone()], 1.0).unwrap();
    still.validate(&arm).unwrap();
    assert_eq!(still.sample(0.01).0, q);
    let other = vec![0.2; 5];
    let moved = through(&arm, &[q.clone(), q, other.clone(), other.clone()], 0.5).unwrap();
    assert_eq!(moved.points.last().unwrap().q_rad, other);
}

#[test]
fn sampling_is_the_cubic_with_the_given_ends() {
    // q = t^3 - t^2 + 2 t + 1 is its own Hermite interpolant.
    let q = |t: f64| ((t - 1.0) * t + 2.0) * t + 1.0;
    let rate = |t: f64| (3.0 * t - 2.0) * t + 2.0;
    let point = |t_s: f64| TrajectoryPoint {
        t_s,
        q_rad: vec![q(t_s)],
        qd_rad_s: vec![rate(t_s)],
    };
    let trajectory = JointTrajectory {
        points: vec![point(0.0), point(0.7), point(2.0)],
    };
    for i in 0..=200 {
        let t = 0.01 * f64::from(i);
        let (a, b) = trajectory.sample(t);
        assert!(
            (a[0] - q(t)).abs() < 1e-12 && (b[0] - rate(t)).abs() < 1e-12,
            "{t}"
        );
    }
    assert_eq!(trajectory.sample(-1.0), (vec![1.0], vec![0.0]));
    assert_eq!(trajectory.sample(9.0), (vec![q(2.0)], vec![0.0]));
    assert!(trajectory.sample(f64::NAN).0[0].is_nan());
    let piece = trajectory.pieces(1).next().unwrap();
    assert!((piece.accelerations().0 - (6.0 * 0.7 - 2.0)).abs() < 1e-10);
    assert!((piece.accelerations().1 - (6.0 * 2.0 - 2.0)).abs() < 1e-10);
}

#[test]
fn extremes_of_a_piece_agree_with_dense_sampling() {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    for _ in 0..500 {
        let mut r = || -> f64 { rng.random_range(-1.0..1.0) };
        let (start, end, start_rate, end_rate) = (r(), r(), r(), r());
        let duration = 0.1 + 2.0 * r().abs();
        let piece = Piece {
            start,
            end,
            start_rate,
            end_rate,
            duration,
        };
        let (mut low, mut high, mut rate) = (f64::INFINITY, f64::NEG_INFINITY, 0.0_f64);
        for i in 0..=2000 {
            let x = duration * f64::from(i) / 2000.0;
            let q = piece.position(x);
            (low, high) = (low.min(q), high.max(q));
            rate = rate.max(piece.rate(x).abs());
        }
        let (l, h) = piece.range();
        assert!(
            (l - low).abs() < 1e-5 && (h - high).abs() < 1e-5,
            "{l} {low} {h} {high}"
        );
        assert!((piece.extreme_rate().abs() - rate).abs() < 1e-4);
    }
}

#[test]
fn what_breaks_a_limit_is_named_with_point_joint_value_and_limit() {
    let arm = arm();
    let good = through(&arm, &[vec![0.0; 5], vec![0.5; 5]], 1.0).unwrap();
    let refuse = |change: &dyn Fn(&mut JointTrajectory)| {
        let mut bad = good.clone();
        change(&mut bad);
        bad.validate(&arm).unwrap_err()
    };
    let limit = |error: TrajectoryError| match error {
        TrajectoryError::Limit {
            point,
            joint,
            quantity,
            limit,
            ..
        } => (point, joint, quantity, limit),
        other => panic!("{other}"),
    };
    assert_eq!(
        limit(refuse(&|t| t.points[0].q_rad[1] = 3.5)),
        (0, 1, Quantity::Position, 3.0)
    );
    assert_eq!(
        limit(refuse(&|t| t.points[0].qd_rad_s[0] = -0.4)),
        (0, 0, Quantity::Rate, -0.3)
    );
    let jerky = refuse(&|t| t.points[3].q_rad[2] += 1e-4);
    assert_eq!(limit(jerky), (2, 2, Quantity::Acceleration, 0.6));
    assert!(matches!(
        refuse(&|t| t.points[4].t_s = t.points[3].t_s),
        TrajectoryError::TimeNotIncreasing { point: 4, .. }
    ));
    assert!(matches!(
        refuse(&|t| t.points[2].q_rad[0] = f64::NAN),
        TrajectoryError::NotFinite {
            point: 2,
            what: "q_rad",
            ..
        }
    ));
    assert!(matches!(
        refuse(&|t| t.points[2].qd_rad_s.push(0.0)),
        TrajectoryError::WrongLength {
            point: 2,
            what: "qd_rad_s",
            expected: 5,
            found: 6
        }
    ));
    assert!(matches!(
        refuse(&|t| t.points.clear()),
        TrajectoryError::TooFew { .. }
    ));
}

#[test]
fn bad_waypoints_and_options_are_refused() {
    let arm = arm();
    let q = vec![0.0; 5];
    let one = through(&arm, std::slice::from_ref(&q), 1.0).unwrap_err();
    assert!(matches!(one, TrajectoryError::TooFew { found: 1, .. }));
    let outside = through(&arm, &[q.clone(), vec![3.2; 5]], 1.0).unwrap_err();
    assert!(matches!(
        outside,
        TrajectoryError::WayPoint { index: 1, .. }
    ));
    for scale in [0.0, -1.0, 1.5, f64::NAN] {
        assert!(through(&arm, &[q.clone(), vec![0.1; 5]], scale).is_err());
    }
    let fast = TimingOptions {
        max_tool_speed_m_s: Some(0.1),
        ..TimingOptions::default()
    };
    assert!(through_with(&arm, &[q.clone(), vec![0.1; 5]], &fast).is_err());
}

#[test]
fn a_trajectory_survives_json_and_refuses_unknown_fields() {
    let trajectory = through(&arm(), &[vec![0.0; 5], vec![0.1; 5]], 1.0).unwrap();
    let text = serde_json::to_string(&trajectory).unwrap();
    assert_eq!(
        serde_json::from_str::<JointTrajectory>(&text).unwrap(),
        trajectory
    );
    assert!(serde_json::from_str::<JointTrajectory>(r#"{"points":[],"speed":1}"#).is_err());
}
