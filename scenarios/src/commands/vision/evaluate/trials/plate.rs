//! Trials of the plate of discs and a saddle.

use nalgebra::{Isometry3, Vector2, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rover_cameras::Camera;
use rover_vision::{
    DetectionRules, Image8, PlateLayout, PlateSearch, find, find_plate, find_saddle,
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
    scene(rng, noise_dn, PLATE_SIDE_PX, std::f64::consts::PI, &shade)
}

/// Error of one point of the plate, a different one in every trial.
pub(super) fn plate(rng: &mut ChaCha8Rng, noise_dn: f64) -> Outcome {
    let Some((camera, image, pose, _)) = plate_scene(rng, noise_dn) else {
        return Outcome::MISSED;
    };
    let search = PlateSearch {
        camera: &camera,
        layout: &PlateLayout::standard(PLATE_M),
        predicted_camera_frame_from_plate: spoiled(&pose, rng),
        search_radius_px: PLATE_RADIUS_PX,
        rules: &DetectionRules::default(),
    };
    let Ok(found) = find_plate(&image, &search) else {
        return Outcome::MISSED;
    };
    let chosen = rng.random_range(0..found.points.len().max(1));
    found
        .points
        .get(chosen)
        .and_then(|p| {
            let truth = patch::seen(&camera, &pose, p.point_in_plate.x, p.point_in_plate.y)?;
            let off = p.pixel_px - truth;
            Some(Outcome {
                error_px: Some([off.x, off.y]),
                sigma_px: p.sigma_px,
            })
        })
        .unwrap_or(Outcome::MISSED)
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
    let Some((camera, image, pose, truth)) = plate_scene(rng, noise_dn) else {
        return Outcome::MISSED;
    };
    let search = PlateSearch {
        camera: &camera,
        layout: &PlateLayout::standard(PLATE_M),
        predicted_camera_frame_from_plate: spoiled(&pose, rng),
        search_radius_px: PLATE_RADIUS_PX,
        rules: &DetectionRules::default(),
    };
    find_saddle(&image, &search).map_or(Outcome::MISSED, |p| {
        let off = p.pixel_px - truth;
        Outcome {
            error_px: Some([off.x, off.y]),
            sigma_px: p.sigma_px,
        }
    })
}

pub(super) fn blank_plate_saddle(rng: &mut ChaCha8Rng, noise_dn: f64) -> bool {
    blank_scene(rng, noise_dn).is_some_and(|(camera, pose, image)| {
        let search = PlateSearch {
            camera: &camera,
            layout: &PlateLayout::standard(PLATE_M),
            predicted_camera_frame_from_plate: pose,
            search_radius_px: PLATE_RADIUS_PX,
            rules: &DetectionRules::default(),
        };
        find_saddle(&image, &search).is_ok()
    })
}
