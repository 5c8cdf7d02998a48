//! From a place seen metres away to contact: a whole command cycle of a rover that drives.

use crate::command::{number, run};
use serde_json::Value;

const SCENARIO: &str = "scenarios/single_cycle.toml";
/// A place on the ground, five metres away.
const SEED: &str = "1";

#[test]
fn a_place_named_from_metres_away_is_driven_to_and_touched_alike_in_any_mode() {
    let (code, report) = run(&[SCENARIO, "--varied", "--seed", SEED]);
    assert_eq!(code, 0, "{report:#}");
    let names: Vec<_> = report["phases"]
        .as_array()
        .unwrap()
        .iter()
        .map(|phase| phase["name"].as_str().unwrap())
        .collect();
    assert_eq!(
        names,
        [
            "designate",
            "approach",
            "survey",
            "servo",
            "contact",
            "score",
            "stow"
        ]
    );
    assert!(number(&report, "/target/position_m/0") > 3.0, "{report:#}");
    assert_eq!(report["target"]["pair"], "mast");
    assert_eq!(report["approach"]["target"]["pair"], "body");
    assert!(number(&report, "/approach/driven_m") > 2.0, "{report:#}");
    let lateral = number(&report, "/truth/lateral_error_mm");
    assert!(lateral < 15.0, "{report:#}");
    // The sources are vectors in one plane that add up to the whole.
    let sources = report["truth"]["sources"].as_object().unwrap();
    let sum: f64 = sources.values().map(|mm| mm.as_f64().unwrap()).sum();
    assert!(lateral <= sum + 1e-6, "{lateral} mm of {sources:?}");

    let (code, other) = run(&[SCENARIO, "--varied", "--seed", SEED, "--processes"]);
    assert_eq!((code, &other["digest"]), (0, &report["digest"]));
}

/// Each fault on the way ends the run safely, with its name, before the arm has touched anything.
fn ends_with(fault: &str, overrides: &[&str]) {
    let mut arguments = vec![SCENARIO];
    arguments.extend(overrides);
    let (code, report) = run(&arguments);
    assert_eq!(code, 3, "{report:#}");
    let reason = report["reason"].as_str().unwrap();
    assert!(reason.starts_with(fault), "{reason}, expected {fault}");
    assert_eq!(report["contact"], Value::Null);
    assert_eq!(report["truth"]["lateral_error_mm"], Value::Null);
}

fn on_the_ground_ends_with(fault: &str, setting: &str) {
    ends_with(fault, &["--varied", "--seed", SEED, "--set", setting]);
}

#[test]
fn a_way_longer_than_allowed_ends_the_run_safely_and_says_why() {
    on_the_ground_ends_with("too_far:", "approach.max_distance_m=0.5");
}

#[test]
fn slip_beyond_its_limit_ends_the_run_safely_and_says_why() {
    on_the_ground_ends_with("slip:", "approach.max_slip=0.001");
}

#[test]
fn ground_that_is_too_steep_everywhere_ends_the_run_safely_and_says_why() {
    on_the_ground_ends_with("path_blocked:", "approach.max_slope_deg=0.2");
}

#[test]
fn a_target_known_too_poorly_ends_the_run_safely_and_says_why() {
    on_the_ground_ends_with("target_uncertain:", "approach.max_sigma_mm=0.2");
}

#[test]
fn more_stops_than_allowed_end_the_run_safely_and_say_why() {
    on_the_ground_ends_with("too_many_stops:", "approach.max_stops_n=1");
}

#[test]
fn a_target_that_vanishes_under_way_is_lost_and_nothing_else_is_taken_for_it() {
    let gone = "simulation.faults.rock_vanishes={rock_n=165,when={at_time_s=20.0}}";
    ends_with("target_lost:", &["--set", gone]);
}
