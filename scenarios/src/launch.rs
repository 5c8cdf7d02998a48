//! Starts simulator and services, waits until all are present, and stops them again.
//!
//! In one process every part has a Zenoh session of its own; with [`Mode::Processes`] every part
//! is a process of its own, this same binary run as `rover service NAME`. Either way each peer
//! connects to the endpoints of all that were started before it, which makes the full mesh that
//! peers need, and nothing goes on before the presence of all is seen.

mod child;
mod part;

use crate::{
    placement::{Abort, RUNNER},
    scenario::LoadedScenario,
};
use child::Child;
use rover_bus::{BusError, NetworkConfig, Peer, Presence, Role};
use rover_messages::{Fault, keys::service};
use rover_robot::Robot;
use std::{path::PathBuf, time::Duration};

pub use child::READY;
pub use part::{Part, serve_hardware, serve_service};

/// Why a system could not be started.
#[derive(Debug, thiserror::Error)]
pub enum LaunchError {
    /// The network refused.
    #[error("{name}: {error}")]
    Bus {
        /// Which part.
        name: String,
        /// What the bus said.
        error: Box<BusError>,
    },
    /// No service of that name.
    #[error("no service named `{name}`; there are: {known}")]
    UnknownService {
        /// The name.
        name: String,
        /// The names there are.
        known: String,
    },
    /// The simulated world could not be made of the scenario.
    #[error("{0}")]
    World(#[from] rover_sim::SimulationError),
    /// A process could not be started, or ended before it was ready.
    #[error("process of {name}: {message}")]
    Process {
        /// Which part.
        name: String,
        /// What happened.
        message: String,
    },
}

impl LaunchError {
    pub(crate) fn bus(name: &str) -> impl Fn(BusError) -> Self {
        move |error| Self::Bus {
            name: name.into(),
            error: Box::new(error),
        }
    }

    fn process(name: &str, message: impl Into<String>) -> Self {
        Self::Process {
            name: name.into(),
            message: message.into(),
        }
    }

    /// Whether the scenario is at fault, not the machine.
    pub fn is_bad_input(&self) -> bool {
        matches!(self, Self::UnknownService { .. } | Self::World(_))
    }
}

/// Where the parts run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Mode {
    /// All in this process, each with its own session.
    InProcess,
    /// Each in a process of its own, started from this program.
    Processes {
        /// The `rover` binary.
        program: PathBuf,
    },
}

/// How to start a system.
#[derive(Clone, Debug)]
pub struct LaunchOptions {
    /// Where the parts run.
    pub mode: Mode,
    /// Endpoints for outside clients, besides the loopback ports among the parts.
    pub listen: Vec<String>,
    /// Whether simulated time is held back to the wall clock.
    pub realtime: bool,
}

impl Default for LaunchOptions {
    fn default() -> Self {
        Self {
            mode: Mode::InProcess,
            listen: Vec::new(),
            realtime: false,
        }
    }
}

/// A running system: simulator, services, and the runner's own peer.
pub struct System {
    peer: Peer,
    presence: Option<Presence>,
    /// In starting order.
    parts: Vec<Running>,
    /// Files that child processes read; removed at the end.
    _files: Option<tempfile::TempDir>,
    stop_limit: Duration,
}

enum Running {
    Here { peer: Peer, part: Part },
    Process(Box<Child>),
}

/// All parts there are, in starting order: the hardware, then the services.
pub fn part_names() -> impl Iterator<Item = &'static str> {
    std::iter::once(service::HARDWARE)
        .chain(service::ALL)
        .chain([service::ROVER_APPROACH])
}

/// The parts that a robot needs, in starting order: the approach only if it drives.
pub fn parts_of(robot: &Robot) -> impl Iterator<Item = &'static str> {
    let drives = robot.mobility().is_ok() && robot.mast().is_ok();
    part_names().filter(move |name| drives || *name != service::ROVER_APPROACH)
}

impl System {
    /// Starts everything and waits until all are present.
    ///
    /// # Errors
    /// [`LaunchError`]; whatever had been started is stopped again.
    pub async fn start(
        loaded: &LoadedScenario,
        options: &LaunchOptions,
    ) -> Result<Self, LaunchError> {
        let limits = &loaded.scenario.limits;
        let files = match options.mode {
            Mode::InProcess => None,
            Mode::Processes { .. } => Some(child::write_files(loaded)?),
        };
        let mut parts = Vec::new();
        let mut endpoints: Vec<String> = Vec::new();
        for name in parts_of(&loaded.robot) {
            let started = match (&options.mode, &files) {
                (Mode::Processes { program }, Some(files)) => {
                    let command = child::command(
                        program,
                        name,
                        files.path(),
                        loaded.scenario.seed,
                        options.realtime,
                        &endpoints,
                    );
                    Child::start(name, command, limits.start())
                        .await
                        .map(|child| {
                            endpoints.push(child.locator.clone());
                            Running::Process(Box::new(child))
                        })
                }
                _ => here(name, loaded, options.realtime, &mut endpoints).await,
            };
            match started {
                Ok(part) => parts.push(part),
                Err(error) => {
                    stop_parts(parts, limits.stop()).await;
                    return Err(error);
                }
            }
        }
        match runner(loaded, options, &endpoints).await {
            Ok((peer, presence)) => Ok(Self {
                peer,
                presence: Some(presence),
                parts,
                _files: files,
                stop_limit: limits.stop(),
            }),
            Err(error) => {
                stop_parts(parts, limits.stop()).await;
                Err(error)
            }
        }
    }

    /// The runner's peer, announced as [`RUNNER`].
    pub fn peer(&self) -> &Peer {
        &self.peer
    }

    /// From now on the loss of any part aborts the run with a reason that names it. Ends when the
    /// returned task is aborted or the system stops.
    ///
    /// # Errors
    /// [`LaunchError::Bus`].
    pub async fn watch_losses(
        &self,
        abort: Abort,
    ) -> Result<tokio::task::JoinHandle<()>, LaunchError> {
        let mut watcher = self
            .peer
            .watch_presence()
            .await
            .map_err(LaunchError::bus(RUNNER))?;
        Ok(tokio::spawn(async move {
            while let Some((name, alive)) = watcher.next().await {
                if !alive && part_names().any(|part| part == name) {
                    let message = format!("{name} has left the network during the run");
                    abort.now(Fault::new(RUNNER, "service_lost", message));
                }
            }
        }))
    }

    /// Process ids of the parts that run as processes, with their names.
    pub fn processes(&self) -> Vec<(String, u32)> {
        let ids = self.parts.iter().filter_map(|part| match part {
            Running::Process(child) => Some((child.name.clone(), child.id()?)),
            Running::Here { .. } => None,
        });
        ids.collect()
    }

    /// Stops everything in the reverse order of its start.
    pub async fn stop(mut self) {
        self.presence = None;
        let limit = self.stop_limit;
        stop_parts(std::mem::take(&mut self.parts), limit).await;
        close(self.peer.clone(), limit).await;
    }
}

/// The runner's peer, after all parts are present.
async fn runner(
    loaded: &LoadedScenario,
    options: &LaunchOptions,
    endpoints: &[String],
) -> Result<(Peer, Presence), LaunchError> {
    let error = LaunchError::bus(RUNNER);
    let mut config = NetworkConfig::new(loaded.robot.name(), RUNNER, Role::Runner, endpoints);
    config.listen.clone_from(&options.listen);
    let peer = Peer::open(config).await.map_err(&error)?;
    let names: Vec<_> = parts_of(&loaded.robot).collect();
    let limit = loaded.scenario.limits.start();
    let announced = async {
        peer.await_presence(&names, limit).await?;
        peer.announce().await
    };
    match announced.await {
        Ok(presence) => Ok((peer, presence)),
        Err(e) => {
            close(peer, loaded.scenario.limits.stop()).await;
            Err(error(e))
        }
    }
}

/// A part in this process.
async fn here(
    name: &'static str,
    loaded: &LoadedScenario,
    realtime: bool,
    endpoints: &mut Vec<String>,
) -> Result<Running, LaunchError> {
    let role = if name == service::HARDWARE {
        Role::Simulator
    } else {
        Role::Service
    };
    let config = NetworkConfig::new(loaded.robot.name(), name, role, endpoints);
    let peer = Peer::open(config).await.map_err(LaunchError::bus(name))?;
    endpoints.extend(peer.locators().await);
    let part = if name == service::HARDWARE {
        serve_hardware(&peer, loaded, realtime).await
    } else {
        serve_service(name, &peer, loaded.robot.clone()).await
    };
    match part {
        Ok(part) => Ok(Running::Here { peer, part }),
        Err(error) => {
            close(peer, loaded.scenario.limits.stop()).await;
            Err(error)
        }
    }
}

async fn stop_parts(mut parts: Vec<Running>, limit: Duration) {
    while let Some(part) = parts.pop() {
        match part {
            Running::Process(child) => child.stop(limit).await,
            Running::Here { peer, part } => {
                drop(part);
                close(peer, limit).await;
            }
        }
    }
}

/// Closes a session; one that does not close in time is left to the end of the process.
pub(crate) async fn close(peer: Peer, limit: Duration) {
    let name = peer.name().to_owned();
    if tokio::time::timeout(limit, peer.close()).await.is_err() {
        tracing::warn!(name, "the session did not close in time");
    }
}
