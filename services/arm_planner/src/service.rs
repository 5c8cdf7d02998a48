//! The planner on the network: `planner/plan` and `planner/survey`.

use crate::{Planner, SERVICE};
use rover_bus::{BusError, Peer};
use rover_messages::{
    Fault,
    arm::ArmState,
    imaging::StereoFrame,
    keys,
    planning::{Plan, PlanRequest, SurveyReport, SurveyRequest},
    status::work,
};
use rover_robot::{CameraPairDescription, Robot};
use rover_service::{Service, ServiceShell, frames};
use rover_vision::{MatchRules, sparse_points};
use std::{
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

/// Wall-clock limit for the arm's state.
const STATE_LIMIT: Duration = Duration::from_secs(30);
/// Spacing of the pixels that a survey matches: one to two map cells at the ranges of an arm.
const SURVEY_STEP_PX: u32 = 10;

/// Starts the service on `peer`; it lives as long as the returned value.
///
/// # Errors
/// [`BusError`] when a key cannot be declared or the name is taken.
pub async fn serve(peer: &Peer, robot: Arc<Robot>) -> Result<Service, BusError> {
    let shell = ServiceShell::new(peer, &robot, SERVICE).await?;
    let desk = Desk {
        peer: peer.clone(),
        shell: shell.clone(),
        planner: Arc::new(Mutex::new(Planner::new(robot.clone()))),
        robot,
    };
    let planning = desk.clone();
    let plan = peer
        .serve(keys::PLANNER_PLAN, move |request: PlanRequest| {
            let desk = planning.clone();
            async move { desk.plan(request).await }
        })
        .await?;
    let survey = peer
        .serve(keys::PLANNER_SURVEY, move |request: SurveyRequest| {
            let desk = desk.clone();
            async move { desk.survey(request).await }
        })
        .await?;
    shell.start(vec![plan, survey]).await
}

#[derive(Clone)]
struct Desk {
    peer: Peer,
    shell: ServiceShell,
    robot: Arc<Robot>,
    planner: Arc<Mutex<Planner>>,
}

impl Desk {
    async fn plan(&self, request: PlanRequest) -> Result<Plan, Fault> {
        let _activity = self.shell.activity("planning");
        self.shell.answered(self.planned(request).await, "plans")
    }

    async fn planned(&self, request: PlanRequest) -> Result<Plan, Fault> {
        let joints = match &request.start_rad {
            Some(start) => start.clone(),
            None => self.joints().await?,
        };
        let planner = self.planner();
        let shell = self.shell.clone();
        aside(move || shell.timed(work::PLANNING, || planner.plan(&request, &joints))).await
    }

    async fn survey(&self, request: SurveyRequest) -> Result<SurveyReport, Fault> {
        let _activity = self.shell.activity("surveying");
        self.shell.answered(self.surveyed(request).await, "surveys")
    }

    async fn surveyed(&self, request: SurveyRequest) -> Result<SurveyReport, Fault> {
        let pair = self
            .robot
            .pair(&request.pair)
            .map_err(|e| Fault::new(SERVICE, "unknown_name", e.to_string()))?
            .clone();
        let joints = self.joints().await?;
        let frame = frames::capture(&self.peer, SERVICE, &pair.name).await?;
        let (planner, shell) = (self.planner(), self.shell.clone());
        let planner =
            aside(move || shell.timed(work::VISION, || mapped(planner, &frame, &pair, &joints)))
                .await?;
        let report = planner.terrain().map(|map| SurveyReport {
            points_n: map.points_n() as u32,
            cells_n: map.cells_n() as u32,
            cell_m: map.cell_m(),
        });
        *self.planner.lock().unwrap_or_else(PoisonError::into_inner) = planner;
        report.ok_or_else(|| Fault::new(SERVICE, "no_map", "the survey left no map"))
    }

    fn planner(&self) -> Planner {
        self.planner
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone()
    }

    async fn joints(&self) -> Result<Vec<f64>, Fault> {
        let state: ArmState = self
            .peer
            .latest(keys::ARM_STATE, STATE_LIMIT)
            .await
            .map_err(|e| e.into_fault(SERVICE))?;
        Ok(state.joints_rad)
    }
}

/// The planner with a map of what `frame` shows, taken with the arm at `joints` (rad).
fn mapped(
    planner: Planner,
    frame: &StereoFrame,
    pair: &CameraPairDescription,
    joints: &[f64],
) -> Result<Planner, Fault> {
    let (left, right) = frames::prepared(SERVICE, frame)?;
    let rules = MatchRules {
        range_min_m: pair.range_min_m,
        range_max_m: pair.range_max_m,
        // Ground and what faces the cameras; a map of centimetres needs no other slants.
        slant_normals: vec![[0.0, 0.0, 1.0]],
        ..Default::default()
    };
    let found = sparse_points(&left, &right, &frame.cameras, SURVEY_STEP_PX, &rules)
        .map_err(|e| Fault::new(SERVICE, "bad_frame", e.to_string()))?;
    let points: Vec<_> = found.into_iter().map(|(_, point)| point).collect();
    let map = planner.map_of(&points, joints)?;
    Ok(planner.with_terrain(map))
}

/// Runs long computing beside the tasks of the network.
async fn aside<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, Fault> + Send + 'static,
) -> Result<T, Fault> {
    tokio::task::spawn_blocking(work)
        .await
        .unwrap_or_else(|e| Err(Fault::new(SERVICE, "internal", e.to_string())))
}
