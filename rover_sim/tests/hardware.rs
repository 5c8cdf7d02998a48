//! The simulator on the bus.
//!
//! Guarantees: time passes in granted heartbeats only; a commander that leaves or falls silent has
//! the arm at rest within 100 ms of simulated time, in the same control step every time; a service
//! cannot read or command anything under `sim/`; every key answers.
#![allow(clippy::unwrap_used, clippy::expect_used, missing_docs)]

use rover_bus::{BusError, NetworkConfig, Peer, Presence, Role};
use rover_kinematics::{JointTrajectory, through};
use rover_messages::{
    Nothing,
    arm::{ArmState, ExecuteFeedback, ExecuteGoal, ExecuteResult, Guard, Motion, StopReason},
    imaging::{CaptureRequest, RawPair},
    keys::{self, service::HARDWARE},
    simulation::{InjectedFault, StepRequest, TruthState, View, ViewRequest},
    status::{FaultReport, ServiceStatus},
};
use rover_robot::Robot;
use rover_sim::{
    Hardware, RockDescription, ScatteredRocks, SimulationDescription, TerrainDescription, World,
    hardware::{Options, serve},
};
use std::{sync::Arc, time::Duration};

const LIMIT: Duration = Duration::from_secs(30);
const NAMESPACE: &str = "testbed";

fn robot() -> Arc<Robot> {
    let text = include_str!("../../scenarios/robots/bluestreak.toml");
    Arc::new(Robot::parse(text, "bluestreak.toml").unwrap())
}

fn world() -> World {
    let robot = robot();
    let start = robot.posture("ready").unwrap().to_vec();
    let terrain = TerrainDescription {
        height_m: 0.25,
        cell_m: 0.05,
        rocks: vec![RockDescription {
            position_m: [0.54, 0.0, 0.27],
            subdivisions_n: 3,
            ..RockDescription::default()
        }],
        scattered: ScatteredRocks {
            count_n: 0,
            ..ScatteredRocks::default()
        },
        ..TerrainDescription::default()
    };
    let description = SimulationDescription {
        terrain,
        ..SimulationDescription::default()
    };
    World::new(robot, &description, 1, &start).unwrap()
}

struct System {
    hardware: Hardware,
    locators: Vec<String>,
    _peer: Peer,
}

async fn system(options: Options) -> System {
    let peer = Peer::open(NetworkConfig::new(
        NAMESPACE,
        HARDWARE,
        Role::Simulator,
        &[],
    ))
    .await
    .unwrap();
    let world = tokio::task::spawn_blocking(world).await.unwrap();
    let hardware = serve(&peer, world, options).await.unwrap();
    System {
        hardware,
        locators: peer.locators().await,
        _peer: peer,
    }
}

async fn join(system: &System, name: &str, role: Role) -> (Peer, Presence) {
    let peer = Peer::open(NetworkConfig::new(NAMESPACE, name, role, &system.locators))
        .await
        .unwrap();
    peer.await_presence(&[HARDWARE], LIMIT).await.unwrap();
    let presence = peer.announce().await.unwrap();
    (peer, presence)
}

async fn state(peer: &Peer) -> ArmState {
    peer.latest(keys::ARM_STATE, LIMIT).await.unwrap()
}

fn to_stow(state: &ArmState) -> JointTrajectory {
    let robot = robot();
    let path = [
        state.joints_rad.clone(),
        robot.posture("stow").unwrap().to_vec(),
    ];
    through(&robot.arm, &path, 1.0).unwrap()
}

async fn command(
    peer: &Peer,
    trajectory: JointTrajectory,
) -> rover_bus::Goal<ExecuteFeedback, ExecuteResult> {
    let goal = ExecuteGoal {
        trajectory,
        guard: Guard::default(),
    };
    peer.command(keys::ARM_EXECUTE, &goal).await.unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_motion_takes_the_time_that_its_heartbeats_grant() {
    let system = system(Options::default()).await;
    let (peer, _presence) = join(&system, "runner", Role::Runner).await;
    let before = state(&peer).await;
    assert_eq!((before.step, before.motion), (0, Motion::Idle));
    let trajectory = to_stow(&before);
    let duration_s = trajectory.duration_s();
    let mut goal = command(&peer, trajectory.clone()).await;
    for beat in 1..=5_u64 {
        let progress = goal.beat().await.unwrap();
        let feedback = progress.feedback.unwrap();
        assert_eq!(feedback.state.step, beat * 10);
        assert!((feedback.elapsed_s - beat as f64 * 0.02).abs() < 1e-9);
        assert_eq!(state(&peer).await, feedback.state);
    }
    let result = goal.finish(|_| ()).await.unwrap();
    assert!(result.completed);
    assert!(result.state.sim_time_s > duration_s && result.state.sim_time_s < duration_s + 1.0);
    for (q, end) in result
        .state
        .joints_rad
        .iter()
        .zip(&trajectory.points.last().unwrap().q_rad)
    {
        assert!((q - end).abs() < 1e-9);
    }
    let status: ServiceStatus = peer.latest(&keys::status(HARDWARE), LIMIT).await.unwrap();
    assert_eq!(status.counters["motions"], 1);
    assert_eq!(state(&peer).await.step, result.state.step);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_lost_commander_stops_the_arm_in_the_same_step_every_time() {
    let mut ends = Vec::new();
    for way in ["leaves", "falls silent"] {
        let limit = Duration::from_millis(if way == "leaves" { 20_000 } else { 3_000 });
        let system = system(Options {
            beat_limit: limit,
            ..Options::default()
        })
        .await;
        let (observer, _presence) = join(&system, "observer", Role::Runner).await;
        let (peer, presence) = join(&system, "commander", Role::Runner).await;
        let mut watcher = observer.watch::<ArmState>(keys::ARM_STATE).await.unwrap();
        let mut faults = observer
            .watch::<FaultReport>(&keys::fault(HARDWARE))
            .await
            .unwrap();
        let mut goal = command(&peer, to_stow(&state(&peer).await)).await;
        for _ in 0..40 {
            goal.beat().await.unwrap();
        }
        if way == "leaves" {
            drop(presence);
        }
        let last = loop {
            let seen = watcher.next().await.unwrap();
            if seen.step > 400 && seen.motion == Motion::Idle {
                break seen;
            }
        };
        let lost = StopReason::CommanderLost {
            commander: "commander".into(),
        };
        assert_eq!(last.stop_reason, Some(lost), "{way}");
        // Standstill of the motors within the ramp, then the arm's own settling.
        let granted_s = 0.8;
        assert!(
            last.sim_time_s - granted_s < 1.0,
            "{way}: {} s",
            last.sim_time_s
        );
        assert!(last.rates_rad_s.iter().all(|r| *r == 0.0));
        ends.push((last.step, last.joints_rad.clone()));
        let fault = faults.next().await.unwrap().fault;
        assert_eq!(fault.name, "commander_lost", "{way}");
        assert!(fault.details["still_after_ms"] < 61.0, "{fault:?}");
        assert!(fault.details.contains_key("since_last_beat_ms"));
    }
    assert_eq!(ends[0], ends[1]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_cancelled_goal_and_a_stop_command_end_as_named_faults() {
    let system = system(Options::default()).await;
    let (peer, _presence) = join(&system, "runner", Role::Runner).await;
    let mut goal = command(&peer, to_stow(&state(&peer).await)).await;
    for _ in 0..10 {
        goal.beat().await.unwrap();
    }
    goal.cancel().await.unwrap();
    let Err(BusError::Fault(fault)) = goal.finish(|_| ()).await else {
        panic!("no fault")
    };
    assert_eq!(fault.name, "cancelled");
    let rest = state(&peer).await;
    assert_eq!(
        (rest.motion, &rest.stop_reason),
        (Motion::Idle, &Some(StopReason::Cancelled))
    );

    let mut goal = command(&peer, to_stow(&rest)).await;
    for _ in 0..10 {
        goal.beat().await.unwrap();
    }
    let answer: ArmState = peer.ask(keys::ARM_STOP, &Nothing {}, LIMIT).await.unwrap();
    assert_eq!(answer.motion, Motion::Stopping);
    let Err(BusError::Fault(fault)) = goal.finish(|_| ()).await else {
        panic!("no fault")
    };
    assert_eq!(fault.name, "stopped");
    // A stop without a motion is fine.
    let answer: ArmState = peer.ask(keys::ARM_STOP, &Nothing {}, LIMIT).await.unwrap();
    assert_eq!(answer.motion, Motion::Idle);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_key_of_the_simulator_answers_the_runner_and_none_a_service() {
    let system = system(Options::default()).await;
    let (peer, _presence) = join(&system, "runner", Role::Runner).await;
    let pair: RawPair = peer
        .ask(
            &keys::camera_grab("body"),
            &CaptureRequest::default(),
            LIMIT,
        )
        .await
        .unwrap();
    assert_eq!(
        (pair.left.width_px, pair.left.height_px, pair.step),
        (640, 480, 0)
    );
    let again: RawPair = peer
        .ask(
            &keys::camera_grab("body"),
            &CaptureRequest::default(),
            LIMIT,
        )
        .await
        .unwrap();
    assert_eq!(again, pair);
    let truth: TruthState = peer
        .ask(keys::SIM_TRUTH_STATE, &Nothing {}, LIMIT)
        .await
        .unwrap();
    assert!(truth.rendering_wall_s > 0.0 && truth.collision.is_none());
    let request = ViewRequest {
        eye_m: [1.2, -0.9, 0.9],
        look_at_m: truth.tip_in_world_m,
        width_px: 160,
        height_px: 120,
        field_of_view_deg: 40.0,
    };
    let view: View = peer
        .ask(keys::SIM_TRUTH_VIEW, &request, LIMIT)
        .await
        .unwrap();
    assert_eq!(view.image.pixels.len(), 160 * 120);
    let stepped: ArmState = peer
        .ask(keys::SIM_STEP, &StepRequest { periods_n: 3 }, LIMIT)
        .await
        .unwrap();
    assert_eq!(stepped.step, 30);
    let _: Nothing = peer
        .ask(
            keys::SIM_FAULT_INJECT,
            &InjectedFault::RockVanishes(0),
            LIMIT,
        )
        .await
        .unwrap();
    let without: RawPair = peer
        .ask(
            &keys::camera_grab("body"),
            &CaptureRequest::default(),
            LIMIT,
        )
        .await
        .unwrap();
    assert_ne!(without.left, pair.left);
    let unknown = InjectedFault::RockVanishes(7);
    let refused = peer
        .ask::<_, Nothing>(keys::SIM_FAULT_INJECT, &unknown, LIMIT)
        .await;
    assert!(matches!(refused, Err(BusError::Fault(f)) if f.name == "unknown_rock"));
    let reset: ArmState = peer.ask(keys::SIM_RESET, &Nothing {}, LIMIT).await.unwrap();
    assert_eq!(reset.step, 0);
    system
        .hardware
        .with_world(|w| assert_eq!(w.grab("body", 0).unwrap().left, pair.left));

    let (service, _presence) = join(&system, "epec_servo", Role::Service).await;
    assert!(state(&service).await.step == 0);
    let short = Duration::from_millis(500);
    let denied = service
        .ask::<_, TruthState>(keys::SIM_TRUTH_STATE, &Nothing {}, short)
        .await;
    assert!(denied.is_err(), "{denied:?}");
    let denied = service.ask::<_, Nothing>(
        keys::SIM_FAULT_INJECT,
        &InjectedFault::SwitchDead(true),
        short,
    );
    assert!(denied.await.is_err());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn in_real_time_the_clock_runs_by_itself() {
    let system = system(Options {
        realtime: true,
        ..Options::default()
    })
    .await;
    let (peer, _presence) = join(&system, "runner", Role::Runner).await;
    let mut watcher = peer.watch::<ArmState>(keys::ARM_STATE).await.unwrap();
    let first = watcher.next().await.unwrap();
    let second = watcher.next().await.unwrap();
    assert!(second.step > first.step);
}
