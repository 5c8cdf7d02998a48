//! Moving the arm on behalf of an action: plan, execute with heartbeats, stop when interrupted.

use rover_bus::{BusError, GoalContext, Interrupt, Peer};
use rover_messages::{
    Fault,
    arm::{ArmState, ExecuteFeedback, ExecuteGoal, ExecuteResult, Guard},
    keys,
    planning::{Plan, PlanRequest},
};
use std::time::Duration;

/// Wall-clock limit for an answer of a hardware or planning query.
const ANSWER_LIMIT: Duration = Duration::from_secs(60);

/// The arm as seen by a service that commands it.
#[derive(Clone)]
pub struct ArmClient {
    peer: Peer,
    service: &'static str,
}

impl ArmClient {
    /// The arm, commanded by `service`.
    pub fn new(peer: &Peer, service: &'static str) -> Self {
        Self {
            peer: peer.clone(),
            service,
        }
    }

    /// The arm's present state.
    ///
    /// # Errors
    /// Fault `arm_silent` when the driver does not answer.
    pub async fn state(&self) -> Result<ArmState, Fault> {
        self.peer
            .latest(keys::ARM_STATE, ANSWER_LIMIT)
            .await
            .map_err(|e| self.fault("arm_silent", &e))
    }

    /// Asks the planner for a motion.
    ///
    /// # Errors
    /// The planner's own fault, or `planner_silent`.
    pub async fn plan(&self, request: &PlanRequest) -> Result<Plan, Fault> {
        self.peer
            .ask(keys::PLANNER_PLAN, request, ANSWER_LIMIT)
            .await
            .map_err(|e| self.fault("planner_silent", &e))
    }

    /// Executes a plan; every heartbeat comes from this loop. When `context` is interrupted the
    /// arm is stopped and the interruption is returned as a fault. `progress` sees the arm after
    /// each heartbeat period.
    ///
    /// # Errors
    /// The driver's fault, `arm_silent`, `cancelled` or `commander_lost`.
    pub async fn execute<F>(
        &self,
        plan: &Plan,
        guard: Guard,
        context: &GoalContext<F>,
        mut progress: impl FnMut(&ArmState) + Send,
    ) -> Result<ExecuteResult, Fault>
    where
        F: rover_messages::Wire + Clone,
    {
        let goal = ExecuteGoal {
            trajectory: plan.trajectory.clone(),
            guard,
        };
        let mut running = self
            .peer
            .command::<_, ExecuteFeedback, ExecuteResult>(keys::ARM_EXECUTE, &goal)
            .await
            .map_err(|e| self.fault("arm_silent", &e))?;
        let mut interruption = None;
        loop {
            if interruption.is_none()
                && let Some(interrupt) = context.interrupted()
            {
                interruption = Some(interrupted(self.service, &interrupt));
                running
                    .cancel()
                    .await
                    .map_err(|e| self.fault("arm_silent", &e))?;
            }
            let beat = running.beat().await;
            match (beat, &interruption) {
                (Ok(report), _) => {
                    if let Some(feedback) = &report.feedback {
                        progress(&feedback.state);
                    }
                    if let Some(fault) = report.fault {
                        return Err(interruption.unwrap_or(fault));
                    }
                    if let Some(result) = report.result {
                        return interruption.map_or(Ok(result), Err);
                    }
                }
                (Err(_), Some(fault)) => return Err(fault.clone()),
                (Err(error), None) => return Err(self.fault("arm_silent", &error)),
            }
        }
    }

    fn fault(&self, name: &str, error: &BusError) -> Fault {
        match error {
            BusError::Fault(fault) => fault.clone(),
            other => Fault::new(self.service, name, other.to_string()),
        }
    }
}

/// The fault that an interrupted goal ends with.
pub fn interrupted(service: &str, interrupt: &Interrupt) -> Fault {
    match interrupt {
        Interrupt::Cancelled => {
            Fault::new(service, "cancelled", "the commander cancelled the goal")
        }
        other => Fault::new(service, "commander_lost", format!("{other:?}")),
    }
}
