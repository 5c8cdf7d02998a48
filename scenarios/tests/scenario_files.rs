//! What a scenario file and `--set` may say, and what a mistake is answered with.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use rover::{
    embedded,
    scenario::{LoadedScenario, Scenario, ScenarioError},
};
use rover_messages::placement::{Method, Observation};

const SMALL: &str = r#"
name = "small"
robot = "robots/bluestreak.toml"
[target]
pair = "body"
pixel_px = [320.0, 240.0]
"#;

fn load(sets: &[&str]) -> Result<LoadedScenario, ScenarioError> {
    let sets: Vec<String> = sets.iter().map(|s| (*s).to_owned()).collect();
    LoadedScenario::load("scenarios/bluestreak.toml", &sets, None)
}

fn message(sets: &[&str]) -> String {
    load(sets).unwrap_err().to_string()
}

#[test]
fn every_shipped_scenario_is_valid_and_makes_its_own_name() {
    for (file, text) in embedded::SCENARIOS {
        let loaded = LoadedScenario::load(file, &[], None).unwrap();
        let stem = file.rsplit('/').next().unwrap().trim_end_matches(".toml");
        assert_eq!(loaded.scenario.name, stem);
        assert!(!loaded.scenario.description.is_empty());
        assert_eq!(Scenario::parse(text, file).unwrap(), loaded.scenario);
    }
}

#[test]
fn defaults_fill_everything_but_name_robot_and_target() {
    let scenario = Scenario::parse(SMALL, "small.toml").unwrap();
    assert_eq!(scenario.servo.method, Method::EpecField);
    assert_eq!(scenario.servo.observation, Observation::Pose);
    assert_eq!(scenario.arm.start_posture, "stow");
    for field in ["name", "robot", "target"] {
        let without: String = SMALL
            .lines()
            .filter(|l| !l.starts_with(field))
            .collect::<Vec<_>>()
            .join("\n");
        let without = without.replace("[target]", "");
        assert!(Scenario::parse(&without, "x").is_err(), "{field}");
    }
}

#[test]
fn the_printed_scenario_is_the_effective_one_and_reads_back() {
    let loaded = load(&["servo.tolerance_mm=0.25", "simulation.truth.angle_deg=0.5"]).unwrap();
    let printed = loaded.scenario.to_toml().unwrap();
    assert_eq!(
        Scenario::parse(&printed, "printed").unwrap(),
        loaded.scenario
    );
    assert!(printed.contains("tolerance_mm = 0.25"));
    assert!(printed.contains("max_force_n = "), "defaults are filled in");
    assert!(
        printed.contains("# Largest axial force, N."),
        "fields are explained"
    );
}

#[test]
fn an_unknown_field_is_refused_with_file_line_and_the_known_names() {
    let text = SMALL.replace("pixel_px", "pixel");
    let error = Scenario::parse(&text, "small.toml")
        .unwrap_err()
        .to_string();
    for part in [
        "small.toml",
        "line 6",
        "unknown field `pixel`",
        "`pixel_px`",
    ] {
        assert!(error.contains(part), "`{part}` is missing in: {error}");
    }
}

#[test]
fn a_wrong_type_is_refused_with_line_found_and_expected() {
    let text = SMALL.to_owned() + "[contact]\nmax_force_n = \"much\"\n";
    let error = Scenario::parse(&text, "small.toml")
        .unwrap_err()
        .to_string();
    for part in [
        "small.toml",
        "line 8",
        "max_force_n",
        "\"much\"",
        "expected f64",
    ] {
        assert!(error.contains(part), "`{part}` is missing in: {error}");
    }
}

#[test]
fn a_value_out_of_range_names_field_value_and_range() {
    for (set, parts) in [
        (
            "servo.tolerance_mm=0",
            ["servo.tolerance_mm", "0, expected 0.001 to 100"],
        ),
        (
            "servo.stations_m=[0.03, 0.06]",
            ["servo.stations_m", "expected far to near"],
        ),
        (
            "servo.stations_m=[]",
            ["servo.stations_m", "empty, expected at least one"],
        ),
        (
            "target.pixel_px=[640, 10]",
            ["target.pixel_px (u)", "640, expected -0.5 to 639.5"],
        ),
        ("target.pair=mast", ["target.pair", "the robot has: body"]),
        (
            "arm.start_posture=fold",
            ["arm.start_posture", "the robot has: ready, stow"],
        ),
        ("limits.start_s=nan", ["limits.start_s", "NaN, expected"]),
    ] {
        let error = message(&[set]);
        for part in parts {
            assert!(
                error.contains(part),
                "{set}: `{part}` is missing in: {error}"
            );
        }
    }
}

#[test]
fn set_replaces_numbers_words_lists_and_entries_of_lists() {
    let loaded = load(&[
        "servo.method=epec",
        "servo.observation=\"position\"",
        "servo.stations_m=[0.1, 0.05]",
        "simulation.truth.angle_deg=2",
        "simulation.terrain.rocks.0.radius_m=0.12",
        "simulation.occlusion.fiducial_hidden_within_m=0.08",
    ])
    .unwrap();
    let scenario = loaded.scenario;
    assert_eq!(scenario.servo.method, Method::Epec);
    assert_eq!(scenario.servo.observation, Observation::Position);
    assert_eq!(scenario.servo.stations_m, [0.1, 0.05]);
    assert_eq!(scenario.simulation.truth.angle_deg, 2.0);
    assert_eq!(scenario.simulation.terrain.rocks[0].radius_m, 0.12);
    let occlusion = scenario.simulation.occlusion.unwrap();
    assert_eq!(occlusion.fiducial_hidden_within_m, 0.08);
}

#[test]
fn a_mistyped_path_is_refused_with_the_nearest_names() {
    for (set, nearest) in [
        ("servo.toleranc_mm=1", "`servo.tolerance_mm`"),
        ("sevo.tolerance_mm=1", "`servo.tolerance_mm`"),
        ("tolerance_mm=1", "`servo.tolerance_mm`"),
        (
            "simulation.truth.angel_deg=1",
            "`simulation.truth.angle_deg`",
        ),
        (
            "simulation.terrain.rocks.99.radius_m=1",
            "they count from 0",
        ),
        ("servo.method.name=epec", "has no fields"),
    ] {
        let error = message(&[set]);
        assert!(error.starts_with(&format!("--set {set}: ")), "{error}");
        assert!(
            error.contains(nearest),
            "{set}: {nearest} is missing in: {error}"
        );
    }
}

#[test]
fn a_value_that_does_not_fit_is_refused_with_what_was_expected() {
    for (set, part) in [
        (
            "servo.method=fancy",
            "expected one of `kinematic`, `epec`, `epec_field`",
        ),
        ("servo.tolerance_mm=true", "expected f64"),
        ("servo.tolerance_mm=1 2", "is not a TOML value"),
        ("servo.tolerance_mm", "expected PATH=VALUE"),
        ("=1", "expected PATH=VALUE"),
        ("servo.method=", "expected PATH=VALUE"),
    ] {
        let error = message(&[set]);
        assert!(
            error.contains(part),
            "{set}: `{part}` is missing in: {error}"
        );
    }
}

#[test]
fn the_seed_of_the_command_line_wins() {
    let loaded = LoadedScenario::load(embedded::DEFAULT_SCENARIO, &["seed=5".into()], Some(9));
    assert_eq!(loaded.unwrap().scenario.seed, 9);
    assert_eq!(load(&["seed=5"]).unwrap().scenario.seed, 5);
}

#[test]
fn a_file_on_disk_wins_and_finds_the_shipped_robot() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mine.toml");
    std::fs::write(&path, SMALL).unwrap();
    let loaded = LoadedScenario::load(path.to_str().unwrap(), &[], None).unwrap();
    assert_eq!(loaded.scenario.name, "small");
    assert_eq!(loaded.robot.name(), "bluestreak");
    assert_eq!(loaded.robot_origin, "scenarios/robots/bluestreak.toml");

    let robots = folder.path().join("robots");
    std::fs::create_dir(&robots).unwrap();
    let mine = loaded
        .robot_text
        .replace("name = \"bluestreak\"", "name = \"mine\"");
    std::fs::write(robots.join("bluestreak.toml"), mine).unwrap();
    let loaded = LoadedScenario::load(path.to_str().unwrap(), &[], None).unwrap();
    assert_eq!(loaded.robot.name(), "mine");
}

#[test]
fn a_scenario_that_is_nowhere_lists_what_there_is() {
    let error = LoadedScenario::load("nowhere.toml", &[], None)
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("nowhere.toml") && error.contains("scenarios/bluestreak.toml"),
        "{error}"
    );
}
