//! Figures of the simulated rover: tilt by the arm, speed of the physics, creep, odometry, images.
//!
//! `cargo run --release -p rover-sim --example rover_figures [FOLDER]` writes what the cameras and
//! an outside camera see to the folder, if one is given.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::print_stdout,
    missing_docs
)]

use rover_kinematics::through;
use rover_messages::{
    arm::Guard,
    imaging::ImageData,
    mobility::{DriveArc, DriveGoal, DriveGuard, DriveResult, PointGoal},
    simulation::{PickRequest, SurfaceKind, ViewRequest},
};
use rover_robot::Robot;
use rover_sim::{
    Advance, RockField, ScatteredRocks, SimulationDescription, TerrainDescription,
    TruthDescription, World,
};
use std::{path::Path, sync::Arc, time::Instant};

const ROCKY8: &str = include_str!("../../scenarios/robots/rocky8.toml");

fn description(seed: u64) -> SimulationDescription {
    SimulationDescription {
        truth: TruthDescription {
            angle_deg: 0.5,
            length_mm: 1.0,
            ..TruthDescription::default()
        },
        terrain: TerrainDescription {
            centre_m: [5.0, 0.0],
            size_m: [14.0, 8.0],
            cell_m: 0.025,
            relief_m: 0.02,
            relief_wavelength_m: 2.0,
            relief_gain: 0.5,
            seed,
            rocks: vec![],
            scattered: ScatteredRocks {
                count_n: 160,
                radius_m: [0.004, 0.03],
                subdivisions_n: 2,
            },
            field: Some(RockField::default()),
            ..TerrainDescription::default()
        },
        ..SimulationDescription::default()
    }
}

fn world(text: &str, d: &SimulationDescription, seed: u64) -> World {
    let robot = Arc::new(Robot::parse(text, "rocky8.toml").unwrap());
    let stow = robot.posture("stow").unwrap().to_vec();
    World::new(robot, d, seed, &stow).unwrap()
}

fn until_end(world: &mut World) -> Advance {
    loop {
        match world.advance(1) {
            Advance::Moving => {}
            other => return other,
        }
    }
}

fn drive(world: &mut World, length_m: f64, curvature_1_m: f64) -> DriveResult {
    let goal = DriveGoal {
        arc: DriveArc::Arc {
            length_m,
            curvature_1_m,
        },
        speed_fraction: 1.0,
        guard: DriveGuard::default(),
    };
    world.start_drive(&goal).unwrap();
    match until_end(world) {
        Advance::Parked(result) => result.unwrap(),
        other => panic!("{other:?}"),
    }
}

fn go(world: &mut World, posture: &str) {
    let robot = world.robot().clone();
    let path = [
        world.state().joints_rad,
        robot.posture(posture).unwrap().to_vec(),
    ];
    world
        .start(through(&robot.arm, &path, 1.0).unwrap(), Guard::default())
        .unwrap();
    match until_end(world) {
        Advance::Ended(result) => drop(result.unwrap()),
        other => panic!("{other:?}"),
    }
}

fn write(folder: Option<&Path>, name: &str, image: &ImageData) {
    let Some(folder) = folder else { return };
    let mut bytes = format!("P5\n{} {}\n255\n", image.width_px, image.height_px).into_bytes();
    bytes.extend(&image.pixels);
    std::fs::write(folder.join(name), bytes).unwrap();
}

fn main() {
    let folder = std::env::args().nth(1);
    let folder = folder.as_deref().map(Path::new);
    let start = Instant::now();
    let d = description(3);
    let mut rover = world(ROCKY8, &d, 3);
    println!("building the world: {:.2} s", start.elapsed().as_secs_f64());
    let truth = rover.truth_state().rover.unwrap();
    println!(
        "stands at {:.4?} m, {:.5?} rad",
        truth.position_m, truth.rpy_rad
    );

    let tip = rover.tip_in_world();
    let _ = tip;
    let start = Instant::now();
    let before = rover.step_count();
    go(&mut rover, "ready");
    let ready = rover.truth_state().rover.unwrap();
    println!("tilt at ready: {:.4} deg", ready.tilt_by_arm_deg);
    go(&mut rover, "reach");
    let reach = rover.truth_state().rover.unwrap();
    let tip = rover.tip_in_world();
    println!(
        "tilt stow -> reach: {:.4} deg (pitch {:.4}, roll {:.4})",
        reach.tilt_by_arm_deg,
        (reach.rpy_rad[1] - truth.rpy_rad[1]).to_degrees(),
        (reach.rpy_rad[0] - truth.rpy_rad[0]).to_degrees(),
    );
    let lever = nalgebra::Vector3::from(tip) - nalgebra::Vector3::new(0.0, 0.0, 0.32);
    println!(
        "at the instrument, {:.3} m from the pivot: {:.2} mm",
        lever.norm(),
        reach.tilt_by_arm_deg.to_radians() * lever.norm() * 1e3
    );
    go(&mut rover, "ready");
    go(&mut rover, "stow");
    let steps = rover.step_count() - before;
    let wall = start.elapsed().as_secs_f64();
    println!("arm: {steps} steps, {:.0} steps/s", steps as f64 / wall);
    let back = rover.truth_state().rover.unwrap();
    println!("tilt after stowing again: {:.6} deg", back.tilt_by_arm_deg);

    for (length, curvature) in [(1.0, 0.0), (1.0, 0.3), (1.0, -0.3), (1.0, 0.0), (-1.0, 0.0)] {
        let from = rover.truth_state().rover.unwrap();
        let (start, before) = (Instant::now(), rover.step_count());
        let physics = rover.truth_state().physics_wall_s;
        let result = drive(&mut rover, length, curvature);
        let steps = (rover.step_count() - before) as f64;
        let to = rover.truth_state().rover.unwrap();
        let way = (nalgebra::Vector3::from(to.position_m)
            - nalgebra::Vector3::from(from.position_m))
        .norm();
        println!(
            "drive {length} m, {curvature} 1/m: way {way:.3} m, completed {} {:?}, slip {:.3}, \
             yaw {:.2} deg, odometry off {:.1} mm, {:.3} deg; {steps} steps, {:.0} steps/s ({:.2} s, \
             {:.2} s in all)",
            result.completed,
            result.stop_reason,
            result.state.slip,
            (to.rpy_rad[2] - from.rpy_rad[2]).to_degrees(),
            to.position_error_m * 1e3,
            to.heading_error_rad.to_degrees(),
            steps / (rover.truth_state().physics_wall_s - physics),
            rover.truth_state().physics_wall_s - physics,
            start.elapsed().as_secs_f64(),
        );
    }
    let from = rover.truth_state().rover.unwrap();
    rover
        .start_drive(&DriveGoal {
            arc: DriveArc::Turn { angle_rad: 0.5 },
            speed_fraction: 1.0,
            guard: DriveGuard::default(),
        })
        .unwrap();
    println!("turn: {:?}", until_end(&mut rover));
    let to = rover.truth_state().rover.unwrap();
    println!(
        "turned {:.4} rad, moved {:.4?}",
        to.rpy_rad[2] - from.rpy_rad[2],
        nalgebra::Vector3::from(to.position_m) - nalgebra::Vector3::from(from.position_m)
    );

    let mut rover = world(ROCKY8, &d, 3);
    for surface in [SurfaceKind::Rock, SurfaceKind::Ground] {
        let mut request = PickRequest {
            pair: "mast".into(),
            surface,
            range_m: [3.0, 9.0],
            choice_n: 0,
        };
        let pick = match rover.pick(&request) {
            Ok(pick) => pick,
            Err(fault) => {
                println!("{fault}");
                continue;
            }
        };
        let [pan_rad, tilt_rad] = pick.mast_rad.unwrap();
        rover
            .start_pointing(&PointGoal { pan_rad, tilt_rad })
            .unwrap();
        println!("{:?}", until_end(&mut rover));
        let start = Instant::now();
        let pair = rover.grab("mast", 0).unwrap();
        println!("mast pair: {:.3} s", start.elapsed().as_secs_f64());
        let start = Instant::now();
        let _ = rover.grab("mast", 1).unwrap();
        println!("mast pair again: {:.3} s", start.elapsed().as_secs_f64());
        write(folder, &format!("mast_{surface:?}.pgm"), &pair.left);
        request.choice_n = 0;
        println!("{:?}", rover.pick(&request));
    }
    let start = Instant::now();
    let pair = rover.grab("body", 0).unwrap();
    println!("body pair: {:.3} s", start.elapsed().as_secs_f64());
    write(folder, "body.pgm", &pair.left);
    for (name, eye_m) in [("chase", [-2.2, -1.6, 1.8]), ("front", [2.2, 1.2, 0.9])] {
        let view = rover
            .view(&ViewRequest {
                eye_m,
                look_at_m: [0.3, 0.0, 0.4],
                width_px: 960,
                height_px: 640,
                field_of_view_deg: 50.0,
            })
            .unwrap();
        write(folder, &format!("{name}.pgm"), &view.image);
    }

    // On slopes: gravity turned against the terrain.
    for slope_deg in [0.0_f64, 15.0, 25.0] {
        let (s, c) = slope_deg.to_radians().sin_cos();
        let text = ROCKY8.replace(
            "gravity_m_s2 = [0.0, 0.0, -9.81]",
            &format!("gravity_m_s2 = [{}, 0.0, {}]", -9.81 * s, -9.81 * c),
        );
        let mut d = description(5);
        d.terrain.relief_m = 0.0;
        d.terrain.field = None;
        d.terrain.scattered.count_n = 0;
        let mut rover = world(&text, &d, 5);
        let from = rover.truth_state().rover.unwrap();
        let goal = DriveGoal {
            arc: DriveArc::Arc {
                length_m: 1.0,
                curvature_1_m: 0.0,
            },
            speed_fraction: 1.0,
            guard: DriveGuard {
                max_slip: Some(1.0),
                max_tilt_rad: Some(1.5),
            },
        };
        rover.start_drive(&goal).unwrap();
        let outcome = until_end(&mut rover);
        let slip = match &outcome {
            Advance::Parked(Ok(result)) => result.state.slip,
            _ => panic!("{outcome:?}"),
        };
        let to = rover.truth_state().rover.unwrap();
        println!(
            "slope {slope_deg} deg: 1 m commanded, {:.3} m driven, slip estimated {slip:.3}",
            to.position_m[0] - from.position_m[0]
        );
        println!(
            "  creep in 10 s on the wheels: {:.5} mm",
            rover.creep_mm(5000)
        );
    }
}
