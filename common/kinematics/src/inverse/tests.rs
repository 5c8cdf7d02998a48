#![allow(clippy::unwrap_used, clippy::expect_used)]
// The flight table gives its twists to six decimals, which is not pi/2.
#![allow(clippy::approx_constant)]

use super::*;
use crate::rows::{DhRow, JointLimits};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::f64::consts::{FRAC_PI_2, PI};

/// `(a, alpha, d, offset)` rows with the same limits for each joint.
fn arm_of(rows: &[(f64, f64, f64, f64)], limit: f64) -> Arm {
    let row = |r: &(f64, f64, f64, f64)| DhRow {
        a_m: r.0,
        alpha_rad: r.1,
        d_m: r.2,
        theta_offset_rad: r.3,
    };
    let limit = JointLimits {
        lower_rad: -limit,
        upper_rad: limit,
        max_rate_rad_s: 0.5,
        max_acceleration_rad_s2: 1.0,
    };
    Arm::new(rows.iter().map(row).collect(), vec![limit; rows.len()]).unwrap()
}

const FLIGHT: [(f64, f64, f64, f64); 5] = [
    (0.062443, 1.570796, 0.048494, 0.0),
    (0.353552, 0.0, 0.0, 0.0),
    (0.330349, 0.0, 0.0, 0.0),
    (0.0, -1.570796, -0.098924, 0.0),
    (0.0, 1.570796, -0.077131, 0.0),
];

fn flight_arm() -> Arm {
    arm_of(&FLIGHT, PI)
}

fn tools() -> Vec<Tool> {
    let mut tools = vec![
        Tool::on_turret(0.1306, 0.0),
        Tool::on_turret(0.1636, 1.570796),
        Tool::on_turret(0.1301, 3.3161),
        Tool::on_turret(0.0, 0.0),
    ];
    let mut beside = Tool::on_turret(0.1293, 4.7124);
    beside.tip_in_link.y += 0.03;
    tools.push(beside);
    tools
}

/// Arms of every mirrored form of the family, with offsets, and with lengths of either sign.
fn family_arms() -> Vec<Arm> {
    let mut arms = vec![flight_arm()];
    for signs in 0..8 {
        let sign = |bit: i32| if signs & bit == 0 { 1.0 } else { -1.0 };
        arms.push(arm_of(
            &[
                (0.07, sign(1) * 1.570796, 0.05, 0.3),
                (0.35, 0.0, 0.02, -0.4),
                (0.33, 0.0, -0.03, 1.1),
                (0.0, sign(2) * FRAC_PI_2, -0.1, -0.2),
                (0.0, sign(4) * 1.5707964, -0.08, 0.5),
            ],
            PI,
        ));
    }
    let mut folded = FLIGHT;
    (folded[1].0, folded[2].0) = (-0.2, 0.4);
    arms.push(arm_of(&folded, PI));
    arms
}

fn random_angles(rng: &mut ChaCha8Rng, n: usize, limit: f64) -> Vec<f64> {
    (0..n).map(|_| rng.random_range(-limit..limit)).collect()
}

fn turn_apart(a: f64, b: f64) -> f64 {
    let d = (a - b).rem_euclid(TAU);
    d.min(TAU - d)
}

/// Largest difference of two configurations, whole turns apart from.
fn apart(a: &[f64], b: &[f64]) -> f64 {
    a.iter()
        .zip(b)
        .map(|(a, b)| turn_apart(*a, *b))
        .fold(0.0, f64::max)
}

#[test]
fn every_branch_of_100_000_reachable_goals_meets_its_goal_and_one_is_the_original() {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let (arms, tools) = (family_arms(), tools());
    let (mut worst_point, mut worst_axis): (f64, f64) = (0.0, 0.0);
    let (mut solutions_seen, mut singular_goals) = (0, 0);
    for trial in 0..100_000 {
        // Half of the goals belong to the flight arm.
        let arm = &arms[if trial % 2 == 0 {
            0
        } else {
            trial / 2 % arms.len()
        }];
        let tool = &tools[trial % tools.len()];
        let q = random_angles(&mut rng, 5, PI);
        let goal = AxisGoal::at(arm, tool, &q).unwrap();
        let solutions = solve_axis(arm, tool, &goal).unwrap();
        let mut nearest = f64::INFINITY;
        let mut last: Option<Branch> = None;
        for s in &solutions {
            let (point, axis) = goal.miss(arm, tool, &s.joints_rad).unwrap();
            if s.singular {
                assert!(point <= 1e-9 && axis <= 1.5e-6, "{s:?} {point:e} {axis:e}");
            } else {
                worst_point = worst_point.max(point);
                worst_axis = worst_axis.max(axis);
            }
            nearest = nearest.min(apart(&s.joints_rad, &q));
            assert!(last < Some(s.branch), "branches in a fixed order");
            last = Some(s.branch);
            if !s.singular {
                let actual = Branch::of(arm, tool, &s.joints_rad).unwrap();
                assert_eq!(actual, s.branch, "branch of {:?}", s.joints_rad);
            }
        }
        solutions_seen += solutions.len();
        if solutions.iter().any(|s| s.singular) {
            // The original may be one of those that coincide, or of a free plane angle.
            singular_goals += 1;
        } else {
            assert!(
                nearest < 1e-4,
                "trial {trial}: {q:?} not found, nearest {nearest:e}"
            );
        }
    }
    assert!(singular_goals < 20, "{singular_goals}");
    assert!(worst_point < 1e-12, "point {worst_point:e}");
    assert!(worst_axis < 1e-11, "axis {worst_axis:e}");
    assert!(solutions_seen > 300_000, "{solutions_seen}");
}

#[test]
fn a_descent_from_many_seeds_finds_no_branch_that_the_closed_form_missed() {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let arm = flight_arm();
    let options = NumericOptions {
        respect_limits: false,
        ..NumericOptions::default()
    };
    let mut found_by_descent = 0;
    let mut known_branches = 0;
    for trial in 0..60 {
        let tool = &tools()[trial % 5];
        let goal = AxisGoal::at(&arm, tool, &random_angles(&mut rng, 5, 2.5)).unwrap();
        let known = solve_axis(&arm, tool, &goal).unwrap();
        let mut hit = vec![false; known.len()];
        for _ in 0..120 {
            let seed = random_angles(&mut rng, 5, PI);
            let Ok(q) = solve_numeric(&arm, tool, &goal, &seed, &options) else {
                continue;
            };
            found_by_descent += 1;
            let which = known.iter().position(|s| apart(&s.joints_rad, &q) < 1e-5);
            hit[which.unwrap_or_else(|| panic!("{q:?} is missing for {goal:?}"))] = true;
        }
        known_branches += known.len();
        assert!(hit.iter().filter(|h| **h).count() * 2 >= known.len());
    }
    assert!(
        found_by_descent > 3_000 && known_branches > 200,
        "{found_by_descent}"
    );
}

#[test]
fn the_documented_flight_pose_comes_back_from_its_tool_point_and_axis() {
    let arm = flight_arm();
    let tool = Tool::on_turret(0.1306, 0.0);
    let q = [-0.11828, -0.803972, 1.76256, 0.709861, 1.49277];
    let goal = AxisGoal::at(&arm, &tool, &q).unwrap();
    let near = q.map(|x| x + 0.05);
    let answer = closest_solution(&arm, &tool, &goal, &near).unwrap();
    assert!(apart(&answer, &q) < 1e-12);
}

#[test]
fn out_of_reach_says_which_condition_and_by_how_much() {
    let arm = flight_arm();
    let tool = Tool::on_turret(0.1, 0.0);
    let axis = Unit::new_normalize(-Vector3::z());
    let reason = |point| solve_axis(&arm, &tool, &AxisGoal { point, axis }).unwrap_err();
    // With the axis along -z the sine of psi is 1, u is along -z or z, n along r or -r: the tip
    // is reached by a1 + (a2 + a3) + d5 along r at the height of the shoulder, and d4 beside.
    let (a1, a2, a3) = (FLIGHT[0].0, FLIGHT[1].0, FLIGHT[2].0);
    let (d1, d4, d5) = (FLIGHT[0].2, FLIGHT[3].2, FLIGHT[4].2);
    let forward = a1 + a2 + a3 - d5;
    let beyond = forward + 0.05;
    let far = Vector3::new(beyond, -d4, d1 - 0.1);
    match reason(far) {
        IkError::OutOfReach {
            constraint: Constraint::ArmExtended,
            by_m,
        } => {
            assert!((by_m - 0.05).abs() < 1e-6, "{by_m}");
        }
        other => panic!("{other}"),
    }
    match reason(Vector3::new(0.04, 0.03, 0.2)) {
        IkError::OutOfReach {
            constraint: Constraint::ShoulderOffset,
            by_m,
        } => {
            assert!((by_m - (0.098924 - 0.05)).abs() < 1e-12, "{by_m}");
        }
        other => panic!("{other}"),
    }
    // A short forearm leaves a hole around the shoulder; the tip in its middle lacks 15 cm less
    // what d5 gives either way.
    let mut rows = FLIGHT;
    rows[2].0 = 0.1;
    let short = arm_of(&rows, PI);
    let (x, y) = (a1, -d4);
    let goal = AxisGoal {
        point: Vector3::new(x, y, d1 - 0.1),
        axis,
    };
    match solve_axis(&short, &tool, &goal).unwrap_err() {
        IkError::OutOfReach {
            constraint: Constraint::ArmFolded,
            by_m,
        } => {
            // The best branch faces backwards: 2 a1 + |d5| from its own shoulder.
            let expected = (a2 - 0.1) - (2.0 * a1 - d5);
            assert!((by_m - expected).abs() < 1e-6, "{by_m} {expected}");
        }
        other => panic!("{other}"),
    }
}

#[test]
fn a_goal_moved_across_the_edge_of_reach_is_refused_by_the_distance_moved() {
    let arm = flight_arm();
    let tool = Tool::on_turret(0.1306, 0.0);
    // Elbow straight: one solution, singular.
    let q = [0.2, -0.3, 0.0, 0.4, 1.2];
    let goal = AxisGoal::at(&arm, &tool, &q).unwrap();
    let outward = {
        let poses = arm.link_poses(&q).unwrap();
        (poses[3].translation.vector - poses[1].translation.vector).normalize()
    };
    let moved = |by: f64| AxisGoal {
        point: goal.point + outward * by,
        axis: goal.axis,
    };
    let inside = solve_axis(&arm, &tool, &moved(-1e-3)).unwrap();
    assert!(inside.iter().any(|s| apart(&s.joints_rad, &q) < 0.2));
    let beyond = solve_axis(&arm, &tool, &moved(0.02));
    // Other branches may still reach; those of this one must be gone.
    let nearest = match &beyond {
        Ok(solutions) => solutions
            .iter()
            .map(|s| apart(&s.joints_rad, &q))
            .fold(f64::INFINITY, f64::min),
        Err(_) => f64::INFINITY,
    };
    assert!(nearest > 0.5, "{nearest}");
    let there = solve_axis(&arm, &tool, &goal).unwrap();
    let s = there
        .iter()
        .find(|s| apart(&s.joints_rad, &q) < 1e-3)
        .expect("the straight elbow");
    assert!(goal.miss(&arm, &tool, &s.joints_rad).unwrap().0 < 1e-9);
}

#[test]
fn an_axis_parallel_to_the_bending_axis_is_answered_and_flagged() {
    let arm = arm_of(
        &FLIGHT.map(|(a, alpha, d, o)| {
            (
                a,
                if alpha == 0.0 {
                    0.0
                } else {
                    alpha.signum() * FRAC_PI_2
                },
                d,
                o,
            )
        }),
        PI,
    );
    let tool = Tool::on_turret(0.1306, 0.0);
    for last in [0.0, PI] {
        let q = [0.3, -0.7, 1.6, 0.4, last];
        let goal = AxisGoal::at(&arm, &tool, &q).unwrap();
        let solutions = solve_axis(&arm, &tool, &goal).unwrap();
        let singular: Vec<_> = solutions.iter().filter(|s| s.singular).collect();
        assert!(!singular.is_empty());
        for s in &solutions {
            let (point, axis) = goal.miss(&arm, &tool, &s.joints_rad).unwrap();
            assert!(point < 1e-9 && axis < 1e-6, "{point:e} {axis:e}");
        }
        // Asked to stay near, the free plane angle stays what it was.
        let near: Vec<f64> = q.iter().map(|x| x * 0.999).collect();
        let answer = closest_solution(&arm, &tool, &goal, &near).unwrap();
        assert!(apart(&answer, &q) < 0.01, "{answer:?}");
    }
}

#[test]
fn goals_close_to_the_singular_axis_keep_their_accuracy() {
    let arm = flight_arm();
    let tool = Tool::on_turret(0.1306, 0.0);
    for exponent in 0..16 {
        let small = 10_f64.powi(-exponent);
        for elbow in [1.5, small] {
            let q = [0.3, -0.7, elbow, 0.4, small];
            let goal = AxisGoal::at(&arm, &tool, &q).unwrap();
            let solutions = solve_axis(&arm, &tool, &goal).unwrap();
            for s in &solutions {
                let (point, axis) = goal.miss(&arm, &tool, &s.joints_rad).unwrap();
                assert!(point < 1e-9, "{exponent} {s:?} {point:e}");
                assert!(
                    axis < if s.singular { 1.5e-6 } else { 1e-9 },
                    "{exponent} {axis:e}"
                );
            }
        }
    }
}

#[test]
fn a_tool_of_no_offset_above_the_first_axis_keeps_joint_0_where_it_is() {
    let mut rows = FLIGHT;
    rows[3].2 = 0.0;
    for joint in [0, 3, 4] {
        rows[joint].1 = FRAC_PI_2.copysign(rows[joint].1);
    }
    let arm = arm_of(&rows, PI);
    let tool = Tool::on_turret(0.1, 0.0);
    let goal = AxisGoal {
        point: Vector3::new(0.0, 0.0, 0.3),
        axis: Unit::new_normalize(Vector3::z()),
    };
    let answer = closest_solution(&arm, &tool, &goal, &[0.7, 0.0, 1.0, 0.0, 0.0]).unwrap();
    assert!(goal.miss(&arm, &tool, &answer).unwrap().0 < 1e-9);
    let solutions = solve_axis(&arm, &tool, &goal).unwrap();
    assert!(solutions.iter().all(|s| s.singular));
    assert!(
        turn_apart(answer[0], 0.7).min(turn_apart(answer[0] + PI, 0.7)) < 1e-6,
        "{answer:?}"
    );
}

#[test]
fn whole_turns_bring_angles_into_unsymmetric_limits() {
    let limits = [
        (-1.0, 4.0),
        (-2.5, 0.3),
        (0.0, 6.0),
        (1.0, 7.0),
        (-6.0, 1.0),
    ];
    let limits = limits.map(|(lower_rad, upper_rad)| JointLimits {
        lower_rad,
        upper_rad,
        max_rate_rad_s: 0.1,
        max_acceleration_rad_s2: 0.1,
    });
    let arm = Arm::new(flight_arm().rows().to_vec(), limits.to_vec()).unwrap();
    let tool = Tool::on_turret(0.1306, 0.0);
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut refused = 0;
    for _ in 0..3_000 {
        let q: Vec<f64> = limits
            .iter()
            .map(|l| rng.random_range(l.lower_rad..l.upper_rad))
            .collect();
        let goal = AxisGoal::at(&arm, &tool, &q).unwrap();
        let solutions = solve_axis(&arm, &tool, &goal).unwrap();
        for s in &solutions {
            let is_within = arm.check_limits(&s.joints_rad).is_ok();
            assert_eq!(is_within, s.within_limits);
            assert_eq!(s.limit_violation.is_none(), is_within);
        }
        assert!(
            solutions
                .iter()
                .any(|s| s.within_limits && apart(&s.joints_rad, &q) < 1e-4)
        );
        let answer = closest_solution(&arm, &tool, &goal, &q).unwrap();
        arm.check_limits(&answer).unwrap();
        assert!(travel_time(&arm, &answer, &q) < 1e-3, "{answer:?} {q:?}");
        // A goal that some posture reaches, but none within the limits.
        let outside: Vec<f64> = vec![2.0, -3.0, 2.0, 0.5, 2.0];
        let goal = AxisGoal::at(&arm, &tool, &outside).unwrap();
        match closest_solution(&arm, &tool, &goal, &q) {
            Ok(answer) => arm.check_limits(&answer).unwrap(),
            Err(IkError::JointLimit {
                joint,
                value_rad,
                lower_rad,
                upper_rad,
            }) => {
                refused += 1;
                assert_eq!(
                    (lower_rad, upper_rad),
                    (limits[joint].lower_rad, limits[joint].upper_rad)
                );
                assert!(value_rad < lower_rad || value_rad > upper_rad);
            }
            Err(other) => panic!("{other}"),
        }
    }
    assert!(refused == 0 || refused == 3_000);
}

#[test]
fn other_arms_and_tools_are_named_and_solved_by_descent() {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let mut tilted = FLIGHT;
    tilted[2].1 = 0.02;
    let off_family = arm_of(&tilted, PI);
    let tool = Tool::on_turret(0.1306, 0.0);
    let goal = AxisGoal::at(&off_family, &tool, &[0.1; 5]).unwrap();
    match solve_axis(&off_family, &tool, &goal).unwrap_err() {
        IkError::NotThisFamily(m) => {
            assert_eq!(
                (m.parameter, m.joint, m.value),
                ("alpha_rad", Some(2), 0.02)
            );
        }
        other => panic!("{other}"),
    }
    let mut beside = tool.clone();
    beside.tip_in_link.x = 0.01;
    assert!(matches!(
        solve_axis(&flight_arm(), &beside, &goal).unwrap_err(),
        IkError::NotThisFamily(_)
    ));
    let six = arm_of(
        &[
            (0.05, FRAC_PI_2, 0.3, 0.0),
            (0.4, 0.0, 0.0, 0.0),
            (0.05, FRAC_PI_2, 0.0, 0.0),
            (0.0, -FRAC_PI_2, 0.4, 0.0),
            (0.0, FRAC_PI_2, 0.0, 0.0),
            (0.0, 0.0, 0.1, 0.0),
        ],
        2.9,
    );
    for arm in [&off_family, &six] {
        for _ in 0..200 {
            let q = random_angles(&mut rng, arm.joint_count(), 2.4);
            let goal = AxisGoal::at(arm, &beside, &q).unwrap();
            let near: Vec<f64> = q.iter().map(|x| x + rng.random_range(-0.1..0.1)).collect();
            let answer = closest_solution(arm, &beside, &goal, &near).unwrap();
            arm.check_limits(&answer).unwrap();
            let (point, axis) = goal.miss(arm, &beside, &answer).unwrap();
            assert!(point <= 1e-10 && axis <= 1e-10, "{point:e} {axis:e}");
        }
    }
}

#[test]
fn four_joints_reach_the_point_and_say_what_the_axis_lacks() {
    let arm = arm_of(
        &[
            (0.06, FRAC_PI_2, 0.05, 0.0),
            (0.35, 0.0, 0.0, 0.0),
            (0.33, 0.0, 0.0, 0.0),
            (0.1, 0.0, 0.0, 0.0),
        ],
        PI,
    );
    let axis_in_link = Unit::new_normalize(Vector3::x());
    let tool = Tool {
        tip_in_link: Vector3::zeros(),
        axis_in_link,
    };
    let q = [0.3, 0.6, -1.4, -0.5];
    let goal = AxisGoal::at(&arm, &tool, &q).unwrap();
    let answer = closest_solution(&arm, &tool, &goal, &[0.2, 0.5, -1.2, -0.4]).unwrap();
    assert!(apart(&answer, &q) < 1e-8);
    // Turned out of the arm's plane by 0.2 rad: no joint can follow.
    let plane = Unit::new_normalize(Vector3::new(0.3_f64.sin(), -0.3_f64.cos(), 0.0));
    let axis = Unit::new_normalize(
        goal.axis.into_inner() * 0.2_f64.cos() + plane.into_inner() * 0.2_f64.sin(),
    );
    let turned = AxisGoal {
        point: goal.point,
        axis,
    };
    match closest_solution(&arm, &tool, &turned, &q).unwrap_err() {
        IkError::AxisInfeasible { by_rad } => assert!((by_rad - 0.2).abs() < 1e-4, "{by_rad}"),
        other => panic!("{other}"),
    }
    let far = AxisGoal {
        point: Vector3::new(2.0, 0.0, 0.0),
        axis: goal.axis,
    };
    assert!(matches!(
        solve_numeric(&arm, &tool, &far, &q, &NumericOptions::default()).unwrap_err(),
        IkError::OutOfReach { constraint: Constraint::TotalLength, by_m } if by_m > 1.0
    ));
}

#[test]
fn unusable_numbers_are_refused() {
    let arm = flight_arm();
    let tool = Tool::on_turret(0.1, 0.0);
    let axis = Unit::new_normalize(Vector3::z());
    let mut goal = AxisGoal {
        point: Vector3::new(0.5, f64::NAN, 0.0),
        axis,
    };
    assert_eq!(solve_axis(&arm, &tool, &goal), Err(IkError::NotFinite));
    goal.point.y = 0.0;
    goal.axis = Unit::new_unchecked(Vector3::new(0.0, 0.0, 2.0));
    assert_eq!(solve_axis(&arm, &tool, &goal), Err(IkError::NotFinite));
    goal.axis = axis;
    assert!(matches!(
        closest_solution(&arm, &tool, &goal, &[0.0; 4]),
        Err(IkError::Arm(_))
    ));
    let options = NumericOptions::default();
    let nan = [f64::NAN; 5];
    assert!(matches!(
        solve_numeric(&arm, &tool, &goal, &nan, &options),
        Err(IkError::Arm(_))
    ));
}

#[test]
fn a_joint_limit_found_by_descent_is_named() {
    let arm = flight_arm();
    let tool = Tool::on_turret(0.1306, 0.0);
    let q = [0.2, -0.5, 1.2, 0.4, 1.2];
    let goal = AxisGoal::at(&arm, &tool, &q).unwrap();
    let mut limits = arm.limits().to_vec();
    (limits[4].lower_rad, limits[4].upper_rad) = (-0.5, 0.9);
    let tight = Arm::new(arm.rows().to_vec(), limits).unwrap();
    let near = [0.2, -0.5, 1.2, 0.4, 0.8];
    match solve_numeric(&tight, &tool, &goal, &near, &NumericOptions::default()).unwrap_err() {
        IkError::JointLimit {
            joint,
            value_rad,
            upper_rad,
            ..
        } => {
            assert_eq!((joint, upper_rad), (4, 0.9));
            assert!((value_rad - 1.2).abs() < 1e-8);
        }
        other => panic!("{other}"),
    }
}

#[test]
fn a_joint_without_a_rate_limit_counts_as_the_slowest_that_has_one() {
    let arm = flight_arm();
    let mut limits = arm.limits().to_vec();
    limits[0].max_rate_rad_s = 0.5;
    for limit in &mut limits[1..] {
        limit.max_rate_rad_s = 0.25;
    }
    limits[4].max_rate_rad_s = NO_RATE_LIMIT_RAD_S;
    let arm = Arm::new(arm.rows().to_vec(), limits).unwrap();
    let mut there = [0.0; 5];
    there[4] = 1.0;
    assert!((travel_time(&arm, &[0.0; 5], &there) - 4.0).abs() < 1e-12);
}
