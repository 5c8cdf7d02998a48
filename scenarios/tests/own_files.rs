//! Files as other tools write them, options that do not apply, and files that are not there.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod support;

use image::{ExtendedColorType, ImageEncoder, codecs::jpeg::JpegEncoder};
use nalgebra::Vector3;
use std::path::Path;
use support::{camera, done, json, photograph, refused, run, write};

fn folder(files: &[(&str, &str)]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for (name, content) in files {
        std::fs::write(folder.path().join(name), content).unwrap();
    }
    folder
}

#[test]
fn an_option_without_effect_is_refused_by_name() {
    let folder = folder(&[("arm.urdf", &chain(7, "")), ("j.csv", "")]);
    let at = folder.path();
    let flat = rover_vision::Image8::from_raw(64, 48, vec![90; 64 * 48]).unwrap();
    write(at, "i.png", &flat);
    for (kind, more, word) in [
        (
            "saddle",
            &["--family", "tag36h11"][..],
            "it is for apriltag",
        ),
        ("disc", &["--template", "i.png"], "it is for template"),
        ("disc", &["--model", "m.cahv"], "without --normal"),
        ("harris", &["--model", "m.cahv"], "plate, apriltag"),
        ("harris", &["--radius", "9"], "without --near"),
        ("plate", &["--radius", "9"], "without --pose"),
        ("plate", &["--near", "9,9"], "--pose"),
        (
            "plate",
            &["--layout", "l.toml", "--width-m", "1"],
            "beside --layout",
        ),
        ("apriltag", &["--normal", "0,0,1"], "it is for disc"),
        ("apriltag", &["--warp", "1,0,0,1"], "it is for template"),
        ("template", &["--width-m", "0.1"], "without --pose"),
        (
            "template",
            &["--pose", "0,0,1,1,0,0,0", "--near", "9,9"],
            "beside --pose",
        ),
    ] {
        let find = [&["vision", "find", "i.png", "--fiducial", kind][..], more].concat();
        refused(at, &find, &[more[0], word]);
    }
    let twice = std::process::Command::new(env!("CARGO_BIN_EXE_rover"))
        .args(["vision", "find", "-", "--fiducial", "disc", "--rules", "-"])
        .stdin(std::fs::File::open(at.join("i.png")).unwrap())
        .output()
        .unwrap();
    let said = support::text(&twice.stderr);
    assert_eq!(twice.status.code(), Some(2), "{said}");
    assert!(said.contains("given twice"), "{said}");
    for (args, option) in [
        (
            &["fk", "arm.urdf", "j.csv", "--tool-axis", "1,0,0"][..],
            "--tool-axis",
        ),
        (
            &["ik", "arm.urdf", "j.csv", "--pose", "--tool-axis", "1,0,0"],
            "--tool-axis",
        ),
        (
            &["ik", "arm.urdf", "j.csv", "--all", "--max-rate-rad-s", "1"],
            "--max-rate-rad-s",
        ),
        (
            &["ik", "arm.urdf", "j.csv", "--package-path", "."],
            "--package-path",
        ),
    ] {
        refused(
            at,
            &[&["arm"], args].concat(),
            &[option, "it is for `arm info`"],
        );
    }
    let plan = [
        "arm",
        "plan",
        "bluestreak.toml",
        "--from",
        "ready",
        "--to",
        "stow",
    ];
    let touch = [&plan[..], &["--contact-radius-m", "0.1"]].concat();
    refused(at, &touch, &["--terrain"]);
}

#[test]
fn a_file_that_cannot_be_read_is_told_in_plain_words() {
    let folder = folder(&[("file", "x")]);
    let at = folder.path();
    std::fs::create_dir(at.join("sub.toml")).unwrap();
    let calibrate = "camera calibrate --board chessboard:9x6:0.02 --out o --left";
    for command in [
        "camera info",
        "vision find --fiducial disc",
        calibrate,
        "arm fk bluestreak.toml",
        "arm info --tip x --base y",
    ] {
        let words: Vec<&str> = command.split(' ').collect();
        let ending = if command.contains("--tip") {
            ".urdf"
        } else {
            ""
        };
        for (name, why) in [
            ("none", "there is no such file"),
            (
                "file/none",
                "a part of the path is a file, a folder is expected there",
            ),
        ] {
            let name = format!("{name}{ending}");
            refused(
                at,
                &[&words[..], &[&name]].concat(),
                &[&format!("{name}: {why}")],
            );
        }
    }
    let why = "sub.toml: is a folder, a file is expected";
    refused(at, &["camera", "info", "sub.toml"], &[why]);
    refused(at, &["run", "sub.toml"], &[why]);
}

/// As OpenCV 5.0 writes the results of its sample `stereo_calib`.
const INTRINSICS: &str = include_str!("data/opencv_intrinsics.yml");
const EXTRINSICS: &str = include_str!("data/opencv_extrinsics.yml");

#[test]
fn the_two_files_of_opencvs_stereo_calibration_make_one_pair() {
    let files = [
        ("intrinsics.yml", INTRINSICS),
        ("extrinsics.yml", EXTRINSICS),
    ];
    let folder = folder(&files);
    let at = folder.path();
    const ASKED: [&str; 4] = ["--size", "640x480", "--limit-px", "1"];
    let both = ["--extrinsics", "extrinsics.yml", "--unit-m", "0.025"];
    fn info<'a>(more: &[&'a str]) -> Vec<&'a str> {
        [&["camera", "info"], more, &ASKED].concat()
    }
    for side in ["1", "2"] {
        let (model, out) = (format!("intrinsics.yml#{side}"), format!("{side}.cahvor"));
        let place: &[&str] = if side == "2" { &both } else { &[] };
        let [_, said] = done(
            at,
            &[&["camera", "convert", &model, &out], place, &ASKED].concat(),
        );
        assert_eq!(
            side == "2",
            said.contains("the unit of T is 0.025 m"),
            "{said}"
        );
    }
    // `cv2.projectPoints` with R and T, and without, of the point (4, 2, 30) in squares.
    std::fs::write(at.join("p.csv"), "x_m,y_m,z_m\n0.1,0.05,0.75\n").unwrap();
    for (side, expected) in [("1", LEFT_PX), ("2", RIGHT_PX)] {
        let [table, _] = done(
            at,
            &["camera", "project", &format!("{side}.cahvor"), "p.csv"],
        );
        let row: Vec<&str> = table.lines().nth(1).unwrap().split(',').collect();
        for (cell, expected) in row.iter().zip(expected) {
            let found: f64 = cell.parse().unwrap();
            // What the fit of its lens is off at worst.
            assert!((found - expected).abs() < 0.6, "camera {side}: {table}");
        }
    }
    let [_, said] = done(at, &info(&["intrinsics.yml#2", both[0], both[1]]));
    assert!(
        said.contains("3.33") && said.contains("the file does not say"),
        "{said}"
    );
    let [_, said] = done(at, &info(&["intrinsics.yml#2"]));
    assert!(said.contains("--extrinsics FILE"), "{said}");
    for (more, parts) in [
        (&["extrinsics.yml"][..], ["extrinsics.yml", "--extrinsics"]),
        (
            &["intrinsics.yml", both[0], both[1]],
            ["--extrinsics", "FILE#2"],
        ),
        (
            &["intrinsics.yml#1", "--unit-m", "0.025"],
            ["--unit-m", "FILE#2"],
        ),
        (
            &["intrinsics.yml#2", both[0], "none.yml"],
            ["none.yml", "no such file"],
        ),
        (
            &["intrinsics.yml#2", both[0], "intrinsics.yml"],
            ["intrinsics.yml", "R, T"],
        ),
    ] {
        refused(at, &info(more), &parts);
    }
}

const LEFT_PX: [f64; 2] = [411.918596, 270.479565];
const RIGHT_PX: [f64; 2] = [344.073006, 282.492977];

fn ros(name: &str, shift: f64) -> String {
    format!(
        "image_width: 640\nimage_height: 480\ncamera_name: {name}\ncamera_matrix:\n  rows: 3\n  \
         cols: 3\n  data: [500, 0, 320, 0, 500, 240, 0, 0, 1]\ndistortion_model: plumb_bob\n\
         distortion_coefficients: {{rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}}\n\
         rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}\n\
         projection_matrix: {{rows: 3, cols: 4, data: [500, 0, 320, {shift}, 0, 500, 240, 0, 0, 0, \
         1, 0]}}\n"
    )
}

#[test]
fn the_left_camera_of_a_rectified_pair_makes_a_pair_with_the_right_one() {
    let files = [
        ("left.yaml", ros("cam_l", 0.0)),
        ("right.yaml", ros("cam_r", -50.0)),
    ];
    let folder = folder(&[(files[0].0, &files[0].1), (files[1].0, &files[1].1)]);
    let at = folder.path();
    let [_, said] = done(at, &["camera", "info", "left.yaml"]);
    assert!(
        said.contains("frame `cam_l`") && said.contains("rectified_left"),
        "{said}"
    );
    let matches = "ul_px,vl_px,ur_px,vr_px\n370,240,320,240\n";
    std::fs::write(at.join("m.csv"), matches).unwrap();
    let [table, _] = done(
        at,
        &["camera", "triangulate", "left.yaml", "right.yaml", "m.csv"],
    );
    let row: Vec<&str> = table.lines().nth(1).unwrap().split(',').collect();
    for (cell, expected) in row.iter().zip([0.1, 0.0, 1.0]) {
        assert!(
            (cell.parse::<f64>().unwrap() - expected).abs() < 1e-9,
            "{table}"
        );
    }
    // The right one on the left: its axes are another camera's.
    let other = ["camera", "triangulate", "right.yaml", "left.yaml", "m.csv"];
    refused(at, &other, &["rectified_left", "cam_l", "one frame"]);
}

#[test]
fn more_than_one_yaml_document_is_refused_with_its_line() {
    let one = ros("c", 0.0);
    let lines = one.lines().count();
    let (second, twice) = (
        format!("{one}---\n{one}"),
        format!("{one}image_width: 640\n"),
    );
    let (garbage, ended) = (
        format!("{one}and so on\n"),
        format!("{one}---\n# the end\n\n"),
    );
    let folder = folder(&[
        ("second.yaml", &second),
        ("twice.yaml", &twice),
        ("garbage.yaml", &garbage),
        ("ended.yaml", &ended),
    ]);
    let at = folder.path();
    let line = format!("line {}", lines + 1);
    for (name, word) in [
        ("second.yaml", "a second document"),
        ("twice.yaml", "duplicate mapping key: image_width"),
        ("garbage.yaml", "and so on"),
    ] {
        refused(at, &["camera", "info", name], &[name, &line, word]);
    }
    done(at, &["camera", "info", "ended.yaml"]);
}

#[test]
fn a_table_with_comments_is_read_and_its_errors_name_the_files_line() {
    let table = "# of the rig\n# u_px,v_px\n\n100,100\n# far\n200,200\n";
    let bad = format!("{table}300;300\n");
    let folder = folder(&[
        ("c.yaml", &ros("c", 0.0)),
        ("p.csv", table),
        ("bad.csv", &bad),
    ]);
    let at = folder.path();
    let [rays, _] = done(at, &["camera", "ray", "c.yaml", "p.csv"]);
    assert_eq!(
        rays.lines().filter(|line| line.ends_with(",ok")).count(),
        2,
        "{rays}"
    );
    let out = run(at, &["camera", "ray", "c.yaml", "bad.csv"]);
    assert_eq!(out.status.code(), Some(2));
    let said = support::text(&out.stderr);
    assert!(said.contains("bad.csv:7: 1 cells, 2 expected"), "{said}");
}

/// A fiducial is where it is in the PNG.
#[test]
fn a_jpeg_is_a_picture_too_and_what_is_none_is_told_with_what_is() {
    let folder = folder(&[("p.gif", "GIF89a......")]);
    let at = folder.path();
    let disc = |x: f64, y: f64| {
        let is_dark = (x - 0.012).hypot(y + 0.02) < 0.015;
        if is_dark { 30.0 } else { 200.0 }
    };
    let image = photograph(&camera(0.0), Vector3::z(), &disc);
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, 100)
        .write_image(&image.pixels, 320, 240, ExtendedColorType::L8)
        .unwrap();
    std::fs::write(at.join("p.jpg"), &jpeg).unwrap();
    std::fs::write(at.join("cut.jpg"), &jpeg[..jpeg.len() / 2]).unwrap();
    write(at, "p.png", &image);
    let place = |name: &str| {
        let found = json(&run(at, &["vision", "find", name, "--fiducial", "disc"]));
        ["u_px", "v_px"].map(|key| found[key].as_f64().unwrap_or_else(|| panic!("{found}")))
    };
    for (a, b) in place("p.jpg").iter().zip(place("p.png")) {
        assert!((a - b).abs() < 0.05, "{a} {b}");
    }
    let find = |name| ["vision", "find", name, "--fiducial", "disc"];
    refused(at, &find("p.gif"), &["p.gif", "GIF data", "PNG", "JPEG"]);
    refused(at, &find("cut.jpg"), &["cut.jpg", "cut off"]);
    // 12 bits in a 16-bit file.
    let grey = image.pixels.iter().flat_map(|p| [p >> 4, p << 4]);
    let pgm: Vec<u8> = b"P5\n320 240\n65535\n"
        .iter()
        .copied()
        .chain(grey)
        .collect();
    std::fs::write(at.join("dim.pgm"), pgm).unwrap();
    let said = support::text(&run(at, &find("dim.pgm")).stderr);
    assert!(
        said.contains("dim.pgm") && said.contains("stretch"),
        "{said}"
    );
}

/// An arm of `n` joints with more links in `tail`.
fn chain(n: usize, tail: &str) -> String {
    let mut text = String::from("<robot name=\"r\"><link name=\"l0\"/>\n");
    for i in 1..=n {
        let axis = if i % 2 == 1 { "0 0 1" } else { "0 1 0" };
        text += &format!(
            "<link name=\"l{i}\"/><joint name=\"j{i}\" type=\"revolute\"><parent link=\"l{}\"/>\
             <child link=\"l{i}\"/><origin xyz=\"0.01 0 0.2\"/><axis xyz=\"{axis}\"/>\
             <limit lower=\"-2.5\" upper=\"2.5\" velocity=\"1\" effort=\"1\"/></joint>\n",
            i - 1
        );
    }
    text + tail + "</robot>\n"
}

fn joint(name: &str, kind: &str, parent: &str) -> String {
    format!(
        "<link name=\"{name}\"/><joint name=\"to_{name}\" type=\"{kind}\"><parent link=\"{parent}\"/>\
         <child link=\"{name}\"/><limit lower=\"0\" upper=\"0.04\" velocity=\"1\" effort=\"1\"/>\
         </joint>\n"
    )
}

#[test]
fn the_tip_of_an_arm_with_several_ends_must_be_named() {
    let fingers =
        |hand: &str| joint("left", "prismatic", hand) + &joint("right", "prismatic", hand);
    let camera = joint("eye", "fixed", "l7");
    let wheels = joint("wheel_1", "continuous", "l0") + &joint("wheel_2", "continuous", "l0");
    let folder = folder(&[
        ("five.urdf", &chain(5, &fingers("l5"))),
        ("seven.urdf", &chain(7, &fingers("l7"))),
        ("eye.urdf", &chain(7, &(fingers("l7") + &camera))),
        ("elbow.urdf", &chain(6, &joint("eye", "fixed", "l3"))),
        ("rover.urdf", &chain(6, &wheels)),
    ]);
    let at = folder.path();
    for (name, ends) in [
        (
            "five.urdf",
            &["left (6 moving joints)", "right (6 moving joints)"][..],
        ),
        (
            "seven.urdf",
            &["left (8 moving joints)", "right (8 moving joints)"],
        ),
        (
            "eye.urdf",
            &["left (8 moving joints)", "eye (7 moving joints)"],
        ),
        (
            "elbow.urdf",
            &["l6 (6 moving joints)", "eye (3 moving joints)"],
        ),
    ] {
        refused(
            at,
            &["arm", "info", name],
            &[ends, &[name, "--tip"]].concat(),
        );
    }
    let [text, _] = done(at, &["arm", "info", "five.urdf", "--tip", "l5"]);
    assert!(text.contains("5 joints"), "{text}");
    let [text, _] = done(at, &["arm", "info", "rover.urdf"]);
    assert!(text.contains("tool at link l6"), "{text}");
}

#[test]
fn all_answers_of_a_redundant_arm_are_called_samples() {
    let folder = folder(&[("five.urdf", &chain(5, "")), ("seven.urdf", &chain(7, ""))]);
    let at = folder.path();
    let ask = |arm: &str, n: usize, pose: &[&str]| {
        let joints: Vec<String> = (1..=n).map(|i| format!("q{i}_rad")).collect();
        let q = ["0.4"; 7][..n].join(",");
        std::fs::write(at.join("q.csv"), format!("{}\n{q}\n", joints.join(","))).unwrap();
        let [table, _] = done(at, &["arm", "fk", arm, "q.csv"]);
        let row: Vec<f64> = table
            .lines()
            .nth(1)
            .unwrap()
            .split(',')
            .map_while(|cell| cell.parse().ok())
            .collect();
        let cells = if pose.is_empty() {
            // The tip's z axis.
            let [w, x, y, z] = [row[3], row[4], row[5], row[6]];
            let axis = [
                2.0 * (x * z + w * y),
                2.0 * (y * z - w * x),
                1.0 - 2.0 * (x * x + y * y),
            ];
            [&row[..3], &axis].concat()
        } else {
            row
        };
        let cells: Vec<String> = cells.iter().map(f64::to_string).collect();
        let header = if pose.is_empty() {
            "x_m,y_m,z_m,ax,ay,az"
        } else {
            "x_m,y_m,z_m,qw,qx,qy,qz"
        };
        std::fs::write(at.join("t.csv"), format!("{header}\n{}\n", cells.join(","))).unwrap();
        let [table, said] = done(at, &[&["arm", "ik", arm, "t.csv", "--all"], pose].concat());
        assert!(table.lines().nth(1).unwrap().ends_with(",ok"), "{table}");
        said
    };
    assert!(ask("seven.urdf", 7, &[]).contains("samples"));
    assert!(ask("seven.urdf", 7, &["--pose"]).contains("samples"));
    assert_eq!(ask("five.urdf", 5, &[]), "");
    let free =
        |arm: &str| json(&run(at, &["arm", "info", arm, "--json", "-"]))["free_joints_n"].clone();
    let expected = serde_json::json!({ "point_and_axis": 2, "pose": 1 });
    assert_eq!(free("seven.urdf"), expected);
    let expected = serde_json::json!({ "point_and_axis": 0, "pose": 0 });
    assert_eq!(free("five.urdf"), expected);
}

/// What a command of a test says is looked at by path too.
#[test]
fn an_output_whose_folder_cannot_be_made_is_told_in_plain_words() {
    let folder = folder(&[("c.yaml", &ros("c", 0.0)), ("file", "x")]);
    let out = run(
        folder.path(),
        &["camera", "info", "c.yaml", "--json", "file/x.json"],
    );
    assert_ne!(out.status.code(), Some(0));
    let said = support::text(&out.stderr);
    assert!(
        said.contains("file/x.json: ") && !said.contains("os error"),
        "{said}"
    );
    assert!(!Path::new("file/x.json").exists());
}
