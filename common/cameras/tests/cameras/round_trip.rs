//! From pixel to ray to point to pixel, over whole images; derivatives against differences.

use crate::common::references;
use nalgebra::{
    Isometry3, Matrix2, Matrix2x3, Matrix3x2, Translation3, Unit, UnitQuaternion, Vector2, Vector3,
};
use rover_cameras::{Camera, CameraModel};

const PIXELS: usize = 100_000;

/// A small deterministic generator of numbers in [0, 1) (SplitMix64).
struct Numbers(u64);

impl Numbers {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.next()
    }

    fn pixel(&mut self, camera: &Camera) -> Vector2<f64> {
        Vector2::new(
            self.between(-0.5, f64::from(camera.width_px) - 0.5),
            self.between(-0.5, f64::from(camera.height_px) - 0.5),
        )
    }
}

/// The worst distance between a pixel and the image of a point on its ray.
fn worst_round_trip_px(camera: &Camera) -> f64 {
    let mut numbers = Numbers(1);
    let mut worst_px = 0.0_f64;
    for _ in 0..PIXELS {
        let pixel = numbers.pixel(camera);
        let range_m = numbers.between(0.05, 30.0);
        let point = camera.ray(&pixel).unwrap().at(range_m);
        let back = camera.project(&point).unwrap();
        worst_px = worst_px.max((back - pixel).amax());
    }
    worst_px
}

/// The paper's camera with a tilted lens of barrel, pincushion and mixed distortion, strong enough
/// to move the corners by tens of pixels.
fn distorted_cameras() -> Vec<(String, Camera)> {
    let rotation = UnitQuaternion::from_euler_angles(0.3, 0.8, -1.1);
    let pose = Isometry3::from_parts(Translation3::new(0.3, -0.2, 1.1), rotation);
    let axis = Unit::new_normalize(Vector3::new(0.004, -0.003, 1.0));
    [
        [0.0, -0.12, 0.03],
        [0.01, -0.3, 0.2],
        [-0.02, 0.2, 0.1],
        [0.0, -0.3, 0.0],
        [0.0, 0.0, 0.0],
    ]
    .into_iter()
    .map(|r| {
        let camera = Camera::pinhole_distorted(
            &pose,
            [602.15, 602.15],
            [319.5, 239.5],
            [640, 480],
            &axis,
            r,
        );
        camera.validate().unwrap();
        (format!("r = {r:?}"), camera)
    })
    .collect()
}

#[test]
fn unit_axis_models_round_trip_to_a_billionth_of_a_pixel() {
    let flight = references()
        .into_iter()
        .map(|model| (model.name, model.camera.with_unit_axes().unwrap()));
    for (name, camera) in flight.chain(distorted_cameras()) {
        let worst_px = worst_round_trip_px(&camera);
        println!("{name}: {worst_px:e} px");
        assert!(worst_px < 1e-9, "{name}: {worst_px} px");
    }
}

/// As published, with axes rounded to six digits, the two JPL equations are not quite each
/// other's inverse: they err in proportion to the length error of O.
#[test]
fn published_models_round_trip_within_the_rounding_of_their_axes() {
    for model in references() {
        let length_error = match &model.camera.model {
            CameraModel::Cahv(_) => 0.0,
            CameraModel::Cahvor(m) => (m.o.norm() - 1.0).abs(),
            // The whole angle is measured from O here, not a small correction of it.
            CameraModel::Cahvore(m) => 100.0 * m.h.norm() * (m.o.norm() - 1.0).abs(),
        };
        let worst_px = worst_round_trip_px(&model.camera);
        println!(
            "{}: |O| off by {length_error:e}, {worst_px:e} px",
            model.name
        );
        let limit_px = 5e-10 + 0.05 * length_error;
        assert!(worst_px < limit_px, "{}: {worst_px} px", model.name);
    }
}

/// The image of a point that moves along its ray stands still, and moving the pixel by one moves
/// the image by one: the two derivatives are each other's inverse.
#[test]
fn ray_and_projection_jacobians_are_inverse() {
    for (name, camera) in all_cameras() {
        let camera = camera.with_unit_axes().unwrap();
        let mut numbers = Numbers(5);
        for _ in 0..1000 {
            let pixel = numbers.pixel(&camera);
            let range_m = numbers.between(0.2, 10.0);
            let (ray, by_pixel) = camera.ray_with_jacobians(&pixel).unwrap();
            let image = camera.project_with_jacobian(&ray.at(range_m)).unwrap();
            let along = image.jacobian * ray.direction.as_ref() * range_m;
            assert!(along.amax() < 1e-9, "{name}: {along}");
            let across = image.jacobian * (by_pixel.direction * range_m + by_pixel.origin);
            assert!(
                (across - Matrix2::identity()).amax() < 1e-11,
                "{name}: {across}"
            );
        }
    }
}

fn all_cameras() -> impl Iterator<Item = (String, Camera)> {
    references()
        .into_iter()
        .map(|m| (m.name, m.camera))
        .chain(distorted_cameras())
}

#[test]
fn projection_jacobian_matches_central_differences() {
    for (name, camera) in all_cameras() {
        let mut numbers = Numbers(2);
        for _ in 0..200 {
            let pixel = numbers.pixel(&camera);
            let point = camera.ray(&pixel).unwrap().at(numbers.between(0.4, 5.0));
            let found = camera.project_with_jacobian(&point).unwrap().jacobian;
            let step_m = 1e-5;
            let columns = [Vector3::x(), Vector3::y(), Vector3::z()].map(|axis| {
                let ahead = camera.project(&(point + axis * step_m)).unwrap();
                let back = camera.project(&(point - axis * step_m)).unwrap();
                (ahead - back) / (2.0 * step_m)
            });
            let expected = Matrix2x3::from_columns(&columns);
            let error = (found - expected).amax() / expected.amax();
            assert!(error < 1e-7, "{name}: {error}");
        }
    }
}

#[test]
fn ray_jacobian_matches_central_differences() {
    for (name, camera) in all_cameras() {
        let mut numbers = Numbers(3);
        for _ in 0..200 {
            let pixel = numbers.pixel(&camera);
            let found = camera.ray_with_jacobian(&pixel).unwrap().1;
            let step_px = 1e-2;
            let columns = [Vector2::x(), Vector2::y()].map(|axis| {
                let ahead = camera.ray(&(pixel + axis * step_px)).unwrap().direction;
                let back = camera.ray(&(pixel - axis * step_px)).unwrap().direction;
                (ahead.as_ref() - back.as_ref()) / (2.0 * step_px)
            });
            let expected = Matrix3x2::from_columns(&columns);
            let error = (found - expected).amax() / expected.amax();
            assert!(error < 1e-7, "{name}: {error}");
        }
    }
}

/// Moving the camera and the point together moves nothing in the image.
#[test]
fn transformed_cameras_see_transformed_points_at_the_same_pixel() {
    let to_from = Isometry3::from_parts(
        Translation3::new(-3.0, 2.0, 0.7),
        UnitQuaternion::from_euler_angles(2.0, -0.4, 0.9),
    );
    for (name, camera) in all_cameras() {
        let moved = camera.transformed(&to_from);
        let mut numbers = Numbers(4);
        for _ in 0..100 {
            let pixel = numbers.pixel(&camera);
            let ray = camera.ray(&pixel).unwrap();
            let moved_ray = moved.ray(&pixel).unwrap();
            let expected = to_from.rotation * ray.direction.as_ref();
            assert!(
                (moved_ray.direction.as_ref() - expected).amax() < 1e-13,
                "{name}"
            );
            let point = to_from.transform_point(&ray.at(1.7).into()).coords;
            let there = moved.project(&point).unwrap();
            let here = camera.project(&ray.at(1.7)).unwrap();
            assert!((there - here).amax() < 1e-9, "{name}");
        }
    }
}
