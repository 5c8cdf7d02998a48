//! Accuracy of tracking and hand-over over rendered approaches.
//!
//! ```text
//! cargo run --release -p rover-approach --example approaches -- [runs] [class ...]
//! ```
//!
//! A class is `rock10`, `rock8`, `rock5`, `ground5`, `ground3`, or any other kind and range. Every
//! run has its own terrain, target, sun, odometry, tilt, pointing and calibration errors. One line
//! per run goes to standard output as JSON, the summary to standard error.

mod run;
mod scene;

use run::{Outcome, RunRules, approach};
use scene::{AnyError, Kind};

fn main() -> Result<(), AnyError> {
    let mut arguments = std::env::args().skip(1);
    let runs: u64 = arguments.next().map_or(Ok(30), |n| n.parse())?;
    let mut classes: Vec<String> = arguments.collect();
    if classes.is_empty() {
        classes = ["rock10", "rock8", "rock5", "ground5", "ground3"]
            .map(String::from)
            .into();
    }
    for class in &classes {
        let (kind, range) = match (class.strip_prefix("rock"), class.strip_prefix("ground")) {
            (Some(range), _) => (Kind::Rock, range.parse()?),
            (_, Some(range)) => (Kind::Ground, range.parse()?),
            _ => {
                return Err(
                    format!("class `{class}`, expected rock10, ground5 or the like").into(),
                );
            }
        };
        let mut outcomes = Vec::new();
        for seed in 0..runs {
            let outcome = approach(kind, range, 1 + seed, &RunRules::default())?;
            println!("{}", outcome.json(class, 1 + seed));
            outcomes.push(outcome);
        }
        summarise(class, &outcomes);
    }
    Ok(())
}

fn quantiles(values: impl Iterator<Item = f64>) -> String {
    let mut v: Vec<f64> = values.collect();
    v.sort_by(f64::total_cmp);
    if v.is_empty() {
        return "none".into();
    }
    let at = |q: f64| v[((v.len() - 1) as f64 * q).round() as usize];
    format!(
        "{:.2}/{:.2}/{:.2} (n {})",
        at(0.5),
        at(0.95),
        at(1.0),
        v.len()
    )
}

fn summarise(class: &str, outcomes: &[Outcome]) {
    let done: Vec<_> = outcomes.iter().filter_map(|o| o.tracked.as_ref()).collect();
    let handed: Vec<_> = done.iter().filter_map(|t| t.handed.as_ref()).collect();
    eprintln!(
        "{class}: {} runs, {} refused",
        outcomes.len(),
        outcomes.len() - done.len()
    );
    eprintln!(
        "  silent false locks (> 50 mm): {}",
        done.iter().filter(|t| t.surface_mm > 50.0).count()
    );
    for (name, values) in [
        ("tracked, mm", quantiles(done.iter().map(|t| t.surface_mm))),
        (
            "first ray, mm",
            quantiles(done.iter().filter_map(|t| t.first_ray_mm)),
        ),
        (
            "first ray or tracked as decided, mm",
            quantiles(done.iter().map(|t| t.decided_mm)),
        ),
        ("hand-over, px", quantiles(handed.iter().map(|h| h.own_px))),
        (
            "by geometry, px",
            quantiles(handed.iter().map(|h| h.geometric_px)),
        ),
        (
            "after hand-over, mm",
            quantiles(handed.iter().map(|h| h.surface_mm)),
        ),
        (
            "after hand-over in space, mm",
            quantiles(handed.iter().map(|h| h.space_mm)),
        ),
        (
            "sigma predicted, mm",
            quantiles(handed.iter().map(|h| h.sigma_mm)),
        ),
    ] {
        eprintln!("  {name}: median/95 %/max {values}");
    }
    for o in outcomes {
        if let Some(why) = &o.refused {
            eprintln!("    refused at {:.2} m: {why}", o.range_m);
        }
    }
    for t in &done {
        if let Some(why) = &t.not_handed {
            eprintln!("    not handed over: {why}");
        }
    }
}
