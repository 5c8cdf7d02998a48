//! `rover service`: one part alone as a process.

use super::{CommandError, Exit, interrupted};
use crate::{
    embedded,
    launch::{LaunchError, READY, close, part_names, serve_hardware, serve_service},
    output::print,
    scenario::{LoadedScenario, load_robot},
};
use rover_bus::{NetworkConfig, Peer, Role};
use rover_messages::keys::service;
use std::{path::PathBuf, time::Duration};
use tokio::io::AsyncReadExt;

/// Runs one service alone as its own process, until Ctrl-C
///
/// Peers do not pass on messages between other peers: name every other part with --connect, or
/// start this one first and let the others connect to it.
#[derive(Clone, Debug, clap::Args)]
pub struct ServiceArgs {
    /// mast_imaging, target_selection, arm_planner, epec_servo, contact_approach, or rover_sim
    /// for the simulated hardware
    pub name: String,
    /// Robot file, for a service; a path on disk wins over a shipped file of the same name
    #[arg(
        long,
        value_name = "FILE",
        default_value = "scenarios/robots/bluestreak.toml"
    )]
    pub robot: String,
    /// Scenario file, for rover_sim
    #[arg(long, value_name = "FILE", default_value = embedded::DEFAULT_SCENARIO)]
    pub scenario: String,
    /// Seed, for rover_sim, instead of the scenario's own
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
    /// Replaces one field of the scenario by a TOML value, for rover_sim; may be repeated
    #[arg(long, value_name = "PATH=VALUE")]
    pub set: Vec<String>,
    /// Paces the simulation by the wall clock, for rover_sim
    #[arg(long)]
    pub realtime: bool,
    /// Endpoint of another part to connect to; may be repeated
    #[arg(long, value_name = "ENDPOINT")]
    pub connect: Vec<String>,
    /// Endpoint to listen on (default: a free loopback port); may be repeated
    #[arg(long, value_name = "ENDPOINT")]
    pub listen: Vec<String>,
    /// Zenoh configuration file (JSON5) in place of the defaults
    #[arg(long, value_name = "FILE")]
    pub zenoh: Option<PathBuf>,
    /// For a parent process: writes `READY <endpoint>` to standard output when present, and ends
    /// when standard input does
    #[arg(long)]
    pub ready: bool,
}

const STOP_LIMIT: Duration = Duration::from_secs(5);

/// Runs the command.
///
/// # Errors
/// [`CommandError`].
pub async fn run(args: ServiceArgs) -> Result<Exit, CommandError> {
    let name = part_names()
        .find(|part| *part == args.name)
        .ok_or_else(|| LaunchError::UnknownService {
            name: args.name.clone(),
            known: part_names().collect::<Vec<_>>().join(", "),
        })?;
    let hardware = if name == service::HARDWARE {
        Some(LoadedScenario::load(&args.scenario, &args.set, args.seed)?)
    } else {
        None
    };
    let robot = match &hardware {
        Some(loaded) => loaded.robot.clone(),
        None => load_robot(&args.robot)?,
    };
    let role = if hardware.is_some() {
        Role::Simulator
    } else {
        Role::Service
    };
    let mut config = NetworkConfig::new(robot.name(), name, role, &args.connect);
    config.listen = args.listen;
    config.file = args.zenoh;
    let peer = Peer::open(config).await.map_err(LaunchError::bus(name))?;
    let part = match &hardware {
        Some(loaded) => serve_hardware(&peer, loaded, args.realtime).await?,
        None => serve_service(name, &peer, robot).await?,
    };
    let locators = peer.locators().await;
    if args.ready {
        let locator = locators.first().map(String::as_str).unwrap_or_default();
        print(&format!("{READY} {locator}\n"))?;
        tokio::select! {
            () = input_ended() => {}
            _ = interrupted() => {}
        }
    } else {
        eprintln!(
            "{name} is present on {}; Ctrl-C ends it",
            locators.join(", ")
        );
        interrupted().await;
    }
    drop(part);
    close(peer, STOP_LIMIT).await;
    Ok(Exit::Done)
}

/// Completes when standard input ends, whatever comes before.
async fn input_ended() {
    let mut input = tokio::io::stdin();
    let mut sink = [0; 256];
    while input.read(&mut sink).await.is_ok_and(|n| n > 0) {}
}
