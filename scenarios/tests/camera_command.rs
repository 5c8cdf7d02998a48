//! `rover camera` on files: tables, conversions, calibration, and what is refused.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use nalgebra::{Isometry3, Point3, Unit, Vector2, Vector3};
use rover_cameras::{
    Camera, StereoPair,
    formats::{read_text, write_text},
};
use rover_vision::Image8;
use std::{
    fs,
    path::Path,
    process::{Command, Output},
};

const HAZCAM: &str = "\
Model = CAHVORE
Dimensions = 1024 1024
Frame = rover
C = 0.609331 -0.041064 -0.233849
A = 0.703447 -0.005161 0.710729
H = 351.362 452.204 353.494
V = 35.8065 -1.75143 682.705
O = 0.704402 -0.006062 0.709775
R = 3e-06 -0.012015 -0.007525
E = 0.001442 0.001522 0.000483
T = 3
P = 0.37
";

fn rover(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_rover"))
        .arg("camera")
        .args(args)
        .current_dir(folder)
        .env_remove("RUST_LOG")
        .output()
        .unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn done(folder: &Path, args: &[&str]) -> String {
    let out = rover(folder, args);
    assert_eq!(
        out.status.code(),
        Some(0),
        "{args:?}: {}",
        text(&out.stderr)
    );
    text(&out.stdout)
}

fn refused(folder: &Path, args: &[&str], parts: &[&str]) {
    let out = rover(folder, args);
    let stderr = text(&out.stderr);
    assert_eq!(out.status.code(), Some(2), "{args:?}: {stderr}");
    for part in parts {
        assert!(
            stderr.contains(part),
            "{args:?}: `{part}` is missing in: {stderr}"
        );
    }
}

fn folder(files: &[(&str, &str)]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for (name, content) in files {
        fs::write(folder.path().join(name), content).unwrap();
    }
    folder
}

fn rows(table: &str) -> Vec<Vec<String>> {
    table
        .lines()
        .map(|line| line.split(',').map(str::to_owned).collect())
        .collect()
}

#[test]
fn points_get_the_reference_pixels_and_a_reason_where_there_is_none() {
    let points = "x_m,y_m,z_m\n0.890709861654442,-0.04312838855292208,0.0504426791749768\n\
                  -5,0,-5\n0.9,5,0.05\n";
    let folder = folder(&[("haz.cahvore", HAZCAM), ("p.csv", points)]);
    let out = rows(&done(folder.path(), &["project", "haz.cahvore", "p.csv"]));
    assert_eq!(out[0], ["u_px", "v_px", "range_m", "status"]);
    let number = |i: usize| out[1][i].parse::<f64>().unwrap();
    assert!((number(0) - 496.0691570960001).abs() < 1e-9, "{out:?}");
    assert!((number(1) - 510.41525608073).abs() < 1e-9, "{out:?}");
    assert_eq!(out[1][3], "ok");
    for row in &out[2..] {
        assert_eq!(row[..3], ["", "", ""], "{row:?}");
        assert!(row[3].contains("the"), "{row:?}");
    }
}

#[test]
fn rays_and_triangulation_give_a_point_back() {
    let left = Camera::pinhole(
        &Isometry3::identity(),
        [600.0; 2],
        [319.5, 239.5],
        [640, 480],
    );
    let right = left.transformed(&Isometry3::translation(0.08, 0.0, 0.0));
    let point = Vector3::new(0.05, -0.02, 0.6);
    let (l, r) = (
        left.project(&point).unwrap(),
        right.project(&point).unwrap(),
    );
    let folder = folder(&[
        ("l.cahv", &write_text(&left, Some("rig")).unwrap()),
        ("r.cahv", &write_text(&right, Some("rig")).unwrap()),
        ("other.cahv", &write_text(&right, Some("mast")).unwrap()),
        ("px.csv", &format!("u_px,v_px\n{},{}\n", l.x, l.y)),
        (
            "m.csv",
            &format!(
                "ul_px,vl_px,ur_px,vr_px\n{},{},{},{}\n100,100,300,100\n",
                l.x, l.y, r.x, r.y
            ),
        ),
    ]);
    let out = rows(&done(folder.path(), &["ray", "l.cahv", "px.csv"]));
    assert_eq!(out[0], ["ox_m", "oy_m", "oz_m", "dx", "dy", "dz", "status"]);
    let dz: f64 = out[1][5].parse().unwrap();
    assert!((dz - point.normalize().z).abs() < 1e-12);
    let out = rows(&done(
        folder.path(),
        &["triangulate", "l.cahv", "r.cahv", "m.csv"],
    ));
    for axis in 0..3 {
        let x: f64 = out[1][axis].parse().unwrap();
        assert!((x - point[axis]).abs() < 1e-9, "{out:?}");
    }
    assert_ne!(out[2].last().unwrap(), "ok", "{out:?}");
    refused(
        folder.path(),
        &["triangulate", "l.cahv", "other.cahv", "m.csv"],
        &["rig", "mast", "one frame"],
    );
}

#[test]
fn a_model_goes_through_every_format_and_comes_back() {
    let lens = Camera::pinhole_distorted(
        &Isometry3::identity(),
        [600.0, 601.0],
        [319.5, 239.5],
        [640, 480],
        &Vector3::z_axis(),
        [0.0, -0.12, 0.03],
    );
    let original = write_text(&lens, Some("cam")).unwrap();
    let folder = folder(&[("a.cahvor", &original)]);
    let at = folder.path();
    for (to, file) in [
        ("toml", "a.toml"),
        ("ros", "ros.yaml"),
        ("opencv", "cv.yaml"),
        ("kalibr", "k.yaml"),
    ] {
        let out = rover(
            at,
            &["convert", "a.cahvor", file, "--to", to, "--json", "-"],
        );
        assert_eq!(out.status.code(), Some(0), "{to}: {}", text(&out.stderr));
        let report: serde_json::Value = serde_json::from_slice(&out.stdout).unwrap();
        assert_eq!(report["exact"], true);
        assert_eq!(report["to"], to);
        let back = read_text(&done(at, &["convert", file, "-", "--to", "cahv"])).unwrap();
        let camera = back.camera().unwrap();
        let point = Vector3::new(0.3, -0.2, 1.0);
        let error = camera.project(&point).unwrap() - lens.project(&point).unwrap();
        assert!(error.amax() < 1e-9, "{to}: {error}");
    }
    refused(at, &["convert", "a.cahvor", "a.yaml"], &["a.yaml", "--to"]);
    refused(at, &["convert", "a.cahvor", "a.toml"], &["--force"]);
    refused(
        at,
        &["convert", "ros.yaml#1", "-", "--to", "cahv"],
        &["Kalibr"],
    );
    let half = done(
        at,
        &[
            "convert",
            "a.cahvor",
            "-",
            "--to",
            "cahv",
            "--downsample",
            "2",
        ],
    );
    assert!(half.contains("Dimensions = 320 240"), "{half}");
}

#[test]
fn what_a_format_cannot_hold_is_refused_with_the_error_of_the_best_fit() {
    let folder = folder(&[("haz.cahvore", HAZCAM)]);
    let strict = [
        "convert",
        "haz.cahvore",
        "-",
        "--to",
        "ros",
        "--limit-px",
        "0.000001",
    ];
    refused(folder.path(), &strict, &["px off at worst"]);
}

#[test]
fn broken_files_are_refused_with_file_and_line() {
    let folder = folder(&[
        ("s.cahv", &HAZCAM.replace("T = 3", "S = 3")),
        ("x.yaml", "image_width: [\n"),
        ("x.toml", "size_px = 3\n"),
        ("haz.cahvore", HAZCAM),
        ("p.csv", "x_m,y_m\n1,2\n"),
    ]);
    let at = folder.path();
    refused(at, &["info", "s.cahv"], &["s.cahv", "line 11", "S = 3"]);
    refused(at, &["info", "x.yaml"], &["x.yaml", "line"]);
    refused(at, &["info", "x.toml"], &["x.toml", "line 1"]);
    refused(at, &["info", "none.cahv"], &["none.cahv"]);
    refused(at, &["project", "haz.cahvore", "p.csv"], &["p.csv", "z_m"]);
}

#[test]
fn info_says_what_the_model_means() {
    let folder = folder(&[("haz.cahvore", HAZCAM)]);
    let out = done(folder.path(), &["info", "haz.cahvore", "--json", "-"]);
    let info: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!(info["model"], "CAHVORE");
    assert_eq!(info["frame"], "rover");
    assert!(
        (info["focal_px"][0].as_f64().unwrap() - 454.8).abs() < 0.1,
        "{info}"
    );
    let field = info["field_deg"]["horizontal"].as_f64().unwrap();
    assert!((120.0..130.0).contains(&field), "{info}");
}

/// A board of 9 x 6 inner corners, seen by `camera`.
fn picture(camera: &Camera, camera_from_board: &Isometry3<f64>) -> Image8 {
    let (rotation, shift) = (
        camera_from_board.rotation,
        camera_from_board.translation.vector,
    );
    let normal = rotation * Vector3::z();
    let mut pixels = Vec::with_capacity(640 * 480);
    for v in 0..480 {
        for u in 0..640 {
            let mut sum = 0.0;
            for k in 0..9 {
                let sub = |i: i32| (f64::from(i) - 1.0) / 3.0;
                let pixel = Vector2::new(f64::from(u) + sub(k % 3), f64::from(v) + sub(k / 3));
                let ray = camera.ray(&pixel).unwrap();
                let range = normal.dot(&(shift - ray.origin)) / normal.dot(ray.direction.as_ref());
                let at = camera_from_board.inverse() * Point3::from(ray.at(range));
                let (i, j) = (
                    (at.x / 0.02).floor() as i64 + 1,
                    (at.y / 0.02).floor() as i64 + 1,
                );
                let on = (0..10).contains(&i) && (0..7).contains(&j);
                sum += if on && (i + j) % 2 == 0 { 30.0 } else { 200.0 };
            }
            pixels.push((sum / 9.0_f64).round() as u8);
        }
    }
    Image8::from_raw(640, 480, pixels).unwrap()
}

#[test]
fn a_pair_is_calibrated_from_pictures_alone() {
    let axis = Unit::new_normalize(Vector3::new(0.002, -0.001, 1.0));
    let r = [0.0, -0.12, 0.03];
    let lens = |fx: f64| {
        let own = Isometry3::identity();
        Camera::pinhole_distorted(&own, [fx, fx], [322.0, 238.0], [640, 480], &axis, r)
    };
    let left = lens(602.0);
    let right_from_left =
        Isometry3::new(Vector3::new(-0.08, 0.0, 0.0), Vector3::new(0.0, 0.1, 0.0));
    let right = lens(598.0).transformed(&right_from_left.inverse());
    let folder = tempfile::tempdir().unwrap();
    let mut args = vec![
        "calibrate",
        "--board",
        "chessboard:9x6:0.02",
        "--out",
        "result",
    ];
    let (mut lefts, mut rights) = (vec!["--left".to_owned()], vec!["--right".to_owned()]);
    let turns = [
        [0.4, 0.0, 0.1],
        [-0.4, 0.1, 0.0],
        [0.0, 0.5, -0.1],
        [0.1, -0.5, 0.2],
        [0.3, 0.3, 0.0],
        [-0.3, -0.3, -0.2],
    ];
    for (n, turn) in turns.iter().enumerate() {
        let turn = Vector3::from(*turn);
        let place = Isometry3::new(Vector3::new(0.03, 0.0, 0.42), turn);
        let shift = place * Vector3::new(-0.08, -0.05, 0.0);
        let pose = Isometry3::from_parts((place.translation.vector + shift).into(), place.rotation);
        for (camera, side, list) in [(&left, "l", &mut lefts), (&right, "r", &mut rights)] {
            let name = format!("{side}{n}.png");
            picture(camera, &pose)
                .write_png(&folder.path().join(&name))
                .unwrap();
            list.push(name);
        }
    }
    // A pair given twice counts once, and is named.
    lefts.push("l0.png".into());
    rights.push("r0.png".into());
    args.extend(lefts.iter().chain(&rights).map(String::as_str));
    let out = rover(folder.path(), &args);
    let said = text(&out.stderr);
    assert_eq!(out.status.code(), Some(0), "{said}");
    for part in [
        "l0.png + r0.png shows",
        "counted once",
        "fx 60",
        "baseline: ",
    ] {
        assert!(said.contains(part), "`{part}` is missing in: {said}");
    }
    let result = folder.path().join("result");
    let read = |name: &str| fs::read_to_string(result.join(name)).unwrap();
    let report: serde_json::Value = serde_json::from_str(&read("report.json")).unwrap();
    for side in ["left", "right"] {
        let rms_px = report["rms_px"][side].as_f64().unwrap();
        assert!(rms_px < 0.1, "{side}: {rms_px} px");
        assert_eq!(report["residual_map"][side].as_array().unwrap().len(), 6);
    }
    assert_eq!(report["covariance"].as_array().unwrap().len(), 22);
    assert_eq!(report["accepted"], true);
    let pictures = report["pictures"].as_array().unwrap();
    assert_eq!(pictures.len(), 14);
    for picture in &pictures[..12] {
        assert_eq!(picture["corners"], 54, "{picture}");
        assert!(picture["rms_px"].as_f64().unwrap() < 0.1, "{picture}");
    }
    assert_eq!(pictures[12]["repeats_view"], 0);
    assert!(read("residuals.html").contains("<svg"));
    let found = read_text(&read("right.cahvor")).unwrap();
    assert_eq!(found.frame.as_deref(), Some("left_camera"));
    // The frame is the left camera's own, so what can be compared is what the pair measures.
    let pair = StereoPair {
        left: read_text(&read("left.cahvor")).unwrap().camera().unwrap(),
        right: found.camera().unwrap(),
    };
    let measured = [[0.02, 0.03, 0.45], [-0.04, -0.02, 0.4]].map(|at| {
        let point = Vector3::from(at);
        let (l, r) = (
            left.project(&point).unwrap(),
            right.project(&point).unwrap(),
        );
        let seen = pair.triangulate(&l, &r).unwrap();
        assert!(seen.miss_m < 3e-4, "{seen:?}");
        (point, seen.point)
    });
    let [(a, seen_a), (b, seen_b)] = measured;
    let error_m = (seen_a - seen_b).norm() - (a - b).norm();
    assert!(error_m.abs() < 5e-4, "{error_m} m");
    refused(folder.path(), &args, &["--force"]);
    pictures_that_are_no_pairs_are_refused_with_their_names(folder.path());
    refused(
        folder.path(),
        &[
            "calibrate",
            "--board",
            "chessboard:9x6",
            "--left",
            "l0.png",
            "--out",
            "x",
        ],
        &["chessboard:COLSxROWS:SQUARE_M"],
    );
}

/// The pictures l0.png to l5.png and r0.png to r5.png are there.
fn pictures_that_are_no_pairs_are_refused_with_their_names(folder: &Path) {
    let calibrate = |left: &[usize], right: &[usize], more: &[&str], parts: &[&str]| {
        let mut args: Vec<String> = [
            "calibrate",
            "--board",
            "chessboard:9x6:0.02",
            "--out",
            "bad",
        ]
        .map(str::to_owned)
        .into();
        args.extend(more.iter().map(|x| (*x).to_owned()));
        args.push("--left".into());
        args.extend(left.iter().map(|n| format!("l{n}.png")));
        args.push("--right".into());
        args.extend(right.iter().map(|n| format!("r{n}.png")));
        let args: Vec<&str> = args.iter().map(String::as_str).collect();
        refused(folder, &args, parts);
        assert!(!folder.join("bad/left.cahvor").exists());
    };
    calibrate(
        &[0, 1, 2, 3, 4],
        &[1, 2, 3, 4, 5],
        &["--force"],
        &["no models written"],
    );
    calibrate(&[0; 4], &[0; 4], &["--force"], &["1 different placements"]);
    calibrate(
        &[0, 1, 2, 3],
        &[0, 1, 1, 3],
        &["--force"],
        &["l1.png + r1.png", "l2.png + r1.png", "right camera"],
    );
    calibrate(
        &[0, 1, 2, 3],
        &[0, 1, 2, 3],
        &["--linearity", "0.5"],
        &["--linearity 0.5", "--model cahvore"],
    );
}

const STEREO: &str = "%YAML:1.0
M1: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 500., 0., 320., 0., 500., 240., 0., 0., 1. ]
D1: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.2, 0.05, 0., 0., 0. ]
M2: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 510., 0., 330., 0., 510., 240., 0., 0., 1. ]
D2: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.2, 0.05, 0.003, 0., 0.3 ]
";

#[test]
fn the_cameras_of_a_stereo_file_are_taken_out_by_their_number() {
    let folder = folder(&[("s.yml", STEREO), ("h.cahvore", HAZCAM)]);
    let at = folder.path();
    refused(at, &["info", "s.yml"], &["s.yml", "--size"]);
    let size = ["--size", "640x480"];
    let convert = |input: &str, more: &[&str]| {
        let args = [&["convert", input, "-", "--to", "cahv"], &size[..], more].concat();
        rover(at, &args)
    };
    for (input, focal) in [("s.yml", "500"), ("s.yml#1", "500")] {
        let out = convert(input, &[]);
        assert_eq!(out.status.code(), Some(0), "{}", text(&out.stderr));
        assert!(text(&out.stdout).contains(&format!("H = {focal} 0 320")));
    }
    let out = convert("s.yml#2", &[]);
    let said = text(&out.stderr);
    assert_eq!(out.status.code(), Some(2), "{said}");
    for part in ["CAHVOR or CAHVORE", "rover camera convert --limit-px"] {
        assert!(said.contains(part), "`{part}` is missing in: {said}");
    }
    let out = convert("s.yml#2", &["--limit-px", "20"]);
    assert_eq!(out.status.code(), Some(0), "{}", text(&out.stderr));
    assert!(text(&out.stdout).contains("Frame = camera2_optical"));
    refused(at, &["info", "h.cahvore#1"], &["h.cahvore", "#1"]);
}

#[test]
fn pixels_outside_the_image_are_answered_only_if_asked_for() {
    let camera = Camera::pinhole(
        &Isometry3::identity(),
        [600.0; 2],
        [319.5, 239.5],
        [640, 480],
    );
    let right = camera.transformed(&Isometry3::translation(0.08, 0.0, 0.0));
    let folder = folder(&[
        ("l.cahv", &write_text(&camera, None).unwrap()),
        ("r.cahv", &write_text(&right, None).unwrap()),
        ("px.csv", "u_px,v_px\n700,100\n"),
        ("m.csv", "ul_px,vl_px,ur_px,vr_px\n720,100,600,100\n"),
        ("p.csv", "x_m,y_m,z_m\n0.8,0,1\n"),
    ]);
    for args in [
        vec!["ray", "l.cahv", "px.csv"],
        vec!["triangulate", "l.cahv", "r.cahv", "m.csv"],
        vec!["project", "l.cahv", "p.csv"],
    ] {
        let plain = rows(&done(folder.path(), &args));
        let status = plain[1].last().unwrap();
        assert!(status.contains("640 x 480"), "{args:?}: {status}");
        let beyond = [&args[..], &["--beyond-image"]].concat();
        let wide = rows(&done(folder.path(), &beyond));
        assert_eq!(wide[1].last().unwrap(), "ok", "{args:?}");
    }
}
