//! `rover vision evaluate`: bias, sigma, detection and false-accept rates of every detector and of
//! the matcher, over rendered patches, beside the targets.

mod patch;
mod trials;

use std::fmt::Write;
use std::path::PathBuf;

use rayon::prelude::*;
use serde::Serialize;

use super::input;
use crate::commands::{CommandError, Exit};
use crate::output::{Output, print};
use trials::{Outcome, SUBJECTS, Subject};

/// Measures bias, sigma, detection and false-accept rates of the detectors and of the matcher
///
/// Every trial renders a patch with known truth: tilt, turn, range, blur, light and its slope are
/// drawn anew each time, half of the trials with grey noise of 1 DN, half with 5 DN of 255. As many
/// patches without the fiducial follow. The same seed gives the same table on any number of threads.
#[derive(Clone, Debug, clap::Args)]
pub struct EvaluateArgs {
    /// Patches per detector with the fiducial, and as many without
    #[arg(long, value_name = "N", default_value_t = 10_000)]
    patches: u32,
    /// Evaluates only these; may be repeated
    #[arg(long, value_name = "NAME")]
    only: Vec<String>,
    /// Seed of the trials
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Writes the table as JSON; `-` is standard output
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Overwrites an output that exists
    #[arg(long)]
    force: bool,
}

/// One row of the table.
#[derive(Clone, Debug, Serialize)]
struct Row {
    name: &'static str,
    noise_dn: f64,
    patches: u32,
    detected_percent: f64,
    /// Mean error in u and v, px.
    #[serde(skip_serializing_if = "Option::is_none")]
    bias_px: Option<[f64; 2]>,
    /// Standard deviation per coordinate, px.
    #[serde(skip_serializing_if = "Option::is_none")]
    sigma_px: Option<f64>,
    /// The error's length that 95 % stay below, px.
    #[serde(skip_serializing_if = "Option::is_none")]
    p95_px: Option<f64>,
    /// Errors per stated standard deviation, rms (1 is honest).
    #[serde(skip_serializing_if = "Option::is_none")]
    stated: Option<f64>,
    /// Accepted fiducials more than `gross_px` off.
    gross: u32,
    gross_px: f64,
    /// Patches without the fiducial, and those in which one was seen.
    blanks: u32,
    false_accepts: u32,
    target: &'static str,
}

const NOISES_DN: [f64; 2] = [1.0, 5.0];
/// Accepted results farther off are counted by themselves and not in bias and sigma, px.
const GROSS_PX: f64 = 1.0;

/// Runs the command.
pub fn run(args: &EvaluateArgs) -> Result<Exit, CommandError> {
    let out = args
        .json
        .as_ref()
        .map(|path| Output::open(path, args.force))
        .transpose()?;
    if args.patches == 0 {
        return Err(CommandError::BadInput(
            "--patches is 0, expected at least 1".into(),
        ));
    }
    for name in &args.only {
        if SUBJECTS.iter().all(|s| s.name != name) {
            let known: Vec<&str> = SUBJECTS.iter().map(|s| s.name).collect();
            return Err(CommandError::BadInput(format!(
                "--only {name}: expected one of {}",
                known.join(", ")
            )));
        }
    }
    let chosen = |s: &&Subject| args.only.is_empty() || args.only.iter().any(|n| n == s.name);
    let mut rows = Vec::new();
    for (index, subject) in SUBJECTS.iter().enumerate().filter(|(_, s)| chosen(s)) {
        eprintln!("rover: {}", subject.name);
        for (k, noise_dn) in NOISES_DN.into_iter().enumerate() {
            let stream = args.seed.wrapping_mul(1_000_003) + (2 * index + k) as u64;
            rows.push(evaluate(subject, noise_dn, args.patches, k, stream));
        }
    }
    if out != Some(Output::Stdout) {
        print(&table(&rows))?;
    }
    if let Some(out) = out {
        input::write_json(&out, &rows)?;
    }
    Ok(Exit::Done)
}

/// Trials of one subject at one noise: half of `patches`, rounded up for the first noise.
fn evaluate(subject: &Subject, noise_dn: f64, patches: u32, k: usize, stream: u64) -> Row {
    let share = if k == 0 {
        patches.div_ceil(2)
    } else {
        patches / 2
    };
    let outcomes: Vec<Outcome> = (0..share)
        .into_par_iter()
        .map(|i| (subject.trial)(&mut patch::rng(stream, u64::from(i)), noise_dn))
        .collect();
    let blanks = if subject.blank.is_some() { share } else { 0 };
    let false_accepts = subject.blank.map_or(0, |blank| {
        (0..share)
            .into_par_iter()
            .filter(|&i| blank(&mut patch::rng(stream, (1 << 32) + u64::from(i)), noise_dn))
            .count() as u32
    });
    let found: Vec<&Outcome> = outcomes.iter().filter(|o| o.error_px.is_some()).collect();
    let gross = found.iter().filter(|o| o.size() > GROSS_PX).count();
    let good: Vec<(f64, f64, f64)> = found
        .iter()
        .filter(|o| o.size() <= GROSS_PX)
        .filter_map(|o| o.error_px.map(|[u, v]| (u, v, o.sigma_px)))
        .collect();
    let n = good.len() as f64;
    let mut row = Row {
        name: subject.name,
        noise_dn,
        patches: share,
        detected_percent: 100.0 * found.len() as f64 / f64::from(share.max(1)),
        bias_px: None,
        sigma_px: None,
        p95_px: None,
        stated: None,
        gross: gross as u32,
        gross_px: GROSS_PX,
        blanks,
        false_accepts,
        target: subject.target,
    };
    if good.len() < 2 {
        return row;
    }
    let mean = |f: &dyn Fn(&(f64, f64, f64)) -> f64| good.iter().map(f).sum::<f64>() / n;
    let bias = [mean(&|e| e.0), mean(&|e| e.1)];
    let coordinates = f64::from(subject.coordinates);
    let square = mean(&|e| (e.0 - bias[0]).powi(2) + (e.1 - bias[1]).powi(2));
    let mut sizes: Vec<f64> = good.iter().map(|e| e.0.hypot(e.1)).collect();
    sizes.sort_by(f64::total_cmp);
    row.bias_px = Some(bias);
    row.sigma_px = Some((square / coordinates).sqrt());
    row.p95_px = sizes.get((0.95 * n) as usize).copied();
    let stated = mean(&|e| (e.0 * e.0 + e.1 * e.1) / (coordinates * e.2 * e.2));
    row.stated = stated.is_finite().then(|| stated.sqrt());
    row
}

fn table(rows: &[Row]) -> String {
    let mut text = String::from(
        "detector          noise  patches  found %   bias u   bias v    sigma      95 %  stated  \
         >1 px  false accepts   target\n",
    );
    let number = |x: Option<f64>| x.map_or_else(|| "-".into(), |x| format!("{x:.4}"));
    for r in rows {
        let _ = writeln!(
            text,
            "{:<17} {:>5} {:>8} {:>8.2} {:>8} {:>8} {:>8} {:>9} {:>7} {:>6} {:>14}   {}",
            r.name,
            r.noise_dn,
            r.patches,
            r.detected_percent,
            number(r.bias_px.map(|b| b[0])),
            number(r.bias_px.map(|b| b[1])),
            number(r.sigma_px),
            number(r.p95_px),
            r.stated.map_or_else(|| "-".into(), |x| format!("{x:.2}")),
            r.gross,
            if r.blanks > 0 {
                format!("{}/{}", r.false_accepts, r.blanks)
            } else {
                "-".into()
            },
            r.target,
        );
    }
    text
}
