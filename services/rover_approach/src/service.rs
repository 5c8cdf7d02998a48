//! The approach on the bus: `approach/drive_to`.

use crate::hardware::{Hardware, fault};
use crate::session::Session;
use rover_bus::{ActionPolicy, BusError, GoalContext, Peer};
use rover_messages::{
    Fault,
    approach::{DriveToFeedback, DriveToGoal, DriveToResult},
    keys::{self, service::ROVER_APPROACH},
};
use rover_robot::Robot;
use rover_service::{Service, ServiceShell};
use std::{sync::Arc, time::Duration};

/// Starts the service on `peer`; it lives as long as the returned value.
///
/// # Errors
/// [`BusError`] when a key cannot be declared or the name is taken.
pub async fn serve(peer: &Peer, robot: Arc<Robot>) -> Result<Service, BusError> {
    let shell = ServiceShell::new(peer, &robot, ROVER_APPROACH).await?;
    let approach = Approach {
        peer: peer.clone(),
        robot,
        shell: shell.clone(),
    };
    let policy = ActionPolicy {
        lockstep: false,
        beat_limit: Duration::from_secs(10),
    };
    let action = peer
        .serve_action(keys::APPROACH_DRIVE_TO, policy, move |context, goal| {
            let approach = approach.clone();
            async move { approach.drive_to(&context, goal).await }
        })
        .await?;
    shell.start(vec![action]).await
}

#[derive(Clone)]
struct Approach {
    peer: Peer,
    robot: Arc<Robot>,
    shell: ServiceShell,
}

impl Approach {
    async fn drive_to(
        &self,
        context: &GoalContext<DriveToFeedback>,
        goal: DriveToGoal,
    ) -> Result<DriveToResult, Fault> {
        let _activity = self.shell.activity("approaching");
        let hardware = Hardware {
            peer: &self.peer,
            context,
            light: None,
            shell: &self.shell,
        };
        match Session::run(hardware, &self.robot, &goal).await {
            Ok(result) => {
                self.shell.count("approaches");
                Ok(result)
            }
            Err(found) => {
                self.shell.fault(&found, "rover stopped");
                Err(found)
            }
        }
    }
}

/// The fault of a robot that cannot approach anything.
pub(crate) fn unfit(error: &rover_robot::RobotError) -> Fault {
    fault("robot_cannot_approach", error.to_string())
}
