//! The mission against scripted services on a real network: the order of what is asked, what a
//! refusal or a loss makes of the run, and what is in the report. The services here answer what
//! the test tells them and share nothing with the real ones but the keys.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use rover::{
    embedded,
    placement::{Abort, Mission, RUNNER, Unobserved},
    report::{Outcome, RunReport},
    scenario::LoadedScenario,
};
use rover_bus::{
    ActionPolicy, GoalContext, Interrupt, NetworkConfig, Peer, Presence, Role, Served, Stream,
};
use rover_compensation::Compensation;
use rover_geometry::{Direction, Point};
use rover_messages::{
    Fault, Nothing,
    arm::{ArmState, Motion},
    keys::{self, service},
    placement::{
        ContactFeedback, ContactGoal, ContactResult, Look, PlaceFeedback, PlaceGoal, PlaceResult,
    },
    planning::{SurveyReport, SurveyRequest},
    simulation::{Score, ScoreRequest},
    target::{SelectRequest, Target},
};
use std::sync::{
    Arc, Mutex,
    atomic::{AtomicU32, Ordering},
};

/// What the scripted services do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Script {
    Normal,
    RefuseTarget,
    ServoFails,
    ServoHangs,
    NoContact,
}

struct World {
    time_s: Mutex<f64>,
    states: Stream<ArmState>,
    stops: AtomicU32,
    asked: Mutex<Vec<&'static str>>,
}

impl World {
    fn note(&self, what: &'static str) {
        self.asked.lock().unwrap().push(what);
    }

    /// Moves time on and publishes the arm's state.
    fn pass(&self, seconds: f64) {
        let mut time_s = self.time_s.lock().unwrap();
        *time_s += seconds;
        self.states
            .publish(ArmState {
                sim_time_s: *time_s,
                step: 0,
                joints_rad: vec![0.125, -0.969, 1.316, -1.918, -1.5708],
                rates_rad_s: vec![0.0; 5],
                contact: false,
                switch_travel_m: 0.0,
                tip_force_n: 0.0,
                motion: Motion::Idle,
                stop_reason: None,
            })
            .unwrap();
    }
}

struct Network {
    world: Arc<World>,
    runner: Peer,
    _presence: Presence,
    _served: Vec<Served>,
    _peers: Vec<Peer>,
}

fn target() -> Target {
    Target {
        pair: "body".into(),
        pixel_px: [340.0, 236.0],
        right_pixel_px: [270.0, 236.0],
        position_m: Point::new(0.503, 0.039, 0.385),
        normal: Direction::new([-0.259, 0.141, 0.956].into()).unwrap(),
        covariance_m2: [[1e-8, 0.0, 0.0], [0.0, 1e-8, 0.0], [0.0, 0.0, 4e-8]],
        plane_rms_mm: 0.2,
        roughness_mm: 1.0,
        points_n: 200,
        sim_time_s: 0.0,
    }
}

fn look(station_m: f64, found: bool) -> Look {
    Look {
        sim_time_s: 1.0,
        step: 500,
        station_m,
        found,
        reason: (!found).then(|| "hidden".into()),
        error_vector_m: found.then_some([0.001, -0.002, 0.003]),
        rotation_error_rad: None,
        left_px: None,
        right_px: None,
        rms_px: None,
        predicted_error_m: 0.0005,
    }
}

async fn network(name: &str, script: Script) -> Network {
    let namespace = format!("mission-{name}-{}", std::process::id());
    let open = |name: &'static str, role, connect: Vec<String>| {
        Peer::open(NetworkConfig::new(&namespace, name, role, &connect))
    };
    let hardware = open(service::HARDWARE, Role::Simulator, vec![])
        .await
        .unwrap();
    let mut endpoints = hardware.locators().await;
    let others = open("others", Role::Service, endpoints.clone())
        .await
        .unwrap();
    endpoints.extend(others.locators().await);
    let runner = open(RUNNER, Role::Runner, endpoints).await.unwrap();

    let world = Arc::new(World {
        time_s: Mutex::new(0.0),
        states: hardware.stream(keys::ARM_STATE).await.unwrap(),
        stops: AtomicU32::new(0),
        asked: Mutex::default(),
    });
    world.pass(0.0);
    let presence = hardware.announce().await.unwrap();
    let mut served = Vec::new();
    let w = world.clone();
    let stop = hardware.serve(keys::ARM_STOP, move |_: Nothing| {
        let w = w.clone();
        async move {
            w.stops.fetch_add(1, Ordering::SeqCst);
            Err::<ArmState, _>(Fault::new("rover_sim", "at_rest", "the arm is at rest"))
        }
    });
    served.push(stop.await.unwrap());
    let w = world.clone();
    let score = hardware.serve(keys::SIM_TRUTH_SCORE, move |request: ScoreRequest| {
        w.note("score");
        async move {
            assert_eq!(request.target, target());
            let open_loop = request
                .open_loop_joints_rad
                .expect("the target is in reach");
            assert_eq!(open_loop.len(), 5);
            Ok(Score {
                target_in_world_m: [0.57, 0.0, 0.39],
                normal_in_world: [0.0, 0.0, 1.0],
                contact_in_world_m: Some([0.57, 0.0, 0.39]),
                lateral_error_mm: Some(0.4),
                range_error_mm: Some(0.1),
                axis_error_deg: Some(0.5),
                open_loop_lateral_error_mm: Some(15.0),
                arm_model_error_mm: 16.0,
                target_error_mm: 0.2,
            })
        }
    });
    served.push(score.await.unwrap());
    let w = world.clone();
    let select = others.serve(keys::TARGET_SELECT, move |request: SelectRequest| {
        w.note("select");
        async move {
            assert_eq!(
                (request.pair.as_str(), request.pixel_px),
                ("body", [340.0, 236.0])
            );
            if script == Script::RefuseTarget {
                return Err(Fault::new(
                    "target_selection",
                    "no_texture",
                    "nothing to match",
                ));
            }
            Ok(target())
        }
    });
    served.push(select.await.unwrap());
    let w = world.clone();
    let survey = others.serve(keys::PLANNER_SURVEY, move |_: SurveyRequest| {
        w.note("survey");
        async move {
            Ok(SurveyReport {
                points_n: 9,
                cells_n: 9,
                cell_m: 0.01,
            })
        }
    });
    served.push(survey.await.unwrap());
    let w = world.clone();
    let place = others.serve_action(
        keys::SERVO_PLACE,
        ActionPolicy::free(),
        move |context: GoalContext<PlaceFeedback>, goal: PlaceGoal| {
            w.note("place");
            let w = w.clone();
            async move {
                let fail = |name: &str| Err(Fault::new("epec_servo", name, "as told"));
                let feedback = PlaceFeedback {
                    activity: "moving".into(),
                    distance_m: 0.1,
                    look: None,
                };
                context.feedback(feedback);
                w.pass(10.0);
                match script {
                    Script::ServoFails => return fail("predicted_error_too_large"),
                    Script::ServoHangs => {
                        assert_eq!(context.until_interrupted().await, Interrupt::Cancelled);
                        return fail("cancelled");
                    }
                    _ => {}
                }
                Ok(PlaceResult {
                    looks: vec![look(0.16, true), look(0.03, false)],
                    converged: true,
                    standoff_m: *goal.stations_m.last().unwrap(),
                    predicted_error_m: 0.0005,
                    compensation: Compensation::constant([0.001, -0.002, 0.003]),
                })
            }
        },
    );
    served.push(place.await.unwrap());
    let w = world.clone();
    let contact = others.serve_action(
        keys::CONTACT_APPROACH,
        ActionPolicy::free(),
        move |_: GoalContext<ContactFeedback>, goal: ContactGoal| {
            w.note("contact");
            let w = w.clone();
            async move {
                assert_eq!(
                    goal.compensation,
                    Compensation::constant([0.001, -0.002, 0.003])
                );
                w.pass(6.0);
                if script == Script::NoContact {
                    let message = "no surface within 20 mm";
                    return Err(Fault::new("contact_approach", "no_contact", message));
                }
                Ok(ContactResult {
                    made: true,
                    switch_travel_m: 0.002,
                    peak_force_n: 3.0,
                    approach_m: 0.031,
                    joints_at_contact_rad: vec![0.0; 5],
                    sim_time_s: 16.0,
                    retracted: goal.retract,
                })
            }
        },
    );
    served.push(contact.await.unwrap());
    Network {
        world,
        runner,
        _presence: presence,
        _served: served,
        _peers: vec![hardware, others],
    }
}

async fn run(network: &Network, abort: Abort) -> RunReport {
    let loaded = LoadedScenario::load(embedded::DEFAULT_SCENARIO, &[], Some(3)).unwrap();
    let _presence = network.runner.announce().await.unwrap();
    let mut unobserved = Unobserved;
    let mission = Mission::new(
        &network.runner,
        &loaded.scenario,
        &loaded.robot,
        abort,
        &mut unobserved,
        false,
    );
    mission.run().await.0.sealed().unwrap()
}

fn asked(network: &Network) -> Vec<&'static str> {
    network.world.asked.lock().unwrap().clone()
}

fn phases(report: &RunReport) -> Vec<(&str, f64, &str)> {
    report
        .phases
        .iter()
        .map(|p| (p.name.as_str(), p.sim_s, p.outcome.as_str()))
        .collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_placement_asks_in_order_and_reports_everything() {
    let network = network("placed", Script::Normal).await;
    let report = run(&network, Abort::default()).await;
    assert_eq!(report.outcome, Outcome::Placed, "{:?}", report.reason);
    assert_eq!(
        asked(&network),
        ["select", "survey", "place", "contact", "score"]
    );
    assert_eq!(
        phases(&report),
        [
            ("designate", 0.0, "done"),
            ("survey", 0.0, "done"),
            ("servo", 10.0, "done"),
            ("contact", 6.0, "done"),
            ("score", 0.0, "done"),
        ]
    );
    assert_eq!(report.seed, 3);
    let servo = report.servo.unwrap();
    assert_eq!(servo.fiducial_found, [true, false]);
    assert_eq!(servo.error_vectors_mm, [Some([1.0, -2.0, 3.0]), None]);
    assert!(report.contact.unwrap().made);
    assert_eq!(report.truth.unwrap().lateral_error_mm, Some(0.4));
    assert_eq!(network.world.stops.load(Ordering::SeqCst), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_same_run_twice_has_the_same_digest() {
    let first = run(&network("digest-a", Script::Normal).await, Abort::default()).await;
    let second = run(&network("digest-b", Script::Normal).await, Abort::default()).await;
    assert_eq!(first.digest, second.digest);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_refused_target_ends_the_run_before_the_arm_moves() {
    let network = network("refused", Script::RefuseTarget).await;
    let report = run(&network, Abort::default()).await;
    assert_eq!(report.outcome, Outcome::Aborted);
    assert_eq!(
        report.reason.as_deref(),
        Some("no_texture: nothing to match")
    );
    assert_eq!(asked(&network), ["select"]);
    assert_eq!(phases(&report), [("designate", 0.0, "no_texture")]);
    assert!(report.target.is_none() && report.servo.is_none() && report.truth.is_none());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_failed_servo_stops_the_arm_and_is_still_scored() {
    let network = network("servo", Script::ServoFails).await;
    let report = run(&network, Abort::default()).await;
    assert_eq!(
        report.reason.as_deref(),
        Some("predicted_error_too_large: as told")
    );
    assert_eq!(asked(&network), ["select", "survey", "place", "score"]);
    assert_eq!(
        phases(&report)[2],
        ("servo", 10.0, "predicted_error_too_large")
    );
    assert!(report.servo.is_none() && report.contact.is_none());
    assert!(report.truth.is_some());
    assert_eq!(network.world.stops.load(Ordering::SeqCst), 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_missed_surface_is_an_aborted_run_that_says_so() {
    let network = network("missed", Script::NoContact).await;
    let report = run(&network, Abort::default()).await;
    assert_eq!(report.outcome, Outcome::Aborted);
    assert_eq!(
        report.reason.as_deref(),
        Some("no_contact: no surface within 20 mm")
    );
    assert!(report.servo.is_some() && report.contact.is_none());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_abort_cancels_what_runs_and_its_reason_is_the_runs() {
    let network = network("abort", Script::ServoHangs).await;
    let abort = Abort::default();
    let later = {
        let (abort, world) = (abort.clone(), network.world.clone());
        async move {
            while !world.asked.lock().unwrap().contains(&"place") {
                tokio::task::yield_now().await;
            }
            abort.now(Fault::new(
                RUNNER,
                "service_lost",
                "arm_planner has left the network",
            ));
            abort.now(Fault::new(RUNNER, "interrupted", "comes too late"));
        }
    };
    let (report, ()) = tokio::join!(run(&network, abort), later);
    assert_eq!(
        report.reason.as_deref(),
        Some("service_lost: arm_planner has left the network")
    );
    assert_eq!(phases(&report)[2].2, "service_lost");
    assert_eq!(network.world.stops.load(Ordering::SeqCst), 1);
}
