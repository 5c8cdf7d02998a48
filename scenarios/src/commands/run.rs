//! `rover run`: one scenario, end to end.

use super::{CommandError, Exit, watch};
use crate::{
    embedded, html,
    launch::{LaunchOptions, Mode, System},
    output::{Output, print},
    placement::{Abort, Mission},
    progress::TerminalProgress,
    report::Outcome,
    scenario::LoadedScenario,
};
use anyhow::Context;
use std::path::{Path, PathBuf};

/// Runs one scenario, end to end: starts simulator and services, runs, reports, stops
#[derive(Clone, Debug, clap::Args)]
pub struct RunArgs {
    /// Scenario file; a path on disk wins over a shipped file of the same name
    #[arg(default_value = embedded::DEFAULT_SCENARIO)]
    pub scenario: String,
    /// Seed, instead of the scenario's own
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
    /// Replaces one field by a TOML value, e.g. servo.method=epec; may be repeated
    #[arg(long, value_name = "PATH=VALUE")]
    pub set: Vec<String>,
    /// Draws the fields that the scenario's campaign varies from the seed, as `rover campaign`
    /// does
    #[arg(long)]
    pub varied: bool,
    /// Writes the report as JSON; `-` is standard output
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Writes a page with pictures and numbers into this folder
    #[arg(long, value_name = "DIR")]
    pub report: Option<PathBuf>,
    /// Runs every part as a process of its own (default: all in this one, each with its own
    /// Zenoh session)
    #[arg(long)]
    pub processes: bool,
    /// Paces the simulation by the wall clock
    #[arg(long)]
    pub realtime: bool,
    /// Overwrites outputs that exist
    #[arg(long)]
    pub force: bool,
    /// Writes the effective scenario, every default filled in, and runs nothing
    #[arg(long)]
    pub print: bool,
}

const PAGE: &str = "index.html";

/// Runs the command.
///
/// # Errors
/// [`CommandError`].
pub async fn run(args: RunArgs) -> Result<Exit, CommandError> {
    let load = if args.varied {
        LoadedScenario::load_varied
    } else {
        LoadedScenario::load
    };
    let loaded = load(&args.scenario, &args.set, args.seed)?;
    if args.print {
        print(&loaded.scenario.to_toml()?)?;
        return Ok(Exit::Done);
    }
    let json = args
        .json
        .as_deref()
        .map(|p| Output::open(p, args.force))
        .transpose()?;
    let page = args
        .report
        .as_deref()
        .map(|p| page(p, args.force))
        .transpose()?;
    let mode = if args.processes {
        let program = std::env::current_exe().context("path of the rover binary")?;
        Mode::Processes { program }
    } else {
        Mode::InProcess
    };
    let options = LaunchOptions {
        mode,
        listen: Vec::new(),
        realtime: args.realtime,
    };

    let mut progress = TerminalProgress::default();
    progress.say("starting simulator and services");
    let system = System::start(&loaded, &options).await?;
    let abort = Abort::default();
    let watching = watch(&system, &abort).await?;
    let mission = Mission::new(
        system.peer(),
        &loaded.scenario,
        &loaded.robot,
        abort,
        &mut progress,
        page.is_some(),
    );
    let (report, evidence) = mission.run().await;
    // From here on parts leave because they are told to.
    watching.iter().for_each(tokio::task::JoinHandle::abort);
    progress.say("stopping");
    system.stop().await;
    progress.finish();

    let report = report.sealed()?;
    if let Some(output) = &json {
        output.write(&report.to_json()?)?;
    }
    if let (Some(page), Some(evidence)) = (&page, &evidence) {
        page.write(&html::page(&report, evidence, &loaded)?)?;
    }
    if json != Some(Output::Stdout) {
        print(&report.summary())?;
    }
    Ok(match report.outcome {
        Outcome::Placed => Exit::Done,
        Outcome::Aborted => Exit::Aborted,
    })
}

fn page(folder: &Path, force: bool) -> Result<Output, CommandError> {
    if folder.exists() && !folder.is_dir() {
        let message = format!(
            "--report {}: is a file, expected a folder",
            folder.display()
        );
        return Err(CommandError::BadInput(message));
    }
    Ok(Output::open(&folder.join(PAGE), force)?)
}
