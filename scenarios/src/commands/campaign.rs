//! `rover campaign`: many runs, one record each, one summary.

use super::{CommandError, Exit, interrupted};
use crate::{
    campaign::{CampaignError, Folder, Manifest, Record, Shard, Summary, page::page},
    output::{Output, print},
    report::{Outcome, RunReport},
    scenario::LoadedScenario,
};
use anyhow::Context;
use indicatif::{ProgressBar, ProgressStyle};
use std::{
    collections::BTreeMap,
    io::IsTerminal,
    path::{Path, PathBuf},
    process::Stdio,
    time::Instant,
};
use tokio::{process::Command, task::JoinSet};

/// Runs one scenario many times with randomised truth, and sums up
///
/// Each run has the next seed, draws what the scenario's campaign section varies, and leaves one
/// record in the folder. The same command again goes on with the runs that are missing. A run is
/// repeated with `rover run SCENARIO --varied --seed N`.
#[derive(Clone, Debug, clap::Args)]
pub struct CampaignArgs {
    /// Scenario file; a path on disk wins over a shipped file of the same name
    pub scenario: String,
    /// How many runs
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub runs: u64,
    /// Folder for records, summary and page
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Only part I of N, for batch systems; parts may share the folder
    #[arg(long, value_name = "I/N", default_value = "1/1")]
    pub shard: Shard,
    /// Runs at the same time (default: one for each core)
    #[arg(long, value_name = "K", value_parser = clap::value_parser!(u64).range(1..=1024))]
    pub jobs: Option<u64>,
    /// Seed of the first run (default: the scenario's)
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
    /// Replaces one field by a TOML value; may be repeated
    #[arg(long, value_name = "PATH=VALUE")]
    pub set: Vec<String>,
    /// Writes the summary as JSON; `-` is standard output
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Overwrites a JSON file that exists
    #[arg(long)]
    pub force: bool,
}

impl From<CampaignError> for CommandError {
    fn from(error: CampaignError) -> Self {
        match error {
            CampaignError::File { ref source, .. } if source.is_wrong_path() => {
                Self::BadInput(error.to_string())
            }
            CampaignError::File { .. } => Self::Internal(error.into()),
            CampaignError::Other { .. } | CampaignError::Broken { .. } => {
                Self::BadInput(error.to_string())
            }
        }
    }
}

/// Runs the command.
///
/// # Errors
/// [`CommandError`].
pub async fn run(args: CampaignArgs) -> Result<Exit, CommandError> {
    let json = args
        .json
        .as_deref()
        .map(|p| Output::open(p, args.force))
        .transpose()?;
    let loaded = LoadedScenario::load(&args.scenario, &args.set, args.seed)?;
    let first_seed = loaded.scenario.seed;
    // What cannot be drawn is refused before anything runs.
    LoadedScenario::load_varied(&args.scenario, &args.set, args.seed)?;
    let manifest = Manifest {
        version: env!("CARGO_PKG_VERSION").into(),
        scenario: args.scenario.clone(),
        set: args.set.clone(),
        first_seed,
        effective: loaded.scenario.to_toml()?,
        robot: loaded.robot_text.clone(),
    };
    let folder = Folder::open(&args.out, &manifest)?;
    let complete = missing_runs(&args, first_seed, &folder).await?;

    let mut records = Vec::new();
    for seed in (0..args.runs).map(|i| first_seed + i) {
        records.extend(folder.record(seed)?);
    }
    let summary = Summary::new(&args.scenario, first_seed, args.runs, &records);
    let text = serde_json::to_string_pretty(&summary).context("summary")? + "\n";
    folder.write("summary.json", &text)?;
    folder.write("index.html", &page(&summary, &records))?;
    if let Some(json) = &json {
        json.write(&text)?;
    }
    if json != Some(Output::Stdout) {
        print(&told(&summary, &args.out))?;
    }
    Ok(match (complete, summary.all.failed) {
        (false, _) => Exit::Aborted,
        (true, 0) => Exit::Done,
        (true, _) => Exit::Failed,
    })
}

/// Runs what has no record yet; whether all of this shard is done.
async fn missing_runs(
    args: &CampaignArgs,
    first_seed: u64,
    folder: &Folder,
) -> Result<bool, CommandError> {
    let mut seeds = Vec::new();
    for i in (0..args.runs).filter(|&i| args.shard.has(i)) {
        if folder.record(first_seed + i)?.is_none() {
            seeds.push(first_seed + i);
        }
    }
    let bar = progress(seeds.len() as u64);
    let cores = std::thread::available_parallelism().map_or(1, |n| n.get() as u64);
    let jobs = args.jobs.unwrap_or(cores) as usize;
    let program = std::env::current_exe().context("path of the rover binary")?;
    let mut waiting = seeds.into_iter();
    let mut running = JoinSet::new();
    let mut stop = Box::pin(interrupted());
    let mut begin = |running: &mut JoinSet<_>| {
        if let Some(seed) = waiting.next() {
            running.spawn(one(program.clone(), args.clone(), seed));
        }
    };
    for _ in 0..jobs {
        begin(&mut running);
    }
    loop {
        let ended = tokio::select! {
            biased;
            how = &mut stop => {
                // Dropping a run kills its process; it leaves no record and is run again.
                running.shutdown().await;
                bar.finish_and_clear();
                eprintln!("{how}; the same command goes on with what is missing");
                return Ok(false);
            }
            ended = running.join_next() => ended,
        };
        let Some(ended) = ended else { break };
        let record = ended.context("a run's task")??;
        folder.keep(&record)?;
        bar.suspend(|| eprintln!("{}", line(&record)));
        bar.inc(1);
        begin(&mut running);
    }
    bar.finish_and_clear();
    Ok(true)
}

/// One run as a process of its own.
async fn one(program: PathBuf, args: CampaignArgs, seed: u64) -> Result<Record, CommandError> {
    let loaded = LoadedScenario::load_varied(&args.scenario, &args.set, Some(seed))?;
    let mut given = vec![
        "run".to_owned(),
        args.scenario.clone(),
        "--varied".into(),
        "--seed".into(),
        seed.to_string(),
    ];
    for set in &args.set {
        given.extend(["--set".into(), set.clone()]);
    }
    let started = Instant::now();
    let output = Command::new(program)
        .args(&given)
        .args(["--json", "-"])
        .stdin(Stdio::null())
        .kill_on_drop(true)
        .output()
        .await
        .context("starting a run")?;
    let wall_s = started.elapsed().as_secs_f64();
    let report = match output.status.code() {
        Some(0 | 3) => serde_json::from_slice::<RunReport>(&output.stdout).ok(),
        _ => None,
    };
    let said = String::from_utf8_lossy(&output.stderr);
    let failure = report.is_none().then(|| {
        let last = said.lines().rfind(|line| !line.trim().is_empty());
        format!("{}: {}", output.status, last.unwrap_or("no message"))
    });
    Ok(Record {
        seed,
        command: format!("rover {}", quoted(&given)),
        varied: varied(&loaded)?,
        wall_s,
        report,
        failure,
    })
}

/// The fields that were drawn and what they became.
fn varied(loaded: &LoadedScenario) -> Result<BTreeMap<String, serde_json::Value>, CommandError> {
    let whole = serde_json::to_value(&loaded.scenario).context("scenario as JSON")?;
    let paths = loaded.scenario.campaign.vary.iter().map(|v| v.path.clone());
    Ok(paths
        .filter_map(|path| {
            let value = whole.pointer(&format!("/{}", path.replace('.', "/")))?;
            Some((path, value.clone()))
        })
        .collect())
}

/// Arguments as a shell takes them.
fn quoted(args: &[String]) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=".contains(c);
    let word = |arg: &String| {
        if !arg.is_empty() && arg.chars().all(plain) {
            arg.clone()
        } else {
            format!("'{}'", arg.replace('\'', r"'\''"))
        }
    };
    args.iter().map(word).collect::<Vec<_>>().join(" ")
}

fn line(record: &Record) -> String {
    let outcome = match (&record.report, &record.failure) {
        (Some(r), _) if r.outcome == Outcome::Placed => {
            let error = r.truth.as_ref().and_then(|t| t.lateral_error_mm);
            error.map_or("placed".into(), |e| format!("placed, {e:.2} mm off"))
        }
        (Some(r), _) => format!("aborted, {}", r.reason.clone().unwrap_or_default()),
        (None, failure) => format!("failed, {}", failure.clone().unwrap_or_default()),
    };
    format!("seed {}: {outcome}, {:.1} s", record.seed, record.wall_s)
}

fn progress(runs: u64) -> ProgressBar {
    if !std::io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    let bar = ProgressBar::new(runs);
    if let Ok(style) = ProgressStyle::with_template("{wide_bar} {pos}/{len} runs, {eta} left") {
        bar.set_style(style);
    }
    bar
}

fn told(summary: &Summary, out: &Path) -> String {
    let all = &summary.all;
    let [low, high] = all.success_interval_95;
    let mut lines = vec![
        format!(
            "{}: {} of {} runs",
            summary.scenario, all.runs, summary.planned
        ),
        format!(
            "  placed          {} ({:.1} %, 95 % interval {:.1} to {:.1} %), aborted {}, failed {}",
            all.placed,
            all.success_rate * 100.0,
            low * 100.0,
            high * 100.0,
            all.aborted,
            all.failed
        ),
    ];
    for group in std::iter::once(all).chain(&summary.groups) {
        if let Some(e) = group.lateral_error_mm {
            let name = if group.name.is_empty() {
                String::new()
            } else {
                format!("   ({}, {} of {})", group.name, group.placed, group.runs)
            };
            lines.push(format!(
                "  lateral error   median {:.2} mm, 95 % {:.2} mm, largest {:.2} mm{name}",
                e.median, e.p95, e.max
            ));
        }
    }
    if let Some(e) = all.open_loop_lateral_error_mm {
        lines.push(format!(
            "  open loop       median {:.1} mm, 95 % {:.1} mm",
            e.median, e.p95
        ));
    }
    lines.push(format!(
        "  prediction      held in {} of {} placed; silent false locks: {}",
        all.predicted_held,
        all.placed,
        all.silent_false_locks.len()
    ));
    for fault in &summary.faults {
        lines.push(format!("  {:<15} {}", fault.seeds.len(), fault.name));
    }
    lines.push(format!(
        "  records         {}, page {}",
        out.join("runs").display(),
        out.join("index.html").display()
    ));
    lines.join("\n") + "\n"
}
