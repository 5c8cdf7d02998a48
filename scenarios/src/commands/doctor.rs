//! `rover doctor`: what this machine and network lack, and how to mend it.

use super::{CommandError, Exit};
use crate::{
    embedded,
    output::{Output, print},
    scenario::LoadedScenario,
};
use rover_bus::{NetworkConfig, Peer, Role};
use rover_messages::Nothing;
use serde::Serialize;
use std::{
    net::{TcpListener, TcpStream},
    path::PathBuf,
    time::{Duration, Instant},
};

/// Checks what this machine and network lack, and tells how to mend it
#[derive(Clone, Debug, clap::Args)]
pub struct DoctorArgs {
    /// Writes the findings as JSON; `-` is standard output
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Overwrites an output that exists
    #[arg(long)]
    pub force: bool,
}

/// One check.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// What was looked at.
    pub check: &'static str,
    /// `ok`, `advice` (works, could be better) or `fault`.
    pub state: State,
    /// What was found.
    pub found: String,
    /// How to mend it, if it is not `ok`.
    pub remedy: Option<String>,
}

/// How a check ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// As it should be.
    Ok,
    /// Works, could be better.
    Advice,
    /// Something will not work.
    Fault,
}

#[derive(Serialize)]
struct Findings {
    version: &'static str,
    healthy: bool,
    findings: Vec<Finding>,
}

/// Runs the command; exit code 1 if anything will not work.
///
/// # Errors
/// [`CommandError`].
pub async fn run(args: DoctorArgs) -> Result<Exit, CommandError> {
    let output = args
        .json
        .as_deref()
        .map(|p| Output::open(p, args.force))
        .transpose()?;
    let findings = vec![
        version(),
        cpu(),
        cores(),
        memory(),
        log(),
        shipped(),
        loopback(),
        zenoh().await,
    ];
    let healthy = findings.iter().all(|f| f.state != State::Fault);
    let mut text = String::new();
    for f in &findings {
        let mark = match f.state {
            State::Ok => "ok",
            State::Advice => "advice",
            State::Fault => "FAULT",
        };
        text += &format!("{mark:<7} {:<16} {}\n", f.check, f.found);
        if let Some(remedy) = &f.remedy {
            text += &format!("{:25}{remedy}\n", "");
        }
    }
    let all = Findings {
        version: env!("CARGO_PKG_VERSION"),
        healthy,
        findings,
    };
    if let Some(output) = &output {
        let json = serde_json::to_string_pretty(&all).map_err(anyhow::Error::from)? + "\n";
        output.write(&json)?;
    }
    if output != Some(Output::Stdout) {
        print(&text)?;
    }
    Ok(if healthy { Exit::Done } else { Exit::Failed })
}

fn finding(check: &'static str, state: State, found: String, remedy: Option<&str>) -> Finding {
    Finding {
        check,
        state,
        found,
        remedy: remedy.map(Into::into),
    }
}

fn version() -> Finding {
    let found = format!(
        "rover {} for {} {}",
        env!("CARGO_PKG_VERSION"),
        std::env::consts::ARCH,
        std::env::consts::OS
    );
    finding("version", State::Ok, found, None)
}

fn cpu() -> Finding {
    #[cfg(target_arch = "x86_64")]
    let has = std::arch::is_x86_feature_detected!("avx2");
    #[cfg(not(target_arch = "x86_64"))]
    let has = false;
    if has {
        finding("cpu", State::Ok, "AVX2".into(), None)
    } else {
        finding(
            "cpu",
            State::Advice,
            "no AVX2".into(),
            Some(
                "pictures are the same but take about twice as long; an x86-64 CPU of 2013 or later has it",
            ),
        )
    }
}

fn cores() -> Finding {
    match std::thread::available_parallelism() {
        Ok(n) if n.get() >= 2 => finding("cores", State::Ok, format!("{n}"), None),
        Ok(n) => finding(
            "cores",
            State::Advice,
            format!("{n}"),
            Some("runs are right but slow: give the machine or container at least 2 cores"),
        ),
        Err(e) => finding("cores", State::Advice, format!("unknown: {e}"), None),
    }
}

fn memory() -> Finding {
    const ENOUGH_MIB: u64 = 1024;
    let text = std::fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let available = text
        .lines()
        .find_map(|line| line.strip_prefix("MemAvailable:"))
        .and_then(|rest| rest.split_whitespace().next()?.parse::<u64>().ok())
        .map(|kib| kib / 1024);
    match available {
        Some(mib) if mib >= ENOUGH_MIB => {
            finding("memory", State::Ok, format!("{mib} MiB available"), None)
        }
        Some(mib) => finding(
            "memory",
            State::Advice,
            format!("{mib} MiB available"),
            Some("a run takes up to 1 GiB: close other programs or raise the container's limit"),
        ),
        None => finding("memory", State::Ok, "not told by this system".into(), None),
    }
}

fn log() -> Finding {
    match std::env::var("RUST_LOG") {
        Err(_) => finding(
            "RUST_LOG",
            State::Ok,
            "not set (warnings only)".into(),
            None,
        ),
        Ok(filter) => match tracing_subscriber::EnvFilter::try_new(&filter) {
            Ok(_) => finding("RUST_LOG", State::Ok, filter, None),
            Err(e) => finding(
                "RUST_LOG",
                State::Fault,
                format!("`{filter}`: {e}"),
                Some(
                    "set it to a level or to target=level pairs, e.g. RUST_LOG=rover_epec_servo=debug",
                ),
            ),
        },
    }
}

fn shipped() -> Finding {
    for (name, _) in embedded::SCENARIOS {
        if let Err(e) = LoadedScenario::load(name, &[], None) {
            return finding(
                "shipped files",
                State::Fault,
                e.to_string(),
                Some("a file on disk with a shipped name wins: mend it, or run in another folder"),
            );
        }
    }
    let found = format!(
        "{} scenarios, {} robots",
        embedded::SCENARIOS.len(),
        embedded::ROBOTS.len()
    );
    finding("shipped files", State::Ok, found, None)
}

fn loopback() -> Finding {
    let reached = TcpListener::bind("127.0.0.1:0").and_then(|listener| {
        let address = listener.local_addr()?;
        TcpStream::connect_timeout(&address, Duration::from_secs(2))?;
        Ok(address)
    });
    match reached {
        Ok(_) => finding(
            "loopback TCP",
            State::Ok,
            "127.0.0.1 reachable".into(),
            None,
        ),
        Err(e) => finding(
            "loopback TCP",
            State::Fault,
            e.to_string(),
            Some(
                "the parts talk over 127.0.0.1: bring `lo` up (ip link set lo up) and let a firewall or sandbox pass it",
            ),
        ),
    }
}

async fn zenoh() -> Finding {
    match round_trip().await {
        Ok(took) => {
            let found = format!("two sessions, one question in {} us", took.as_micros());
            finding("zenoh", State::Ok, found, None)
        }
        Err(e) => finding(
            "zenoh",
            State::Fault,
            e.to_string(),
            Some(
                "two Zenoh sessions in this process cannot talk: check loopback TCP, ulimit -n and RUST_LOG=zenoh=debug",
            ),
        ),
    }
}

async fn round_trip() -> Result<Duration, rover_bus::BusError> {
    let limit = Duration::from_secs(5);
    let namespace = format!("doctor-{}", std::process::id());
    let server = Peer::open(NetworkConfig::new(&namespace, "server", Role::Runner, &[])).await?;
    let served = server
        .serve("echo", |_: Nothing| async { Ok(Nothing {}) })
        .await?;
    let endpoints = server.locators().await;
    let asker = Peer::open(NetworkConfig::new(
        &namespace,
        "asker",
        Role::Runner,
        &endpoints,
    ))
    .await?;
    asker.ask::<_, Nothing>("echo", &Nothing {}, limit).await?;
    let started = Instant::now();
    asker.ask::<_, Nothing>("echo", &Nothing {}, limit).await?;
    let took = started.elapsed();
    drop(served);
    asker.close().await;
    server.close().await;
    Ok(took)
}
