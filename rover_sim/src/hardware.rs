//! The simulator on the bus: the keys that a robot's hardware offers, and the simulator's own
//! under `sim/`.
//!
//! Simulated time passes only in the heartbeat periods that the commander of `arm/execute`,
//! `wheels/drive` or `mast/point` grants (and, in real time, by the wall clock). A commander that is lost, late or calls the goal off
//! has the arm stopped in the very control step that it last granted, so the stop is the same
//! every time, whatever the machine's load.

mod lockstep;

use crate::world::{Advance, World, lock};
use lockstep::{Arm, Mast, Wheels};
use rover_bus::{BusError, Peer, Stream};
use rover_messages::{
    Fault, Nothing,
    arm::{ArmState, StopReason},
    imaging::CaptureRequest,
    keys::{self, service::HARDWARE},
    mobility::{DriveStop, MastState, WheelsState},
    simulation::{
        DesignateRequest, InjectedFault, PickRequest, ScoreRequest, StepRequest, ViewRequest,
    },
    status::work,
};
use rover_service::{Service, ServiceShell};
use std::{
    sync::{Arc, Mutex},
    time::Duration,
};
use tokio::{task::JoinHandle, time::Instant};

/// In real time nobody may be waited for longer than this.
const REALTIME_BEAT_LIMIT: Duration = Duration::from_secs(1);

/// How the simulator runs.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    /// Simulated time keeps pace with the wall clock, also while no motion is under way.
    pub realtime: bool,
    /// Wall-clock limit for a commander's next heartbeat.
    pub beat_limit: Duration,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            realtime: false,
            beat_limit: Duration::from_secs(10),
        }
    }
}

/// The running simulator; it ends when this is dropped.
#[must_use = "the simulator ends when its handle is dropped"]
pub struct Hardware {
    service: Service,
    hands: Hands,
    ticker: Option<JoinHandle<()>>,
}

impl Hardware {
    /// The simulator's bookkeeping on the bus.
    pub fn shell(&self) -> &ServiceShell {
        self.service.shell()
    }

    /// Looks at the world itself; for tests and tools in the same process.
    pub fn with_world<T>(&self, look: impl FnOnce(&mut World) -> T) -> T {
        look(&mut lock(&self.hands.world))
    }
}

impl Drop for Hardware {
    fn drop(&mut self) {
        if let Some(ticker) = &self.ticker {
            ticker.abort();
        }
    }
}

/// What every handler shares.
#[derive(Clone)]
struct Hands {
    world: Arc<Mutex<World>>,
    states: Arc<Stream<ArmState>>,
    masts: Option<Arc<Stream<MastState>>>,
    wheels: Option<Arc<Stream<WheelsState>>>,
    shell: ServiceShell,
    pace: Option<Pace>,
}

/// Wall clock and simulated time at the start of pacing.
#[derive(Clone, Copy)]
struct Pace {
    since: Instant,
    sim_time_s: f64,
}

impl Pace {
    fn due(&self, sim_time_s: f64) -> Instant {
        self.since + Duration::from_secs_f64((sim_time_s - self.sim_time_s).max(0.0))
    }
}

/// Puts a world on the bus as the robot's hardware.
///
/// # Errors
/// [`BusError`] when a key cannot be declared or the hardware is present already.
pub async fn serve(peer: &Peer, world: World, options: Options) -> Result<Hardware, BusError> {
    let robot = world.robot().clone();
    let shell = ServiceShell::new(peer, &robot, HARDWARE).await?;
    let states = Arc::new(peer.stream(keys::ARM_STATE).await?);
    let d = robot.description();
    let masts = match d.mast {
        Some(_) => Some(Arc::new(peer.stream(keys::MAST_STATE).await?)),
        None => None,
    };
    let wheels = match d.mobility {
        Some(_) => Some(Arc::new(peer.stream(keys::WHEELS_STATE).await?)),
        None => None,
    };
    let pace = options.realtime.then(|| Pace {
        since: Instant::now(),
        sim_time_s: world.sim_time_s(),
    });
    let hands = Hands {
        world: Arc::new(Mutex::new(world)),
        states,
        masts,
        wheels,
        shell: shell.clone(),
        pace,
    };
    hands.publish();
    let beat_limit = if options.realtime {
        options.beat_limit.min(REALTIME_BEAT_LIMIT)
    } else {
        options.beat_limit
    };
    let mut served = vec![lockstep::serve::<Arm>(peer, &hands, beat_limit).await?];
    if d.mast.is_some() {
        served.push(lockstep::serve::<Mast>(peer, &hands, beat_limit).await?);
    }
    if d.mobility.is_some() {
        served.push(lockstep::serve::<Wheels>(peer, &hands, beat_limit).await?);
        let stop = |hands: &Hands, _: Nothing| {
            lock(&hands.world).stop_drive(DriveStop::StopCommand);
            hands.publish();
            lock(&hands.world)
                .wheels_state()
                .ok_or_else(nothing_under_way)
        };
        served.push(hands.query(peer, keys::WHEELS_STOP, "stops", stop).await?);
    }
    served.push(
        hands
            .query(peer, keys::ARM_STOP, "stops", |hands, _: Nothing| {
                lock(&hands.world).stop(StopReason::StopCommand);
                Ok(hands.publish())
            })
            .await?,
    );
    for pair in &robot.description().cameras {
        let name = pair.name.clone();
        let grab = move |hands: &Hands, request: CaptureRequest| {
            let (eyes, moment) = hands.look();
            hands.shell.timed(work::RENDERING, || {
                lock(&eyes).grab(&moment, &name, request.exposure_n)
            })
        };
        served.push(
            hands
                .query(peer, &keys::camera_grab(&pair.name), "grabs", grab)
                .await?,
        );
    }
    served.extend(simulation_keys(peer, &hands).await?);
    let ticker = pace.map(|pace| tokio::spawn(idle(hands.clone(), pace)));
    Ok(Hardware {
        service: shell.start(served).await?,
        hands,
        ticker,
    })
}

/// The keys under `sim/`.
async fn simulation_keys(peer: &Peer, hands: &Hands) -> Result<Vec<rover_bus::Served>, BusError> {
    Ok(vec![
        hands
            .query(
                peer,
                keys::SIM_TRUTH_SCORE,
                "scores",
                |hands, request: ScoreRequest| lock(&hands.world).score(&request),
            )
            .await?,
        hands
            .query(
                peer,
                keys::SIM_TRUTH_DESIGNATE,
                "designations",
                |hands, request: DesignateRequest| {
                    let mut world = lock(&hands.world);
                    let surface = world
                        .designate(&request.pair, request.pixel_px)
                        .map_err(|e| Fault::new(HARDWARE, "no_surface", e.to_string()))?;
                    Ok(world.true_place(&surface))
                },
            )
            .await?,
        hands
            .query(
                peer,
                keys::SIM_TRUTH_PICK,
                "picks",
                |hands, request: PickRequest| lock(&hands.world).pick(&request),
            )
            .await?,
        hands
            .query(
                peer,
                keys::SIM_TRUTH_STATE,
                "truths",
                |hands, _: Nothing| Ok(lock(&hands.world).truth_state()),
            )
            .await?,
        hands
            .query(
                peer,
                keys::SIM_TRUTH_VIEW,
                "views",
                |hands, request: ViewRequest| {
                    let (eyes, moment) = hands.look();
                    hands
                        .shell
                        .timed(work::RENDERING, || lock(&eyes).view(&moment, &request))
                },
            )
            .await?,
        hands
            .query(
                peer,
                keys::SIM_FAULT_INJECT,
                "injections",
                |hands, fault: InjectedFault| {
                    lock(&hands.world).inject(&fault)?;
                    hands.publish();
                    Ok(Nothing {})
                },
            )
            .await?,
        hands
            .query(
                peer,
                keys::SIM_STEP,
                "steps",
                |hands, request: StepRequest| hands.step_idle(request.periods_n),
            )
            .await?,
        hands
            .query(peer, keys::SIM_RESET, "resets", |hands, _: Nothing| {
                let mut world = lock(&hands.world);
                world.reset()?;
                drop(world);
                Ok(hands.publish())
            })
            .await?,
    ])
}

impl Hands {
    /// Serves a query whose handler computes: it runs beside the asynchronous runtime.
    async fn query<Q, A, F>(
        &self,
        peer: &Peer,
        key: &str,
        counter: &'static str,
        answer: F,
    ) -> Result<rover_bus::Served, BusError>
    where
        Q: rover_messages::Wire,
        A: rover_messages::Wire,
        F: Fn(&Hands, Q) -> Result<A, Fault> + Send + Sync + 'static,
    {
        let answer = Arc::new(answer);
        let hands = self.clone();
        peer.serve(key, move |question: Q| {
            let (hands, answer) = (hands.clone(), answer.clone());
            async move {
                let shell = hands.shell.clone();
                let outcome = computed(move || answer(&hands, question)).await.flatten();
                shell.answered(outcome, counter)
            }
        })
        .await
    }

    /// The cameras and what is before them now.
    fn look(&self) -> (Arc<Mutex<crate::Eyes>>, crate::Moment) {
        let world = lock(&self.world);
        (world.eyes(), world.moment())
    }

    /// Publishes the states of arm, mast and wheels and returns the arm's.
    fn publish(&self) -> ArmState {
        // Published under the world's lock: states appear in the order of their steps.
        let world = lock(&self.world);
        let state = world.state();
        if let Err(error) = self.states.publish(state.clone()) {
            tracing::warn!(%error, "the arm's state could not be published");
        }
        if let (Some(stream), Some(mast)) = (&self.masts, world.mast_state())
            && let Err(error) = stream.publish(mast)
        {
            tracing::warn!(%error, "the mast's state could not be published");
        }
        if let (Some(stream), Some(wheels)) = (&self.wheels, world.wheels_state())
            && let Err(error) = stream.publish(wheels)
        {
            tracing::warn!(%error, "the wheels' state could not be published");
        }
        state
    }

    /// Grants one heartbeat period to the world and tells what came of it.
    fn grant(&self) -> Advance {
        let mut world = lock(&self.world);
        let before = world.collision();
        let advance = self.shell.timed(work::PHYSICS, || world.advance(1));
        let collision = world.collision().filter(|_| before.is_none());
        drop(world);
        if let Some(c) = collision {
            let message = format!("link {} of the arm touches something solid", c.link_n);
            let fault = Fault::new(HARDWARE, "uncontrolled_contact", message)
                .with("link_n", c.link_n as f64)
                .with("force_n", c.force_n)
                .with("sim_time_s", c.sim_time_s);
            self.shell
                .fault(&fault, "none: the driver does not feel it");
        }
        self.publish();
        advance
    }

    /// Lets time pass while no motion is under way.
    fn step_idle(&self, periods: u32) -> Result<ArmState, Fault> {
        let mut world = lock(&self.world);
        if world.is_moving() {
            let message = "a motion is under way; its commander's heartbeats are the clock";
            return Err(Fault::new(HARDWARE, "busy", message));
        }
        world.advance(periods);
        drop(world);
        Ok(self.publish())
    }
}

/// Runs computing beside the asynchronous runtime.
async fn computed<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, Fault> {
    tokio::task::spawn_blocking(work)
        .await
        .map_err(|e| Fault::new(HARDWARE, "internal_error", e.to_string()))
}

fn nothing_under_way() -> Fault {
    Fault::new(HARDWARE, "internal_error", "no motion is under way")
}

/// In real time: lets time pass while no motion is under way.
async fn idle(hands: Hands, pace: Pace) {
    let period_s = lock(&hands.world).robot().description().arm.heartbeat_s;
    loop {
        let next = {
            let world = lock(&hands.world);
            if world.is_moving() {
                Instant::now() + Duration::from_secs_f64(period_s)
            } else {
                pace.due(world.sim_time_s() + period_s)
            }
        };
        tokio::time::sleep_until(next).await;
        let ticking = hands.clone();
        // A motion has its own clock; a step that is refused because of one is no fault.
        let _ = computed(move || ticking.step_idle(1)).await;
    }
}
