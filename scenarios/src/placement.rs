//! The mission: designate, survey, servo, contact, score, stow. It talks to the services through
//! their keys alone and would run unchanged against real hardware, but for the score.

use crate::{
    evidence::Evidence,
    report::{ContactReport, Outcome, Phase, RunReport, ServoReport, TargetReport, TruthReport},
    scenario::Scenario,
};
use rover_bus::{BusError, GoalState, Peer};
use rover_kinematics::{AxisGoal, closest_solution};
use rover_messages::{
    Fault, Nothing, Wire,
    arm::{ArmState, ExecuteFeedback, ExecuteGoal, ExecuteResult, Guard},
    keys,
    placement::{ContactFeedback, ContactResult, PlaceFeedback, PlaceResult},
    planning::{Plan, PlanGoal, PlanRequest, SurveyReport, SurveyRequest},
    simulation::{Score, ScoreRequest},
    target::{SelectRequest, Target},
};
use rover_robot::Robot;
use std::{
    future::Future,
    sync::Arc,
    time::{Duration, Instant},
};
use tokio::sync::watch;

/// Name under which the runner announces itself and commands.
pub const RUNNER: &str = "runner";

/// Longest wait for an action to end after it was cancelled.
const CANCEL_LIMIT: Duration = Duration::from_secs(5);

/// Who watches a run; the methods return at once.
pub trait Observer: Send {
    /// A phase begins.
    fn phase(&mut self, _name: &str) {}
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

/// Tells a running mission to end early, and why; the first reason counts.
#[derive(Clone, Debug)]
pub struct Abort {
    reason: Arc<watch::Sender<Option<Fault>>>,
}

impl Default for Abort {
    fn default() -> Self {
        Self {
            reason: Arc::new(watch::Sender::new(None)),
        }
    }
}

impl Abort {
    /// Ends the mission with this reason.
    pub fn now(&self, reason: Fault) {
        self.reason.send_if_modified(|present| {
            let first = present.is_none();
            if first {
                *present = Some(reason);
            }
            first
        });
    }

    /// The reason, as soon as there is one.
    pub async fn requested(&self) -> Fault {
        let mut reason = self.reason.subscribe();
        loop {
            if let Some(fault) = reason.borrow_and_update().clone() {
                return fault;
            }
            // The sender lives in `self`, so a change always comes or nobody ever asks.
            if reason.changed().await.is_err() {
                std::future::pending::<()>().await;
            }
        }
    }
}

/// One run of one scenario on a network that is up.
pub struct Mission<'a> {
    peer: &'a Peer,
    scenario: &'a Scenario,
    robot: &'a Robot,
    abort: Abort,
    observer: &'a mut dyn Observer,
    sim_time_s: f64,
    phases: Vec<Phase>,
    evidence: Option<Evidence>,
}

/// What a mission came to, as far as it came.
#[derive(Clone, Debug, Default)]
struct Record {
    target: Option<Target>,
    placed: Option<PlaceResult>,
    contact: Option<ContactReport>,
    score: Option<Score>,
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
            self.stop_arm().await;
        }
        let scoring = self
            .peer
            .is_present(keys::service::HARDWARE)
            .await
            .unwrap_or(false);
        if let Some(target) = record.target.clone().filter(|_| scoring) {
            let scored = self.score(&target).await;
            match scored {
                Ok(score) => record.score = Some(score),
                Err(fault) => ended = ended.and(Err(fault)),
            }
        }
        if ended.is_ok() && !self.scenario.arm.end_posture.is_empty() {
            ended = self.stow().await;
            if ended.is_err() {
                self.stop_arm().await;
            }
        }
        let report = self.report(&record, ended.err());
        if let Some(evidence) = &mut self.evidence {
            evidence.target = record.target;
            evidence.score = record.score;
        }
        (report, self.evidence)
    }

    /// Everything up to contact.
    async fn place(&mut self, record: &mut Record) -> Result<(), Fault> {
        let (peer, scenario) = (self.peer, self.scenario);
        let question_limit = scenario.limits.question();
        self.sim_time_s = self.now_s().await.unwrap_or_default();

        let request = SelectRequest {
            pair: scenario.target.pair.clone(),
            pixel_px: scenario.target.pixel_px,
        };
        let started = self.begin("designate");
        let abort = self.abort.clone();
        let selected = unless(
            &abort,
            peer.ask::<_, Target>(keys::TARGET_SELECT, &request, question_limit),
        )
        .await;
        let target = self.end(started, selected).await?;
        if let Some(evidence) = &mut self.evidence {
            evidence
                .designated(peer, &scenario.target.pair, question_limit)
                .await;
        }
        record.target = Some(target.clone());

        let started = self.begin("survey");
        let request = SurveyRequest {
            pair: scenario.target.pair.clone(),
        };
        let surveyed = unless(
            &abort,
            peer.ask::<_, SurveyReport>(keys::PLANNER_SURVEY, &request, question_limit),
        )
        .await;
        self.end(started, surveyed).await?;

        let started = self.begin("servo");
        let goal = scenario.place_goal(&target);
        let (observer, evidence) = (&mut *self.observer, &mut self.evidence);
        let placed = act(
            peer,
            &abort,
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
        let placed: PlaceResult = self.end(started, placed).await?;
        if let Some(evidence) = &mut self.evidence {
            evidence.looks.clone_from(&placed.looks);
            evidence
                .at_standoff(peer, &scenario.target.pair, question_limit)
                .await;
        }
        record.placed = Some(placed.clone());

        let started = self.begin("contact");
        let goal = scenario.contact_goal(&target, &placed);
        let (observer, evidence) = (&mut *self.observer, &mut self.evidence);
        let contact = act(
            peer,
            &abort,
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
    async fn score(&mut self, target: &Target) -> Result<Score, Fault> {
        let started = self.begin("score");
        let limit = self.scenario.limits.question();
        let scored = async {
            let state: ArmState = self.peer.latest(keys::ARM_STATE, limit).await?;
            let open_loop_joints_rad = open_loop_joints(self.robot, target, &state.joints_rad);
            let request = ScoreRequest {
                target: target.clone(),
                handed_over: None,
                open_loop_joints_rad,
            };
            self.peer
                .ask::<_, Score>(keys::SIM_TRUTH_SCORE, &request, limit)
                .await
        };
        let scored = scored.await.map_err(|e| e.into_fault(RUNNER));
        self.end(started, scored).await
    }

    /// Brings the arm to the scenario's end posture.
    async fn stow(&mut self) -> Result<(), Fault> {
        let started = self.begin("stow");
        let request = PlanRequest {
            start_rad: None,
            goal: PlanGoal::Posture(self.scenario.arm.end_posture.clone()),
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

    /// Stops the arm; a network on which nobody answers has no arm to stop.
    async fn stop_arm(&self) {
        let stopped = self
            .peer
            .ask::<_, ArmState>(keys::ARM_STOP, &Nothing {}, CANCEL_LIMIT)
            .await;
        if let Err(error) = stopped {
            tracing::warn!(%error, "arm/stop was not answered");
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
            servo: record
                .placed
                .as_ref()
                .map(|placed| ServoReport::new(method, placed)),
            contact: record.contact.clone(),
            truth: record.score.as_ref().map(TruthReport::from),
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

/// The answer, unless the run is aborted before it comes.
async fn unless<T>(
    abort: &Abort,
    answer: impl Future<Output = Result<T, BusError>>,
) -> Result<T, Fault> {
    tokio::select! {
        biased;
        reason = abort.requested() => Err(reason),
        answer = answer => answer.map_err(|e| e.into_fault(RUNNER)),
    }
}

/// Commands an action and follows it to its end; an abort or the limit cancels it.
async fn act<G: Wire, F: Wire, R: Wire>(
    peer: &Peer,
    abort: &Abort,
    limit: Duration,
    key: &str,
    goal: &G,
    mut on_feedback: impl AsyncFnMut(&F),
) -> Result<R, Fault> {
    let fault = |error: BusError| error.into_fault(RUNNER);
    let mut goal = unless(abort, peer.command::<G, F, R>(key, goal)).await?;
    let deadline = tokio::time::Instant::now() + limit;
    loop {
        let early = tokio::select! {
            biased;
            progress = goal.beat() => {
                let progress = progress.map_err(fault)?;
                if let Some(feedback) = &progress.feedback {
                    on_feedback(feedback).await;
                }
                match progress.state {
                    GoalState::Accepted | GoalState::Running => continue,
                    GoalState::Succeeded => return progress.result.ok_or_else(|| {
                        Fault::new(RUNNER, "bad_message", format!("{key}: success without result"))
                    }),
                    _ => return Err(progress.fault.unwrap_or_else(|| {
                        Fault::new(RUNNER, "cancelled", format!("{key}: the goal was cancelled"))
                    })),
                }
            }
            reason = abort.requested() => reason,
            () = tokio::time::sleep_until(deadline) => Fault::new(
                RUNNER,
                "timeout",
                format!("{key}: not finished after limits.action_s = {} s", limit.as_secs_f64()),
            ),
        };
        // Ends by itself once the goal is cancelled; the reason for the abort is what counts.
        let wound_down = async {
            goal.cancel().await?;
            loop {
                let state = goal.beat().await?.state;
                if !matches!(state, GoalState::Accepted | GoalState::Running) {
                    return Ok::<(), BusError>(());
                }
            }
        };
        match tokio::time::timeout(CANCEL_LIMIT, wound_down).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => tracing::warn!(%error, key, "the cancelled goal was lost"),
            Err(_) => tracing::warn!(key, "the cancelled goal did not end in time"),
        }
        return Err(early);
    }
}
