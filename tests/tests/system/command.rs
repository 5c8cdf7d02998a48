//! Running the `rover` command, and what it answers to mistakes.

use serde_json::Value;
use std::process::{Command, Output};

pub const ROVER: &str = env!("CARGO_BIN_EXE_rover-under-test");

pub fn rover(arguments: &[&str]) -> Output {
    Command::new(ROVER)
        .args(arguments)
        .current_dir(env!("CARGO_TARGET_TMPDIR"))
        .output()
        .expect("the rover command starts")
}

const TESTBED: &str = "scenarios/bluestreak.toml";

/// Runs a scenario; gives exit code and report.
pub fn run(arguments: &[&str]) -> (i32, Value) {
    let mut all = vec!["run"];
    all.extend(arguments);
    all.extend(["--json", "-"]);
    let output = rover(&all);
    let code = output.status.code().expect("an exit code");
    let report = serde_json::from_slice(&output.stdout).unwrap_or_else(|e| {
        let messages = String::from_utf8_lossy(&output.stderr).into_owned();
        panic!("{arguments:?}: exit {code}, no report ({e}): {messages}")
    });
    (code, report)
}

/// A number of a report.
pub fn number(report: &Value, path: &str) -> f64 {
    report
        .pointer(path)
        .and_then(Value::as_f64)
        .unwrap_or_else(|| panic!("no {path}: {report:#}"))
}

fn refused(arguments: &[&str], expected: &[&str]) {
    let output = rover(arguments);
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{arguments:?}: {message}");
    for word in expected {
        assert!(
            message.contains(word),
            "{arguments:?} does not mention `{word}`: {message}"
        );
    }
    assert!(
        output.stdout.is_empty(),
        "{arguments:?} wrote to standard output"
    );
}

#[test]
fn a_mistyped_or_impossible_setting_is_refused_with_exit_2() {
    refused(&["run", "no_such.toml"], &["no_such.toml"]);
    refused(
        &["run", "--set", "servo.metod=\"epec\""],
        &["metod", "method"],
    );
    refused(
        &["run", "--set", "contact.speed_mm_s=-1.0"],
        &["speed_mm_s", "-1"],
    );
    refused(
        &["run", TESTBED, "--set", "target.pixel_px=[900.0, 20.0]"],
        &["pixel_px", "900"],
    );
    refused(
        &["run", TESTBED, "--set", "target.pair=\"mast\""],
        &["mast", "body"],
    );
}

#[test]
fn a_scenario_file_with_a_misspelt_field_is_refused_with_file_line_and_field() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("mine.toml");
    let text = String::from_utf8(rover(&["run", TESTBED, "--print"]).stdout).unwrap();
    assert!(text.contains("pixel_px"));
    std::fs::write(&file, text.replace("pixel_px", "pixel_mm")).unwrap();
    refused(
        &["run", file.to_str().unwrap()],
        &["mine.toml", "pixel_mm", "pixel_px", "line"],
    );
}

#[test]
fn an_output_that_exists_is_kept_without_force() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("report.json");
    std::fs::write(&file, "precious").unwrap();
    refused(
        &["run", "--json", file.to_str().unwrap()],
        &["report.json", "--force"],
    );
    assert_eq!(std::fs::read_to_string(&file).unwrap(), "precious");
}
