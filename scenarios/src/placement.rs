//! The mission: designate, survey, servo, contact, score, stow. It talks to the services through
//! their keys alone and would run unchanged against real hardware, but for the score.

mod abort;
mod command;
mod way;

pub use abort::Abort;

use crate::{
    evidence::Evidence,
    report::{
        ApproachReport, ContactReport, Outcome, Phase, RunReport, ServoReport, TargetReport,
        TruthReport, Waypoints,
    },
    scenario::Scenario,
};
use command::{act, unless};
use rover_bus::{BusError, Peer};
use rover_kinematics::{AxisGoal, closest_solution};
use rover_messages::{
    Fault, Nothing,
    approach::{BasePose, DriveToFeedback, DriveToResult},
    arm::{ArmState, ExecuteFeedback, ExecuteGoal, ExecuteResult, Guard},
    keys,
    mobility::WheelsState,
    placement::{ContactFeedback, ContactResult, PlaceFeedback, PlaceResult},
    planning::{Plan, PlanGoal, PlanRequest, SurveyReport, SurveyRequest},
    simulation::{Score, ScoreRequest, TruthState},
    status::{ServiceStatus, work},
    target::Target,
};
use rover_robot::Robot;
use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

/// Name under which the runner announces itself and commands.
pub const RUNNER: &str = "runner";

/// Longest wait for an action to end after it was cancelled.
const CANCEL_LIMIT: Duration = Duration::from_secs(5);
/// Base poses from which a placement is tried if the scenario does not say.
const MOST_BASE_POSES_N: u32 = 3;

/// Who watches a run; the methods return at once.
pub trait Observer: Send {
    /// A phase begins.
    fn phase(&mut self, _name: &str) {}
    /// The target was selected.
    fn target(&mut self, _target: &Target) {}
    /// The approach reports.
    fn approach(&mut self, _feedback: &DriveToFeedback) {}
    /// The servo reports.
    fn servo(&mut self, _feedback: &PlaceFeedback) {}
    /// The contact motion reports.
    fn contact(&mut self, _feedback: &ContactFeedback) {}
    /// A phase has ended.
    fn ended(&mut self, _phase: &Phase) {}
}

/// An observer that looks away.
#[derive(Clone, Copy, Debug, Default)]
pub struct Unobserved;
impl Observer for Unobserved {}

/// One run of one scenario on a network that is up.
pub struct Mission<'a> {
    peer: &'a Peer,
    scenario: &'a Scenario,
    robot: &'a Robot,
    abort: Abort,
    observer: &'a mut dyn Observer,
    sim_time_s: f64,
    since: Instant,
    phases: Vec<Phase>,
    evidence: Option<Evidence>,
}

/// What a mission came to, as far as it came.
#[derive(Clone, Debug, Default)]
struct Record {
    target: Option<Target>,
    approach: Option<DriveToResult>,
    /// Base poses left again, with the fault of the placement from there.
    earlier: Vec<(BasePose, Fault)>,
    placed: Option<PlaceResult>,
    contact: Option<ContactReport>,
    score: Option<Score>,
    waypoints: Waypoints,
}

impl<'a> Mission<'a> {
    /// A mission for `peer`, which must have announced itself as [`RUNNER`]. Pictures for a
    /// report are only asked for `with_evidence`; they change nothing else.
    pub fn new(
        peer: &'a Peer,
        scenario: &'a Scenario,
        robot: &'a Robot,
        abort: Abort,
        observer: &'a mut dyn Observer,
        with_evidence: bool,
    ) -> Self {
        let evidence = with_evidence.then(Evidence::default);
        let phases = Vec::new();
        Self {
            peer,
            scenario,
            robot,
            abort,
            observer,
            sim_time_s: 0.0,
            since: Instant::now(),
            phases,
            evidence,
        }
    }

    /// Runs the mission to its end. Whatever happens, the arm is at rest afterwards and the
    /// report says what happened; its digest is still to be computed.
    pub async fn run(mut self) -> (RunReport, Option<Evidence>) {
        let mut record = Record::default();
        let mut ended = self.place(&mut record).await;
        if ended.is_err() {
            self.stop().await;
        }
        let scoring = self
            .peer
            .is_present(keys::service::HARDWARE)
            .await
            .unwrap_or(false);
        if let Some(target) = record.target.clone().filter(|_| scoring) {
            let handed_over = record.approach.as_ref().map(|a| a.target.clone());
            let scored = self.score(&target, handed_over).await;
            match scored {
                Ok(score) => record.score = Some(score),
                Err(fault) => ended = ended.and(Err(fault)),
            }
        }
        if ended.is_ok() && !self.scenario.arm.end_posture.is_empty() {
            ended = self.take_up(&self.scenario.arm.end_posture).await;
            if ended.is_err() {
                self.stop().await;
            }
        }
        let mut report = self.report(&record, ended.err());
        report.wall_by_kind_s = self.wall_by_kind_s().await;
        if let Some(evidence) = &mut self.evidence {
            evidence.target = record.target;
            evidence.score = record.score;
        }
        (report, self.evidence)
    }

    /// Everything up to contact.
    async fn place(&mut self, record: &mut Record) -> Result<(), Fault> {
        let scenario = self.scenario;
        self.sim_time_s = self.now_s().await.unwrap_or_default();

        let (target, anchor) = self.designate().await?;
        record.target = Some(target.clone());
        match &scenario.approach_under_the_sun() {
            Some(settings) => {
                let goal = settings.goal(&target, anchor);
                let most_n = settings.max_base_poses_n.unwrap_or(MOST_BASE_POSES_N);
                self.place_from_somewhere(record, goal, most_n).await
            }
            None => self.place_from_here(record, &target).await,
        }
    }

    /// To the standoff and on to contact.
    async fn place_from_here(&mut self, record: &mut Record, target: &Target) -> Result<(), Fault> {
        let (peer, question_limit) = (self.peer, self.scenario.limits.question());
        let lost_m = record
            .approach
            .as_ref()
            .map_or(0.0, |a| a.forecast_mm * 1e-3);
        let placed = self.reach_standoff(target, lost_m).await;
        if let Some(evidence) = &mut self.evidence {
            evidence
                .at_standoff(peer, &target.pair, question_limit)
                .await;
            match &placed {
                Ok(placed) => evidence.looks.clone_from(&placed.looks),
                Err(_) => evidence.after_servo(peer, question_limit).await,
            }
        }
        let placed = placed?;
        record.placed = Some(placed.clone());
        if self.is_simulated().await {
            let truth: TruthState = self.ask(keys::SIM_TRUTH_STATE, &Nothing {}).await?;
            record.waypoints.at_standoff(&truth);
        }
        self.contact(record, target, &placed).await
    }

    /// Surveys the ground before the arm and brings the instrument to the standoff.
    async fn reach_standoff(&mut self, target: &Target, lost_m: f64) -> Result<PlaceResult, Fault> {
        let (peer, scenario) = (self.peer, self.scenario);
        let question_limit = scenario.limits.question();
        let started = self.begin("survey");
        let request = SurveyRequest {
            pair: target.pair.clone(),
        };
        let surveyed = unless(
            &self.abort,
            peer.ask::<_, SurveyReport>(keys::PLANNER_SURVEY, &request, question_limit),
        )
        .await;
        self.end(started, surveyed).await?;

        let started = self.begin("servo");
        let goal = scenario.place_goal(target, lost_m);
        let (observer, evidence) = (&mut *self.observer, &mut self.evidence);
        let placed = act(
            peer,
            &self.abort,
            scenario.limits.action(),
            keys::SERVO_PLACE,
            &goal,
            async |feedback: &PlaceFeedback| {
                observer.servo(feedback);
                if let (Some(evidence), Some(look)) = (evidence.as_mut(), &feedback.look) {
                    evidence.look(look);
                }
            },
        )
        .await;
        self.end(started, placed).await
    }

    /// Drives the instrument along the normal until the switch closes.
    async fn contact(
        &mut self,
        record: &mut Record,
        target: &Target,
        placed: &PlaceResult,
    ) -> Result<(), Fault> {
        let (peer, scenario) = (self.peer, self.scenario);
        let question_limit = scenario.limits.question();
        let started = self.begin("contact");
        let goal = scenario.contact_goal(target, placed);
        let (observer, evidence) = (&mut *self.observer, &mut self.evidence);
        let contact = act(
            peer,
            &self.abort,
            scenario.limits.action(),
            keys::CONTACT_APPROACH,
            &goal,
            async |feedback: &ContactFeedback| {
                observer.contact(feedback);
                if let Some(evidence) = evidence.as_mut()
                    && feedback.activity == "in_contact"
                {
                    evidence.in_contact(peer, question_limit).await;
                }
            },
        )
        .await;
        if let Err(fault) = &contact {
            record.contact = ContactReport::missed(fault);
        }
        let contact: ContactResult = self.end(started, contact).await?;
        if let Some(evidence) = &mut self.evidence {
            evidence.after_contact(peer, question_limit).await;
        }
        record.contact = Some(ContactReport::from(&contact));
        Ok(())
    }

    /// Measures the placement against the truth; the simulator's privilege.
    async fn score(
        &mut self,
        target: &Target,
        handed_over: Option<Target>,
    ) -> Result<Score, Fault> {
        let started = self.begin("score");
        let limit = self.scenario.limits.question();
        let scored = async {
            let state: ArmState = self.peer.latest(keys::ARM_STATE, limit).await?;
            let believed = handed_over.as_ref().unwrap_or(target);
            let open_loop_joints_rad = open_loop_joints(self.robot, believed, &state.joints_rad);
            let request = ScoreRequest {
                target: target.clone(),
                handed_over,
                open_loop_joints_rad,
            };
            self.peer
                .ask::<_, Score>(keys::SIM_TRUTH_SCORE, &request, limit)
                .await
        };
        let scored = scored.await.map_err(|e| e.into_fault(RUNNER));
        self.end(started, scored).await
    }

    /// Brings the arm to a posture in which it can be left.
    async fn take_up(&mut self, posture: &str) -> Result<(), Fault> {
        let started = self.begin("stow");
        let request = PlanRequest {
            start_rad: None,
            goal: PlanGoal::Posture(posture.into()),
            speed_fraction: 1.0,
            max_tip_speed_m_s: None,
            contact_radius_m: 0.0,
        };
        let limits = &self.scenario.limits;
        let stowed = async {
            let plan: Plan = unless(
                &self.abort,
                self.peer
                    .ask(keys::PLANNER_PLAN, &request, limits.question()),
            )
            .await?;
            let goal = ExecuteGoal {
                trajectory: plan.trajectory,
                guard: Guard::default(),
            };
            act::<_, ExecuteFeedback, ExecuteResult>(
                self.peer,
                &self.abort,
                limits.action(),
                keys::ARM_EXECUTE,
                &goal,
                async |_| (),
            )
            .await
        };
        let stowed = stowed.await.and_then(|result| {
            if result.completed {
                return Ok(());
            }
            let message = format!("the arm stopped on its way: {:?}", result.state.stop_reason);
            Err(Fault::new(RUNNER, "stow_stopped", message))
        });
        self.end(started, stowed).await
    }

    /// Stops the arm and the wheels; a network on which nobody answers has none to stop.
    async fn stop(&self) {
        let peer = self.peer;
        let arm = peer.ask::<_, ArmState>(keys::ARM_STOP, &Nothing {}, CANCEL_LIMIT);
        if let Err(error) = arm.await {
            tracing::warn!(%error, "arm/stop was not answered");
        }
        if self.robot.mobility().is_ok() {
            let wheels = peer.ask::<_, WheelsState>(keys::WHEELS_STOP, &Nothing {}, CANCEL_LIMIT);
            if let Err(error) = wheels.await {
                tracing::warn!(%error, "wheels/stop was not answered");
            }
        }
    }

    fn begin(&mut self, name: &'static str) -> (&'static str, Instant) {
        self.observer.phase(name);
        (name, Instant::now())
    }

    async fn end<T>(
        &mut self,
        (name, started): (&'static str, Instant),
        outcome: Result<T, Fault>,
    ) -> Result<T, Fault> {
        let wall_s = started.elapsed().as_secs_f64();
        let now_s = self.now_s().await.unwrap_or(self.sim_time_s);
        let phase = Phase {
            name: name.into(),
            sim_s: now_s - self.sim_time_s,
            wall_s,
            outcome: outcome
                .as_ref()
                .map_or_else(|fault| fault.name.clone(), |_| "done".into()),
        };
        self.sim_time_s = now_s;
        self.observer.ended(&phase);
        self.phases.push(phase);
        outcome
    }

    /// What simulator and services say of their computing, and what is left of the wall time.
    async fn wall_by_kind_s(&self) -> BTreeMap<String, f64> {
        let mut by_kind = BTreeMap::<String, f64>::new();
        let driven = [keys::service::HARDWARE, keys::service::ROVER_APPROACH];
        for service in keys::service::ALL.into_iter().chain(driven) {
            if !self.peer.is_present(service).await.unwrap_or(false) {
                continue;
            }
            let limit = self.scenario.limits.question();
            let key = keys::status(service);
            if let Ok(status) = self.peer.latest::<ServiceStatus>(&key, limit).await {
                for (kind, busy_s) in status.busy_s {
                    *by_kind.entry(kind).or_default() += busy_s;
                }
            }
        }
        let wall_s = self.since.elapsed().as_secs_f64();
        let known_s: f64 = by_kind.values().sum();
        by_kind.insert(work::BUS.into(), (wall_s - known_s).max(0.0));
        by_kind
    }

    /// Simulated time, s.
    async fn now_s(&self) -> Result<f64, BusError> {
        let limit = self.scenario.limits.question();
        Ok(self
            .peer
            .latest::<ArmState>(keys::ARM_STATE, limit)
            .await?
            .sim_time_s)
    }

    fn report(&self, record: &Record, ended: Option<Fault>) -> RunReport {
        let method = self.scenario.servo.method;
        RunReport {
            scenario: self.scenario.name.clone(),
            robot: self.robot.name().into(),
            seed: self.scenario.seed,
            outcome: if ended.is_none() {
                Outcome::Placed
            } else {
                Outcome::Aborted
            },
            reason: ended.map(|fault| format!("{}: {}", fault.name, fault.message)),
            phases: self.phases.clone(),
            target: record.target.as_ref().map(TargetReport::from),
            approach: record
                .approach
                .as_ref()
                .map(|reached| ApproachReport::new(reached, &record.earlier)),
            servo: record
                .placed
                .as_ref()
                .map(|placed| ServoReport::new(method, placed)),
            contact: record.contact.clone(),
            truth: record
                .score
                .as_ref()
                .map(|score| TruthReport::new(score, &record.waypoints)),
            wall_by_kind_s: BTreeMap::new(),
            digest: String::new(),
        }
    }
}

/// Joint angles that place the tip on the believed target with believed kinematics alone, on the
/// branch nearest to `near_rad`; none if the target is out of reach.
pub fn open_loop_joints(robot: &Robot, target: &Target, near_rad: &[f64]) -> Option<Vec<f64>> {
    let arm_base_from_rover = robot.rover_from_arm_base.inverse();
    let goal = AxisGoal {
        point: (arm_base_from_rover * target.position_m).coords,
        axis: (arm_base_from_rover * -target.normal).unit,
    };
    closest_solution(&robot.arm, &robot.tool, &goal, near_rad).ok()
}
