//! `rover vision` on images that the test writes: answers, refusals and exit codes.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod support;

use std::{path::Path, process::Output};

use nalgebra::Vector3;
use rover_vision::{Image8, PlateLayout, texture::texture};
use support::{camera, json, model, photograph, text, write};

fn rover(folder: &Path, args: &[&str]) -> Output {
    support::run(folder, &[&["vision"], args].concat())
}

#[test]
fn a_disc_a_saddle_and_a_template_are_found_where_they_are() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let facing = Vector3::z();
    let disc = |x: f64, y: f64| {
        if (x - 0.012).hypot(y + 0.02) < 0.015 {
            30.0
        } else {
            200.0
        }
    };
    write(at, "disc.png", &photograph(&camera(0.0), facing, &disc));
    let seen = json(&rover(at, &["find", "disc.png", "--fiducial", "disc"]));
    let (u, v) = (159.5 + 400.0 * 0.012 / 0.6, 119.5 - 400.0 * 0.02 / 0.6);
    assert_eq!(seen["status"], "ok");
    assert!((seen["u_px"].as_f64().unwrap() - u).abs() < 0.03, "{seen}");
    assert!((seen["v_px"].as_f64().unwrap() - v).abs() < 0.03, "{seen}");
    assert!(seen["score"].as_f64().unwrap() > 0.97 && seen["sigma_px"].as_f64().unwrap() < 0.1);

    let saddle = |x: f64, y: f64| {
        if (x - 0.01) * (y - 0.01) > 0.0 {
            40.0
        } else {
            210.0
        }
    };
    write(at, "saddle.png", &photograph(&camera(0.0), facing, &saddle));
    let near = [
        "find",
        "saddle.png",
        "--fiducial",
        "saddle",
        "--near",
        "160,120",
    ];
    let seen = json(&rover(at, &near));
    let expected = 159.5 + 400.0 * 0.01 / 0.6;
    // Edges without any blur alias: a twentieth of a pixel is what they allow.
    assert!(
        (seen["u_px"].as_f64().unwrap() - expected).abs() < 0.06,
        "{seen}"
    );

    let rock = |x: f64, y: f64| texture(x, y, 0.06, 0.004, 30.0, 3);
    let image = photograph(&camera(0.0), facing, &rock);
    let cut = (0..31 * 31).map(|i| image.get(100 + i % 31, 80 + i / 31).unwrap());
    write(
        at,
        "cut.png",
        &Image8::from_raw(31, 31, cut.collect()).unwrap(),
    );
    write(at, "rock.png", &image);
    let args = [
        "find",
        "rock.png",
        "--fiducial",
        "template",
        "--template",
        "cut.png",
    ];
    let seen = json(&rover(at, &args));
    assert!(
        (seen["u_px"].as_f64().unwrap() - 115.0).abs() < 0.01,
        "{seen}"
    );
    assert!(
        (seen["v_px"].as_f64().unwrap() - 95.0).abs() < 0.01,
        "{seen}"
    );
}

#[test]
fn a_plate_is_found_with_its_pose_in_the_whole_image() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let layout = PlateLayout::standard(0.16);
    // the plate's y is up, the camera's down
    let plate = |x: f64, y: f64| layout.albedo(x, -y).map_or(110.0, |a| a * 220.0);
    let camera = camera(0.0);
    write(at, "plate.png", &photograph(&camera, Vector3::z(), &plate));
    model(at, "camera.cahv", &camera);
    let args = [
        "find",
        "plate.png",
        "--fiducial",
        "plate",
        "--model",
        "camera.cahv",
        "--width-m",
        "0.16",
    ];
    let out = rover(at, &args);
    let seen = json(&out);
    assert_eq!(out.status.code(), Some(0), "{seen}");
    let position = &seen["pose"]["position_m"];
    for (k, expected) in [0.0, 0.0, 0.6].into_iter().enumerate() {
        assert!(
            (position[k].as_f64().unwrap() - expected).abs() < 2e-3,
            "{seen}"
        );
    }
    assert!(
        (seen["u_px"].as_f64().unwrap() - 159.5).abs() < 0.05,
        "{seen}"
    );
}

#[test]
fn what_is_not_there_ends_with_3_and_says_which_rule_refused() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let flat = Image8::from_raw(64, 48, vec![90; 64 * 48]).unwrap();
    write(at, "flat.png", &flat);
    for kind in ["harris", "disc", "saddle", "apriltag"] {
        let out = rover(at, &["find", "flat.png", "--fiducial", kind]);
        assert_eq!(out.status.code(), Some(3), "{kind}");
        let said = json(&out);
        assert_eq!(said["refused_by"], "nothing_there", "{said}");
        assert!(said.get("u_px").is_none() && said["status"] != "ok");
        assert!(text(&out.stderr).contains(kind));
    }
}

#[test]
fn bad_input_ends_with_2_and_names_what_is_wrong() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    write(
        at,
        "flat.png",
        &Image8::from_raw(64, 48, vec![90; 64 * 48]).unwrap(),
    );
    model(at, "camera.cahv", &camera(0.0));
    std::fs::write(at.join("rules.toml"), "min_contrst_dn = 3\n").unwrap();
    std::fs::write(at.join("not.png"), "GIF89a").unwrap();
    let refused = |args: &[&str], parts: &[&str]| {
        let out = rover(at, args);
        let said = text(&out.stderr);
        assert_eq!(out.status.code(), Some(2), "{args:?}: {said}");
        assert!(out.stdout.is_empty());
        for part in parts {
            assert!(
                said.contains(part),
                "{args:?}: `{part}` is missing in: {said}"
            );
        }
    };
    refused(&["find", "no.png", "--fiducial", "disc"], &["no.png"]);
    refused(
        &["find", "not.png", "--fiducial", "disc"],
        &["not.png", "PNG"],
    );
    refused(
        &["find", "flat.png", "--fiducial", "cross"],
        &["cross", "saddle"],
    );
    refused(
        &["find", "flat.png", "--fiducial", "template"],
        &["--template"],
    );
    refused(
        &["find", "flat.png", "--fiducial", "disc", "--near", "1"],
        &["--near", "2 finite"],
    );
    refused(
        &["find", "flat.png", "--fiducial", "disc", "--near", "900,9"],
        &["--near", "64 x 48"],
    );
    refused(
        &[
            "find",
            "flat.png",
            "--fiducial",
            "disc",
            "--rules",
            "rules.toml",
        ],
        &["rules.toml", "min_contrst_dn", "min_contrast_dn"],
    );
    refused(
        &[
            "find",
            "flat.png",
            "--fiducial",
            "plate",
            "--model",
            "camera.cahv",
            "--width-m",
            "0.1",
        ],
        &["camera.cahv", "320 x 240", "64 x 48"],
    );
    refused(
        &[
            "find",
            "flat.png",
            "--fiducial",
            "apriltag",
            "--family",
            "tag99",
        ],
        &["tag99", "tag36h11"],
    );
    refused(&["evaluate", "--only", "discs"], &["discs", "disc"]);
    refused(&["evaluate", "--patches", "0"], &["--patches"]);
    refused(&["evaluate", "--noise", "99"], &["--noise"]);
}

#[test]
fn the_evaluation_reports_every_rate_beside_its_target() {
    let folder = tempfile::tempdir().unwrap();
    let args = [
        "evaluate",
        "--patches",
        "8",
        "--only",
        "saddle",
        "--json",
        "rows.json",
    ];
    let out = rover(folder.path(), &args);
    assert_eq!(out.status.code(), Some(0), "{}", text(&out.stderr));
    assert!(text(&out.stdout).contains("false accepts"));
    let written = std::fs::read_to_string(folder.path().join("rows.json")).unwrap();
    let rows: serde_json::Value = serde_json::from_str(&written).unwrap();
    assert_eq!(rows.as_array().unwrap().len(), 2);
    for row in rows.as_array().unwrap() {
        assert_eq!(
            (&row["name"], &row["patches"]),
            (&"saddle".into(), &4.into())
        );
        assert!(row["detected_percent"].as_f64().unwrap() >= 50.0, "{row}");
        assert!(row["target"].as_str().unwrap().contains("no false accept"));
    }
    let again = rover(folder.path(), &[&args[..], &["--force"]].concat());
    assert_eq!(again.status.code(), Some(0));
    assert_eq!(
        std::fs::read_to_string(folder.path().join("rows.json")).unwrap(),
        written
    );
}
