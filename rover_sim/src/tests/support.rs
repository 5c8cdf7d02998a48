//! Arms, floors and worlds for the tests.

use crate::{
    ContactDescription, RockDescription, ScatteredRocks, SimulationDescription, SurfacePoint,
    TargetPixel, TerrainDescription, TruthDescription, arm::ArmModel,
};
use nalgebra::{Isometry3, Point3, Unit, UnitQuaternion, Vector3};
use rover_kinematics::{
    Arm, AxisGoal, DhRow, JointLimits, JointTrajectory, TimingOptions, closest_solution,
    through_with,
};
use rover_robot::{Capsule, ContactSwitch, LinkDynamics, Robot};
use std::{
    f64::consts::{FRAC_PI_2, PI},
    sync::Arc,
};

/// The arm of the Mars Exploration Rover with its z axis down, 0.6 m above the ground.
pub fn arm_model() -> ArmModel {
    let a = [0.062443, 0.353552, 0.330349, 0.0, 0.0];
    let d = [0.048494, 0.0, 0.0, -0.098924, -0.077131];
    let alpha = [FRAC_PI_2, 0.0, 0.0, -FRAC_PI_2, FRAC_PI_2];
    let mass = [1.0, 1.2, 0.9, 0.5, 0.8];
    let com = [
        [-0.03, -0.024, 0.0],
        [-0.18, 0.0, 0.0],
        [-0.165, 0.0, 0.0],
        [0.0, -0.05, 0.0],
        [0.0, 0.0, 0.03],
    ];
    let inertia = [
        [2e-3, 2e-3, 2e-3],
        [1e-3, 12e-3, 12e-3],
        [1e-3, 9e-3, 9e-3],
        [1e-3; 3],
        [1.5e-3, 1.5e-3, 1e-3],
    ];
    let stiffness = [12e3, 8e3, 8e3, 6e3, 6e3];
    let rows = (0..5)
        .map(|i| DhRow {
            a_m: a[i],
            alpha_rad: alpha[i],
            d_m: d[i],
            theta_offset_rad: 0.0,
        })
        .collect();
    let limits = (0..5)
        .map(|_| JointLimits {
            lower_rad: -3.4,
            upper_rad: 3.4,
            max_rate_rad_s: 0.4,
            max_acceleration_rad_s2: 0.8,
        })
        .collect();
    ArmModel {
        arm: Arm::new(rows, limits).unwrap(),
        world_from_base: Isometry3::from_parts(
            Vector3::new(0.06, 0.16, 0.60).into(),
            UnitQuaternion::from_euler_angles(PI, 0.0, 0.0),
        ),
        standing: None,
        links: (0..5)
            .map(|i| LinkDynamics {
                mass_kg: mass[i],
                com_m: com[i],
                inertia_kg_m2: inertia[i],
                stiffness_nm_rad: stiffness[i],
                damping_nms_rad: stiffness[i] / 100.0,
                max_torque_nm: 60.0,
            })
            .collect(),
        shapes: vec![
            vec![],
            vec![Capsule {
                from_m: [-0.353552, 0.0, 0.0],
                to_m: [0.0; 3],
                radius_m: 0.028,
            }],
            vec![Capsule {
                from_m: [-0.330349, 0.0, 0.0],
                to_m: [0.0; 3],
                radius_m: 0.024,
            }],
            vec![Capsule {
                from_m: [0.0, -0.098924, 0.0],
                to_m: [0.0; 3],
                radius_m: 0.026,
            }],
            vec![Capsule {
                from_m: [0.0; 3],
                to_m: [0.0, 0.0, 0.108],
                radius_m: 0.016,
            }],
        ],
        body: vec![],
        tip_in_link: Vector3::new(0.0, 0.0, 0.1306),
        axis_in_link: Vector3::z_axis(),
        switch: ContactSwitch {
            ball_radius_m: 0.002,
            closes_at_m: 0.002,
            travel_m: 0.004,
            spring_n_m: 1000.0,
            preload_n: 1.0,
        },
        contact: ContactDescription::default(),
        gravity_m_s2: Vector3::new(0.0, 0.0, -9.81),
        step_s: 0.002,
    }
}

/// A posture with the instrument pointing down, its tip 0.15 m above the ground.
pub const READY: [f64; 5] = [0.125, 0.1, 0.7, -2.371, -1.57];

/// A square of ground, 2 m wide, of `2 * n * n` triangles, at height `z_m`.
pub fn floor(z_m: f64, n: u32) -> (Vec<Vector3<f64>>, Vec<[u32; 3]>) {
    let mut positions = Vec::new();
    let mut triangles = Vec::new();
    for j in 0..=n {
        for i in 0..=n {
            let x = f64::from(i) / f64::from(n) * 2.0 - 0.5;
            let y = f64::from(j) / f64::from(n) * 2.0 - 1.0;
            positions.push(Vector3::new(x, y, z_m));
            if i < n && j < n {
                let k = j * (n + 1) + i;
                triangles.push([k, k + 1, k + n + 2]);
                triangles.push([k, k + n + 2, k + n + 1]);
            }
        }
    }
    (positions, triangles)
}

/// The testbed robot.
pub fn robot() -> Arc<Robot> {
    let text = include_str!("../../../scenarios/robots/bluestreak.toml");
    Arc::new(Robot::parse(text, "bluestreak.toml").unwrap())
}

/// A coarse table with one rock in the arm's workspace, the pixel on the rock's top as target, an
/// exact robot without droop.
pub fn scene() -> SimulationDescription {
    SimulationDescription {
        truth: TruthDescription {
            droop: false,
            ..TruthDescription::default()
        },
        terrain: TerrainDescription {
            centre_m: [0.75, 0.0],
            size_m: [1.2, 1.2],
            height_m: 0.25,
            cell_m: 0.02,
            relief_m: 0.004,
            rocks: vec![RockDescription {
                position_m: [0.54, 0.0, 0.27],
                radius_m: 0.13,
                roughness: 0.06,
                subdivisions_n: 5,
                seed: 7,
            }],
            scattered: ScatteredRocks {
                count_n: 3,
                ..ScatteredRocks::default()
            },
            ..TerrainDescription::default()
        },
        target: Some(TargetPixel {
            pair: "body".into(),
            pixel_px: [340.0, 236.0],
        }),
        ..SimulationDescription::default()
    }
}

/// Joint angles that put the believed tip at `point` with the axis along `axis` (rover frame).
pub fn reach(robot: &Robot, point: &Vector3<f64>, axis: &Vector3<f64>, near: &[f64]) -> Vec<f64> {
    let base_from_rover = robot.rover_from_arm_base.isometry.inverse();
    let goal = AxisGoal {
        point: (base_from_rover * Point3::from(*point)).coords,
        axis: Unit::new_normalize(base_from_rover.rotation * axis),
    };
    closest_solution(&robot.arm, &robot.tool, &goal, near).unwrap()
}

/// A straight motion of the tip along its axis, from `from_m` to `to_m` above `surface`, at
/// `speed_m_s`.
pub fn straight(
    robot: &Robot,
    surface: &SurfacePoint,
    [from_m, to_m]: [f64; 2],
    speed_m_s: f64,
) -> JointTrajectory {
    let axis = -surface.normal.into_inner();
    let knots = 60;
    let mut near = robot.posture("ready").unwrap().to_vec();
    let path: Vec<Vec<f64>> = (0..=knots)
        .map(|i| {
            let above = from_m + (to_m - from_m) * f64::from(i) / f64::from(knots);
            near = reach(robot, &(surface.point_m - axis * above), &axis, &near);
            near.clone()
        })
        .collect();
    let knot_m = (from_m - to_m).abs() / f64::from(knots);
    let lengths = (0..=knots).map(|i| f64::from(i) * knot_m).collect();
    let options = TimingOptions {
        max_tool_speed_m_s: Some(speed_m_s),
        path_lengths_m: Some(lengths),
        ..TimingOptions::default()
    };
    through_with(&robot.arm, &path, &options).unwrap()
}
