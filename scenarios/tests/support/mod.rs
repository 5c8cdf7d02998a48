//! What the tests of commands share: running them, and pictures of a plane.

// Each test file uses a part of it.
#![allow(dead_code)]

use std::{
    path::Path,
    process::{Command, Output},
};

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector2, Vector3};
use rover_cameras::{Camera, formats::write_text};
use rover_vision::Image8;

/// Runs `rover` with these arguments in a folder.
pub fn run(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_rover"))
        .args(args)
        .current_dir(folder)
        .env_remove("RUST_LOG")
        .output()
        .unwrap()
}

/// The same, of which it is expected that it is done; what it wrote to standard output and error.
pub fn done(folder: &Path, args: &[&str]) -> [String; 2] {
    let out = run(folder, args);
    let said = text(&out.stderr);
    assert_eq!(out.status.code(), Some(0), "{args:?}: {said}");
    [text(&out.stdout), said]
}

/// The same, of which it is expected that it is refused with these words and without an answer.
pub fn refused(folder: &Path, args: &[&str], parts: &[&str]) {
    let out = run(folder, args);
    let said = text(&out.stderr);
    assert_eq!(out.status.code(), Some(2), "{args:?}: {said}");
    assert!(out.stdout.is_empty(), "{args:?}: {}", text(&out.stdout));
    for part in parts {
        assert!(
            said.contains(part),
            "{args:?}: `{part}` is missing in: {said}"
        );
    }
    assert!(!said.contains("os error"), "{args:?}: {said}");
}

pub fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

pub fn json(out: &Output) -> serde_json::Value {
    serde_json::from_slice(&out.stdout).unwrap_or_else(|e| panic!("{e}: {}", text(&out.stderr)))
}

/// A camera at (`x`, 0, 0), looking along z.
pub fn camera(x: f64) -> Camera {
    let pose = Isometry3::from_parts(Translation3::new(x, 0.0, 0.0), UnitQuaternion::identity());
    Camera::pinhole(&pose, [400.0; 2], [159.5, 119.5], [320, 240])
}

/// The plane through (0, 0, 0.6) with this normal, as `shade` of x and y colours it.
pub fn photograph(
    camera: &Camera,
    normal: Vector3<f64>,
    shade: &dyn Fn(f64, f64) -> f64,
) -> Image8 {
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

pub fn write(folder: &Path, name: &str, image: &Image8) {
    image.write_png(&folder.join(name)).unwrap();
}

pub fn model(folder: &Path, name: &str, camera: &Camera) {
    std::fs::write(
        folder.join(name),
        write_text(camera, Some("rover")).unwrap(),
    )
    .unwrap();
}
