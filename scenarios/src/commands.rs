//! The verbs of the command line, one file each.

pub mod arm;
pub mod camera;
pub mod campaign;
pub mod doctor;
pub mod inspect;
mod line;
pub mod run;
pub mod service;
pub mod study;
pub mod up;
pub mod vision;

pub use line::main;

use crate::{
    html::PageError,
    launch::{LaunchError, System},
    output::OutputError,
    placement::{Abort, RUNNER},
    report::ReportError,
    scenario::ScenarioError,
    tables::TableError,
};
use rover_messages::Fault;
use std::process::ExitCode;

/// How a command ended; the exit code of the process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// Done.
    Done,
    /// Internal failure.
    Failed,
    /// Bad input.
    BadInput,
    /// The mission ended safely without placing the instrument.
    Aborted,
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(match exit {
            Exit::Done => 0,
            Exit::Failed => 1,
            Exit::BadInput => 2,
            Exit::Aborted => 3,
        })
    }
}

/// Why a command could not do its work.
#[derive(Debug, thiserror::Error)]
pub enum CommandError {
    /// What the user gave cannot be used.
    #[error("{0}")]
    BadInput(String),
    /// Anything else.
    #[error("{0:#}")]
    Internal(#[from] anyhow::Error),
}

impl CommandError {
    /// The exit code that belongs to it.
    pub fn exit(&self) -> Exit {
        match self {
            Self::BadInput(_) => Exit::BadInput,
            Self::Internal(_) => Exit::Failed,
        }
    }
}

impl From<ScenarioError> for CommandError {
    fn from(error: ScenarioError) -> Self {
        Self::BadInput(error.to_string())
    }
}

impl From<LaunchError> for CommandError {
    fn from(error: LaunchError) -> Self {
        if error.is_bad_input() {
            Self::BadInput(error.to_string())
        } else {
            Self::Internal(error.into())
        }
    }
}

impl From<ReportError> for CommandError {
    fn from(error: ReportError) -> Self {
        Self::Internal(error.into())
    }
}

impl From<PageError> for CommandError {
    fn from(error: PageError) -> Self {
        Self::Internal(error.into())
    }
}

impl From<OutputError> for CommandError {
    fn from(error: OutputError) -> Self {
        match error {
            _ if error.is_bad_input() => Self::BadInput(error.to_string()),
            // Its text ends with what the system said; as a chain it would say so twice.
            _ => Self::Internal(anyhow::Error::msg(error.to_string())),
        }
    }
}

impl From<TableError> for CommandError {
    fn from(error: TableError) -> Self {
        if error.is_bad_input() {
            Self::BadInput(error.to_string())
        } else {
            Self::Internal(error.into())
        }
    }
}

/// Completes when the user asks to end: Ctrl-C or a polite request to terminate.
pub(crate) async fn interrupted() -> &'static str {
    #[cfg(unix)]
    {
        use tokio::signal::unix::{SignalKind, signal};
        if let Ok(mut terminate) = signal(SignalKind::terminate()) {
            return tokio::select! {
                _ = terminate.recv() => "terminated from outside",
                heard = tokio::signal::ctrl_c() => ended_by(heard).await,
            };
        }
    }
    ended_by(tokio::signal::ctrl_c().await).await
}

async fn ended_by(heard: std::io::Result<()>) -> &'static str {
    if heard.is_err() {
        // Without a handler the system ends the process by itself.
        std::future::pending::<()>().await;
    }
    "interrupted by Ctrl-C"
}

/// From now on Ctrl-C, and the loss of any part, abort a run on `system`.
///
/// # Errors
/// [`LaunchError`] when presence cannot be watched.
pub(crate) async fn watch(
    system: &System,
    abort: &Abort,
) -> Result<[tokio::task::JoinHandle<()>; 2], LaunchError> {
    let losses = system.watch_losses(abort.clone()).await?;
    let abort = abort.clone();
    let signals = tokio::spawn(async move {
        let how = interrupted().await;
        abort.now(Fault::new(
            RUNNER,
            "interrupted",
            format!("the run was {how}"),
        ));
    });
    Ok([losses, signals])
}
