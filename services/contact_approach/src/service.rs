//! The contact motion on the bus: `contact/approach`.

use crate::guarded_move::{GuardedMove, Outcome};
use rover_bus::{ActionPolicy, BusError, GoalContext, Peer};
use rover_messages::{
    Fault,
    arm::{ExecuteResult, Guard},
    keys::{self, service::CONTACT_APPROACH},
    placement::{ContactFeedback, ContactGoal, ContactResult},
    planning::PlanRequest,
};
use rover_robot::Robot;
use rover_service::{Service, ServiceShell, motion::ArmClient};
use std::{sync::Arc, time::Duration};

/// Starts the service on `peer`; it lives as long as the returned value.
///
/// # Errors
/// [`BusError`] when a key cannot be declared or the name is taken.
pub async fn serve(peer: &Peer, robot: Arc<Robot>) -> Result<Service, BusError> {
    let shell = ServiceShell::new(peer, &robot, CONTACT_APPROACH).await?;
    let contact = Contact {
        arm: ArmClient::new(peer, CONTACT_APPROACH),
        robot,
        shell: shell.clone(),
    };
    let policy = ActionPolicy {
        lockstep: false,
        beat_limit: Duration::from_secs(10),
    };
    let action = peer
        .serve_action(keys::CONTACT_APPROACH, policy, move |context, goal| {
            let contact = contact.clone();
            async move { contact.approach(&context, goal).await }
        })
        .await?;
    shell.start(vec![action]).await
}

#[derive(Clone)]
struct Contact {
    arm: ArmClient,
    robot: Arc<Robot>,
    shell: ServiceShell,
}

impl Contact {
    async fn approach(
        &self,
        context: &GoalContext<ContactFeedback>,
        goal: ContactGoal,
    ) -> Result<ContactResult, Fault> {
        let _activity = self.shell.activity("approaching");
        match self.run(context, &goal).await {
            Ok(result) => {
                self.shell.count("contacts");
                Ok(result)
            }
            Err((fault, action)) => {
                self.shell.fault(&fault, action);
                Err(fault)
            }
        }
    }

    async fn run(
        &self,
        context: &GoalContext<ContactFeedback>,
        goal: &ContactGoal,
    ) -> Result<ContactResult, (Fault, &'static str)> {
        const REFUSED: &str = "goal refused";
        const STOPPED: &str = "arm stopped";
        let motion = GuardedMove::new(&self.robot, goal.clone());
        let before = self.arm.state().await.map_err(|f| (f, REFUSED))?;
        if before.contact {
            let message = "the contact switch is closed before the approach, expected it open";
            return Err((
                Fault::new(CONTACT_APPROACH, "switch_already_closed", message),
                REFUSED,
            ));
        }
        let start_m = motion
            .distance_m(&before.joints_rad)
            .map_err(|f| (f, REFUSED))?;
        let request = motion
            .approach(&before.joints_rad)
            .map_err(|f| (f, REFUSED))?;
        let guard = Guard {
            max_force_n: Some(goal.max_force_n),
            ..Guard::default()
        };
        let done = self
            .move_arm(context, &motion, &request, guard, "approaching")
            .await
            .map_err(|f| (f, STOPPED))?;
        let contact_q = match motion.outcome(&done) {
            Outcome::Contact => done.joints_at_contact_rad.clone().unwrap_or_default(),
            Outcome::NoContact(fault) => {
                let mut fault = fault
                    .with("peak_force_n", done.peak_force_n)
                    .with("switch_travel_mm", done.state.switch_travel_m * 1e3);
                if let Ok(end_m) = motion.distance_m(&done.state.joints_rad) {
                    fault = fault.with("approach_mm", (start_m - end_m) * 1e3);
                }
                let back = self.retract(context, &motion, &done).await;
                let action = if back.is_ok() {
                    "arm retracted to the standoff"
                } else {
                    STOPPED
                };
                return Err((fault, action));
            }
        };
        let end_m = motion.distance_m(&contact_q).map_err(|f| (f, STOPPED))?;
        if goal.retract {
            self.retract(context, &motion, &done)
                .await
                .map_err(|f| (f, STOPPED))?;
        }
        Ok(ContactResult {
            switch_travel_m: done.state.switch_travel_m,
            peak_force_n: done.peak_force_n,
            approach_m: start_m - end_m,
            joints_at_contact_rad: contact_q,
            sim_time_s: done.state.sim_time_s,
            retracted: goal.retract,
        })
    }

    async fn retract(
        &self,
        context: &GoalContext<ContactFeedback>,
        motion: &GuardedMove,
        at: &ExecuteResult,
    ) -> Result<(), Fault> {
        let request = motion.retract(&at.state.joints_rad)?;
        self.move_arm(context, motion, &request, Guard::default(), "retracting")
            .await?;
        Ok(())
    }

    async fn move_arm(
        &self,
        context: &GoalContext<ContactFeedback>,
        motion: &GuardedMove,
        request: &PlanRequest,
        guard: Guard,
        activity: &str,
    ) -> Result<ExecuteResult, Fault> {
        let plan = self.arm.plan(request).await?;
        self.arm
            .execute(&plan, guard, context, |state| {
                if let Ok(distance_m) = motion.distance_m(&state.joints_rad) {
                    let activity = if state.contact {
                        "in_contact"
                    } else {
                        activity
                    }
                    .into();
                    let tip_force_n = state.tip_force_n;
                    context.feedback(ContactFeedback {
                        activity,
                        distance_m,
                        tip_force_n,
                    });
                }
            })
            .await
    }
}
