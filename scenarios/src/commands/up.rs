//! `rover up`: simulator and services, until Ctrl-C.

use super::{CommandError, Exit, watch};
use crate::{
    embedded,
    launch::{LaunchOptions, Mode, System},
    output::print,
    placement::Abort,
    scenario::LoadedScenario,
};
use anyhow::Context;

/// Starts simulator and services and stays until Ctrl-C
///
/// The endpoint for clients is written to standard output as soon as all are present; a client
/// that attaches there reaches all of them.
#[derive(Clone, Debug, clap::Args)]
pub struct UpArgs {
    /// Scenario file; a path on disk wins over a shipped file of the same name
    #[arg(default_value = embedded::DEFAULT_SCENARIO)]
    pub scenario: String,
    /// Seed, instead of the scenario's own
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
    /// Replaces one field by a TOML value, e.g. simulation.truth.angle_deg=0.5; may be repeated
    #[arg(long, value_name = "PATH=VALUE")]
    pub set: Vec<String>,
    /// Endpoint for clients; may be repeated
    #[arg(long, value_name = "ENDPOINT", default_value = "tcp/127.0.0.1:7447")]
    pub listen: Vec<String>,
    /// Runs every part as a process of its own
    #[arg(long)]
    pub processes: bool,
    /// Paces the simulation by the wall clock
    #[arg(long)]
    pub realtime: bool,
}

/// Runs the command.
///
/// # Errors
/// [`CommandError`]; also when a part is lost meanwhile.
pub async fn run(args: UpArgs) -> Result<Exit, CommandError> {
    let loaded = LoadedScenario::load(&args.scenario, &args.set, args.seed)?;
    let mode = if args.processes {
        let program = std::env::current_exe().context("path of the rover binary")?;
        Mode::Processes { program }
    } else {
        Mode::InProcess
    };
    let options = LaunchOptions {
        mode,
        listen: args.listen,
        realtime: args.realtime,
    };
    let system = System::start(&loaded, &options).await?;
    let abort = Abort::default();
    let watching = watch(&system, &abort).await?;
    for locator in system.peer().locators().await {
        print(&format!("{locator}\n"))?;
    }
    eprintln!(
        "`{}` is up with scenario `{}`; Ctrl-C ends it",
        loaded.robot.name(),
        loaded.scenario.name
    );
    let reason = abort.requested().await;
    watching.iter().for_each(tokio::task::JoinHandle::abort);
    system.stop().await;
    if reason.name == "interrupted" {
        return Ok(Exit::Done);
    }
    Err(CommandError::Internal(anyhow::anyhow!(
        "{}",
        reason.message
    )))
}
