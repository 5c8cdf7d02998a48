//! A service that dies in the middle of its work.

use crate::command::ROVER;
use rover::{
    launch::{LaunchOptions, Mode, System},
    placement::{Abort, Mission, Unobserved},
    report::Outcome,
    scenario::LoadedScenario,
};
use rover_messages::{
    arm::{ArmState, Motion},
    keys,
    status::ServiceStatus,
};
use std::{process::Command, time::Duration};

/// Guarantees the dead man: a killed commander stops the arm within 100 ms of simulated time, and
/// the run ends with a reason that names it.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn killing_the_servo_in_mid_motion_stops_the_arm_and_names_the_servo() {
    let loaded = LoadedScenario::load("scenarios/bluestreak.toml", &[], Some(3)).unwrap();
    let mode = Mode::Processes {
        program: ROVER.into(),
    };
    let options = LaunchOptions {
        mode,
        ..LaunchOptions::default()
    };
    let system = System::start(&loaded, &options).await.unwrap();
    let abort = Abort::default();
    let watching = system.watch_losses(abort.clone()).await.unwrap();
    let servo = system
        .processes()
        .into_iter()
        .find(|(name, _)| name == keys::service::EPEC_SERVO)
        .map(|(_, id)| id)
        .unwrap();

    let mut states = system
        .peer()
        .watch::<ArmState>(keys::ARM_STATE)
        .await
        .unwrap();
    let mut statuses = system
        .peer()
        .watch::<ServiceStatus>(&keys::status(keys::service::HARDWARE))
        .await
        .unwrap();
    let killer = tokio::spawn(async move {
        loop {
            let state = states.next().await.unwrap();
            let fast = state.rates_rad_s.iter().any(|r| r.abs() > 0.1);
            if state.motion == Motion::Moving && fast {
                break;
            }
        }
        let killed = Command::new("kill")
            .args(["-KILL", &servo.to_string()])
            .status()
            .unwrap();
        assert!(killed.success());
    });

    let mut nobody = Unobserved;
    let mission = Mission::new(
        system.peer(),
        &loaded.scenario,
        &loaded.robot,
        abort,
        &mut nobody,
        false,
    );
    let (report, _) = mission.run().await;
    killer.await.unwrap();
    watching.abort();

    assert_eq!(report.outcome, Outcome::Aborted);
    let reason = report.reason.unwrap();
    assert!(reason.contains(keys::service::EPEC_SERVO), "{reason}");

    let limit = Duration::from_secs(30);
    // The runner may see the loss before the driver does.
    let reported = async {
        loop {
            if let Some(fault) = statuses.next().await.unwrap().last_fault {
                break fault;
            }
        }
    };
    let fault = tokio::time::timeout(limit, reported)
        .await
        .expect("the driver reports the lost commander");
    // Whichever comes first: the driver's own dead man, or the runner that sees the loss as well.
    assert!(
        ["commander_lost", "stopped"].contains(&fault.name.as_str()),
        "{fault}"
    );
    let since_ms = fault.details["since_last_beat_ms"];
    println!("at rest {since_ms} ms of simulated time after the last heartbeat");
    assert!(since_ms <= 100.0, "{since_ms} ms");
    let state: ArmState = system.peer().latest(keys::ARM_STATE, limit).await.unwrap();
    assert_eq!(state.motion, Motion::Idle);
    assert!(
        state.rates_rad_s.iter().all(|r| r.abs() < 1e-3),
        "{state:?}"
    );
    system.stop().await;
}
