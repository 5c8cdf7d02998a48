//! The shipped robot file, and what a mistyped one is answered.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use rover_robot::{Robot, RobotError};

const BLUESTREAK: &str = include_str!("../../../scenarios/robots/bluestreak.toml");

fn parse(from: &str, to: &str) -> Result<Robot, RobotError> {
    assert!(BLUESTREAK.contains(from), "{from}");
    Robot::parse(&BLUESTREAK.replacen(from, to, 1), "robot.toml")
}

#[test]
fn the_shipped_robot_is_whole_and_keeps_its_hash() {
    let a = Robot::parse(BLUESTREAK, "bluestreak.toml").unwrap();
    let b = Robot::parse(BLUESTREAK, "copy.toml").unwrap();
    assert_eq!(a.configuration_sha256(), b.configuration_sha256());
    let baseline = a.pair("body").unwrap().cameras.baseline_m();
    assert!((baseline - 0.08).abs() < 1e-12);
    // Pointing down over the workspace, the fiducial faces back and up, towards the cameras.
    let link = a
        .rover_from_link(a.posture("ready").unwrap())
        .unwrap()
        .isometry;
    let normal = link * a.link_from_plate * nalgebra::Vector3::z();
    assert!(normal.x < -0.6 && normal.z > 0.6, "{normal}");
}

#[test]
fn mistakes_are_named_with_field_and_expectation() {
    for (from, to, expected) in [
        (
            "heartbeat_s = 0.02",
            "heartbeat_ms = 20",
            "unknown field `heartbeat_ms`",
        ),
        (
            "heartbeat_s = 0.02",
            "heartbeat_s = 2.0",
            "arm.heartbeat_s: 2, expected at most 0.05",
        ),
        (
            "tip_m = [0.0, 0.0, 0.1306]",
            "tip_m = [0.0, 0.1306]",
            "tip_m",
        ),
        (
            "angle_deg = 1.0",
            "angle_deg = -1.0",
            "model_quality.angle_deg: -1, expected a positive",
        ),
        (
            "travel_m = 0.004",
            "travel_m = 0.001",
            "tool.switch.travel_m: 0.001, expected more than",
        ),
        ("stow = [-1.5,", "stow = [-3.5,", "shoulder_azimuth"),
        (
            "name = \"bluestreak\"",
            "name = \"Blue/streak\"",
            "name: `Blue/streak`, expected lower",
        ),
        (
            "axis = [0.0, 0.0, 1.0]",
            "axis = [0.0, 0.0, 0.0]",
            "tool.axis",
        ),
    ] {
        let message = parse(from, to).unwrap_err().to_string();
        assert!(message.contains(expected), "`{to}` gave: {message}");
        assert!(message.contains("robot.toml"), "{message}");
    }
}

#[test]
fn an_unknown_name_is_answered_with_the_known_ones() {
    let robot = Robot::parse(BLUESTREAK, "bluestreak.toml").unwrap();
    let message = robot.posture("home").unwrap_err().to_string();
    assert_eq!(
        message,
        "no posture named `home`; the robot has: ready, stow"
    );
}

#[test]
fn a_field_that_cannot_be_is_named_with_its_line() {
    for (from, to, part) in [
        ("heartbeat_s = 0.02", "heartbeat_s = 2.0", "heartbeat_s"),
        ("travel_m = 0.004", "travel_m = 0.001", "travel_m"),
        ("stow = [-1.5,", "stow = [-3.5,", "stow"),
    ] {
        let line = BLUESTREAK
            .lines()
            .position(|l| l.contains(from))
            .map(|i| i + 1)
            .unwrap();
        let message = parse(from, to).unwrap_err().to_string();
        let expected = format!("robot.toml:{line}: ");
        assert!(
            message.starts_with(&expected) && message.contains(part),
            "{expected} {message}"
        );
    }
}

proptest::proptest! {
    #![proptest_config(proptest::prelude::ProptestConfig::with_cases(150))]
    #[test]
    fn a_damaged_robot_file_is_read_or_refused_by_name(
        at in 0.0..1.0f64, length in 0usize..40, with in "[ -~\n]{0,10}",
    ) {
        let bytes = BLUESTREAK.as_bytes();
        let start = (at * bytes.len() as f64) as usize;
        let end = (start + length).min(bytes.len());
        let damaged = [&bytes[..start], with.as_bytes(), &bytes[end..]].concat();
        let text = String::from_utf8_lossy(&damaged);
        if let Err(error) = Robot::parse(&text, "robot.toml") {
            proptest::prop_assert!(error.to_string().starts_with("robot.toml"), "{}", error);
        }
    }
}
