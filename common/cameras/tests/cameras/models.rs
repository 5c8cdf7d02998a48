//! What a camera is, where its model ends, and how it is written.

use crate::common::references;
use nalgebra::{Isometry3, Translation3, Unit, UnitQuaternion, Vector2, Vector3};
use rover_cameras::{Camera, CameraError, CameraModel, StereoPair};

const SIZE_PX: [u32; 2] = [640, 480];

fn pose() -> Isometry3<f64> {
    Isometry3::from_parts(
        Translation3::new(0.1, 0.2, 0.9),
        UnitQuaternion::from_euler_angles(-1.9, 0.2, -1.4),
    )
}

fn pinhole() -> Camera {
    Camera::pinhole(&pose(), [602.0, 598.0], [320.5, 238.25], SIZE_PX)
}

fn distorted(r: [f64; 3]) -> Camera {
    let axis = Vector3::z_axis();
    Camera::pinhole_distorted(
        &Isometry3::identity(),
        [600.0; 2],
        [320.0, 240.0],
        SIZE_PX,
        &axis,
        r,
    )
}

fn vectors(camera: &mut Camera) -> &mut rover_cameras::Cahvor {
    match &mut camera.model {
        CameraModel::Cahvor(model) => model,
        other => panic!("expected CAHVOR, found {}", other.name()),
    }
}

#[test]
fn pinhole_projects_by_the_textbook_formula_and_gives_its_terms_back() {
    let camera = pinhole();
    let point_in_camera = Vector3::new(0.31, -0.22, 1.7);
    let point = pose().transform_point(&point_in_camera.into()).coords;
    let pixel = camera.project(&point).unwrap();
    let expected = Vector2::new(602.0 * 0.31 / 1.7 + 320.5, 598.0 * -0.22 / 1.7 + 238.25);
    assert!((pixel - expected).amax() < 1e-10);
    let found = camera.intrinsics();
    let terms = [
        found.hs - 602.0,
        found.vs - 598.0,
        found.hc - 320.5,
        found.vc - 238.25,
    ];
    assert!(terms.iter().all(|error| error.abs() < 1e-10));
    assert_eq!(found.position, Vector3::new(0.1, 0.2, 0.9));
    let turned = found.camera_from_model * (point - found.position);
    assert!((turned - point_in_camera).amax() < 1e-12);
    assert_eq!(found.distortion_centre_px, None);
}

/// With O along A the model is the OpenCV radial one with rescaled coefficients.
#[test]
fn distortion_about_the_boresight_equals_the_opencv_radial_model() {
    let r = [0.01, -0.2, 0.05];
    let camera = distorted(r);
    let focal = 600.0 * (1.0 + r[0]);
    let (k1, k2) = (r[1] / (1.0 + r[0]), r[2] / (1.0 + r[0]));
    for (x, y) in [(0.0, 0.0), (0.3, -0.1), (-0.5, 0.4), (0.52, 0.39)] {
        let r2: f64 = x * x + y * y;
        let scale = focal * (1.0 + k1 * r2 + k2 * r2 * r2);
        let expected = Vector2::new(320.0 + scale * x, 240.0 + scale * y);
        let pixel = camera
            .project(&Vector3::new(2.0 * x, 2.0 * y, 2.0))
            .unwrap();
        assert!((pixel - expected).amax() < 1e-10);
    }
    let centre = camera.intrinsics().distortion_centre_px.unwrap();
    assert!((centre - Vector2::new(320.0, 240.0)).amax() < 1e-10);
}

#[test]
fn points_behind_the_camera_are_refused_with_their_range() {
    for camera in [pinhole(), distorted([0.0, -0.1, 0.02])] {
        let found = camera.intrinsics();
        let behind = found.position - found.camera_from_model.inverse() * Vector3::z() * 0.5;
        match camera.project(&behind) {
            Err(CameraError::BehindCamera { point, range_m }) => {
                assert_eq!(point, behind);
                assert!((range_m + 0.5).abs() < 1e-12);
            }
            other => panic!("expected BehindCamera, found {other:?}"),
        }
        let at_centre = camera.project(&found.position);
        assert!(
            matches!(at_centre, Err(CameraError::BehindCamera { .. })),
            "{at_centre:?}"
        );
    }
}

#[test]
fn numbers_that_are_not_finite_are_refused() {
    for camera in [pinhole(), distorted([0.0, -0.1, 0.02])] {
        for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            for axis in 0..3 {
                let mut point = Vector3::new(0.1, 0.2, 5.0);
                point[axis] = bad;
                assert_eq!(camera.project(&point), Err(CameraError::NotFinite));
                assert!(camera.project_with_jacobian(&point).is_err());
            }
            for axis in 0..2 {
                let mut pixel = Vector2::new(10.0, 20.0);
                pixel[axis] = bad;
                assert_eq!(camera.ray(&pixel), Err(CameraError::NotFinite));
                assert!(camera.ray_with_jacobian(&pixel).is_err());
                assert!(!camera.contains(&pixel, 0.0));
            }
        }
    }
}

/// Barrel distortion folds the image over at some angle: `t (1 + r1 t^2)` peaks at
/// `t^2 = -1 / (3 r1)`. Points beyond must not appear inside the image.
#[test]
fn directions_beyond_the_fold_of_the_distortion_are_refused() {
    let r1: f64 = -0.35;
    let camera = distorted([0.0, r1, 0.0]);
    let fold = (-1.0 / (3.0 * r1)).sqrt();
    let inside = camera
        .project(&Vector3::new(fold * 0.999, 0.0, 1.0))
        .unwrap();
    match camera.project(&Vector3::new(fold * 1.001, 0.0, 1.0)) {
        Err(CameraError::OutsideField {
            off_axis_deg,
            limit_deg,
        }) => {
            assert!((limit_deg - fold.atan().to_degrees()).abs() < 1e-9);
            assert!(off_axis_deg > limit_deg);
        }
        other => panic!("expected OutsideField, found {other:?}"),
    }
    let edge_px = 320.0 + 600.0 * fold * 2.0 / 3.0;
    assert!(inside.x < edge_px);
    let ray = camera.ray(&Vector2::new(edge_px - 1e-3, 240.0)).unwrap();
    assert!(ray.direction.x / ray.direction.z < fold);
    let refused = camera.ray(&Vector2::new(edge_px + 1e-3, 240.0));
    assert!(
        matches!(refused, Err(CameraError::OutsideField { .. })),
        "{refused:?}"
    );
}

/// Against brute force: the first sign change of the slope on a fine grid ends the field.
#[test]
fn the_field_ends_where_the_distortion_stops_rising() {
    let coefficients = [
        [0.0, -0.12, 0.03],
        [0.02, -0.8, 0.15],
        [0.0, -0.5, 0.16],
        [-0.1, 0.3, -0.05],
        [0.0, 0.0, -0.02],
        [0.0, 0.4, 0.3],
    ];
    for r in coefficients {
        let camera = distorted(r);
        let curve = |t: f64| t * (1.0 + r[0] + r[1] * t * t + r[2] * t.powi(4));
        let mut refused = false;
        for step in 1..4000 {
            let t = f64::from(step) * 1e-3;
            refused |= curve(t + 1e-6) <= curve(t - 1e-6);
            let answer = camera.project(&Vector3::new(0.0, t, 1.0));
            assert_eq!(answer.is_err(), refused, "r = {r:?}, t = {t}: {answer:?}");
            if let Ok(pixel) = answer {
                let back = camera.ray(&pixel).unwrap().direction;
                let error = (back.y / back.z - t).abs();
                // Near the fold the inverse is ill-conditioned: errors grow as the square root.
                assert!(error < 1e-7, "r = {r:?}, t = {t}: {error}");
            }
        }
    }
}

#[test]
fn rays_at_right_angles_to_the_optical_axis_are_refused() {
    let axis = Unit::new_normalize(Vector3::new(1.0, 0.0, 0.2));
    let camera = Camera::pinhole_distorted(
        &Isometry3::identity(),
        [100.0; 2],
        [320.0, 240.0],
        SIZE_PX,
        &axis,
        [0.0, 0.01, 0.0],
    );
    let refused = camera.ray(&Vector2::new(0.0, 240.0));
    match refused {
        Err(CameraError::OutsideField {
            off_axis_deg,
            limit_deg,
        }) => {
            assert!(off_axis_deg > 90.0 && limit_deg <= 90.0);
        }
        other => panic!("expected OutsideField, found {other:?}"),
    }
}

#[test]
fn the_image_reaches_half_a_pixel_beyond_the_outermost_centres() {
    let camera = pinhole();
    let inside = |u, v, margin| camera.contains(&Vector2::new(u, v), margin);
    assert!(inside(-0.5, -0.5, 0.0) && inside(639.5, 479.5, 0.0));
    assert!(!inside(-0.51, 0.0, 0.0) && !inside(0.0, 479.51, 0.0));
    assert!(inside(0.0, 0.0, 0.5) && inside(639.0, 479.0, 0.5));
    assert!(!inside(-0.01, 0.0, 0.5) && !inside(639.01, 479.0, 0.5));
    assert!(inside(-5.0, 484.0, -5.0));
    assert!(!inside(320.0, 240.0, f64::NAN));
}

#[test]
fn invalid_models_are_refused_with_the_vector_at_fault() {
    let good = distorted([0.0, -0.1, 0.0]);
    good.validate().unwrap();
    type Spoil = fn(&mut Camera);
    let cases: [(Spoil, &str); 10] = [
        (|c| c.width_px = 0, "0 x 480"),
        (|c| vectors(c).c.y = f64::NAN, "C is [0 NaN 0]"),
        (|c| vectors(c).a *= 1.01, "length of A is 1.01"),
        (|c| vectors(c).h.x = f64::INFINITY, "H is [inf"),
        (|c| vectors(c).h = vectors(c).a * 320.0, "hs = |A x H| is 0"),
        (|c| vectors(c).v = vectors(c).h, "parallel"),
        (|c| vectors(c).o *= 0.9, "length of O is 0.9"),
        (|c| vectors(c).o *= -1.0, "O points away"),
        (|c| vectors(c).r.x = -1.5, "r0 is -1.5"),
        (|c| vectors(c).r.z = f64::NAN, "R is [0 -0.1 NaN]"),
    ];
    for (spoil, text) in cases {
        let mut camera = good.clone();
        spoil(&mut camera);
        let message = camera.validate().unwrap_err().to_string();
        assert!(
            message.contains(text),
            "{message:?} does not contain {text:?}"
        );
    }
}

#[test]
fn unit_axes_change_no_pixel_of_a_linear_camera() {
    for model in references() {
        let unit = model.camera.with_unit_axes().unwrap();
        let [_, a, ..] = unit.model.cahv();
        assert!((a.norm() - 1.0).abs() < 1e-15);
        let limit_px = match unit.model {
            CameraModel::Cahv(_) => 1e-10,
            _ => 0.02,
        };
        for vector in &model.projections {
            let error_px = (unit.project(&vector.point).unwrap() - vector.pixel_px).amax();
            assert!(error_px < limit_px, "{}: {error_px}", model.name);
        }
    }
}

#[test]
fn cameras_survive_json_toml_and_bincode_unchanged() {
    for model in references() {
        let pair = StereoPair {
            left: model.camera.clone(),
            right: model
                .camera
                .transformed(&Isometry3::translation(0.0, -0.1, 0.0)),
        };
        let json = serde_json::to_string(&pair).unwrap();
        assert_eq!(serde_json::from_str::<StereoPair>(&json).unwrap(), pair);
        let text = toml::to_string(&pair).unwrap();
        assert_eq!(toml::from_str::<StereoPair>(&text).unwrap(), pair);
        let config = bincode::config::standard();
        let bytes = bincode::serde::encode_to_vec(&pair, config).unwrap();
        let (back, used): (StereoPair, usize) =
            bincode::serde::decode_from_slice(&bytes, config).unwrap();
        assert_eq!((back, used), (pair, bytes.len()));
    }
}

#[test]
fn the_written_form_is_stable_and_strict() {
    let text = "width_px = 640\nheight_px = 480\n[model.cahv]\nc = [0, 0, 1]\na = [1, 0, 0]\n\
                h = [320, -600, 0]\nv = [240, 0, -600]\n";
    let camera: Camera = toml::from_str(text).unwrap();
    camera.validate().unwrap();
    assert_eq!(
        camera.project(&Vector3::new(2.0, 0.0, 1.0)).unwrap(),
        Vector2::new(320.0, 240.0)
    );
    toml::from_str::<Camera>(&text.replace("cahv", "CAHV")).unwrap();
    for (from, to) in [
        ("width_px", "width"),
        ("\nv =", "\nw ="),
        ("cahv", "cahw"),
        ("[0, 0, 1]", "[0, 0]"),
        ("[0, 0, 1]", "[0, 0, 1, 2]"),
        ("v = ", "o = [1, 0, 0]\nv = "),
        ("width_px = 640", "width_px = -1"),
    ] {
        let changed = text.replace(from, to);
        assert!(
            toml::from_str::<Camera>(&changed).is_err(),
            "accepted: {changed}"
        );
    }
}

/// A calibration of real pictures: its polynomial rises for ever, but O is tilted, and far out the
/// distortion carries points behind the image plane.
#[test]
fn a_point_in_front_that_the_distortion_carries_behind_is_outside_the_field() {
    let camera = Camera::pinhole_distorted(
        &Isometry3::identity(),
        [533.7; 2],
        [341.9, 235.3],
        [640, 480],
        &Unit::new_normalize(Vector3::new(-0.000_544, 0.003_913, 1.0)),
        [0.0, -0.289_36, 0.097_88],
    );
    let point = Vector3::new(5.0, 3.0, 0.2);
    let Err(CameraError::OutsideField {
        off_axis_deg,
        limit_deg,
    }) = camera.project(&point)
    else {
        panic!("{:?}", camera.project(&point));
    };
    // The last point on the way out that has an image.
    let [axis, _] = camera.model.lens().unwrap();
    let across = (point - axis * point.dot(axis)).normalize();
    let seen = |degrees: f64| {
        let (sine, cosine) = degrees.to_radians().sin_cos();
        camera.project(&(axis * cosine + across * sine)).is_ok()
    };
    let last = (0..9000)
        .map(|n| f64::from(n) * 0.01)
        .take_while(|degrees| seen(*degrees))
        .last()
        .unwrap();
    assert!((limit_deg - last).abs() < 0.011, "{limit_deg} {last}");
    assert!(off_axis_deg > limit_deg && off_axis_deg < 90.0);
    let behind = camera.project(&Vector3::new(0.0, 0.0, -1.0));
    assert!(matches!(behind, Err(CameraError::BehindCamera { .. })));
}
