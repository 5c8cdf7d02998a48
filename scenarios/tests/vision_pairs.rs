//! `rover vision` on pairs of images that the test writes: tables, surfaces, disparities, doubts.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod support;

use std::{path::Path, process::Output};

use nalgebra::{Vector2, Vector3};
use rover_vision::{Image8, texture::texture};
use support::{camera, json, model, photograph, text, write};

fn rover(folder: &Path, args: &[&str]) -> Output {
    support::run(folder, &[&["vision"], args].concat())
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

/// What the pictures themselves say when they are not what the models are of.
#[test]
fn exchanged_unrelated_and_equal_pictures_are_told_and_others_are_not() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let normal = Vector3::new(0.1, 0.4, -1.0).normalize();
    for (name, seed) in [("", 9), ("other_", 31)] {
        let rock = |x: f64, y: f64| texture(x, y, 0.06, 0.003, 25.0, seed);
        for (side, x) in [("left", 0.0), ("right", 0.06)] {
            let image = photograph(&camera(x), normal, &rock);
            write(at, &format!("{name}{side}.png"), &image);
            model(at, &format!("{side}.cahv"), &camera(x));
        }
    }
    let grid: Vec<String> = (0..40)
        .map(|k| format!("{},{}", 30 + 35 * (k % 8), 30 + 45 * (k / 8)))
        .collect();
    std::fs::write(
        at.join("p.csv"),
        format!("u_px,v_px\n{}\n", grid.join("\n")),
    )
    .unwrap();
    let shared = ["--left-model", "left.cahv", "--right-model", "right.cahv"];
    let disparity = ["--range-min-m", "0.35", "-o", "d.png", "--force"];
    let matching = ["--pixels", "p.csv", "--out", "m.csv", "--force"];
    for (left, right, word) in [
        ("left.png", "right.png", None),
        ("right.png", "left.png", Some("exchanged")),
        ("left.png", "other_right.png", Some("one scene")),
        ("left.png", "left.png", Some("the same")),
    ] {
        for (verb, own) in [("disparity", disparity), ("match", matching)] {
            if verb == "match" && left == right {
                continue;
            }
            let args = [&[verb, left, right][..], &shared, &own, &["--json", "-"]].concat();
            let out = rover(at, &args);
            let report = json(&out);
            let told: Vec<&str> = report["warnings"]
                .as_array()
                .unwrap()
                .iter()
                .map(|w| w.as_str().unwrap())
                .collect();
            assert_eq!(
                told.len(),
                usize::from(word.is_some()),
                "{args:?}: {report}"
            );
            for warning in told {
                assert!(warning.contains(word.unwrap()), "{args:?}: {warning}");
                let said = text(&out.stderr);
                assert!(said.contains(&format!("warning: {warning}")), "{said}");
            }
        }
    }
}

#[test]
fn models_that_are_not_given_in_one_frame_make_no_pair() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    for (side, x) in [("left", 0.0), ("right", 0.06)] {
        let flat = Image8::from_raw(320, 240, vec![90; 320 * 240]).unwrap();
        write(at, &format!("{side}.png"), &flat);
        model(at, &format!("{side}.cahv"), &camera(x));
    }
    let right = std::fs::read_to_string(at.join("right.cahv")).unwrap();
    let other = right.replace("Frame = rover", "Frame = mast");
    std::fs::write(at.join("right.cahv"), other).unwrap();
    let models = ["--left-model", "left.cahv", "--right-model", "right.cahv"];
    let args = [&["vision", "normal", "left.png", "right.png"][..], &models].concat();
    support::refused(
        at,
        &[&args[..], &["--pixel", "160,120"]].concat(),
        &["`rover`", "`mast`", "one frame"],
    );
}
