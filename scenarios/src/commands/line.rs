//! The command line as a whole. It is part of the library so that everything that it waits for
//! is compiled there, once, and not again with each binary.

use super::{
    CommandError, Exit, arm, camera, campaign, doctor, inspect, run, service, study, up, vision,
};
use clap::{Parser, Subcommand};
use std::{io::IsTerminal, process::ExitCode};
use tracing_subscriber::EnvFilter;

/// Places a rover's instrument on a target that is named with one pixel
///
/// Data goes to standard output, messages to standard error. Exit codes: 0 done, 1 internal
/// failure, 2 bad input, 3 the mission ended safely without placing the instrument.
#[derive(Parser)]
#[command(name = "rover", version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Run(run::RunArgs),
    Up(up::UpArgs),
    Campaign(campaign::CampaignArgs),
    Service(service::ServiceArgs),
    Inspect(inspect::InspectArgs),
    Arm(arm::ArmArgs),
    Camera(camera::CameraArgs),
    Vision(vision::VisionArgs),
    Doctor(doctor::DoctorArgs),
    Study(study::StudyArgs),
}

/// Reads the arguments of this process and runs the command.
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    let filter =
        EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("warn,zenoh=error"));
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_ansi(std::io::stderr().is_terminal())
        .with_writer(std::io::stderr)
        .init();
    let runtime = match tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
    {
        Ok(runtime) => runtime,
        Err(e) => {
            eprintln!("rover: the runtime cannot be started: {e}");
            return Exit::Failed.into();
        }
    };
    let done = runtime.block_on(execute(cli.command));
    // A read of standard input may still wait for its next line; nobody waits for it.
    runtime.shutdown_background();
    match done {
        Ok(exit) => exit.into(),
        Err(error) => {
            eprintln!("rover: {error}");
            error.exit().into()
        }
    }
}

async fn execute(command: Command) -> Result<Exit, CommandError> {
    match command {
        Command::Run(args) => run::run(args).await,
        Command::Up(args) => up::run(args).await,
        Command::Campaign(args) => campaign::run(args).await,
        Command::Service(args) => service::run(args).await,
        Command::Inspect(args) => inspect::run(args).await,
        Command::Arm(args) => arm::run(args),
        Command::Camera(args) => camera::run(args),
        Command::Vision(args) => vision::run(args).await,
        Command::Doctor(args) => doctor::run(args).await,
        Command::Study(args) => study::run(&args),
    }
}
