//! The binary's exit codes, streams and refusals, without starting a simulator.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::{
    path::Path,
    process::{Command, Output},
};

fn rover(folder: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_rover"));
    command
        .args(args)
        .current_dir(folder)
        .env_remove("RUST_LOG")
        .output()
        .unwrap()
}

fn elsewhere() -> tempfile::TempDir {
    tempfile::tempdir().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn refused(args: &[&str], parts: &[&str]) {
    let out = rover(elsewhere().path(), args);
    let stderr = text(&out.stderr);
    assert_eq!(out.status.code(), Some(2), "{args:?}: {stderr}");
    assert!(
        out.stdout.is_empty(),
        "{args:?} wrote data: {}",
        text(&out.stdout)
    );
    for part in parts {
        assert!(
            stderr.contains(part),
            "{args:?}: `{part}` is missing in: {stderr}"
        );
    }
}

#[test]
fn help_names_what_works_and_nothing_else() {
    let out = rover(elsewhere().path(), &["--help"]);
    assert_eq!(out.status.code(), Some(0));
    let help = text(&out.stdout);
    for verb in [
        "run", "up", "campaign", "study", "service", "inspect", "camera", "arm", "vision", "doctor",
    ] {
        assert!(
            help.lines().any(|l| l.trim_start().starts_with(verb)),
            "{verb}: {help}"
        );
    }
    let out = rover(elsewhere().path(), &["run", "--help"]);
    let help = text(&out.stdout);
    for flag in [
        "--seed",
        "--set",
        "--json",
        "--report",
        "--processes",
        "--realtime",
        "--force",
        "--print",
    ] {
        assert!(help.contains(flag), "{flag}: {help}");
    }
    assert!(!help.contains("--record"), "{help}");
}

#[test]
fn an_installed_binary_prints_the_default_scenario_in_any_folder() {
    let out = rover(
        elsewhere().path(),
        &["run", "--print", "--set", "servo.method=epec"],
    );
    assert_eq!(out.status.code(), Some(0), "{}", text(&out.stderr));
    let printed = text(&out.stdout);
    assert!(printed.contains("method = \"epec\""), "{printed}");
    assert!(toml::from_str::<toml::Table>(&printed).is_ok());
}

#[test]
fn a_printed_scenario_can_be_run_as_ones_own() {
    let folder = elsewhere();
    let printed = rover(folder.path(), &["run", "--print", "bluestreak_missed.toml"]).stdout;
    std::fs::write(folder.path().join("mine.toml"), &printed).unwrap();
    let again = rover(folder.path(), &["run", "--print", "mine.toml"]);
    assert_eq!(again.status.code(), Some(0), "{}", text(&again.stderr));
    assert_eq!(text(&again.stdout), text(&printed));
}

#[test]
fn bad_input_ends_with_2_and_says_what_where_and_what_was_expected() {
    refused(
        &["run", "nowhere.toml"],
        &["nowhere.toml", "scenarios/bluestreak.toml"],
    );
    refused(
        &["run", "--set", "servo.tolerance=1"],
        &["servo.tolerance_mm"],
    );
    refused(
        &["run", "--set", "servo.tolerance_mm=-1"],
        &["expected 0.001 to 100"],
    );
    refused(&["run", "--seed", "minus"], &["--seed", "minus"]);
    refused(&["run", "--record", "x.mcap"], &["--record"]);
    refused(&["fly"], &["fly"]);
    refused(
        &["service", "epec"],
        &["no service named `epec`", "epec_servo", "rover_sim"],
    );
    refused(
        &["service", "arm_planner", "--robot", "no.toml"],
        &["no.toml", "bluestreak.toml"],
    );
    refused(&["inspect", "a//b", "--once"], &["KEYEXPR"]);
    refused(
        &["inspect", "--once", "--connect", "tcp/127.0.0.1:1"],
        &["tcp/127.0.0.1:1", "rover up"],
    );
}

#[test]
fn a_broken_file_is_refused_with_its_line() {
    let folder = elsewhere();
    std::fs::write(
        folder.path().join("broken.toml"),
        "name = \"x\"\nrobot = 5\n",
    )
    .unwrap();
    let out = rover(folder.path(), &["run", "broken.toml"]);
    let stderr = text(&out.stderr);
    assert_eq!(out.status.code(), Some(2), "{stderr}");
    for part in ["broken.toml", "line 2", "robot", "expected a string"] {
        assert!(stderr.contains(part), "`{part}` is missing in: {stderr}");
    }
}

#[test]
fn existing_outputs_are_refused_before_anything_runs() {
    let folder = elsewhere();
    std::fs::write(folder.path().join("out.json"), "mine").unwrap();
    std::fs::create_dir(folder.path().join("page")).unwrap();
    std::fs::write(folder.path().join("page/index.html"), "mine").unwrap();
    for args in [["run", "--json", "out.json"], ["run", "--report", "page"]] {
        let out = rover(folder.path(), &args);
        assert_eq!(out.status.code(), Some(2), "{}", text(&out.stderr));
        assert!(
            text(&out.stderr).contains("--force"),
            "{}",
            text(&out.stderr)
        );
    }
    assert_eq!(
        std::fs::read_to_string(folder.path().join("out.json")).unwrap(),
        "mine"
    );
}

#[test]
fn the_doctor_reports_every_check_with_a_remedy_for_what_is_wrong() {
    let out = rover(elsewhere().path(), &["doctor", "--json", "-"]);
    let findings: serde_json::Value = serde_json::from_slice(&out.stdout).unwrap();
    assert_eq!(findings["healthy"], out.status.success());
    let all = findings["findings"].as_array().unwrap();
    let checks: Vec<_> = all.iter().map(|f| f["check"].as_str().unwrap()).collect();
    for check in ["loopback TCP", "zenoh", "cpu", "shipped files", "RUST_LOG"] {
        assert!(checks.contains(&check), "{check}: {checks:?}");
    }
    for finding in all {
        assert_eq!(
            finding["state"] == "ok",
            finding["remedy"].is_null(),
            "{finding}"
        );
    }
}
