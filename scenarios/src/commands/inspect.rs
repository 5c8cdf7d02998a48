//! `rover inspect`: a decoded view of the network as JSON lines.
//!
//! It only subscribes and reads streams: its questions always carry a wildcard, which no command
//! answers, so looking never moves anything.

use super::{CommandError, Exit, interrupted};
use crate::{output::print, registry::Registry};
use anyhow::anyhow;
use rover_bus::{NetworkConfig, Peer, Role};
use serde_json::{Value, json};
use std::{path::PathBuf, time::Duration};
use zenoh::{
    key_expr::KeyExpr,
    query::{ConsolidationMode, QueryTarget},
};

/// Shows what is on the network, decoded, as JSON lines; moves nothing
#[derive(Clone, Debug, clap::Args)]
pub struct InspectArgs {
    /// Keys inside the robot's namespace, e.g. arm/state or '*/status'
    #[arg(default_value = "**")]
    pub keyexpr: String,
    /// Writes the present values and ends, instead of following
    #[arg(long)]
    pub once: bool,
    /// Endpoint of any one part
    #[arg(long, value_name = "ENDPOINT", default_value = "tcp/127.0.0.1:7447")]
    pub connect: Vec<String>,
    /// Name of the robot, which is the namespace of its keys (default: bluestreak, or the
    /// namespace of the file given with --zenoh)
    #[arg(long, value_name = "NAME")]
    pub robot: Option<String>,
    /// Zenoh configuration file (JSON5) in place of the defaults
    #[arg(long, value_name = "FILE")]
    pub zenoh: Option<PathBuf>,
}

/// The robot that is looked at when none is named.
const DEFAULT_ROBOT: &str = "bluestreak";
/// Longest wait for the present values.
const READ_LIMIT: Duration = Duration::from_secs(10);
/// Samples that may wait to be written.
const WAITING: usize = 4096;

/// Runs the command.
///
/// # Errors
/// [`CommandError`].
pub async fn run(args: InspectArgs) -> Result<Exit, CommandError> {
    // A key without wildcard could be a command's: this one always has one.
    let asked = if args.keyexpr.contains('*') {
        args.keyexpr.clone()
    } else {
        format!("{}/**", args.keyexpr)
    };
    let asked = KeyExpr::autocanonize(asked).map_err(|_| {
        CommandError::BadInput(format!(
            "KEYEXPR `{}`: expected names joined by single `/`, with `*` for any one and `**` \
             for any number of them",
            args.keyexpr
        ))
    })?;
    let name = format!("inspect-{}", std::process::id());
    // Without a name the namespace is that of the network file.
    let robot = match (&args.robot, &args.zenoh) {
        (Some(robot), _) => robot.as_str(),
        (None, Some(_)) => "",
        (None, None) => DEFAULT_ROBOT,
    };
    let mut config = NetworkConfig::new(robot, &name, Role::Client, &args.connect);
    config.file = args.zenoh;
    let peer = Peer::open(config).await.map_err(|e| {
        CommandError::BadInput(format!(
            "{e}; is `rover up` running, and is --connect one of its endpoints?"
        ))
    })?;
    let registry = Registry::default();
    let shown = if args.once {
        once(&peer, &registry, &asked).await
    } else {
        follow(&peer, &registry, &asked).await
    };
    crate::launch::close(peer, Duration::from_secs(2)).await;
    shown.map(|()| Exit::Done)
}

/// Present values, sorted by key, after who is present.
async fn once(peer: &Peer, registry: &Registry, asked: &KeyExpr<'_>) -> Result<(), CommandError> {
    let mut lines: Vec<(String, Value)> = Vec::new();
    let tokens = peer
        .session()
        .liveliness()
        .get("presence/*")
        .timeout(READ_LIMIT)
        .await
        .map_err(|e| anyhow!("presence: {e}"))?;
    while let Ok(reply) = tokens.recv_async().await {
        if let Ok(sample) = reply.result()
            && asked.intersects(sample.key_expr())
        {
            lines.push((
                sample.key_expr().to_string(),
                present(sample.key_expr(), true),
            ));
        }
    }
    let values = peer
        .session()
        .get(asked)
        .target(QueryTarget::All)
        .consolidation(ConsolidationMode::None)
        .timeout(READ_LIMIT)
        .await
        .map_err(|e| anyhow!("{asked}: {e}"))?;
    while let Ok(reply) = values.recv_async().await {
        match reply.result() {
            Ok(sample) => {
                let payload = sample.payload().to_bytes();
                let encoding = sample.encoding().to_string();
                let key = sample.key_expr().as_str();
                lines.push((key.into(), registry.describe(key, &encoding, &payload)));
            }
            Err(error) => {
                let text = String::from_utf8_lossy(&error.payload().to_bytes()).into_owned();
                tracing::warn!(error = text, "an answer is missing");
            }
        }
    }
    lines.sort_by(|a, b| a.0.cmp(&b.0));
    for (_, line) in &lines {
        print(&format!("{line}\n"))?;
    }
    if lines.is_empty() {
        eprintln!("nothing is published on `{asked}`");
    }
    Ok(())
}

/// Everything that is published from now on, until Ctrl-C.
async fn follow(peer: &Peer, registry: &Registry, asked: &KeyExpr<'_>) -> Result<(), CommandError> {
    let mut samples = peer
        .watch_raw(asked.as_str(), WAITING)
        .await
        .map_err(|e| CommandError::BadInput(e.to_string()))?;
    let presence = peer
        .session()
        .liveliness()
        .declare_subscriber("presence/*")
        .history(true)
        .await
        .map_err(|e| anyhow!("presence: {e}"))?;
    let end = interrupted();
    tokio::pin!(end);
    let mut lost = 0;
    loop {
        let line = tokio::select! {
            sample = samples.next() => {
                let sample = sample.map_err(|e| anyhow!(e))?;
                registry.describe(&sample.key, &sample.encoding, &sample.payload)
            }
            change = presence.recv_async() => {
                let change = change.map_err(|e| anyhow!("presence: {e}"))?;
                if !asked.intersects(change.key_expr()) {
                    continue;
                }
                let alive = change.kind() == zenoh::sample::SampleKind::Put;
                present(change.key_expr(), alive)
            }
            _ = &mut end => return Ok(()),
        };
        print(&format!("{line}\n"))?;
        if samples.lost() > lost {
            lost = samples.lost();
            eprintln!("{lost} samples came faster than they could be written and were dropped");
        }
    }
}

fn present(key: &KeyExpr<'_>, alive: bool) -> Value {
    json!({ "key": key.as_str(), "value": { "present": alive } })
}
