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

/// The same arm for the crate `k`: every row's constant part is a fixed joint behind the turning one.
fn peer(arm: &Arm, tool: &Tool) -> k::SerialChain<f64> {
    use k::{Isometry3, JointType, NodeBuilder, Translation3, UnitQuaternion, Vector3};
    let mut nodes = Vec::new();
    let mut origin = Isometry3::identity();
    for (i, row) in arm.rows().iter().enumerate() {
        let node = NodeBuilder::new()
            .name(&format!("joint{i}"))
            .rotation(origin.rotation)
            .translation(origin.translation)
            .joint_type(JointType::Rotational {
                axis: Vector3::z_axis(),
            })
            .into_node();
        nodes.push(node);
        origin = Isometry3::from_parts(
            Translation3::new(row.a_m, 0.0, row.d_m),
            UnitQuaternion::from_axis_angle(&Vector3::x_axis(), row.alpha_rad),
        );
    }
    let tip = tool.tip_in_link;
    let end = origin * Isometry3::translation(tip.x, tip.y, tip.z);
    let node = NodeBuilder::new()
        .name("tip")
        .rotation(end.rotation)
        .translation(end.translation)
        .joint_type(JointType::Fixed)
        .into_node();
    nodes.push(node);
    for pair in nodes.windows(2) {
        pair[1].set_parent(&pair[0]);
    }
    k::SerialChain::new_unchecked(k::Chain::from_root(nodes[0].clone()))
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
    let chain = peer(&arm, &tool);
    chain.set_joint_positions_unchecked(&q);
    let wanted = chain.end_transform();
    c.bench_function("peer k: fk", |b| {
        b.iter(|| {
            chain.set_joint_positions_unchecked(black_box(&q));
            chain.end_transform()
        });
    });
    c.bench_function("peer k: fk + jacobian", |b| {
        b.iter(|| {
            chain.set_joint_positions_unchecked(black_box(&q));
            chain.update_transforms();
            k::jacobian(&chain)
        });
    });
    // The point and two of the three rotations: what a five-joint arm can be asked for. 1e-9 m.
    let solver = k::JacobianIkSolver::new(1e-9, 1e-9, 0.8, 100);
    let constraints = k::Constraints {
        rotation_z: false,
        ..Default::default()
    };
    c.bench_function("peer k: ik, 0.02 rad away, 1e-9 m", |b| {
        b.iter(|| {
            chain.set_joint_positions_unchecked(&near);
            k::InverseKinematicsSolver::solve_with_constraints(
                &solver,
                &chain,
                black_box(&wanted),
                &constraints,
            )
        });
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
