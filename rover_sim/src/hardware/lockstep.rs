//! What moves in lockstep with its commander: arm, wheels, mast. Each heartbeat grants one period
//! of simulated time; a commander that is lost, late or calls the goal off has the motion stopped
//! in the very control step that it last granted.

use super::{Hands, computed, nothing_under_way};
use crate::world::{Advance, World, lock};
use rover_bus::{ActionPolicy, BusError, GoalContext, Interrupt, Peer, Served};
use rover_messages::{
    Fault, Wire,
    arm::{ExecuteFeedback, ExecuteGoal, ExecuteResult, StopReason},
    keys::{self, service::HARDWARE},
    mobility::{
        DriveFeedback, DriveGoal, DriveResult, DriveStop, PointFeedback, PointGoal, PointResult,
    },
};
use std::time::Duration;

/// Why a motion is stopped.
#[derive(Clone, Debug)]
pub(super) enum Why {
    Cancelled,
    CommanderLost(String),
}

impl Why {
    fn of_arm(self) -> StopReason {
        match self {
            Self::Cancelled => StopReason::Cancelled,
            Self::CommanderLost(commander) => StopReason::CommanderLost { commander },
        }
    }

    fn of_wheels(self) -> DriveStop {
        match self {
            Self::Cancelled => DriveStop::Cancelled,
            Self::CommanderLost(commander) => DriveStop::CommanderLost { commander },
        }
    }
}

/// One thing that moves.
pub(super) trait Lockstep: Send + Sync + 'static {
    /// Key of its action.
    const KEY: &'static str;
    /// Its name in the status, and what a failed goal is reported with.
    const ACTIVITY: &'static str;
    const COUNTER: &'static str;
    const FAILED: &'static str;
    type Goal: Wire;
    type Feedback: Wire + Clone;
    type Result: Wire + Clone;

    fn is_moving(world: &World) -> bool;
    fn start(world: &mut World, goal: Self::Goal) -> Result<(), Fault>;
    fn stop(world: &mut World, why: Why);
    /// The end of its own motion.
    fn ended(advance: Advance) -> Option<Result<Self::Result, Fault>>;
    /// `None` if the robot has no such part.
    fn feedback(world: &World) -> Option<Self::Feedback>;
}

/// `arm/execute`.
pub(super) struct Arm;
/// `wheels/drive`.
pub(super) struct Wheels;
/// `mast/point`.
pub(super) struct Mast;

impl Lockstep for Arm {
    const KEY: &'static str = keys::ARM_EXECUTE;
    const ACTIVITY: &'static str = "moving";
    const COUNTER: &'static str = "motions";
    const FAILED: &'static str = "arm at rest, goal failed";
    type Goal = ExecuteGoal;
    type Feedback = ExecuteFeedback;
    type Result = ExecuteResult;

    fn is_moving(world: &World) -> bool {
        world.is_arm_moving()
    }
    fn start(world: &mut World, goal: ExecuteGoal) -> Result<(), Fault> {
        world.start(goal.trajectory, goal.guard)
    }
    fn stop(world: &mut World, why: Why) {
        world.stop(why.of_arm());
    }
    fn ended(advance: Advance) -> Option<Result<ExecuteResult, Fault>> {
        match advance {
            Advance::Ended(outcome) => Some(outcome),
            _ => None,
        }
    }
    fn feedback(world: &World) -> Option<ExecuteFeedback> {
        Some(ExecuteFeedback {
            state: world.state(),
            elapsed_s: world.elapsed_s(),
        })
    }
}

impl Lockstep for Wheels {
    const KEY: &'static str = keys::WHEELS_DRIVE;
    const ACTIVITY: &'static str = "driving";
    const COUNTER: &'static str = "drives";
    const FAILED: &'static str = "rover at rest, goal failed";
    type Goal = DriveGoal;
    type Feedback = DriveFeedback;
    type Result = DriveResult;

    fn is_moving(world: &World) -> bool {
        world.is_driving()
    }
    fn start(world: &mut World, goal: DriveGoal) -> Result<(), Fault> {
        world.start_drive(&goal)
    }
    fn stop(world: &mut World, why: Why) {
        world.stop_drive(why.of_wheels());
    }
    fn ended(advance: Advance) -> Option<Result<DriveResult, Fault>> {
        match advance {
            Advance::Parked(outcome) => Some(outcome),
            _ => None,
        }
    }
    fn feedback(world: &World) -> Option<DriveFeedback> {
        Some(DriveFeedback {
            state: world.wheels_state()?,
            progress: world.drive_progress(),
        })
    }
}

impl Lockstep for Mast {
    const KEY: &'static str = keys::MAST_POINT;
    const ACTIVITY: &'static str = "pointing";
    const COUNTER: &'static str = "pointings";
    const FAILED: &'static str = "mast at rest, goal failed";
    type Goal = PointGoal;
    type Feedback = PointFeedback;
    type Result = PointResult;

    fn is_moving(world: &World) -> bool {
        world.is_pointing()
    }
    fn start(world: &mut World, goal: PointGoal) -> Result<(), Fault> {
        world.start_pointing(&goal)
    }
    fn stop(world: &mut World, why: Why) {
        world.stop_pointing(why.of_arm());
    }
    fn ended(advance: Advance) -> Option<Result<PointResult, Fault>> {
        match advance {
            Advance::Pointed(outcome) => Some(outcome),
            _ => None,
        }
    }
    fn feedback(world: &World) -> Option<PointFeedback> {
        let state = world.mast_state()?;
        Some(PointFeedback { state })
    }
}

/// Puts an action on the bus.
pub(super) async fn serve<L: Lockstep>(
    peer: &Peer,
    hands: &Hands,
    beat_limit: Duration,
) -> Result<Served, BusError> {
    let hands = hands.clone();
    let policy = ActionPolicy::lockstep(beat_limit);
    peer.serve_action(L::KEY, policy, move |context, goal| {
        execute::<L>(hands.clone(), context, goal)
    })
    .await
}

async fn execute<L: Lockstep>(
    hands: Hands,
    context: GoalContext<L::Feedback>,
    goal: L::Goal,
) -> Result<L::Result, Fault> {
    let outcome = executed::<L>(&hands, &context, goal).await;
    match &outcome {
        Ok(_) => hands.shell.count(L::COUNTER),
        Err(fault) => hands.shell.fault(fault, L::FAILED),
    }
    outcome
}

async fn executed<L: Lockstep>(
    hands: &Hands,
    context: &GoalContext<L::Feedback>,
    goal: L::Goal,
) -> Result<L::Result, Fault> {
    let shell = hands.shell.clone();
    let _activity = shell.activity(L::ACTIVITY);
    let started = hands.clone();
    computed(move || {
        if L::is_moving(&lock(&started.world)) {
            // Its handler has gone without an end.
            let _ = run_to_rest::<L>(&started, Why::CommanderLost("unknown".into()));
        }
        let begun = L::start(&mut lock(&started.world), goal);
        started.publish();
        begun
    })
    .await??;
    loop {
        let interrupt = context.next_beat().await;
        let why = match &interrupt {
            Interrupt::Beat => {
                // In place: to hand over to another thread and back takes longer than many a period.
                let (advance, feedback, sim_time_s) = tokio::task::block_in_place(|| {
                    let advance = hands.grant();
                    let world = lock(&hands.world);
                    (advance, L::feedback(&world), world.sim_time_s())
                });
                if let Some(pace) = hands.pace {
                    tokio::time::sleep_until(pace.due(sim_time_s)).await;
                }
                match advance {
                    Advance::Moving => {
                        if let Some(feedback) = feedback {
                            context.feedback(feedback);
                        }
                    }
                    Advance::Idle => return Err(nothing_under_way()),
                    ended => return L::ended(ended).unwrap_or_else(|| Err(nothing_under_way())),
                }
                continue;
            }
            Interrupt::Cancelled => Why::Cancelled,
            Interrupt::CommanderLost { .. } | Interrupt::Overdue { .. } => {
                Why::CommanderLost(context.commander().to_owned())
            }
        };
        return interrupted::<L>(hands, &interrupt, why).await;
    }
}

/// Brings the motion to rest after an interruption. The goal fails, unless the motion has ended by
/// itself in the meantime.
async fn interrupted<L: Lockstep>(
    hands: &Hands,
    interrupt: &Interrupt,
    why: Why,
) -> Result<L::Result, Fault> {
    let stopped = hands.clone();
    let (outcome, granted_s, rest_s) = computed(move || {
        // Time has stood still since the end of the last granted period.
        let granted_s = lock(&stopped.world).sim_time_s();
        let outcome = run_to_rest::<L>(&stopped, why);
        let rest_s = lock(&stopped.world).sim_time_s();
        (outcome, granted_s, rest_s)
    })
    .await?;
    let mut fault = match outcome {
        Err(fault) => fault,
        // The motion ended by itself in the last period; the goal is void all the same.
        Ok(_) => interrupt
            .to_fault(HARDWARE)
            .unwrap_or_else(nothing_under_way),
    };
    if let Interrupt::Overdue { waited_ms } = interrupt {
        fault = fault.with("waited_ms", *waited_ms as f64);
    }
    Err(fault.with("since_last_beat_ms", (rest_s - granted_s) * 1e3))
}

/// Stops the motion and grants time until it is at rest.
fn run_to_rest<L: Lockstep>(hands: &Hands, why: Why) -> Result<L::Result, Fault> {
    L::stop(&mut lock(&hands.world), why);
    loop {
        match hands.grant() {
            Advance::Moving => {}
            Advance::Idle => return Err(nothing_under_way()),
            ended => return L::ended(ended).unwrap_or_else(|| Err(nothing_under_way())),
        }
    }
}
