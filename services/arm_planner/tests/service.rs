//! The planner on a real network, with a faked arm and faked frames of a textured plane.

#![allow(clippy::unwrap_used, clippy::expect_used, missing_docs)]

#[path = "../../mast_imaging/tests/support/mod.rs"]
mod support;

use rover_arm_planner::serve;
use rover_bus::{BusError, Role};
use rover_geometry::{Direction, Point};
use rover_messages::{
    keys::{self, service::ARM_PLANNER},
    planning::{Plan, PlanGoal, PlanRequest, SurveyReport, SurveyRequest, ToolPose},
    status::{FaultReport, ServiceStatus},
};
use support::{FakeHardware, GROUND_M, LONG, arm_at, bluestreak, peer};

fn ask_for(goal: PlanGoal) -> PlanRequest {
    PlanRequest {
        start_rad: None,
        goal,
        speed_fraction: 1.0,
        max_tip_speed_m_s: None,
        contact_radius_m: 0.0,
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn plans_start_where_the_arm_is_and_heed_what_was_surveyed() {
    let robot = bluestreak();
    let hardware = FakeHardware::start(&robot, "stow", true, |_, pair| Ok(pair)).await;
    let planner = peer(&robot, ARM_PLANNER, Role::Service, &[&hardware.peer]).await;
    let _service = serve(&planner, robot.clone()).await.unwrap();
    let client = peer(&robot, "client", Role::Client, &[&planner]).await;
    client.await_presence(&[ARM_PLANNER], LONG).await.unwrap();
    let plan = async |goal| -> Result<Plan, BusError> {
        client.ask(keys::PLANNER_PLAN, &ask_for(goal), LONG).await
    };
    let survey = async |pair: &str| -> Result<SurveyReport, BusError> {
        client
            .ask(
                keys::PLANNER_SURVEY,
                &SurveyRequest { pair: pair.into() },
                LONG,
            )
            .await
    };

    let ready = plan(PlanGoal::Posture("ready".into())).await.unwrap();
    assert_eq!(
        ready.trajectory.points[0].q_rad,
        robot.posture("stow").unwrap()
    );
    assert_eq!(ready.end_rad, robot.posture("ready").unwrap());

    // Below the plane: free as long as nobody has looked.
    let down = Direction::new(-nalgebra::Vector3::z()).unwrap();
    let buried = PlanGoal::Tool {
        pose: ToolPose {
            tip_m: Point::new(0.5, -0.05, GROUND_M - 0.04),
            axis: down,
        },
        visible_to: None,
    };
    plan(buried.clone()).await.unwrap();
    let report = survey("body").await.unwrap();
    assert!(report.cells_n > 500 && report.points_n > 500, "{report:?}");
    let error = plan(buried).await.unwrap_err();
    assert_eq!(
        error.fault_name(),
        Some("no_collision_free_path"),
        "{error}"
    );
    assert!(error.to_string().contains("terrain"), "{error}");
    let above = PlanGoal::Tool {
        pose: ToolPose {
            tip_m: Point::new(0.5, -0.05, GROUND_M + 0.06),
            axis: down,
        },
        visible_to: Some("body".into()),
    };
    let reached = plan(above).await.unwrap();
    assert!(reached.clearance_m.unwrap() > 0.01);

    let error = survey("periscope").await.unwrap_err();
    assert_eq!(error.fault_name(), Some("unknown_name"), "{error}");

    // The arm has moved on.
    hardware
        .arm
        .publish(arm_at(robot.posture("ready").unwrap()))
        .unwrap();
    let stow = plan(PlanGoal::Posture("stow".into())).await.unwrap();
    assert_eq!(
        stow.trajectory.points[0].q_rad,
        robot.posture("ready").unwrap()
    );

    let status: ServiceStatus = client
        .latest(&keys::status(ARM_PLANNER), LONG)
        .await
        .unwrap();
    assert_eq!(status.state, "ready");
    assert_eq!(
        (
            status.counters["plans"],
            status.counters["surveys"],
            status.counters["faults"]
        ),
        (4, 1, 2)
    );
    let fault: FaultReport = client
        .latest(&keys::fault(ARM_PLANNER), LONG)
        .await
        .unwrap();
    assert_eq!(fault.fault.name, "unknown_name");
}
