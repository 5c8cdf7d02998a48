//! Trials of the plate of discs and a saddle.

use nalgebra::{Isometry3, Vector2, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rover_cameras::Camera;
use rover_vision::{
    DetectionRules, Image8, PlateLayout, PlateSearch, PointObservation, find, find_plate,
    find_saddle,
};

use super::super::patch;
use super::{MAX_TILT_RAD, Outcome, WHITE_DN, scene, spoiled};

/// Side of the patches that hold a whole plate, px, and how far it is searched, px.
const PLATE_SIDE_PX: u32 = 200;
const PLATE_RADIUS_PX: f64 = 20.0;
const PLATE_M: f64 = 0.08;

fn plate_scene(
    rng: &mut ChaCha8Rng,
    noise_dn: f64,
) -> Option<(Camera, Image8, Isometry3<f64>, Vector2<f64>)> {
    let layout = PlateLayout::standard(PLATE_M);
    let shade = move |x: f64, y: f64| layout.albedo(x, y).map(|a| a * WHITE_DN / 0.85);
    scene(rng, noise_dn, PLATE_SIDE_PX, &shade, patch::EDGES)
}

/// What a plate is searched for with, its rules aside, around a predicted pose.
fn search<'a>(
    camera: &'a Camera,
    layout: &'a PlateLayout,
    predicted: Isometry3<f64>,
    rules: &'a DetectionRules,
) -> PlateSearch<'a> {
    PlateSearch {
        camera,
        layout,
        predicted_camera_frame_from_plate: predicted,
        search_radius_px: PLATE_RADIUS_PX,
        rules,
    }
}

/// The error of a point of a plate, if the detector picks one.
fn trial(
    rng: &mut ChaCha8Rng,
    noise_dn: f64,
    pick: impl FnOnce(&Image8, &PlateSearch, &mut ChaCha8Rng) -> Option<PointObservation>,
) -> Outcome {
    let attempt = |rng: &mut ChaCha8Rng| {
        let (camera, image, pose, _) = plate_scene(rng, noise_dn)?;
        let (layout, rules) = (PlateLayout::standard(PLATE_M), DetectionRules::default());
        let search = search(&camera, &layout, spoiled(&pose, rng), &rules);
        let point = pick(&image, &search, rng)?;
        let at = point.point_in_plate;
        let off = point.pixel_px - patch::seen(&camera, &pose, at.x, at.y)?;
        Some(Outcome {
            error_px: Some([off.x, off.y]),
            sigma_px: point.sigma_px,
            bound_px: None,
        })
    };
    attempt(rng).unwrap_or(Outcome::MISSED)
}

/// Error of one point of the plate, a different one in every trial.
pub(super) fn plate(rng: &mut ChaCha8Rng, noise_dn: f64) -> Outcome {
    trial(rng, noise_dn, |image, search, rng| {
        let found = find_plate(image, search).ok()?;
        let chosen = rng.random_range(0..found.points.len().max(1));
        found.points.get(chosen).copied()
    })
}

/// A patch without a plate, and where one is said to be.
fn blank_scene(rng: &mut ChaCha8Rng, noise_dn: f64) -> Option<(Camera, Isometry3<f64>, Image8)> {
    let camera = patch::camera(PLATE_SIDE_PX, PLATE_SIDE_PX, Vector3::zeros(), 0.0);
    let pose = patch::pose(rng, MAX_TILT_RAD, std::f64::consts::PI);
    let image = patch::blank(PLATE_SIDE_PX, PLATE_SIDE_PX, noise_dn, rng)?;
    Some((camera, pose, image))
}

pub(super) fn blank_plate(rng: &mut ChaCha8Rng, noise_dn: f64) -> bool {
    blank_scene(rng, noise_dn).is_some_and(|(camera, pose, image)| {
        let (layout, rules) = (PlateLayout::standard(PLATE_M), DetectionRules::default());
        let near = Some((&pose, PLATE_RADIUS_PX));
        find::plate(&image, &camera, &layout, near, &rules).is_ok()
            || find::plate(&image, &camera, &layout, None, &rules).is_ok()
    })
}

pub(super) fn plate_saddle(rng: &mut ChaCha8Rng, noise_dn: f64) -> Outcome {
    trial(rng, noise_dn, |image, search, _| {
        find_saddle(image, search).ok()
    })
}

pub(super) fn blank_plate_saddle(rng: &mut ChaCha8Rng, noise_dn: f64) -> bool {
    blank_scene(rng, noise_dn).is_some_and(|(camera, pose, image)| {
        let (layout, rules) = (PlateLayout::standard(PLATE_M), DetectionRules::default());
        find_saddle(&image, &search(&camera, &layout, pose, &rules)).is_ok()
    })
}
