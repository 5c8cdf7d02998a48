//! Forward kinematics and derivatives against the Mars Exploration Rover arm's flight reference
//! and against finite differences.
//!
//! Source of the rows, the closed form and the joint angles of three Opportunity images:
//! NASA-AMMOS/VICAR, `vos/mars/src/sub/pig_mer/mer_idd_kinematic.c`, "derived by calling the real
//! FSW with the real calibration files". The expected poses are its closed form, plus the place of
//! the arm's base in the rover frame.
#![allow(clippy::unwrap_used, clippy::expect_used)]
// The flight table gives its twists to six decimals, which is not pi/2.
#![allow(clippy::approx_constant)]

use nalgebra::{Matrix3, Rotation3, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rover_kinematics::{
    Arm, ArmError, DhRow, ERRORS_PER_JOINT, JacobianBuffer, JointLimits, MOUNT_PARAMETERS, Tool,
    point_error_jacobian, pose_error_jacobian, pose_error_jacobian_with_mount,
};
use std::f64::consts::PI;

const A: [f64; 5] = [0.062443, 0.353552, 0.330349, 0.0, 0.0];
const D: [f64; 5] = [0.048494, 0.0, 0.0, -0.098924, -0.077131];
const ALPHA: [f64; 5] = [1.570796, 0.0, 0.0, -1.570796, 1.570796];
const BASE_IN_ROVER: [f64; 3] = [0.56245, -0.1599, -0.18654];

fn limits(n: usize) -> Vec<JointLimits> {
    let limit = JointLimits {
        lower_rad: -PI,
        upper_rad: PI,
        max_rate_rad_s: 0.1,
        max_acceleration_rad_s2: 0.2,
    };
    vec![limit; n]
}

fn flight_arm() -> Arm {
    let rows = (0..5).map(|i| DhRow {
        a_m: A[i],
        alpha_rad: ALPHA[i],
        d_m: D[i],
        theta_offset_rad: 0.0,
    });
    Arm::new(rows.collect(), limits(5)).unwrap()
}

/// The same with twists of exactly pi/2, as the reference poses have them.
fn square_arm() -> Arm {
    let mut rows = flight_arm().rows().to_vec();
    for (joint, twist) in [(0, PI / 2.0), (3, -PI / 2.0), (4, PI / 2.0)] {
        rows[joint].alpha_rad = twist;
    }
    Arm::new(rows, limits(5)).unwrap()
}

/// An arm with nothing special about it.
fn general_arm(n: usize, rng: &mut ChaCha8Rng) -> Arm {
    let rows = (0..n).map(|_| DhRow {
        a_m: rng.random_range(-0.4..0.4),
        alpha_rad: rng.random_range(-2.0..2.0),
        d_m: rng.random_range(-0.3..0.3),
        theta_offset_rad: rng.random_range(-1.0..1.0),
    });
    Arm::new(rows.collect(), limits(n)).unwrap()
}

struct Reference {
    joints: [f64; 5],
    tool: (f64, f64),
    tip_in_rover: [f64; 3],
    rotation: [[f64; 3]; 3],
}

const REFERENCES: [Reference; 3] = [
    Reference {
        joints: [-0.11828, -0.899795, 2.47065, 1.57119, -1.571],
        tool: (0.1293, 4.7124),
        tip_in_rover: [
            0.8696018148805936,
            0.03342951125479521,
            -0.007467756314635139,
        ],
        rotation: [
            [
                0.9930356861360231,
                0.00044918588317348904,
                0.11781309049676968,
            ],
            [
                -0.11781307840432831,
                -5.337886499823177e-05,
                0.993035787727508,
            ],
            [
                0.0004523463863859136,
                -0.9999998976913643,
                -8.714615624551447e-08,
            ],
        ],
    },
    Reference {
        joints: [-0.11828, -0.899801, 0.500046, 1.57045, -1.57096],
        tool: (0.1293, 4.7124),
        tip_in_rover: [
            1.2424063375042267,
            -0.010872597572258058,
            -0.5735437103947691,
        ],
        rotation: [
            [
                -0.3867721602558545,
                -0.9145864198122066,
                0.11806344373306218,
            ],
            [0.04611567728208484, 0.10868459330792528, 0.9930060440331194],
            [
                -0.921021520030794,
                0.38951166846781526,
                0.000140597242401839,
            ],
        ],
    },
    Reference {
        joints: [-0.11828, -0.803972, 1.76256, 0.709861, 1.49277],
        tool: (0.1306, 0.0),
        tip_in_rover: [1.13066634819088, -0.13805530358304224, 0.014808672455681224],
        rotation: [
            [
                0.11009881044508778,
                -0.9882821250590201,
                -0.1057198809467922,
            ],
            [
                0.9908886133506671,
                0.11744219956555514,
                -0.06593243278688068,
            ],
            [
                0.07757582014112936,
                -0.09749754381537826,
                0.9922077509672053,
            ],
        ],
    },
];

/// The source's closed form of the last link's pose, for twists of exactly pi/2.
fn closed_form(q: &[f64]) -> (Vector3<f64>, Matrix3<f64>) {
    let (s1, c1) = q[0].sin_cos();
    let (s2, c2) = q[1].sin_cos();
    let (s23, c23) = (q[1] + q[2]).sin_cos();
    let (s234, c234) = (q[1] + q[2] + q[3]).sin_cos();
    let (s5, c5) = q[4].sin_cos();
    let reach = A[0] + A[1] * c2 + A[2] * c23 - D[4] * s234;
    let position = Vector3::new(
        c1 * reach + D[3] * s1,
        s1 * reach - D[3] * c1,
        D[0] + A[1] * s2 + A[2] * s23 + D[4] * c234,
    );
    let rotation = Matrix3::new(
        c1 * c234 * c5 - s1 * s5,
        -c1 * s234,
        c1 * c234 * s5 + s1 * c5,
        s1 * c234 * c5 + c1 * s5,
        -s1 * s234,
        s1 * c234 * s5 - c1 * c5,
        s234 * c5,
        c234,
        s234 * s5,
    );
    (position, rotation)
}

/// The definition, multiplied out with the standard library's functions.
fn product_of_rows(arm: &Arm, q: &[f64]) -> nalgebra::Matrix4<f64> {
    let mut base_from_link = nalgebra::Matrix4::identity();
    for (row, q) in arm.rows().iter().zip(q) {
        let (s, c) = (q + row.theta_offset_rad).sin_cos();
        let (sa, ca) = row.alpha_rad.sin_cos();
        base_from_link *= nalgebra::Matrix4::new(
            c,
            -s * ca,
            s * sa,
            row.a_m * c,
            s,
            c * ca,
            -c * sa,
            row.a_m * s,
            0.0,
            sa,
            ca,
            row.d_m,
            0.0,
            0.0,
            0.0,
            1.0,
        );
    }
    base_from_link
}

fn random_angles(rng: &mut ChaCha8Rng, n: usize) -> Vec<f64> {
    (0..n).map(|_| rng.random_range(-PI..PI)).collect()
}

#[test]
fn the_flight_poses_are_reproduced() {
    let arm = square_arm();
    for reference in &REFERENCES {
        let tool = Tool::on_turret(reference.tool.0, reference.tool.1);
        let (tip, axis) = tool.at(&arm, &reference.joints).unwrap();
        let tip_in_rover = tip + Vector3::from(BASE_IN_ROVER);
        assert!((tip_in_rover - Vector3::from(reference.tip_in_rover)).norm() < 1e-12);
        // The reference's frame is the tool's: the link turned about y by the tool's angle.
        let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), reference.tool.1);
        let rotation = arm
            .forward(&reference.joints)
            .unwrap()
            .rotation
            .to_rotation_matrix()
            * turn;
        let expected = Matrix3::from_fn(|r, c| reference.rotation[r][c]);
        assert!((rotation.matrix() - expected).norm() < 1e-12);
        assert!((axis.into_inner() - expected.column(2)).norm() < 1e-12);
        // The table's twists, six decimals of pi/2, are 0.1 micrometre away.
        let (tip_by_table, _) = tool.at(&flight_arm(), &reference.joints).unwrap();
        assert!((tip_by_table - tip).norm() < 1.5e-7);
    }
}

#[test]
fn the_published_closed_form_agrees_to_the_rounding_of_its_twists() {
    let arm = flight_arm();
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    for _ in 0..1_000 {
        let q = random_angles(&mut rng, 5);
        let (position, rotation) = closed_form(&q);
        let pose = arm.forward(&q).unwrap();
        assert!((pose.translation.vector - position).norm() < 1e-6);
        assert!((pose.rotation.to_rotation_matrix().matrix() - rotation).norm() < 3e-6);
    }
    let exact = square_arm();
    for _ in 0..1_000 {
        let q = random_angles(&mut rng, 5);
        let (position, rotation) = closed_form(&q);
        let pose = exact.forward(&q).unwrap();
        assert!((pose.translation.vector - position).norm() < 1e-15);
        assert!((pose.rotation.to_rotation_matrix().matrix() - rotation).norm() < 5e-15);
    }
}

#[test]
fn all_ways_to_the_pose_agree_with_the_product_of_the_rows() {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    for trial in 0..4_000 {
        let arm = general_arm(4 + trial % 4, &mut rng);
        let n = arm.joint_count();
        let q = random_angles(&mut rng, n);
        let expected = product_of_rows(&arm, &q);
        let forward = arm.forward(&q).unwrap();
        assert!((forward.to_homogeneous() - expected).norm() < 1e-14);
        assert!((forward.rotation.norm() - 1.0).abs() < 1e-14);
        let poses = arm.link_poses(&q).unwrap();
        assert_eq!(poses.len(), n + 1);
        assert_eq!(poses[0], nalgebra::Isometry3::identity());
        assert!((poses[n].to_homogeneous() - expected).norm() < 1e-14);
        let mut buffer = JacobianBuffer::zeros();
        let point = Vector3::new(0.01, -0.02, 0.13);
        let pose = arm.forward_with_jacobian(&q, &point, &mut buffer).unwrap();
        assert!((pose.to_homogeneous() - expected).norm() < 1e-14);
        let in_base = expected.transform_point(&point.into()).coords;
        assert!((arm.point(&q, &point).unwrap() - in_base).norm() < 1e-14);
    }
}

#[test]
fn the_jacobian_is_the_derivative_of_the_pose() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let h = 1e-6;
    for trial in 0..400 {
        let arm = if trial == 0 {
            flight_arm()
        } else {
            general_arm(4 + trial % 4, &mut rng)
        };
        let n = arm.joint_count();
        let q = random_angles(&mut rng, n);
        let point = Vector3::from_fn(|_, _| rng.random_range(-0.2..0.2));
        let jacobian = arm.jacobian(&q, &point).unwrap();
        assert_eq!(jacobian.shape(), (6, n));
        for joint in 0..n {
            let moved = |by: f64| {
                let mut q = q.clone();
                q[joint] += by;
                arm.forward(&q).unwrap()
            };
            let (minus, plus) = (moved(-h), moved(h));
            let linear = (plus * nalgebra::Point3::from(point)
                - minus * nalgebra::Point3::from(point))
                / (2.0 * h);
            let angular = (plus.rotation * minus.rotation.inverse()).scaled_axis() / (2.0 * h);
            assert!((jacobian.fixed_view::<3, 1>(0, joint) - linear).norm() < 1e-9);
            assert!((jacobian.fixed_view::<3, 1>(3, joint) - angular).norm() < 1e-8);
        }
    }
}

#[test]
fn the_error_jacobian_is_the_derivative_with_respect_to_the_rows() {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let h = 1e-6;
    for trial in 0..200 {
        let arm = if trial == 0 {
            flight_arm()
        } else {
            general_arm(4 + trial % 4, &mut rng)
        };
        let n = arm.joint_count();
        let q = random_angles(&mut rng, n);
        let point = Vector3::from_fn(|_, _| rng.random_range(-0.2..0.2));
        let jacobian = pose_error_jacobian(&arm, &q, &point).unwrap();
        assert_eq!(jacobian.shape(), (6, ERRORS_PER_JOINT * n));
        let linear_only = point_error_jacobian(&arm, &q, &point).unwrap();
        assert_eq!(jacobian.fixed_rows::<3>(0), linear_only);
        for k in 0..4 * n {
            let moved = |by: f64| {
                let mut e = vec![0.0; 4 * n];
                e[k] = by;
                arm.perturbed(&e).unwrap().forward(&q).unwrap()
            };
            let (minus, plus) = (moved(-h), moved(h));
            let linear = (plus * nalgebra::Point3::from(point)
                - minus * nalgebra::Point3::from(point))
                / (2.0 * h);
            let angular = (plus.rotation * minus.rotation.inverse()).scaled_axis() / (2.0 * h);
            assert!((jacobian.fixed_view::<3, 1>(0, k) - linear).norm() < 1e-9);
            assert!((jacobian.fixed_view::<3, 1>(3, k) - angular).norm() < 1e-8);
        }
    }
}

#[test]
fn the_mount_columns_are_the_derivative_of_what_the_cameras_believe() {
    let arm = flight_arm();
    let q = [-0.1, -0.8, 1.7, 0.7, 1.4];
    let (point_in_link, centre) = (Vector3::new(0.0, 0.02, 0.13), Vector3::new(0.1, 0.0, 0.3));
    let jacobian = pose_error_jacobian_with_mount(&arm, &q, &point_in_link, &centre).unwrap();
    assert_eq!(jacobian.ncols(), 20 + MOUNT_PARAMETERS);
    let rows = pose_error_jacobian(&arm, &q, &point_in_link).unwrap();
    assert_eq!(jacobian.columns(0, 20), rows);
    let p = arm.point(&q, &point_in_link).unwrap();
    let believed = |mount: &[f64; 6]| {
        let turn = Rotation3::new(Vector3::new(mount[0], mount[1], mount[2]));
        let position = turn * (p - centre) + centre + Vector3::new(mount[3], mount[4], mount[5]);
        (position, turn)
    };
    let h = 1e-6;
    for k in 0..6 {
        let at = |by: f64| {
            let mut mount = [0.0; 6];
            mount[k] = by;
            believed(&mount)
        };
        let (minus, plus) = (at(-h), at(h));
        let linear = (plus.0 - minus.0) / (2.0 * h);
        let turn = (plus.1 * minus.1.inverse()).into_inner();
        let skew = (turn - turn.transpose()) * 0.5;
        let angular = Vector3::new(skew.m32, skew.m13, skew.m21) / (2.0 * h);
        assert!((jacobian.fixed_view::<3, 1>(0, 20 + k) - linear).norm() < 1e-9);
        assert!((jacobian.fixed_view::<3, 1>(3, 20 + k) - angular).norm() < 1e-8);
    }
}

#[test]
fn bad_arms_and_angles_are_refused_with_the_place() {
    let arm = flight_arm();
    assert!(matches!(
        Arm::new(arm.rows()[..3].to_vec(), limits(3)),
        Err(ArmError::JointCount { found: 3 })
    ));
    assert!(matches!(
        Arm::new(arm.rows().to_vec(), limits(4)),
        Err(ArmError::WrongLength {
            expected: 5,
            found: 4,
            ..
        })
    ));
    let mut rows = arm.rows().to_vec();
    rows[2].d_m = f64::INFINITY;
    assert!(matches!(
        Arm::new(rows, limits(5)),
        Err(ArmError::NotFinite {
            what: "d_m",
            index: 2,
            ..
        })
    ));
    for (field, change) in [
        (
            "upper_rad",
            (|l: &mut JointLimits| l.upper_rad = l.lower_rad) as fn(&mut JointLimits),
        ),
        ("lower_rad", |l| l.lower_rad = f64::NAN),
        ("max_rate_rad_s", |l| l.max_rate_rad_s = 0.0),
        ("max_acceleration_rad_s2", |l| {
            l.max_acceleration_rad_s2 = -1.0
        }),
    ] {
        let mut bad = limits(5);
        change(&mut bad[3]);
        match Arm::new(arm.rows().to_vec(), bad).unwrap_err() {
            ArmError::BadLimit { joint: 3, what, .. } => assert_eq!(what, field),
            other => panic!("{other}"),
        }
    }
    assert!(matches!(
        arm.forward(&[0.0; 4]),
        Err(ArmError::WrongLength { found: 4, .. })
    ));
    assert!(matches!(
        arm.forward(&[0.0, 0.0, 0.0, f64::NAN, 0.0]),
        Err(ArmError::NotFinite { index: 3, .. })
    ));
    assert!(arm.perturbed(&[0.0; 5]).is_err());
    let error = arm.check_limits(&[0.0, 0.0, -3.5, 0.0, 0.0]).unwrap_err();
    assert_eq!(
        error.to_string(),
        "joint[2] = -3.500000 rad is outside -3.141593 to 3.141593 rad"
    );
    arm.check_limits(&[PI, -PI, 0.0, 0.0, 0.0]).unwrap();
}

#[test]
fn rows_refuse_unknown_fields() {
    let text = r#"{"a_m":1.0,"alpha_rad":0.0,"d_m":0.0,"theta_offset_rad":0.0,"twist":1.0}"#;
    assert!(serde_json::from_str::<DhRow>(text).is_err());
}
