//! `rover vision evaluate`: bias, sigma, detection and false-accept rates of every detector and of
//! the matcher, over rendered patches, beside the targets.

use std::fmt::Write;
use std::path::PathBuf;

use super::input;
use crate::commands::{CommandError, Exit};
use crate::output::{Output, print};
use rover_study::detectors::{NOISES_DN, Row, SUBJECTS, Subject, evaluate};

/// Measures bias, sigma, detection and false-accept rates of the detectors and of the matcher
///
/// Every trial renders a patch with known truth: tilt, turn, range, blur, light and its slope are
/// drawn anew each time, half of the trials with grey noise of 1 DN, half with 5 DN of 255. As many
/// patches without the fiducial follow. Where noise may forbid the target, `bound` is the standard
/// deviation that it allows in the matched window (Cramer-Rao). The same seed gives the same table on any number of threads.
#[derive(Clone, Debug, clap::Args)]
pub struct EvaluateArgs {
    /// Patches per detector with the fiducial, and as many without
    #[arg(long, value_name = "N", default_value_t = 10_000)]
    patches: u32,
    /// Evaluates only these; may be repeated
    #[arg(long, value_name = "NAME")]
    only: Vec<String>,
    /// Grey noise, DN of 255; may be repeated, the patches are shared out; 1 and 5 without it
    #[arg(long, value_name = "DN")]
    noise: Vec<f64>,
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
    if let Some(bad) = args.noise.iter().find(|x| !(0.0..=50.0).contains(*x)) {
        return Err(CommandError::BadInput(format!(
            "--noise is {bad}, expected 0 to 50 DN"
        )));
    }
    let noises_dn: &[f64] = if args.noise.is_empty() {
        &NOISES_DN
    } else {
        &args.noise
    };
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
        let count = noises_dn.len() as u32;
        for (k, &noise_dn) in noises_dn.iter().enumerate() {
            let place = 2 * index + k % 2 + 1_000 * (k / 2);
            let stream = args.seed.wrapping_mul(1_000_003) + place as u64;
            let share = args.patches / count + u32::from((k as u32) < args.patches % count);
            rows.push(evaluate(subject, noise_dn, share, stream));
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

fn table(rows: &[Row]) -> String {
    let mut text = String::from(
        "detector          noise  patches  found %   bias u   bias v    sigma    bound      95 %  stated  \
         >1 px  false accepts   target\n",
    );
    let number = |x: Option<f64>| x.map_or_else(|| "-".into(), |x| format!("{x:.4}"));
    for r in rows {
        let _ = writeln!(
            text,
            "{:<17} {:>5} {:>8} {:>8.2} {:>8} {:>8} {:>8} {:>8} {:>9} {:>7} {:>6} {:>14}   {}",
            r.name,
            r.noise_dn,
            r.patches,
            r.detected_percent,
            number(r.bias_px.map(|b| b[0])),
            number(r.bias_px.map(|b| b[1])),
            number(r.sigma_px),
            number(r.bound_px),
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
