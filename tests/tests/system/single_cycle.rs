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

#[test]
fn a_way_longer_than_allowed_ends_the_run_safely_and_says_why() {
    let limit = "approach.max_distance_m=0.5";
    let (code, report) = run(&[SCENARIO, "--varied", "--seed", SEED, "--set", limit]);
    assert_eq!(code, 3, "{report:#}");
    assert!(
        report["reason"].as_str().unwrap().starts_with("too_far"),
        "{report:#}"
    );
    assert_eq!(report["contact"], Value::Null);
}
