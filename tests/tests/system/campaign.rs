//! Campaigns: nothing lost, nothing repeated, every run repeatable from its seed.

use crate::command::{rover, run};
use serde_json::Value;
use std::{fs, path::Path};

const VARY: &str = r#"campaign.vary=[{path="simulation.sun.azimuth_deg", uniform=[215.0, 235.0]}]"#;

fn campaign(folder: &Path, runs: &str, more: &[&str]) -> (Option<i32>, Value, String) {
    let folder = folder.to_str().unwrap();
    let mut all = vec!["campaign", "scenarios/bluestreak.toml", "--runs", runs];
    all.extend([
        "--out", folder, "--seed", "301", "--set", VARY, "--json", "-",
    ]);
    all.extend(more);
    let output = rover(&all);
    let summary = serde_json::from_slice(&output.stdout).unwrap_or(Value::Null);
    let messages = String::from_utf8_lossy(&output.stderr).into_owned();
    (output.status.code(), summary, messages)
}

fn record(folder: &Path, seed: u64) -> Value {
    let text = fs::read_to_string(folder.join(format!("runs/seed_{seed:06}.json"))).unwrap();
    serde_json::from_str(&text).unwrap()
}

#[test]
fn a_campaign_goes_on_where_it_ended_and_each_run_is_repeatable() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let (code, summary, said) = campaign(folder, "3", &["--shard", "1/2"]);
    assert_eq!(code, Some(0), "{said}");
    assert_eq!(summary["all"]["runs"], 2, "{summary:#}");
    assert!(!folder.join("runs/seed_000302.json").exists());

    // As if killed: one record is missing; the other must not be touched.
    fs::remove_file(folder.join("runs/seed_000301.json")).unwrap();
    let kept = record(folder, 303);
    let (code, summary, said) = campaign(folder, "3", &[]);
    assert_eq!(
        (code, &summary["all"]["placed"]),
        (Some(0), &Value::from(3)),
        "{said}"
    );
    assert_eq!(record(folder, 303), kept);
    assert_eq!(said.matches("seed ").count(), 2, "{said}");

    let one = record(folder, 302);
    let (_, again) = run(&[
        "scenarios/bluestreak.toml",
        "--varied",
        "--seed",
        "302",
        "--set",
        VARY,
    ]);
    assert_eq!(one["report"]["digest"], again["digest"]);
    let azimuth = |seed| record(folder, seed)["varied"]["simulation.sun.azimuth_deg"].clone();
    assert_ne!(azimuth(301), azimuth(302));
    assert!((215.0..235.0).contains(&azimuth(301).as_f64().unwrap()));
    let page = fs::read_to_string(folder.join("index.html")).unwrap();
    assert!(page.contains("seeds from 301") && !page.contains("http"));

    let (code, _, said) = campaign(folder, "3", &["--set", "servo.tolerance_mm=0.2"]);
    assert_eq!(code, Some(2));
    assert!(said.contains("another campaign"), "{said}");
}

#[test]
fn what_cannot_be_drawn_is_refused_before_anything_runs() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("c");
    let vary = r#"campaign.vary=[{path="simulation.sun.azimut_deg", uniform=[1.0, 2.0]}]"#;
    let arguments = [
        "campaign",
        "scenarios/bluestreak.toml",
        "--runs",
        "2",
        "--set",
        vary,
    ];
    let output = rover(&[&arguments[..], &["--out", out.to_str().unwrap()]].concat());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(said.contains("azimuth_deg") && !out.exists(), "{said}");
}
