//! The rover's file: mast kinematics, camera placing, and what a mistyped section is answered.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use nalgebra::Vector3;
use rover_geometry::Point;
use rover_robot::{CameraMount, Robot};

const ROCKY8: &str = include_str!("../../../scenarios/robots/rocky8.toml");
const BLUESTREAK: &str = include_str!("../../../scenarios/robots/bluestreak.toml");

fn rocky8() -> Robot {
    Robot::parse(ROCKY8, "rocky8.toml").unwrap()
}

#[test]
fn the_rover_is_whole() {
    let robot = rocky8();
    assert_eq!(robot.pair("mast").unwrap().mount, CameraMount::Mast);
    let body = robot.cameras_at(robot.pair("body").unwrap(), None).unwrap();
    assert!((body.baseline_m() - 0.08).abs() < 1e-12);
    // A target on the ground 0.5 m before the wheels is in the body's view.
    let seen = body.left.project(&Vector3::new(1.0, 0.0, 0.05)).unwrap();
    assert!(body.left.contains(&seen, 20.0), "{seen}");
    assert!(robot.mobility().is_ok());
}

#[test]
fn the_mast_points_where_it_is_told() {
    let robot = rocky8();
    let mast = robot.mast().unwrap();
    for point in [
        [6.0, -1.0, 0.2],
        [1.0, 0.3, 0.0],
        [-2.0, 2.0, 0.0],
        [0.9, 0.0, 0.1],
    ] {
        let point = Point::from(Vector3::from(point));
        let [pan, tilt] = mast.angles_towards(&point).unwrap();
        let seen = mast.rover_from_head(pan, tilt).inverse() * point;
        assert!(seen.coords.x > 0.0 && seen.coords.yz().norm() < 1e-6);
    }
    // Positive pan looks left, positive tilt down.
    let ahead = Point::new(5.0, 0.0, 0.0);
    let left_and_down = mast.rover_from_head(0.3, 0.2) * ahead;
    assert!(left_and_down.coords.y > 1.0 && left_and_down.coords.z < 0.6);
}

#[test]
fn a_mast_pair_looks_along_the_head() {
    let robot = rocky8();
    let pair = robot.pair("mast").unwrap();
    let point = Vector3::new(5.0, 1.5, 0.0);
    let angles = robot.mast().unwrap().angles_towards(&point.into()).unwrap();
    let cameras = robot.cameras_at(pair, Some(angles)).unwrap();
    let [left, right] = [&cameras.left, &cameras.right].map(|c| c.project(&point).unwrap());
    // Disparity f b / Z on both sides of the middle.
    let depth = (left.x - right.x) / (1290.0 * 0.2);
    let range = (point - cameras.left.model.cahv()[0]).norm();
    assert!((1.0 / depth / range - 1.0).abs() < 0.01, "{left} {right}");
    assert!((left.y - right.y).abs() < 1e-9);
    let message = robot.cameras_at(pair, None).unwrap_err().to_string();
    assert_eq!(message, "the robot `rocky8` has no mast angles");
}

#[test]
fn stated_odometry_grows_as_a_random_walk() {
    let o = rocky8().mobility().unwrap().odometry;
    let c = o.covariance(4.0, 0.0);
    assert!((c[0][0].sqrt() - 0.12).abs() < 1e-12);
    assert!((c[2][2].sqrt() - 1f64.to_radians()).abs() < 1e-12);
    // The integral of a random walk: sigma^2 L^3 / 3.
    let walk = 0.5f64.to_radians().powi(2) * 64.0 / 3.0;
    assert!((c[1][1] - 0.04f64.powi(2) - walk).abs() < 1e-12);
}

#[test]
fn mistakes_in_the_new_sections_are_named() {
    for (from, to, expected) in [
        (
            "track_m = 0.72",
            "track_m = -0.72",
            "mobility.track_m: -0.72, expected a positive",
        ),
        (
            "axles_x_m = [0.40, 0.0",
            "axles_x_m = [-0.40, 0.0",
            "mobility.axles_x_m",
        ),
        (
            "pan_rad = [-3.1, 3.1]",
            "pan_rad = [3.1, -3.1]",
            "mast.pan_rad: [3.1, -3.1]",
        ),
        (
            "speed_m_s = 0.10",
            "speed_mm_s = 100",
            "unknown field `speed_mm_s`",
        ),
    ] {
        assert!(ROCKY8.contains(from), "{from}");
        let message = Robot::parse(&ROCKY8.replacen(from, to, 1), "robot.toml")
            .unwrap_err()
            .to_string();
        assert!(message.contains(expected), "`{to}` gave: {message}");
    }
    let text = BLUESTREAK.replacen("name = \"body\"", "name = \"body\"\nmount = \"mast\"", 1);
    let message = Robot::parse(&text, "robot.toml").unwrap_err().to_string();
    assert!(message.contains("the robot has no [mast]"), "{message}");
}

#[test]
fn a_robot_without_the_new_sections_keeps_its_hash() {
    let robot = Robot::parse(BLUESTREAK, "bluestreak.toml").unwrap();
    let text = toml::to_string(robot.description()).unwrap();
    assert!(!text.contains("mount") && !text.contains("mast") && !text.contains("vehicle"));
}
