//! What the runs of a campaign came to, taken together.

use super::Record;
use crate::report::{Outcome, RunReport};
use rover_study::statistics::quantile;
use serde::Serialize;
use std::collections::BTreeMap;

/// An instrument that was placed farther off than this without a word counts as a silent false
/// lock, mm.
pub const FALSE_LOCK_MM: f64 = 50.0;

/// Median, 95 % quantile (nearest rank) and largest of some values.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Spread {
    /// Half of the values are at most this.
    pub median: f64,
    /// 95 % of the values are at most this.
    pub p95: f64,
    /// The largest.
    pub max: f64,
    /// How many values.
    pub count: usize,
}

impl Spread {
    /// The spread of some finite values; none if there are none.
    pub fn of(values: impl IntoIterator<Item = f64>) -> Option<Self> {
        let mut values: Vec<f64> = values.into_iter().filter(|v| v.is_finite()).collect();
        (!values.is_empty()).then(|| Self {
            median: quantile(&mut values, 0.5),
            p95: quantile(&mut values, 0.95),
            max: quantile(&mut values, 1.0),
            count: values.len(),
        })
    }
}

/// How some of the runs ended.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Group {
    /// Path and value of the field that they have in common; empty for all runs.
    pub name: String,
    /// Runs that have ended.
    pub runs: usize,
    /// Instrument placed.
    pub placed: usize,
    /// Ended safely without placing.
    pub aborted: usize,
    /// Ended otherwise.
    pub failed: usize,
    /// Share placed.
    pub success_rate: f64,
    /// Its 95 % confidence interval (Wilson's).
    pub success_interval_95: [f64; 2],
    /// Lateral error of the placed, mm.
    pub lateral_error_mm: Option<Spread>,
    /// The same on kinematics alone, mm.
    pub open_loop_lateral_error_mm: Option<Spread>,
    /// Placed runs whose error is within what was predicted (95 % bound).
    pub predicted_held: usize,
    /// Seeds of placed runs that are more than 50 mm off.
    pub silent_false_locks: Vec<u64>,
}

/// What ended runs, by name.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FaultCount {
    /// Name of the fault, or `process_failed`.
    pub name: String,
    /// Seeds of the runs that it ended.
    pub seeds: Vec<u64>,
}

/// Times of one phase over all runs that had it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PhaseTimes {
    /// Name of the phase.
    pub name: String,
    /// Simulated time, s.
    pub sim_s: Spread,
    /// Wall time, s.
    pub wall_s: Spread,
}

/// A campaign.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// Scenario as it was named.
    pub scenario: String,
    /// Seed of the first run.
    pub first_seed: u64,
    /// Runs that the campaign is to have.
    pub planned: u64,
    /// All runs.
    pub all: Group,
    /// Runs by each value of a field that takes a few.
    pub groups: Vec<Group>,
    /// What ended runs, most frequent first.
    pub faults: Vec<FaultCount>,
    /// Simulated time of a run, s.
    pub sim_s: Option<Spread>,
    /// Wall time of a run with its start and end, s.
    pub wall_s: Option<Spread>,
    /// Simulated over wall time of all runs together, while phases were under way.
    pub speed: Option<f64>,
    /// Where the time goes.
    pub phases: Vec<PhaseTimes>,
}

impl Summary {
    /// Sums up; `records` in the order of their seeds.
    pub fn new(scenario: &str, first_seed: u64, planned: u64, records: &[Record]) -> Self {
        let reports = || records.iter().filter_map(|r| r.report.as_ref());
        let times: Vec<(f64, f64)> = reports().map(RunReport::times).collect();
        let (sim_s, wall_s) = times
            .iter()
            .fold((0.0, 0.0), |(s, w), (sim, wall)| (s + sim, w + wall));
        Self {
            scenario: scenario.into(),
            first_seed,
            planned,
            all: group(String::new(), records.iter()),
            groups: groups(records),
            faults: faults(records),
            sim_s: Spread::of(times.iter().map(|t| t.0)),
            wall_s: Spread::of(records.iter().map(|r| r.wall_s)),
            speed: (wall_s > 0.0).then(|| sim_s / wall_s),
            phases: phases(reports()),
        }
    }
}

fn placed(record: &Record) -> Option<&RunReport> {
    record
        .report
        .as_ref()
        .filter(|r| r.outcome == Outcome::Placed)
}

fn group<'a>(name: String, records: impl Iterator<Item = &'a Record> + Clone) -> Group {
    let runs = records.clone().count();
    let failed = records.clone().filter(|r| r.report.is_none()).count();
    let good: Vec<(&Record, &RunReport)> = records
        .filter_map(|record| Some((record, placed(record)?)))
        .collect();
    let lateral = |report: &RunReport| report.truth.as_ref()?.lateral_error_mm;
    let open_loop = |report: &RunReport| report.truth.as_ref()?.open_loop_lateral_error_mm;
    let held = |report: &RunReport| {
        let predicted = report.servo.as_ref()?.predicted_error_mm;
        Some(lateral(report)? <= predicted)
    };
    let off = |report: &RunReport| lateral(report).is_some_and(|e| e > FALSE_LOCK_MM);
    Group {
        name,
        runs,
        placed: good.len(),
        aborted: runs - failed - good.len(),
        failed,
        success_rate: good.len() as f64 / (runs as f64).max(1.0),
        success_interval_95: wilson(good.len(), runs),
        lateral_error_mm: Spread::of(good.iter().filter_map(|(_, r)| lateral(r))),
        open_loop_lateral_error_mm: Spread::of(good.iter().filter_map(|(_, r)| open_loop(r))),
        predicted_held: good.iter().filter(|(_, r)| held(r) == Some(true)).count(),
        silent_false_locks: good
            .iter()
            .filter(|(_, r)| off(r))
            .map(|(record, _)| record.seed)
            .collect(),
    }
}

/// Groups by the values of each varied field that takes at most a few.
fn groups(records: &[Record]) -> Vec<Group> {
    const FEW: usize = 6;
    let mut values: BTreeMap<&String, Vec<&serde_json::Value>> = BTreeMap::new();
    for (path, value) in records.iter().flat_map(|r| &r.varied) {
        let seen = values.entry(path).or_default();
        if !seen.contains(&value) {
            seen.push(value);
        }
    }
    let mut groups = Vec::new();
    for (path, values) in values
        .into_iter()
        .filter(|(_, v)| (2..=FEW).contains(&v.len()))
    {
        for value in values {
            let of = records
                .iter()
                .filter(move |r| r.varied.get(path) == Some(value));
            groups.push(group(format!("{path} = {value}"), of));
        }
    }
    groups
}

fn faults(records: &[Record]) -> Vec<FaultCount> {
    let mut seeds: BTreeMap<String, Vec<u64>> = BTreeMap::new();
    for record in records {
        let name = match &record.report {
            None => "process_failed".to_owned(),
            Some(report) => match &report.reason {
                None => continue,
                Some(reason) => reason.split(':').next().unwrap_or_default().to_owned(),
            },
        };
        seeds.entry(name).or_default().push(record.seed);
    }
    let mut faults: Vec<FaultCount> = seeds
        .into_iter()
        .map(|(name, seeds)| FaultCount { name, seeds })
        .collect();
    faults.sort_by_key(|f| std::cmp::Reverse(f.seeds.len()));
    faults
}

fn phases<'a>(reports: impl Iterator<Item = &'a RunReport>) -> Vec<PhaseTimes> {
    let mut names: Vec<&str> = Vec::new();
    let mut times: BTreeMap<&str, Vec<(f64, f64)>> = BTreeMap::new();
    for phase in reports.flat_map(|r| &r.phases) {
        let name = phase.name.as_str();
        if !names.contains(&name) {
            names.push(name);
        }
        times
            .entry(name)
            .or_default()
            .push((phase.sim_s, phase.wall_s));
    }
    names
        .into_iter()
        .filter_map(|name| {
            let times = &times[name];
            Some(PhaseTimes {
                name: name.into(),
                sim_s: Spread::of(times.iter().map(|t| t.0))?,
                wall_s: Spread::of(times.iter().map(|t| t.1))?,
            })
        })
        .collect()
}

/// Wilson's 95 % interval of a share.
fn wilson(good: usize, of: usize) -> [f64; 2] {
    if of == 0 {
        return [0.0, 1.0];
    }
    const Z: f64 = 1.959_963_984_540_054;
    let (n, p) = (of as f64, good as f64 / of as f64);
    let centre = p + Z * Z / (2.0 * n);
    let half = Z * (p * (1.0 - p) / n + Z * Z / (4.0 * n * n)).sqrt();
    let scale = 1.0 + Z * Z / n;
    [
        ((centre - half) / scale).max(0.0),
        ((centre + half) / scale).min(1.0),
    ]
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_interval_is_that_of_published_tables() {
        // Newcombe 1998, table I: 81/263, 15/148, 0/20, 1/29 (score method).
        for (good, of, low, high) in [
            (81, 263, 0.2553, 0.3662),
            (15, 148, 0.0624, 0.1605),
            (0, 20, 0.0, 0.1611),
            (1, 29, 0.0061, 0.1718),
        ] {
            let [l, h] = wilson(good, of);
            assert!((l - low).abs() < 1e-4 && (h - high).abs() < 1e-4, "{l} {h}");
        }
    }

    #[test]
    fn a_spread_has_nearest_rank_quantiles_and_leaves_out_what_is_no_number() {
        let spread = Spread::of((1..=20).map(f64::from).chain([f64::NAN])).unwrap();
        assert_eq!((spread.median, spread.p95, spread.max), (10.0, 19.0, 20.0));
        assert_eq!((spread.count, Spread::of([])), (20, None));
    }

    fn record(seed: u64, report: Option<RunReport>, surface: &str) -> Record {
        Record {
            seed,
            command: String::new(),
            varied: [("target.surface".to_owned(), surface.into())].into(),
            wall_s: 1.0,
            failure: report.is_none().then(String::new),
            report,
        }
    }

    fn aborted(seed: u64) -> RunReport {
        RunReport {
            scenario: "s".into(),
            robot: "r".into(),
            seed,
            outcome: Outcome::Aborted,
            reason: Some("no_texture: too plain".into()),
            phases: vec![],
            target: None,
            approach: None,
            servo: None,
            contact: None,
            truth: None,
            wall_by_kind_s: BTreeMap::new(),
            digest: String::new(),
        }
    }

    #[test]
    fn runs_are_counted_by_outcome_fault_and_drawn_value() {
        let mut good = aborted(2);
        (good.outcome, good.reason) = (Outcome::Placed, None);
        let records = [
            record(1, Some(aborted(1)), "rock"),
            record(2, Some(good), "ground"),
            record(3, None, "rock"),
            record(4, Some(aborted(4)), "rock"),
        ];
        let summary = Summary::new("s", 1, 9, &records);
        let all = &summary.all;
        assert_eq!(
            (all.runs, all.placed, all.aborted, all.failed),
            (4, 1, 2, 1)
        );
        assert_eq!(summary.faults[0].seeds, [1, 4]);
        assert_eq!(summary.faults[1].name, "process_failed");
        assert_eq!(summary.groups[0].name, "target.surface = \"rock\"");
        assert_eq!((summary.groups[0].runs, summary.groups[1].placed), (3, 1));
    }
}
