//! A part as a process of its own.
//!
//! The child says `READY <locator>` on its standard output once it is present. It lives as long as
//! its standard input is open: the end of the parent, however it comes, closes it. A Ctrl-C on the
//! terminal reaches the parent only, which then stops its children in order.

use super::LaunchError;
use crate::scenario::LoadedScenario;
use rover_messages::keys::service;
use std::{path::Path, process::Stdio, time::Duration};
use tokio::{
    io::{AsyncBufReadExt, BufReader},
    process::Command,
    time::timeout,
};

/// First word of the line by which a child says that it is present, followed by its endpoint.
pub const READY: &str = "READY";

const SCENARIO_FILE: &str = "scenario.toml";
const ROBOT_FILE: &str = "robot.toml";

/// A running child.
#[derive(Debug)]
pub(super) struct Child {
    pub(super) name: String,
    pub(super) locator: String,
    process: tokio::process::Child,
}

/// Writes the effective scenario and its robot to a new folder, as the children read them.
pub(super) fn write_files(loaded: &LoadedScenario) -> Result<tempfile::TempDir, LaunchError> {
    let error = |message: String| LaunchError::process("files for the processes", message);
    let folder = tempfile::tempdir().map_err(|e| error(e.to_string()))?;
    let mut scenario = loaded.scenario.clone();
    scenario.robot = ROBOT_FILE.into();
    let text = scenario.to_toml().map_err(|e| error(e.to_string()))?;
    for (name, text) in [(SCENARIO_FILE, &text), (ROBOT_FILE, &loaded.robot_text)] {
        let path = folder.path().join(name);
        std::fs::write(&path, text).map_err(|e| error(format!("{}: {e}", path.display())))?;
    }
    Ok(folder)
}

/// The command line of a part.
pub(super) fn command(
    program: &Path,
    name: &str,
    files: &Path,
    seed: u64,
    realtime: bool,
    connect: &[String],
) -> Command {
    let mut command = Command::new(program);
    command.args(["service", name, "--ready", "--listen", "tcp/127.0.0.1:0"]);
    for endpoint in connect {
        command.args(["--connect", endpoint]);
    }
    if name == service::HARDWARE {
        command.arg("--scenario").arg(files.join(SCENARIO_FILE));
        command.args(["--seed", &seed.to_string()]);
        if realtime {
            command.arg("--realtime");
        }
    } else {
        command.arg("--robot").arg(files.join(ROBOT_FILE));
    }
    command
}

impl Child {
    /// Starts the process and waits until it is ready.
    pub(super) async fn start(
        name: &str,
        mut command: Command,
        limit: Duration,
    ) -> Result<Self, LaunchError> {
        command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .kill_on_drop(true);
        #[cfg(unix)]
        command.process_group(0);
        let error = |message: String| LaunchError::process(name, message);
        let mut process = command
            .spawn()
            .map_err(|e| error(format!("cannot be started: {e}")))?;
        let stdout = process
            .stdout
            .take()
            .ok_or_else(|| error("has no output".into()))?;
        let mut lines = BufReader::new(stdout).lines();
        let ready = async {
            while let Some(line) = lines.next_line().await.map_err(|e| error(e.to_string()))? {
                if let Some(locator) = line.strip_prefix(READY) {
                    return Ok(locator.trim().to_owned());
                }
            }
            let status = process.wait().await.map_err(|e| error(e.to_string()))?;
            Err(error(format!("ended before it was ready: {status}")))
        };
        let locator = timeout(limit, ready).await.map_err(|_| {
            error(format!(
                "not ready after limits.start_s = {} s",
                limit.as_secs_f64()
            ))
        })??;
        Ok(Self {
            name: name.into(),
            locator,
            process,
        })
    }

    /// The process id, while it runs.
    pub(super) fn id(&self) -> Option<u32> {
        self.process.id()
    }

    /// Closes the child's input and waits for its end; one that takes too long is killed.
    pub(super) async fn stop(mut self, limit: Duration) {
        drop(self.process.stdin.take());
        match timeout(limit, self.process.wait()).await {
            Ok(Ok(status)) if status.success() => {}
            Ok(Ok(status)) => tracing::warn!(name = self.name, %status, "process failed"),
            Ok(Err(error)) => tracing::warn!(name = self.name, %error, "process was lost"),
            Err(_) => {
                tracing::warn!(
                    name = self.name,
                    "process did not stop in time and is killed"
                );
                if let Err(error) = self.process.kill().await {
                    tracing::warn!(name = self.name, %error, "process could not be killed");
                }
            }
        }
    }
}
