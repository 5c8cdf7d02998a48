//! The rover as a whole: standing, driving, slip, odometry, tilt by the arm, mast, targets.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use nalgebra::{Point3, Vector3};
use rover_kinematics::through;
use rover_messages::{
    arm::Guard,
    mobility::{DriveArc, DriveGoal, DriveGuard, DriveResult, DriveStop, PointGoal},
    simulation::{PickRequest, SurfaceKind},
};
use rover_robot::Robot;
use rover_sim::{
    Advance, RockField, ScatteredRocks, SimulationDescription, SoftPatch, SoilDescription,
    TerrainDescription, TruthDescription, World,
};
use std::sync::Arc;

const ROCKY8: &str = include_str!("../../scenarios/robots/rocky8.toml");

fn robot() -> Arc<Robot> {
    Arc::new(Robot::parse(ROCKY8, "rocky8.toml").unwrap())
}

/// Ground of 6 m by 4 m with little relief and no stones.
fn plain() -> SimulationDescription {
    SimulationDescription {
        truth: TruthDescription {
            droop: true,
            ..TruthDescription::default()
        },
        terrain: TerrainDescription {
            centre_m: [1.5, 0.0],
            size_m: [6.0, 4.0],
            cell_m: 0.05,
            relief_m: 0.005,
            relief_wavelength_m: 2.0,
            rocks: vec![],
            scattered: ScatteredRocks {
                count_n: 0,
                ..ScatteredRocks::default()
            },
            ..TerrainDescription::default()
        },
        ..SimulationDescription::default()
    }
}

fn world_of(robot: Arc<Robot>, d: &SimulationDescription, seed: u64) -> World {
    let stow = robot.posture("stow").unwrap().to_vec();
    World::new(robot, d, seed, &stow).unwrap()
}

fn world(d: &SimulationDescription, seed: u64) -> World {
    world_of(robot(), d, seed)
}

fn until_end(world: &mut World) -> Advance {
    for _ in 0..20_000 {
        match world.advance(1) {
            Advance::Moving => {}
            other => return other,
        }
    }
    panic!("the motion does not end");
}

fn goal(arc: DriveArc) -> DriveGoal {
    DriveGoal {
        arc,
        speed_fraction: 1.0,
        guard: DriveGuard::default(),
    }
}

fn straight(length_m: f64) -> DriveGoal {
    goal(DriveArc::Arc {
        length_m,
        curvature_1_m: 0.0,
    })
}

fn drive(world: &mut World, goal: &DriveGoal) -> DriveResult {
    world.start_drive(goal).unwrap();
    match until_end(world) {
        Advance::Parked(result) => result.unwrap(),
        other => panic!("{other:?}"),
    }
}

fn go(world: &mut World, posture: &str) {
    let robot = world.robot().clone();
    let goal = robot.posture(posture).unwrap().to_vec();
    let path = [world.state().joints_rad, goal];
    let trajectory = through(&robot.arm, &path, 1.0).unwrap();
    world.start(trajectory, Guard::default()).unwrap();
    match until_end(world) {
        Advance::Ended(result) => assert!(result.unwrap().completed),
        other => panic!("{other:?}"),
    }
}

#[test]
fn it_stands_level_on_level_ground_and_drives_where_it_is_told() {
    let mut world = world(&plain(), 1);
    let start = world.world_from_rover().unwrap();
    assert!(start.translation.vector.z.abs() < 0.03, "{start}");
    assert!(start.rotation.angle() < 0.03, "{start}");
    let result = drive(&mut world, &straight(0.4));
    assert!(result.completed, "{result:?}");
    let moved = start.inverse() * world.world_from_rover().unwrap();
    let way = moved.translation.vector;
    assert!(
        (0.37..0.405).contains(&way.x) && way.y.abs() < 0.02,
        "{way}"
    );
    // An arc to the left ends left of a straight line with the heading of its curvature.
    let before = world.world_from_rover().unwrap();
    let arc = goal(DriveArc::Arc {
        length_m: 0.5,
        curvature_1_m: 0.6,
    });
    drive(&mut world, &arc);
    let moved = before.inverse() * world.world_from_rover().unwrap();
    let yaw = moved.rotation.euler_angles().2;
    assert!((yaw - 0.3).abs() < 0.05, "{yaw}");
    assert!(moved.translation.vector.y > 0.03, "{moved}");
    // A turn in place turns in place.
    let before = world.world_from_rover().unwrap();
    drive(&mut world, &goal(DriveArc::Turn { angle_rad: -0.4 }));
    let moved = before.inverse() * world.world_from_rover().unwrap();
    let yaw = moved.rotation.euler_angles().2;
    assert!((yaw + 0.4).abs() < 0.08, "{yaw}");
    assert!(moved.translation.vector.norm() < 0.06, "{moved}");
}

#[test]
fn the_same_drive_gives_the_same_bits_and_another_seed_other_odometry() {
    let run = |seed| {
        let mut world = world(&plain(), seed);
        let result = drive(&mut world, &straight(0.3));
        let pose = world.world_from_rover().unwrap();
        let bits: Vec<u64> = pose
            .to_homogeneous()
            .iter()
            .chain(result.state.pose.position_m.coords.iter())
            .map(|x| x.to_bits())
            .collect();
        bits
    };
    let first = run(4);
    assert_eq!(first, run(4));
    assert_ne!(first, run(5));
}

#[test]
fn odometry_is_as_good_as_stated_and_says_so() {
    let mut world = world(&plain(), 2);
    let result = drive(&mut world, &straight(1.0));
    let truth = world.truth_state().rover.unwrap();
    let sigma = result.covariance[0][0].sqrt();
    assert!((sigma - 0.03).abs() < 0.003, "{sigma}");
    // Stated per axis; the height is not stated.
    assert!(truth.position_error_m < 4.0 * sigma + 0.02, "{truth:?}");
    assert!(truth.position_error_m > 1e-4, "{truth:?}");
    assert!(truth.heading_error_rad.abs() < 4.0 * 0.5f64.to_radians());
    let state = world.wheels_state().unwrap();
    assert!((state.driven_m - 1.0).abs() < 0.05, "{state:?}");
}

#[test]
fn a_soft_patch_stops_it_with_the_slip_as_reason() {
    let mut d = plain();
    d.terrain.soil = Some(SoilDescription {
        soft: vec![SoftPatch {
            centre_m: [1.0, 0.0],
            radius_m: 1.2,
            factor: 18.0,
        }],
        ..SoilDescription::default()
    });
    let mut world = world(&d, 1);
    let result = drive(&mut world, &straight(2.0));
    assert!(!result.completed);
    match result.stop_reason {
        Some(DriveStop::Slip { found, limit }) => assert!(found > limit, "{found}"),
        other => panic!("{other:?}"),
    }
}

#[test]
fn it_does_not_creep_on_a_slope() {
    let slope = 15.0_f64.to_radians();
    let gravity = format!(
        "gravity_m_s2 = [{}, 0.0, {}]",
        -9.81 * slope.sin(),
        -9.81 * slope.cos()
    );
    let text = ROCKY8.replace("gravity_m_s2 = [0.0, 0.0, -9.81]", &gravity);
    let robot = Arc::new(Robot::parse(&text, "rocky8.toml").unwrap());
    let mut world = world_of(robot, &plain(), 1);
    let creep = world.creep_mm(1000);
    assert!(creep < 0.01, "{creep} mm in 2 s");
}

#[test]
fn the_arm_tilts_the_body_as_statics_says_and_gives_it_back() {
    let mut world = world(&plain(), 1);
    let stowed = world.world_from_rover().unwrap();
    assert!(world.truth_state().rover.unwrap().tilt_by_arm_deg < 1e-4);
    go(&mut world, "reach");
    let found = world.world_from_rover().unwrap();
    let standing = world.arm_model().standing.clone().unwrap();
    let joints = world.truth_state().joints_rad;
    let expected = standing.tilted(world.arm_model(), &joints).unwrap();
    let turned = stowed.rotation.angle_to(&found.rotation).to_degrees();
    assert!((0.02..0.5).contains(&turned), "{turned} deg");
    let apart = expected.rotation.angle_to(&found.rotation).to_degrees();
    assert!(apart < 0.02 * turned, "{apart} of {turned} deg");
    // Nose down when the arm reaches forward.
    assert!(found.rotation.euler_angles().1 > stowed.rotation.euler_angles().1);
    go(&mut world, "stow");
    let back = world.world_from_rover().unwrap();
    assert!(stowed.rotation.angle_to(&back.rotation) < 1e-5);
}

#[test]
fn it_does_not_drive_with_the_arm_out_nor_move_two_things_at_once() {
    let mut world = world(&plain(), 1);
    go(&mut world, "ready");
    let fault = world.start_drive(&straight(0.2)).unwrap_err();
    assert_eq!(fault.name, "arm_not_stowed", "{fault}");
    go(&mut world, "stow");
    let sharp = goal(DriveArc::Arc {
        length_m: 0.2,
        curvature_1_m: 1.5,
    });
    let fault = world.start_drive(&sharp).unwrap_err();
    assert_eq!(fault.name, "curvature_too_sharp", "{fault}");
    world.start_drive(&straight(0.5)).unwrap();
    let point = PointGoal {
        pan_rad: 0.3,
        tilt_rad: 0.1,
    };
    assert_eq!(world.start_pointing(&point).unwrap_err().name, "busy");
    for _ in 0..10 {
        world.advance(1);
    }
    world.stop_drive(DriveStop::Cancelled);
    match until_end(&mut world) {
        Advance::Parked(Err(fault)) => assert_eq!(fault.name, "cancelled"),
        other => panic!("{other:?}"),
    }
    assert!(!world.is_moving());
}

#[test]
fn the_mast_points_with_an_error_of_its_own_and_the_frame_says_where() {
    let mut world = world(&plain(), 7);
    let [pan_rad, tilt_rad] = [0.2, 0.35];
    world
        .start_pointing(&PointGoal { pan_rad, tilt_rad })
        .unwrap();
    let Advance::Pointed(Ok(result)) = until_end(&mut world) else {
        panic!("the mast does not arrive");
    };
    assert_eq!((result.state.pan_rad, result.state.tilt_rad), (0.2, 0.35));
    let truly = world.world_from_rover().unwrap().inverse() * world.world_from_head().unwrap();
    let believed = world
        .robot()
        .mast()
        .unwrap()
        .rover_from_head(pan_rad, tilt_rad);
    let turned = truly
        .rotation
        .angle_to(&believed.isometry.rotation)
        .to_degrees();
    assert!((0.01..0.8).contains(&turned), "{turned} deg");
    let moved = truly.translation.vector - believed.isometry.translation.vector;
    assert!((1e-4..0.012).contains(&moved.norm()), "{moved}");
    assert_eq!(world.mast_state().unwrap().pan_rad, pan_rad);
    let far = PointGoal {
        pan_rad: 4.0,
        tilt_rad,
    };
    assert_eq!(world.start_pointing(&far).unwrap_err().name, "mast_limit");
}

#[test]
fn a_picked_place_is_where_its_pixel_says_and_stays_known_after_a_drive() {
    let mut d = plain();
    d.terrain.field = Some(RockField {
        count_n: 4,
        subdivisions_n: 3,
        clear_m: 1.5,
        ..RockField::default()
    });
    let mut world = world(&d, 3);
    let request = PickRequest {
        pair: "mast".into(),
        surface: SurfaceKind::Ground,
        range_m: [2.0, 3.0],
        choice_n: 0,
    };
    let pick = world.pick(&request).unwrap();
    assert!(pick.place.rock_n.is_none());
    let [pan_rad, tilt_rad] = pick.mast_rad.unwrap();
    world
        .start_pointing(&PointGoal { pan_rad, tilt_rad })
        .unwrap();
    until_end(&mut world);
    let pick = world.pick(&request).unwrap();
    let pixel = pick.pixel_px.unwrap();
    let place = world.designate("mast", pixel).unwrap();
    let apart = place.point_m - Vector3::from(pick.place.point_in_world_m);
    assert!(apart.norm() < 2e-3, "{apart}");
    // The believed model, placed by the believed mast, sees it within its calibration.
    let robot = world.robot().clone();
    let cameras = robot
        .cameras_at(robot.pair("mast").unwrap(), Some([pan_rad, tilt_rad]))
        .unwrap();
    let in_rover = world.world_from_rover().unwrap().inverse() * Point3::from(place.point_m);
    let seen = cameras.left.project(&in_rover.coords).unwrap();
    let off = (seen - nalgebra::Vector2::from(pixel)).norm();
    assert!((0.05..25.0).contains(&off), "{off} px");
    drive(&mut world, &straight(0.2));
    let again = world.designate("mast", pixel).unwrap();
    assert_eq!(again, place);
}
