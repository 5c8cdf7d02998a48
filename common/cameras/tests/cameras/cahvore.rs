//! What CAHVORE refuses, its special cases, and parts of images.

use crate::common::references;
use nalgebra::{Isometry3, Unit, Vector2, Vector3};
use rover_cameras::{Cahvore, Camera, CameraError, CameraModel, StereoPair};

fn model(linearity: f64, r: [f64; 3], e: [f64; 3]) -> Camera {
    Camera {
        model: CameraModel::Cahvore(Cahvore {
            c: Vector3::zeros(),
            a: Vector3::z(),
            h: Vector3::new(300.0, 0.0, 319.5),
            v: Vector3::new(0.0, 300.0, 239.5),
            o: Vector3::z(),
            r: r.into(),
            e: e.into(),
            linearity,
        }),
        width_px: 640,
        height_px: 480,
    }
}

#[test]
fn a_perspective_lens_with_a_fixed_pupil_is_cahvor() {
    let r = [0.01, -0.12, 0.03];
    let camera = model(1.0, r, [0.0; 3]);
    let plain = Camera::pinhole_distorted(
        &Isometry3::identity(),
        [300.0; 2],
        [319.5, 239.5],
        [640, 480],
        &Vector3::z_axis(),
        r,
    );
    for (x, y) in [(0.0, 0.0), (0.3, -0.2), (-0.9, 0.6), (1e-12, 0.0)] {
        let point = Vector3::new(x, y, 1.3);
        let (found, expected) = (
            camera.project_with_jacobian(&point).unwrap(),
            plain.project_with_jacobian(&point).unwrap(),
        );
        assert!((found.pixel_px - expected.pixel_px).amax() < 1e-10);
        assert!((found.jacobian - expected.jacobian).amax() < 1e-8);
        let ray = camera.ray(&found.pixel_px).unwrap();
        assert!((ray.direction.as_ref() - point.normalize()).amax() < 1e-12);
    }
}

#[test]
fn an_ideal_fisheye_is_linear_in_the_angle_and_sees_beyond_a_right_angle() {
    let camera = model(0.0, [0.0; 3], [0.0; 3]);
    for degrees in [0.0, 1.0, 45.0, 89.0, 90.0, 100.0, 170.0_f64] {
        let angle = degrees.to_radians();
        let point = Vector3::new(angle.sin(), 0.0, angle.cos()) * 2.0;
        let pixel = camera.project(&point).unwrap();
        assert!(
            (pixel.x - (319.5 + 300.0 * angle)).abs() < 1e-9,
            "{degrees}: {pixel}"
        );
        let ray = camera.ray(&pixel).unwrap();
        assert!((ray.at(2.0) - point).amax() < 1e-11, "{degrees}");
    }
}

#[test]
fn every_linearity_is_continuous_through_zero_and_round_trips() {
    let e = [0.002, 0.001, -0.0005];
    let near = |linearity| {
        model(linearity, [0.0, -0.02, 0.001], e)
            .project(&Vector3::new(0.5, -0.3, 0.8))
            .unwrap()
    };
    assert!((near(1e-5) - near(0.0)).amax() < 1e-6);
    assert!((near(-1e-5) - near(0.0)).amax() < 1e-6);
    for linearity in [-1.0, -0.4, 0.0, 0.37, 1.0] {
        let camera = model(linearity, [0.0, -0.02, 0.001], e);
        for (u, v) in [
            (319.5, 239.5),
            (319.6, 239.4),
            (100.0, 400.0),
            (500.0, 20.0),
        ] {
            let pixel = Vector2::new(u, v);
            let ray = camera.ray(&pixel).unwrap();
            let back = camera.project(&ray.at(0.3)).unwrap();
            assert!((back - pixel).amax() < 1e-9, "{linearity}: {back}");
        }
    }
}

#[test]
fn points_without_a_single_ray_are_refused_with_the_reason() {
    let perspective = model(1.0, [0.0; 3], [0.001, 0.0, 0.0]);
    let refused = perspective.project(&Vector3::new(0.1, 0.0, -1.0));
    assert!(
        matches!(refused, Err(CameraError::OutsideField { .. })),
        "{refused:?}"
    );
    let at_pupil = perspective.project(&Vector3::zeros());
    assert!(
        matches!(at_pupil, Err(CameraError::NearPupil { .. })),
        "{at_pupil:?}"
    );
    let wide = model(0.0, [0.0; 3], [0.05, 0.0, 0.0]);
    let inside = wide.project(&Vector3::new(0.01, 0.0, 0.005));
    assert!(inside.is_err(), "{inside:?}");
    let nowhere = perspective.project(&Vector3::new(f64::NAN, 0.0, 1.0));
    assert_eq!(nowhere, Err(CameraError::NotFinite));
    let far = perspective.project(&Vector3::new(f64::INFINITY, 0.0, 1.0));
    assert_eq!(far, Err(CameraError::NotFinite));
}

#[test]
fn pixels_beyond_the_field_are_refused_with_its_limit() {
    let folding = model(0.0, [0.0, -0.2, 0.0], [0.0; 3]);
    let limit = (1.0_f64 / 0.6).sqrt();
    match folding.project(&Vector3::new((limit + 0.1).sin(), 0.0, (limit + 0.1).cos())) {
        Err(CameraError::OutsideField { limit_deg, .. }) => {
            assert!((limit_deg - limit.to_degrees()).abs() < 1e-9);
        }
        other => panic!("{other:?}"),
    }
    let pixel = Vector2::new(319.5 + 300.0, 239.5);
    let refused = folding.ray(&pixel);
    assert!(
        matches!(refused, Err(CameraError::OutsideField { .. })),
        "{refused:?}"
    );
    // A sine projection ends where the sine does.
    let sine = model(-1.0, [0.0; 3], [0.0; 3]);
    assert!(sine.ray(&Vector2::new(319.5 + 299.0, 239.5)).is_ok());
    assert!(sine.ray(&Vector2::new(319.5 + 301.0, 239.5)).is_err());
}

#[test]
fn a_linearity_or_pupil_that_describes_no_lens_is_refused() {
    for (linearity, e0) in [(1.5, 0.0), (f64::NAN, 0.0), (0.3, f64::INFINITY)] {
        let camera = model(linearity, [0.0; 3], [e0, 0.0, 0.0]);
        assert!(matches!(
            camera.validate(),
            Err(CameraError::InvalidModel { .. })
        ));
    }
}

#[test]
fn points_outside_the_image_are_told_from_those_inside() {
    let camera = model(1.0, [0.0; 3], [0.0; 3]);
    assert!(
        camera
            .project_into_image(&Vector3::new(0.1, 0.0, 1.0), 0.0)
            .is_ok()
    );
    let outside = camera.project_into_image(&Vector3::new(2.0, 0.0, 1.0), 0.0);
    assert!(
        matches!(outside, Err(CameraError::OutsideImage { .. })),
        "{outside:?}"
    );
}

/// The moving origin enters the triangulated point's derivative.
#[test]
fn triangulation_derivatives_hold_for_moving_pupils() {
    let hazcams: Vec<_> = references()
        .into_iter()
        .filter(|m| m.name.starts_with("M2020_HAZ"))
        .map(|m| m.camera.with_unit_axes().unwrap())
        .collect();
    let [left, right] = [hazcams[0].clone(), hazcams[1].clone()];
    let pair = StereoPair { left, right };
    let point = Vector3::new(2.0, 0.15, 0.1);
    let pixels = [
        pair.left.project(&point).unwrap(),
        pair.right.project(&point).unwrap(),
    ];
    let (found, jacobians) = pair
        .triangulate_with_jacobian(&pixels[0], &pixels[1])
        .unwrap();
    assert!((found.point - point).amax() < 1e-9);
    for side in 0..2 {
        for axis in 0..2 {
            let moved = |by: f64| {
                let mut p = pixels;
                p[side][axis] += by;
                pair.triangulate(&p[0], &p[1]).unwrap().point
            };
            let expected = (moved(0.1) - moved(-0.1)) / 0.2;
            let error = (jacobians[side].column(axis) - expected).amax() / expected.amax();
            assert!(error < 1e-6, "side {side} axis {axis}: {error}");
        }
    }
}

/// A pixel of the part, or of the coarser image, is where it was in the whole one.
#[test]
fn subframes_and_downsampled_images_see_the_same_rays() {
    for reference in references() {
        let camera = reference.camera;
        let part = camera.subframe([100, 40], [300, 200]).unwrap();
        let coarse = camera.downsampled(4).unwrap();
        assert_eq!((part.width_px, part.height_px), (300, 200));
        assert_eq!(coarse.width_px, camera.width_px / 4);
        let point = camera.ray(&Vector2::new(210.0, 150.0)).unwrap().at(1.5);
        let whole = camera.project(&point).unwrap();
        let in_part = part.project(&point).unwrap() + Vector2::new(100.0, 40.0);
        let in_coarse = (coarse.project(&point).unwrap().add_scalar(0.5) * 4.0).add_scalar(-0.5);
        assert!((in_part - whole).amax() < 1e-9, "{}", reference.name);
        assert!((in_coarse - whole).amax() < 1e-9, "{}", reference.name);
    }
    let camera = model(1.0, [0.0; 3], [0.0; 3]);
    assert!(camera.subframe([600, 0], [41, 10]).is_err());
    assert!(camera.subframe([u32::MAX, 0], [u32::MAX, 10]).is_err());
    assert!(camera.subframe([0, 0], [0, 10]).is_err());
    assert!(camera.downsampled(0).is_err() && camera.downsampled(481).is_err());
}

#[test]
fn the_axis_of_symmetry_is_a_unit_vector_after_scaling() {
    let camera = model(0.37, [0.0; 3], [0.0; 3]);
    let CameraModel::Cahvore(mut m) = camera.model.clone() else {
        panic!("not CAHVORE");
    };
    m.o *= 1.0005;
    let scaled = Camera {
        model: CameraModel::Cahvore(m),
        ..camera
    }
    .with_unit_axes()
    .unwrap();
    let [o, _] = scaled.model.lens().unwrap();
    assert!((Unit::new_normalize(*o).as_ref() - o).amax() < 1e-15);
}
