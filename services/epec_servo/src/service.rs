//! The servo on the bus: `servo/place`.

use crate::{
    estimator::EstimatorRules,
    place::{Placement, Step},
};
use rover_bus::{ActionPolicy, BusError, GoalContext, Peer};
use rover_messages::{
    Fault,
    arm::Guard,
    imaging::{CaptureRequest, StereoFrame},
    keys::{
        self,
        service::{ARM_PLANNER, EPEC_SERVO},
    },
    placement::{Look, PlaceFeedback, PlaceGoal, PlaceResult},
    status::work,
};
use rover_robot::Robot;
use rover_service::{
    Service, ServiceShell,
    motion::{ArmClient, interrupted},
};
use std::{sync::Arc, time::Duration};

/// Wall-clock limit for one stereo frame.
const FRAME_LIMIT: Duration = Duration::from_secs(60);

/// Starts the service on `peer`; it lives as long as the returned value.
///
/// # Errors
/// [`BusError`] when a key cannot be declared or the name is taken.
pub async fn serve(peer: &Peer, robot: Arc<Robot>) -> Result<Service, BusError> {
    let shell = ServiceShell::new(peer, &robot, EPEC_SERVO).await?;
    let servo = Servo {
        arm: ArmClient::new(peer, EPEC_SERVO),
        peer: peer.clone(),
        robot,
        shell: shell.clone(),
    };
    let policy = ActionPolicy {
        lockstep: false,
        beat_limit: Duration::from_secs(10),
    };
    let action = peer
        .serve_action(keys::SERVO_PLACE, policy, move |context, goal| {
            let servo = servo.clone();
            async move { servo.place(&context, goal).await }
        })
        .await?;
    shell.start(vec![action]).await
}

#[derive(Clone)]
struct Servo {
    arm: ArmClient,
    peer: Peer,
    robot: Arc<Robot>,
    shell: ServiceShell,
}

impl Servo {
    async fn place(
        &self,
        context: &GoalContext<PlaceFeedback>,
        goal: PlaceGoal,
    ) -> Result<PlaceResult, Fault> {
        let _activity = self.shell.activity("placing");
        let pair = goal.target.pair.clone();
        self.robot
            .pair(&pair)
            .map_err(|e| Fault::new(EPEC_SERVO, "unknown_camera_pair", e.to_string()))?;
        let mut placement = Placement::new(self.robot.clone(), goal, EstimatorRules::default());
        match self.run(context, &mut placement, &pair).await {
            Ok(result) => {
                self.shell.count("placements");
                Ok(result)
            }
            Err(fault) => {
                let action = self.leave(context, &mut placement).await;
                self.shell.fault(&fault, action);
                Err(fault)
            }
        }
    }

    async fn run(
        &self,
        context: &GoalContext<PlaceFeedback>,
        placement: &mut Placement,
        pair: &str,
    ) -> Result<PlaceResult, Fault> {
        let mut last_look: Option<Look> = None;
        loop {
            if let Some(interrupt) = context.interrupted() {
                return Err(interrupted(EPEC_SERVO, &interrupt));
            }
            let q = self.arm.state().await?.joints_rad;
            let plan = match placement.next(&q)? {
                Step::Done(result) => return Ok(result),
                Step::Try(request) => match self.arm.plan(&request).await {
                    Ok(plan) => plan,
                    Err(refusal) if refusal.service == ARM_PLANNER => {
                        tracing::info!(%refusal, "a pose before the approach is left out");
                        placement.leave_out();
                        continue;
                    }
                    Err(fault) => return Err(fault),
                },
                Step::Move(request) => self.arm.plan(&request).await?,
                Step::Look => {
                    let frame: StereoFrame = self
                        .peer
                        .ask(
                            &keys::imaging_capture(pair),
                            &CaptureRequest::default(),
                            FRAME_LIMIT,
                        )
                        .await
                        .map_err(|e| match e {
                            BusError::Fault(fault) => fault,
                            other => Fault::new(EPEC_SERVO, "imaging_silent", other.to_string()),
                        })?;
                    let look = tokio::task::block_in_place(|| {
                        self.shell
                            .timed(work::VISION, || placement.look(&q, &frame))
                    })?;
                    self.shell.count(if look.found {
                        "fiducials_found"
                    } else {
                        "fiducials_missed"
                    });
                    let distance_m = placement.distance_m(&q)?;
                    last_look = Some(look);
                    let (activity, look) = ("looking".into(), last_look.clone());
                    context.feedback(PlaceFeedback {
                        activity,
                        distance_m,
                        look,
                    });
                    continue;
                }
            };
            let result = self
                .arm
                .execute(&plan, Guard::default(), context, |state| {
                    if let Ok(distance_m) = placement.distance_m(&state.joints_rad) {
                        let activity = "moving".into();
                        let look = last_look.clone();
                        context.feedback(PlaceFeedback {
                            activity,
                            distance_m,
                            look,
                        });
                    }
                })
                .await?;
            if !result.completed {
                return Err(unexpected_stop(&result));
            }
            self.shell.count("moves");
        }
    }

    /// Takes the arm back to the first station after a fault, unless the goal was interrupted:
    /// then it stays where it stopped. Says what was done.
    async fn leave(
        &self,
        context: &GoalContext<PlaceFeedback>,
        placement: &mut Placement,
    ) -> &'static str {
        if context.interrupted().is_some() {
            return "arm stopped";
        }
        let retreat = async {
            let q = self.arm.state().await?.joints_rad;
            let plan = self.arm.plan(&placement.retreat(&q)?).await?;
            self.arm
                .execute(&plan, Guard::default(), context, |_| ())
                .await
        };
        match retreat.await {
            Ok(_) => "arm taken back to the first station",
            Err(error) => {
                tracing::warn!(%error, "the arm stays where it is");
                "arm stopped"
            }
        }
    }
}

fn unexpected_stop(result: &rover_messages::arm::ExecuteResult) -> Fault {
    let why = result
        .state
        .stop_reason
        .as_ref()
        .map_or("no reason given".into(), ToString::to_string);
    Fault::new(
        EPEC_SERVO,
        "unexpected_stop",
        format!("the arm stopped on its way to a station: {why}"),
    )
}
