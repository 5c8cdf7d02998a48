//! Forward kinematics, Jacobian and inverse kinematics of the Mars Exploration Rover arm.

// The flight table gives its twists to six decimals, which is not pi/2.
#![allow(clippy::approx_constant, clippy::expect_used, missing_docs)]

use criterion::{Criterion, criterion_group, criterion_main};
use nalgebra::Vector3;
use rover_kinematics::{
    Arm, AxisGoal, DhRow, JacobianBuffer, JointLimits, NumericOptions, Tool, closest_solution,
    pose_error_jacobian_with_mount, solve_axis, solve_numeric,
};
use std::hint::black_box;

fn arm() -> Arm {
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
    let limit = JointLimits {
        lower_rad: -3.2,
        upper_rad: 3.2,
        max_rate_rad_s: 0.1,
        max_acceleration_rad_s2: 0.2,
    };
    Arm::new(rows.to_vec(), vec![limit; 5]).expect("the arm is well formed")
}

fn benches(c: &mut Criterion) {
    let arm = arm();
    let tool = Tool::on_turret(0.1306, 0.0);
    let q = [-0.11828, -0.803972, 1.76256, 0.709861, 1.49277];
    let goal = AxisGoal::at(&arm, &tool, &q).expect("a goal");
    let near = q.map(|x| x + 0.02);
    let tip = tool.tip_in_link;
    c.bench_function("fk", |b| b.iter(|| arm.forward(black_box(&q))));
    let mut buffer = JacobianBuffer::zeros();
    c.bench_function("fk + jacobian", |b| {
        b.iter(|| {
            let pose = arm.forward_with_jacobian(black_box(&q), black_box(&tip), &mut buffer);
            black_box(&buffer);
            pose
        });
    });
    c.bench_function("ik, all branches", |b| {
        b.iter(|| solve_axis(black_box(&arm), &tool, black_box(&goal)));
    });
    c.bench_function("ik, closest", |b| {
        b.iter(|| closest_solution(black_box(&arm), &tool, black_box(&goal), &near));
    });
    let options = NumericOptions::default();
    c.bench_function("ik, numeric, 0.02 rad away", |b| {
        b.iter(|| solve_numeric(black_box(&arm), &tool, black_box(&goal), &near, &options));
    });
    let centre = Vector3::new(0.0, 0.0, -0.3);
    c.bench_function("pose error jacobian with mount", |b| {
        b.iter(|| pose_error_jacobian_with_mount(black_box(&arm), &q, &tip, &centre));
    });
}

criterion_group!(group, benches);
criterion_main!(group);
