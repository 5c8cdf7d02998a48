//! The world as a whole: motions, stops, contact, faults, scores, repeatability.

use super::support::{robot, scene, straight};
use crate::{
    Advance, FaultMoment, OcclusionDescription, SimulationDescription, SimulationError,
    SurfacePoint, TargetPixel, VanishingRock, World,
};

use rover_geometry::{Direction, Point};
use rover_kinematics::{JointTrajectory, through};
use rover_messages::{
    Fault,
    arm::{ExecuteResult, Guard, Motion, StopReason},
    simulation::{InjectedFault, ScoreRequest, ViewRequest},
    target::Target,
};

const PAIR: &str = "body";

fn world(description: &SimulationDescription, seed: u64) -> World {
    let robot = robot();
    let start = robot.posture("ready").unwrap().to_vec();
    World::new(robot, description, seed, &start).unwrap()
}

fn surface(world: &mut World) -> SurfacePoint {
    let target = scene().target.unwrap();
    world.designate(&target.pair, target.pixel_px).unwrap()
}

fn run(
    world: &mut World,
    trajectory: JointTrajectory,
    guard: Guard,
) -> Result<ExecuteResult, Fault> {
    world.start(trajectory, guard)?;
    for _ in 0..10_000 {
        if let Advance::Ended(outcome) = world.advance(1) {
            return outcome;
        }
    }
    panic!("the motion does not end");
}

/// Brings the arm to `above_m` over the target, along its normal.
fn go_above(world: &mut World, above_m: f64) -> SurfacePoint {
    let surface = surface(world);
    let robot = world.robot().clone();
    let down = straight(&robot, &surface, [above_m, above_m - 0.001], 0.01);
    let path = [world.state().joints_rad, down.points[0].q_rad.clone()];
    run(
        world,
        through(&robot.arm, &path, 1.0).unwrap(),
        Guard::default(),
    )
    .unwrap();
    surface
}

fn approach(world: &mut World, speed_m_s: f64, guard: Guard) -> Result<ExecuteResult, Fault> {
    let surface = go_above(world, 0.03);
    let robot = world.robot().clone();
    run(
        world,
        straight(&robot, &surface, [0.03, -0.02], speed_m_s),
        guard,
    )
}

fn target(surface: &SurfacePoint) -> Target {
    Target {
        pair: PAIR.into(),
        pixel_px: scene().target.unwrap().pixel_px,
        right_pixel_px: [300.0, 236.0],
        position_m: Point::from(surface.point_m),
        normal: Direction::from(surface.normal),
        covariance_m2: [[0.0; 3]; 3],
        plane_rms_mm: 0.1,
        roughness_mm: 0.1,
        points_n: 100,
        sim_time_s: 0.0,
    }
}

#[test]
fn an_exact_robot_places_exactly_and_stops_in_the_step_of_contact() {
    let mut world = world(&scene(), 1);
    let result = approach(&mut world, 0.005, Guard::default()).unwrap();
    let surface = surface(&mut world);
    assert!(!result.completed);
    assert_eq!(result.state.stop_reason, Some(StopReason::Contact));
    assert_eq!(result.state.motion, Motion::Idle);
    assert!(result.state.contact);
    // Closes at 2 mm and goes on for a few steps of braking at 5 mm/s.
    let travel_m = result.state.switch_travel_m;
    assert!((0.0019..0.00215).contains(&travel_m), "{travel_m} m");
    assert!(
        (2.9..3.6).contains(&result.peak_force_n),
        "{} N",
        result.peak_force_n
    );
    let at_contact = result.joints_at_contact_rad.unwrap();
    for (a, b) in at_contact.iter().zip(&result.state.joints_rad) {
        assert!((a - b).abs() < 5e-4, "{a} {b}");
    }
    let open_loop = straight(world.robot(), &surface, [0.0, -0.001], 0.005).points[0]
        .q_rad
        .clone();
    let request = ScoreRequest {
        target: target(&surface),
        handed_over: None,
        open_loop_joints_rad: Some(open_loop),
    };
    let score = world.score(&request).unwrap();
    let lateral_mm = score.lateral_error_mm.unwrap();
    // A facet that is not square to the mean normal moves the ball's touch by a few tenths.
    assert!(lateral_mm < 0.4, "{lateral_mm} mm");
    assert!(
        score.range_error_mm.unwrap().abs() < 0.3,
        "{:?}",
        score.range_error_mm
    );
    assert!(
        score.axis_error_deg.unwrap() < 0.05,
        "{:?}",
        score.axis_error_deg
    );
    assert!(score.open_loop_lateral_error_mm.unwrap() < 1e-3);
    assert!(score.target_error_mm < 1e-6);
    assert!(world.collision().is_none(), "{:?}", world.collision());

    // Back out: the switch is closed at the start, so it does not stop the motion.
    let robot = world.robot().clone();
    let back: Vec<Vec<f64>> = vec![
        world.state().joints_rad,
        straight(&robot, &surface, [0.03, 0.02], 0.01).points[0]
            .q_rad
            .clone(),
    ];
    let result = run(
        &mut world,
        through(&robot.arm, &back, 0.2).unwrap(),
        Guard::default(),
    )
    .unwrap();
    assert!(result.completed);
    assert!(!result.state.contact);
    assert!(result.state.tip_force_n == 0.0 && result.state.switch_travel_m < 1e-6);
    // The placement is remembered.
    assert_eq!(
        world.score(&request).unwrap().lateral_error_mm,
        score.lateral_error_mm
    );
}

#[test]
fn the_instrument_touches_the_very_surface_that_is_drawn() {
    let mut world = world(&scene(), 1);
    approach(&mut world, 0.005, Guard::default()).unwrap();
    let touch = world.contact.unwrap();
    let eyes = world.eyes();
    let eyes = eyes.lock().unwrap();
    let away = touch.point_m - touch.axis.into_inner() * 0.2;
    let hit = eyes.cast(&away, &touch.axis).unwrap();
    // Along the axis; the touch itself is known to one step of the motion, 10 um.
    assert!(
        (hit - touch.point_m).norm() < 4e-5,
        "{}",
        (hit - touch.point_m).norm()
    );
}

#[test]
fn a_perturbed_robot_misses_by_its_model_error() {
    let mut description = scene();
    description.truth.angle_deg = 0.3;
    description.truth.length_mm = 0.8;
    description.truth.droop = true;
    let mut world = world(&description, 3);
    let result = approach(&mut world, 0.005, Guard::default()).unwrap();
    assert!(result.state.contact);
    let surface = surface(&mut world);
    let open_loop = straight(world.robot(), &surface, [0.0, -0.001], 0.005).points[0]
        .q_rad
        .clone();
    let request = ScoreRequest {
        target: target(&surface),
        handed_over: None,
        open_loop_joints_rad: Some(open_loop),
    };
    let score = world.score(&request).unwrap();
    // This placement was a kinematic one on the true target.
    let (found, predicted) = (
        score.lateral_error_mm.unwrap(),
        score.open_loop_lateral_error_mm.unwrap(),
    );
    assert!(found > 0.3, "{found} mm");
    assert!(
        (found - predicted).abs() < 0.2 * predicted + 0.5,
        "{found} mm, {predicted} mm"
    );
    assert!((0.3..80.0).contains(&score.arm_model_error_mm));
    assert!(score.target_error_mm > 0.05);
}

#[test]
fn a_stop_ends_the_motion_within_its_ramp_and_names_the_reason() {
    for (reason, name) in [
        (StopReason::StopCommand, "stopped"),
        (StopReason::Cancelled, "cancelled"),
        (
            StopReason::CommanderLost {
                commander: "servo".into(),
            },
            "commander_lost",
        ),
    ] {
        let mut world = world(&scene(), 1);
        let robot = world.robot().clone();
        let path = [
            world.state().joints_rad,
            robot.posture("stow").unwrap().to_vec(),
        ];
        world
            .start(through(&robot.arm, &path, 1.0).unwrap(), Guard::default())
            .unwrap();
        for _ in 0..60 {
            assert_eq!(world.advance(1), Advance::Moving);
        }
        let fastest = |w: &World| {
            w.state()
                .rates_rad_s
                .iter()
                .fold(0.0, |m: f64, r| m.max(r.abs()))
        };
        assert!(fastest(&world) > 0.1);
        world.stop(reason);
        let fault = loop {
            match world.advance(1) {
                Advance::Moving => {}
                Advance::Ended(outcome) => break outcome.unwrap_err(),
                other => panic!("no arm motion: {other:?}"),
            }
        };
        assert_eq!(fault.name, name);
        let still_ms = fault.details["still_after_ms"];
        assert!(still_ms < 61.0, "{still_ms} ms");
        assert!(fault.details["rest_after_ms"] <= 1000.0);
        assert_eq!(fastest(&world), 0.0);
    }
}

#[test]
fn what_cannot_be_executed_is_refused_by_name() {
    let mut world = world(&scene(), 1);
    let robot = world.robot().clone();
    let [here, stow] = [
        world.state().joints_rad,
        robot.posture("stow").unwrap().to_vec(),
    ];
    let there_and_back = [stow.clone(), here.clone()];
    let elsewhere = through(&robot.arm, &there_and_back, 1.0).unwrap();
    let fault = world.start(elsewhere, Guard::default()).unwrap_err();
    assert_eq!(fault.name, "start_mismatch");
    assert!(fault.message.contains("joint 0"), "{}", fault.message);
    let fine = through(&robot.arm, &[here, stow], 1.0).unwrap();
    let mut hasty = fine.clone();
    hasty.points.last_mut().unwrap().t_s = hasty.points[hasty.points.len() - 2].t_s + 1e-6;
    assert_eq!(
        world.start(hasty, Guard::default()).unwrap_err().name,
        "trajectory_invalid"
    );
    let mut running = fine.clone();
    running.points.truncate(running.points.len() / 2);
    assert_eq!(
        world.start(running, Guard::default()).unwrap_err().name,
        "trajectory_invalid"
    );
    world.start(fine.clone(), Guard::default()).unwrap();
    assert_eq!(
        world.start(fine, Guard::default()).unwrap_err().name,
        "busy"
    );
}

#[test]
fn a_dead_switch_leaves_the_stop_to_the_force_guard() {
    let mut description = scene();
    description.faults.switch_dead = true;
    let mut world = world(&description, 1);
    let guard = Guard {
        max_force_n: Some(8.0),
        max_deviation_rad: None,
    };
    let result = approach(&mut world, 0.005, guard).unwrap();
    assert!(!result.completed && !result.state.contact);
    assert!(result.joints_at_contact_rad.is_none());
    let Some(StopReason::Force { found_n, limit_n }) = result.state.stop_reason else {
        panic!("{:?}", result.state.stop_reason);
    };
    assert!(found_n > limit_n && found_n < 14.0, "{found_n} N");
}

#[test]
fn a_rock_that_vanishes_is_neither_felt_nor_seen() {
    let mut description = scene();
    let still = world(&description, 1);
    let before = still.grab(PAIR, 0).unwrap();
    description.faults.rock_vanishes = Some(VanishingRock {
        rock_n: 0,
        when: FaultMoment::FirstArmMotion,
    });
    let mut world = world(&description, 1);
    assert_eq!(world.grab(PAIR, 0).unwrap(), before);
    let result = approach(&mut world, 0.02, Guard::default()).unwrap();
    assert!(result.completed && !result.state.contact && result.peak_force_n == 0.0);
    let surface = surface(&mut world);
    let score = world.score(&ScoreRequest {
        target: target(&surface),
        handed_over: None,
        open_loop_joints_rad: None,
    });
    let score = score.unwrap();
    assert!(score.lateral_error_mm.is_none() && score.contact_in_world_m.is_none());
    let after = world.grab(PAIR, 0).unwrap();
    let changed = after
        .left
        .pixels
        .iter()
        .zip(&before.left.pixels)
        .filter(|(a, b)| a.abs_diff(**b) > 20);
    assert!(changed.count() > 5000);
    assert_eq!(
        world
            .inject(&InjectedFault::RockVanishes(99))
            .unwrap_err()
            .name,
        "unknown_rock"
    );
}

#[test]
fn the_fiducial_is_hidden_near_the_target_only() {
    let mut description = scene();
    description.occlusion = Some(OcclusionDescription {
        fiducial_hidden_within_m: 0.05,
    });
    let mut world = world(&description, 1);
    assert!(world.moment().frame.pattern_visible);
    go_above(&mut world, 0.06);
    assert!(world.moment().frame.pattern_visible);
    go_above(&mut world, 0.045);
    assert!(!world.moment().frame.pattern_visible);
    world.inject(&InjectedFault::FiducialHidden(true)).unwrap();
    go_above(&mut world, 0.08);
    assert!(!world.moment().frame.pattern_visible);
    world.inject(&InjectedFault::FiducialHidden(false)).unwrap();
    assert!(world.moment().frame.pattern_visible);
}

/// Bits of everything that a whole approach shows.
fn digest(description: &SimulationDescription, seed: u64) -> u64 {
    let mut hash = 0xcbf2_9ce4_8422_2325_u64;
    let mut eat = |bytes: &[u8]| {
        for b in bytes {
            hash = (hash ^ u64::from(*b)).wrapping_mul(0x0100_0000_01b3);
        }
    };
    let mut world = world(description, seed);
    let surface = surface(&mut world);
    let robot = world.robot().clone();
    let down = straight(&robot, &surface, [0.03, -0.02], 0.02);
    let path = [world.state().joints_rad, down.points[0].q_rad.clone()];
    for trajectory in [through(&robot.arm, &path, 1.0).unwrap(), down] {
        world.start(trajectory, Guard::default()).unwrap();
        while world.advance(1) == Advance::Moving {
            let state = world.state();
            let truth = world.truth_state();
            for x in state
                .joints_rad
                .iter()
                .chain(&state.rates_rad_s)
                .chain(&truth.joints_rad)
            {
                eat(&x.to_bits().to_le_bytes());
            }
            eat(&state.tip_force_n.to_bits().to_le_bytes());
        }
        let pair = world.grab(PAIR, 1).unwrap();
        eat(&pair.left.pixels);
        eat(&pair.right.pixels);
    }
    hash
}

#[test]
fn the_same_seed_gives_the_same_bits_on_any_number_of_threads() {
    let mut description = scene();
    description.truth.angle_deg = 0.5;
    description.truth.length_mm = 1.0;
    description.truth.droop = true;
    description.truth.encoder_noise_rad = 2e-5;
    description.truth.backlash_rad = 1e-4;
    let pool = |n| {
        rayon::ThreadPoolBuilder::new()
            .num_threads(n)
            .build()
            .unwrap()
    };
    let one = pool(1).install(|| digest(&description, 5));
    let three = pool(3).install(|| digest(&description, 5));
    assert_eq!(one, three);
    assert_ne!(one, digest(&description, 6));
}

#[test]
fn a_reset_world_is_the_world_at_its_start() {
    let mut description = scene();
    description.truth.encoder_noise_rad = 1e-5;
    let mut world = world(&description, 2);
    let (state, pair) = (world.state(), world.grab(PAIR, 0).unwrap());
    go_above(&mut world, 0.05);
    assert_ne!(world.state(), state);
    world.reset().unwrap();
    assert_eq!((world.state(), world.grab(PAIR, 0).unwrap()), (state, pair));
}

#[test]
fn exposures_differ_in_noise_alone_and_an_outside_view_shows_the_scene() {
    let world = world(&scene(), 1);
    let (a, b) = (world.grab(PAIR, 0).unwrap(), world.grab(PAIR, 1).unwrap());
    assert_eq!(world.grab(PAIR, 0).unwrap(), a);
    assert_ne!(a.left, b.left);
    let worst = a
        .left
        .pixels
        .iter()
        .zip(&b.left.pixels)
        .map(|(x, y)| x.abs_diff(*y))
        .max();
    assert!(worst.unwrap() < 25, "{worst:?}");
    assert_eq!(world.grab("mast", 0).unwrap_err().name, "unknown_pair");
    let mut request = ViewRequest {
        eye_m: [1.2, -0.9, 0.9],
        look_at_m: [0.5, 0.0, 0.4],
        width_px: 320,
        height_px: 240,
        field_of_view_deg: 50.0,
    };
    let view = world.view(&request).unwrap();
    assert_eq!(view.image.pixels.len(), 320 * 240);
    let (low, high) = view
        .image
        .pixels
        .iter()
        .fold((255, 0), |(l, h), &p| (l.min(p), h.max(p)));
    assert!(high - low > 60);
    request.look_at_m = request.eye_m;
    assert_eq!(world.view(&request).unwrap_err().name, "bad_view");
}

#[test]
fn a_wrong_description_names_field_value_and_expectation() {
    let robot = robot();
    let start = robot.posture("ready").unwrap().to_vec();
    let refused = |change: &dyn Fn(&mut SimulationDescription)| {
        let mut d = scene();
        change(&mut d);
        match World::new(robot.clone(), &d, 1, &start) {
            Err(SimulationError::Field { field, .. }) => field,
            Err(e) => e.to_string(),
            Ok(_) => "accepted".into(),
        }
    };
    assert_eq!(refused(&|d| d.step_s = 0.003), "step_s");
    assert_eq!(
        refused(&|d| d.truth.angle_deg = f64::NAN),
        "truth.angle_deg"
    );
    assert_eq!(
        refused(&|d| d.terrain.rocks[0].radius_m = -1.0),
        "terrain.rocks[0].radius_m"
    );
    assert_eq!(
        refused(&|d| d.faults.rock_vanishes = Some(VanishingRock {
            rock_n: 4,
            when: FaultMoment::AtTimeS(1.0)
        })),
        "faults.rock_vanishes.rock_n"
    );
    assert_eq!(
        refused(&|d| d.target = Some(TargetPixel {
            pair: PAIR.into(),
            pixel_px: [640.0, 3.0]
        })),
        "target.pixel_px"
    );
    assert_eq!(
        refused(&|d| {
            d.target = None;
            d.occlusion = Some(OcclusionDescription {
                fiducial_hidden_within_m: 0.1,
            });
        }),
        "target"
    );
    let unknown =
        toml::from_str::<SimulationDescription>("[truth]\nangle_rad = 1.0\n").unwrap_err();
    assert!(unknown.to_string().contains("angle_rad"));
    let text = toml::to_string(&scene()).unwrap();
    assert_eq!(
        toml::from_str::<SimulationDescription>(&text).unwrap(),
        scene()
    );
    let far = World::new(robot.clone(), &scene(), 1, &[9.0; 5]);
    assert!(matches!(far, Err(SimulationError::Field { .. })));
}
