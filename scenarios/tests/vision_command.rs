//! `rover vision` on images that the test writes: answers, tables, refusals and exit codes.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::{
    path::Path,
    process::{Command, Output},
};

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector2, Vector3};
use rover_cameras::{Camera, formats::write_text};
use rover_vision::{Image8, PlateLayout, texture::texture};

fn rover(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_rover"))
        .args(["vision"])
        .args(args)
        .current_dir(folder)
        .env_remove("RUST_LOG")
        .output()
        .unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn json(out: &Output) -> serde_json::Value {
    serde_json::from_slice(&out.stdout).unwrap_or_else(|e| panic!("{e}: {}", text(&out.stderr)))
}

/// A camera at (`x`, 0, 0), looking along z.
fn camera(x: f64) -> Camera {
    let pose = Isometry3::from_parts(Translation3::new(x, 0.0, 0.0), UnitQuaternion::identity());
    Camera::pinhole(&pose, [400.0; 2], [159.5, 119.5], [320, 240])
}

/// The plane through (0, 0, 0.6) with this normal, as `shade` of x and y colours it.
fn photograph(camera: &Camera, normal: Vector3<f64>, shade: &dyn Fn(f64, f64) -> f64) -> Image8 {
    let mut pixels = Vec::new();
    for v in 0..240 {
        for u in 0..320 {
            let mut sum = 0.0;
            for k in 0..9 {
                let part = |k: i32| (f64::from(k) - 1.0) / 3.0;
                let at = Vector2::new(f64::from(u) + part(k % 3), f64::from(v) + part(k / 3));
                let ray = camera.ray(&at).unwrap();
                let offset = Vector3::new(0.0, 0.0, 0.6) - ray.origin;
                let p = ray.at(normal.dot(&offset) / normal.dot(ray.direction.as_ref()));
                sum += shade(p.x, p.y);
            }
            pixels.push((sum / 9.0).round().clamp(0.0, 255.0) as u8);
        }
    }
    Image8::from_raw(320, 240, pixels).unwrap()
}

fn write(folder: &Path, name: &str, image: &Image8) {
    image.write_png(&folder.join(name)).unwrap();
}

fn model(folder: &Path, name: &str, camera: &Camera) {
    std::fs::write(
        folder.join(name),
        write_text(camera, Some("rover")).unwrap(),
    )
    .unwrap();
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
fn pixels_are_matched_triangulated_and_their_surface_measured() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let normal = Vector3::new(0.2, 0.5, -1.0).normalize();
    let rock = |x: f64, y: f64| texture(x, y, 0.06, 0.003, 25.0, 8);
    for (side, x) in [("left", 0.0), ("right", 0.06)] {
        write(
            at,
            &format!("{side}.png"),
            &photograph(&camera(x), normal, &rock),
        );
        model(at, &format!("{side}.cahv"), &camera(x));
    }
    std::fs::write(at.join("p.csv"), "u_px,v_px\n180,130\n2,2\n150.5,110.25\n").unwrap();
    let models = ["--left-model", "left.cahv", "--right-model", "right.cahv"];
    let pair = [&["left.png", "right.png"][..], &models[..]].concat();
    let out = rover(
        at,
        &[&["match"], &pair[..], &["--pixels", "p.csv"]].concat(),
    );
    let table = text(&out.stdout);
    assert_eq!(out.status.code(), Some(0), "{}", text(&out.stderr));
    let lines: Vec<&str> = table.lines().collect();
    assert_eq!(lines[0], "ur_px,vr_px,x_m,y_m,z_m,score,status");
    assert_eq!(lines.len(), 4);
    for (line, pixel) in [(lines[1], [180.0, 130.0]), (lines[3], [150.5, 110.25])] {
        let cells: Vec<&str> = line.split(',').collect();
        assert_eq!(cells[6], "ok", "{line}");
        let ray = camera(0.0).ray(&Vector2::from(pixel)).unwrap();
        let plane = Vector3::new(0.0, 0.0, 0.6);
        let truth = ray.at(normal.dot(&plane) / normal.dot(ray.direction.as_ref()));
        for (k, cell) in cells[2..5].iter().enumerate() {
            let found: f64 = cell.parse().unwrap();
            assert!((found - truth[k]).abs() < 3e-3, "{line}: {truth}");
        }
    }
    assert!(lines[2].starts_with(",,,,,,") && lines[2].contains("leaves the image"));

    let out = rover(
        at,
        &[&["normal"], &pair[..], &["--pixel", "170,125"]].concat(),
    );
    let seen = json(&out);
    assert_eq!(out.status.code(), Some(0), "{seen}");
    let found = Vector3::new(0, 1, 2).map(|k: usize| seen["normal"][k].as_f64().unwrap());
    assert!(found.dot(&normal) > 0.998, "{seen}");
    assert!(seen["points_used"].as_u64().unwrap() > 40);
    assert!(seen["plane_rms_mm"].as_f64().unwrap() < 1.5);
    let out = rover(at, &[&["normal"], &pair[..], &["--pixel", "1,1"]].concat());
    assert_eq!(out.status.code(), Some(3), "{}", text(&out.stdout));
}

#[test]
fn the_disparity_image_has_the_planes_depth_and_marks_what_it_does_not_know() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let normal = Vector3::new(0.1, 0.4, -1.0).normalize();
    let rock = |x: f64, y: f64| texture(x, y, 0.06, 0.003, 25.0, 9);
    for (side, x) in [("left", 0.0), ("right", 0.06)] {
        let image = photograph(&camera(x), normal, &rock);
        write(at, &format!("{side}.png"), &image);
        model(at, &format!("{side}.cahv"), &camera(x));
    }
    let flat = Image8::from_raw(320, 240, vec![90; 320 * 240]).unwrap();
    write(at, "flat.png", &flat);
    let models = ["--left-model", "left.cahv", "--right-model", "right.cahv"];
    let ask = |images: [&str; 2], more: &[&str]| {
        rover(
            at,
            &[&["disparity"], &images[..], &models[..], more].concat(),
        )
    };
    let ranges = ["--range-min-m", "0.35", "--range-max-m", "1.2"];
    let out = ask(
        ["left.png", "right.png"],
        &[&ranges[..], &["-o", "d.csv", "--json", "-"]].concat(),
    );
    assert_eq!(out.status.code(), Some(0), "{}", text(&out.stderr));
    let summary = json(&out);
    assert!((summary["disparity_depth_px_m"].as_f64().unwrap() - 24.0).abs() < 1e-6);
    assert!(
        summary["found_percent"].as_f64().unwrap() > 50.0,
        "{summary}"
    );

    let table = std::fs::read_to_string(at.join("d.csv")).unwrap();
    let mut lines = table.lines();
    assert_eq!(
        lines.next(),
        Some("u_px,v_px,disparity_px,x_m,y_m,z_m,status")
    );
    let (mut found, mut all, mut off) = (0u64, 0, Vec::new());
    let mut disparities = Vec::new();
    for line in lines {
        let cells: Vec<&str> = line.split(',').collect();
        let pixel = [all % 320, all / 320].map(|x| x.to_string());
        assert_eq!(cells[..2], pixel[..], "{line}");
        all += 1;
        if cells[6..] != ["ok"] {
            assert_eq!(cells[2..6], [""; 4], "{line}");
            assert!(cells[6].len() > 10, "{line}");
            disparities.push(None);
            continue;
        }
        found += 1;
        let number = |k: usize| cells[k].parse::<f64>().unwrap();
        // the cameras are parallel: rectified and taken pixels are alike
        let ray = camera(0.0)
            .ray(&Vector2::new(number(0), number(1)))
            .unwrap();
        let plane = Vector3::new(0.0, 0.0, 0.6);
        let depth = ray
            .at(normal.dot(&plane) / normal.dot(ray.direction.as_ref()))
            .z;
        off.push((number(2) - 24.0 / depth).abs());
        assert!((number(5) - 24.0 / number(2)).abs() < 1e-9, "{line}");
        disparities.push(Some(number(2)));
    }
    assert_eq!((all, summary["found"].as_u64()), (320 * 240, Some(found)));
    off.sort_by(f64::total_cmp);
    let (median, most) = (off[off.len() / 2], off[off.len() * 99 / 100]);
    assert!(median < 0.1 && most < 0.5, "{median} {most}");

    // the same as a picture: 64 steps per px, 0 for no answer
    let png = [&ranges[..], &["--out", "d.png"]].concat();
    let out = ask(["left.png", "right.png"], &png);
    assert_eq!(out.status.code(), Some(0), "{}", text(&out.stderr));
    let picture = image::open(at.join("d.png")).unwrap();
    let image::DynamicImage::ImageLuma16(picture) = picture else {
        panic!("not a 16-bit grey image");
    };
    for (pixel, disparity) in picture.pixels().zip(&disparities) {
        let steps = disparity.map_or(0, |d| (d * 64.0) as u16);
        assert_eq!(pixel.0[0], steps);
    }

    let out = ask(
        ["flat.png", "flat.png"],
        &["-o", "-", "--json", "flat.json"],
    );
    assert_eq!(out.status.code(), Some(3), "{}", text(&out.stderr));
    assert!(
        text(&out.stdout)
            .lines()
            .nth(1)
            .unwrap()
            .starts_with("0,0,,,,,no match")
    );
    let refusals: [(&[&str], &str); 4] = [
        (&["-o", "d.tiff"], ".png"),
        (&["-o", "d.png"], "--force"),
        (&["-o", "-", "--json", "-"], "standard output"),
        (&["-o", "e.png", "--range-min-m", "0.01"], "256"),
    ];
    for (more, why) in refusals {
        let out = ask(["left.png", "right.png"], more);
        assert_eq!(out.status.code(), Some(2), "{more:?}");
        assert!(text(&out.stderr).contains(why), "{}", text(&out.stderr));
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
