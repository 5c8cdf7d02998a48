//! The JSON record of a run: its field names are the product's interface, its digest covers
//! everything but wall times.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use rover::report::{
    ContactReport, ErrorSources, Outcome, Phase, RunReport, ServoReport, TargetReport, TruthReport,
};
use serde_json::{Value, json};

fn report() -> RunReport {
    let phase = |name: &str, sim_s| Phase {
        name: name.into(),
        sim_s,
        wall_s: 0.5,
        outcome: "done".into(),
    };
    RunReport {
        scenario: "bluestreak".into(),
        robot: "bluestreak".into(),
        seed: 7,
        outcome: Outcome::Placed,
        reason: None,
        phases: vec![phase("designate", 0.0), phase("servo", 12.5)],
        target: Some(TargetReport {
            pair: "body".into(),
            pixel_px: [340.0, 236.0],
            position_m: [0.57, 0.0, 0.39],
            normal: [0.1, 0.0, 0.995],
            plane_rms_mm: 0.3,
            sigma_mm: [0.1, 0.1, 0.2],
        }),
        approach: None,
        servo: Some(ServoReport {
            method: "epec_field".into(),
            iterations: 2,
            converged: true,
            error_vectors_mm: vec![Some([1.0, -2.0, 0.1]), None],
            fiducial_found: vec![true, false],
            predicted_error_mm: 0.4,
        }),
        contact: Some(ContactReport {
            made: true,
            switch_travel_mm: 2.1,
            peak_force_n: 3.2,
            approach_m: 0.031,
        }),
        truth: Some(TruthReport {
            lateral_error_mm: Some(0.35),
            range_error_mm: Some(-0.1),
            axis_error_deg: Some(0.7),
            open_loop_lateral_error_mm: Some(14.2),
            arm_model_error_mm: 17.1,
            sources: ErrorSources::default(),
        }),
        wall_by_kind_s: Default::default(),
        digest: String::new(),
    }
    .sealed()
    .unwrap()
}

#[test]
fn the_json_has_exactly_the_fields_of_the_interface() {
    let value: Value = serde_json::from_str(&report().to_json().unwrap()).unwrap();
    let keys = |v: &Value| {
        let mut keys: Vec<_> = v.as_object().unwrap().keys().cloned().collect();
        keys.sort();
        keys
    };
    assert_eq!(
        keys(&value),
        [
            "approach",
            "contact",
            "digest",
            "outcome",
            "phases",
            "reason",
            "robot",
            "scenario",
            "seed",
            "servo",
            "target",
            "truth",
            "wall_by_kind_s"
        ]
    );
    assert_eq!(
        keys(&value["phases"][0]),
        ["name", "outcome", "sim_s", "wall_s"]
    );
    assert_eq!(
        keys(&value["target"]),
        [
            "normal",
            "pair",
            "pixel_px",
            "plane_rms_mm",
            "position_m",
            "sigma_mm"
        ]
    );
    assert_eq!(
        keys(&value["servo"]),
        [
            "converged",
            "error_vectors_mm",
            "fiducial_found",
            "iterations",
            "method",
            "predicted_error_mm"
        ]
    );
    assert_eq!(
        keys(&value["contact"]),
        ["approach_m", "made", "peak_force_n", "switch_travel_mm"]
    );
    assert_eq!(
        keys(&value["truth"]),
        [
            "arm_model_error_mm",
            "axis_error_deg",
            "lateral_error_mm",
            "open_loop_lateral_error_mm",
            "range_error_mm",
            "sources"
        ]
    );
    assert_eq!(value["outcome"], "placed");
    assert_eq!(value["reason"], Value::Null);
    assert_eq!(
        value["servo"]["error_vectors_mm"],
        json!([[1.0, -2.0, 0.1], null])
    );
    let back: RunReport = serde_json::from_value(value).unwrap();
    assert_eq!(back, report());
}

#[test]
fn the_digest_is_the_same_on_every_machine() {
    // Golden: any change of the record's canonical form changes this and must be meant.
    assert_eq!(report().digest, GOLDEN);
}

const GOLDEN: &str = "9fecda8bd53b3c4ad0a2ac092bba9ecf04896efaaa153b40d7ca49d0dc2a9ad7";

#[test]
fn wall_times_do_not_change_the_digest_and_anything_else_does() {
    let first = report();
    let mut slow = first.clone();
    slow.phases[1].wall_s = 99.0;
    slow.digest = "old".into();
    assert_eq!(slow.sealed().unwrap().digest, first.digest);

    let mut other = first.clone();
    other.phases[1].sim_s += 1e-12;
    assert_ne!(other.sealed().unwrap().digest, first.digest);
    let mut other = first.clone();
    other.seed += 1;
    assert_ne!(other.sealed().unwrap().digest, first.digest);
    let mut other = first.clone();
    other.truth.as_mut().unwrap().lateral_error_mm = None;
    assert_ne!(other.sealed().unwrap().digest, first.digest);
}

#[test]
fn a_number_that_is_not_finite_is_refused_and_never_written_as_null() {
    let mut broken = report();
    broken.truth.as_mut().unwrap().arm_model_error_mm = f64::NAN;
    assert!(broken.to_json().is_err());
    assert!(broken.sealed().is_err());
}

#[test]
fn the_summary_gives_outcome_and_numbers_with_units() {
    let text = report().summary();
    for part in [
        "bluestreak: placed",
        "0.350 mm",
        "14.200 mm",
        "0.40 mm (95 %)",
        "fiducial found in 1",
        "3.2 N",
        "12.5 s simulated",
    ] {
        assert!(text.contains(part), "`{part}` is missing in:\n{text}");
    }
    let mut aborted = report();
    aborted.outcome = Outcome::Aborted;
    aborted.reason = Some("no_contact: no surface".into());
    aborted.truth.as_mut().unwrap().lateral_error_mm = None;
    let text = aborted.summary();
    assert!(
        text.contains("aborted") && text.contains("no_contact: no surface"),
        "{text}"
    );
    assert!(text.contains("lateral error          none"), "{text}");
}
