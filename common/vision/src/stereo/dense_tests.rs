#![allow(clippy::unwrap_used, clippy::expect_used)]
//! Rectification and dense disparity on rendered planes, against the cameras' own geometry.

use nalgebra::{Isometry3, Vector2, Vector3};
use rover_cameras::Side;

use super::*;
use crate::synthetic::{self, Rays};

/// Both images of a textured plane, through the distorted test cameras.
fn plane_images(pose: &Isometry3<f64>, noise_dn: f64, seed: u64) -> [Image8; 2] {
    let pair = synthetic::pair();
    let mut rng = synthetic::rng(seed);
    [&pair.left, &pair.right].map(|camera| {
        let mut picture = vec![110.0; 640 * 480];
        let whole = (0, 0, 640, 480);
        synthetic::draw(&mut picture, &Rays::new(camera), whole, 2, &|o, d| {
            let p = synthetic::hit_plane(pose, o, d)?;
            Some(synthetic::texture(p.x, p.y, 0.064, 0.0015, 18.0, seed))
        });
        let pixels = synthetic::expose(&picture, 640, whole, 0.6, noise_dn, &mut rng);
        Image8::from_raw(640, 480, pixels).unwrap()
    })
}

#[test]
fn a_point_lies_on_the_same_row_of_both_rectified_images() {
    let pair = synthetic::pair();
    let rectifier = Rectifier::new(&pair, 30.0).unwrap();
    for (u, v, range) in [(60.0, 40.0, 0.5), (320.0, 240.0, 0.7), (600.0, 440.0, 2.0)] {
        let point = pair.left.ray(&Vector2::new(u, v)).unwrap().at(range);
        let left = rectifier.pair.left.project(&point).unwrap();
        let right = rectifier.pair.right.project(&point).unwrap();
        assert!((left.y - right.y).abs() < 1e-9, "{left} {right}");
        assert!(left.x - right.x > -30.0);
    }
    assert!(matches!(
        Rectifier::new(
            &rover_cameras::StereoPair {
                left: pair.left.clone(),
                right: pair.left.clone()
            },
            0.0
        ),
        Err(RectifyError::Geometry(_))
    ));
}

#[test]
fn a_slanted_plane_gets_dense_disparities_to_a_tenth_of_a_pixel() {
    let pair = synthetic::pair();
    for (case, tilt) in [0.0, 0.4, 0.8].into_iter().enumerate() {
        let pixel = Vector2::new(340.0, 240.0);
        let pose = synthetic::facing_pose(&pair.left, pixel, 0.75, tilt, 0.3, 0.0);
        let images = plane_images(&pose, 1.5, case as u64);
        let rectifier = Rectifier::new(&pair, 34.0).unwrap();
        let left = rectifier.apply(&images[0], Side::Left).unwrap();
        let right = rectifier.apply(&images[1], Side::Right).unwrap();
        let found = dense_disparity(&left, &right, &DenseRules::default()).unwrap();
        let normal = pose * Vector3::z();
        let (mut square, mut n, mut gross, mut possible) = (0.0, 0.0, 0, 0);
        for v in (20..460).step_by(3) {
            for u in (110..600).step_by(3) {
                let at = Vector2::new(f64::from(u), f64::from(v));
                let ray = rectifier.pair.left.ray(&at).unwrap();
                let d = ray.direction.into_inner();
                let range = normal.dot(&(pose.translation.vector - ray.origin)) / normal.dot(&d);
                let Ok(seen) = rectifier.pair.right.project(&ray.at(range)) else {
                    continue;
                };
                let truth = at.x - seen.x;
                if !(3.0..60.0).contains(&truth) || left.get(u, v) == Some(0) {
                    continue;
                }
                possible += 1;
                let Some(disparity) = found.at(u, v) else {
                    continue;
                };
                let e = disparity - truth;
                if e.abs() > 1.0 {
                    gross += 1;
                } else {
                    square += e * e;
                    n += 1.0;
                }
            }
        }
        let rms = f64::sqrt(square / n);
        let share = n / f64::from(possible);
        println!("tilt {tilt}: rms {rms:.3} px, {share:.3} of {possible}, {gross} gross");
        assert!(rms < 0.12, "tilt {tilt}: {rms} px");
        assert!(share > 0.8, "tilt {tilt}: {share}");
        assert!(f64::from(gross) < 0.005 * n, "tilt {tilt}: {gross}");
    }
}

#[test]
fn nothing_is_claimed_without_texture_or_for_unrelated_images() {
    let flat = Image8::from_raw(200, 60, vec![120; 200 * 60]).unwrap();
    let rules = DenseRules::default();
    assert_eq!(dense_disparity(&flat, &flat, &rules).unwrap().count(), 0);
    let noise = |seed: u64| {
        use rand::Rng;
        let mut rng = synthetic::rng(seed);
        let pixels = (0..200 * 60).map(|_| rng.random()).collect();
        Image8::from_raw(200, 60, pixels).unwrap()
    };
    let found = dense_disparity(&noise(1), &noise(2), &rules).unwrap();
    assert!(found.count() < 200 * 60 / 100, "{}", found.count());
    let small = Image8::from_raw(50, 60, vec![0; 3000]).unwrap();
    assert!(matches!(
        dense_disparity(&flat, &small, &rules),
        Err(DenseError::Sizes { .. })
    ));
    let bad = DenseRules {
        half_window_px: 9,
        ..rules
    };
    let text = dense_disparity(&flat, &flat, &bad).unwrap_err().to_string();
    assert!(
        text.contains("half_window_px") && text.contains('9'),
        "{text}"
    );
}
