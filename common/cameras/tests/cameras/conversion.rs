//! The formats of other tools: exact where they can be, with an honest error where not, and closed
//! to hostile files.

use crate::common::references;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector2, Vector3};
use proptest::prelude::*;
use rover_cameras::formats::{
    ConversionError, ConversionRules, Family, FormatError, Lens, LensCamera, MAX_BYTES, ModelFile,
    kalibr, opencv, read_text, read_toml, ros, write_text, write_toml,
};
use rover_cameras::{Camera, CameraModel};

const ALL: [Family; 3] = [Family::PlumbBob, Family::Rational, Family::Equidistant];

fn lens_camera(lens: Lens) -> LensCamera {
    LensCamera {
        frame_from_camera: Isometry3::from_parts(
            Translation3::new(0.1, -0.2, 0.3),
            UnitQuaternion::from_euler_angles(0.3, -0.6, 1.2),
        ),
        focal_px: [431.2, 430.1],
        centre_px: [322.4, 236.9],
        size_px: [640, 480],
        lens,
    }
}

const PLUMB_BOB: Lens = Lens::Polynomial {
    k: [-0.28, 0.07, -0.004, 0.0, 0.0, 0.0],
    p: [0.0007, -0.0004],
};

/// OpenCV's formulas written out once more, from its documentation.
fn opencv_pixel(camera: &LensCamera, point: &Vector3<f64>) -> Vector2<f64> {
    let d = camera.frame_from_camera.inverse() * nalgebra::Point3::from(*point);
    let (x, y) = (d.x / d.z, d.y / d.z);
    let r = (x * x + y * y).sqrt();
    let (xd, yd) = match camera.lens {
        Lens::Polynomial {
            k: [k1, k2, k3, k4, k5, k6],
            p: [p1, p2],
        } => {
            let f = (1.0 + k1 * r.powi(2) + k2 * r.powi(4) + k3 * r.powi(6))
                / (1.0 + k4 * r.powi(2) + k5 * r.powi(4) + k6 * r.powi(6));
            (
                x * f + 2.0 * p1 * x * y + p2 * (r * r + 2.0 * x * x),
                y * f + p1 * (r * r + 2.0 * y * y) + 2.0 * p2 * x * y,
            )
        }
        Lens::Equidistant {
            k: [k1, k2, k3, k4],
        } => {
            let t = r.atan();
            let td = t + k1 * t.powi(3) + k2 * t.powi(5) + k3 * t.powi(7) + k4 * t.powi(9);
            (x / r * td, y / r * td)
        }
    };
    Vector2::new(
        camera.focal_px[0] * xd + camera.centre_px[0],
        camera.focal_px[1] * yd + camera.centre_px[1],
    )
}

#[test]
fn lenses_image_by_the_published_formulas_and_back() {
    let rational = Lens::Polynomial {
        k: [0.4, -0.1, 0.02, 0.7, -0.05, 0.03],
        p: [0.0007, -0.0004],
    };
    let fisheye = Lens::Equidistant {
        k: [-0.01, 0.02, -0.015, 0.004],
    };
    for lens in [Lens::NONE, PLUMB_BOB, rational, fisheye] {
        let camera = lens_camera(lens);
        for (u, v) in [(0.0, 0.0), (322.0, 237.0), (639.0, 479.0), (100.0, 400.0)] {
            let pixel = Vector2::new(u, v);
            let point = camera.ray(&pixel).unwrap().at(1.7);
            assert!(
                (camera.project(&point).unwrap() - pixel).amax() < 1e-9,
                "{lens:?}"
            );
            assert!(
                (opencv_pixel(&camera, &point) - pixel).amax() < 1e-9,
                "{lens:?}"
            );
        }
    }
}

#[test]
fn what_both_can_express_is_carried_over_exactly_and_back() {
    let radial = Lens::Polynomial {
        k: [-0.2, 0.04, 0.0, 0.0, 0.0, 0.0],
        p: [0.0; 2],
    };
    let fisheye = Lens::Equidistant {
        k: [-0.02, 0.003, 0.0, 0.0],
    };
    let rules = ConversionRules::default();
    for (lens, name) in [
        (Lens::NONE, "CAHV"),
        (radial, "CAHVOR"),
        (fisheye, "CAHVORE"),
    ] {
        let original = lens_camera(lens);
        let there = original.to_camera(&rules).unwrap();
        assert!(there.exact && there.worst_px < 1e-9, "{there:?}");
        assert_eq!(there.camera.model.name(), name);
        let back = LensCamera::from_camera(&there.camera, &ALL, &rules).unwrap();
        assert!(back.exact, "{name}: {}", back.worst_px);
        let point = original.ray(&Vector2::new(50.0, 440.0)).unwrap().at(2.0);
        let error = back.camera.project(&point).unwrap() - Vector2::new(50.0, 440.0);
        assert!(error.amax() < 1e-9, "{name}: {error}");
    }
}

#[test]
fn what_is_fitted_reports_its_true_worst_error() {
    let rules = ConversionRules {
        limit_px: 1.0,
        near_m: 0.5,
    };
    let original = lens_camera(PLUMB_BOB);
    let found = original.to_camera(&rules).unwrap();
    assert!(!found.exact && found.worst_px < 0.9, "{}", found.worst_px);
    let mut worst_px = 0.0_f64;
    for i in 0..80 {
        for j in 0..60 {
            let pixel = Vector2::new(f64::from(i) * 8.0, f64::from(j) * 8.0);
            let point = original.ray(&pixel).unwrap().at(1.0);
            worst_px = worst_px.max((found.camera.project(&point).unwrap() - pixel).norm());
        }
    }
    assert!(
        worst_px < 1.05 * found.worst_px,
        "{worst_px} {}",
        found.worst_px
    );
    let strict = ConversionRules {
        limit_px: 1e-6,
        ..rules
    };
    let refused = original.to_camera(&strict);
    assert!(
        matches!(refused, Err(ConversionError::TooFar { .. })),
        "{refused:?}"
    );
}

/// A lens tilted against the image plane, and published axes of six digits: neither has an exact
/// counterpart.
#[test]
fn flight_models_are_fitted_with_an_error_of_a_fraction_of_a_pixel() {
    let rules = ConversionRules {
        limit_px: 0.5,
        ..ConversionRules::default()
    };
    for name in ["MER1_NAVCAM", "MSL_NAV", "VW_TEST_CAHVOR"] {
        let reference = references()
            .into_iter()
            .find(|m| m.name.starts_with(name))
            .unwrap();
        let found = LensCamera::from_camera(&reference.camera, &[Family::PlumbBob], &rules);
        let found = found.unwrap();
        println!("{name}: {:.2e} px", found.worst_px);
        assert!(found.worst_px < 0.3);
        let back = found.camera.to_camera(&rules).unwrap();
        println!("{name}: back {:.2e} px", back.worst_px);
        let moved = (back.camera.model.cahv()[0] - reference.camera.model.cahv()[0]).norm();
        assert!(moved < 1e-9, "{name}: the centre moved by {moved} m");
    }
}

#[test]
fn a_camera_is_read_back_from_every_format() {
    let own = |lens| LensCamera {
        frame_from_camera: Isometry3::identity(),
        ..lens_camera(lens)
    };
    let rational = Lens::Polynomial {
        k: [0.4, -0.1, 1e-7, 0.7, -0.05, 3e21],
        p: [0.0007, -0.0004],
    };
    let fisheye = Lens::Equidistant {
        k: [-0.01, 0.02, -0.015, 0.004],
    };
    for lens in [Lens::NONE, PLUMB_BOB, rational, fisheye] {
        let camera = own(lens);
        let text = ros::write(&camera, "left \"eye\"\n").unwrap();
        let info = ros::read(&text).unwrap();
        assert_eq!(
            (&info.camera, info.name.as_deref()),
            (&camera, Some("left eye"))
        );
        let text = opencv::write(&camera).unwrap();
        assert!(opencv::is_opencv(&text));
        assert_eq!(opencv::read(&text).unwrap(), camera);
    }
    let radtan = Lens::Polynomial {
        k: [-0.28, 0.07, 0.0, 0.0, 0.0, 0.0],
        p: [0.0007, -0.0004],
    };
    let chain = [own(radtan), lens_camera(fisheye), lens_camera(radtan)];
    let text = kalibr::write(&chain).unwrap();
    assert!(kalibr::is_kalibr(&text));
    for (found, expected) in kalibr::read(&text).unwrap().iter().zip(&chain) {
        assert_eq!(found.lens, expected.lens);
        assert_eq!(found.focal_px, expected.focal_px);
        let off = found.frame_from_camera.inverse() * expected.frame_from_camera;
        assert!(off.translation.vector.norm() < 1e-12 && off.rotation.angle() < 1e-7);
    }
}

#[test]
fn files_as_the_tools_write_them_are_read() {
    let ros_text = "image_width: 640\nimage_height: 480\ncamera_name: narrow_stereo/left\n\
        camera_matrix:\n  rows: 3\n  cols: 3\n  data: [438.7, 0, 305.5, 0, 437.3, 243.7, 0, 0, 1]\n\
        distortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  \
        data: [-0.361, 0.1209, 0.000158, 0.000285, 0]\n";
    let info = ros::read(ros_text).unwrap();
    assert_eq!(info.camera.focal_px, [438.7, 437.3]);
    assert_eq!(info.name.as_deref(), Some("narrow_stereo/left"));
    let message = "header:\n  stamp:\n    sec: 0\n    nanosec: 0\n  frame_id: cam\nheight: 480\n\
        width: 640\ndistortion_model: plumb_bob\nd:\n- 0.0\n- 0.0\n- 0.0\n- 0.0\n- 0.0\n\
        k:\n- 600.0\n- 0.0\n- 320.0\n- 0.0\n- 600.0\n- 240.0\n- 0.0\n- 0.0\n- 1.0\n\
        binning_x: 0\nbinning_y: 0\nroi:\n  x_offset: 0\n  y_offset: 0\n  height: 0\n  width: 0\n  \
        do_rectify: false\n";
    assert_eq!(ros::read(message).unwrap().name.as_deref(), Some("cam"));
    let opencv_text = "%YAML:1.0\n---\ncalibration_time: \"Mon 22\"\nimage_width: 640\n\
        image_height: 480\nfisheye_model: 0\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   \
        cols: 3\n   dt: d\n   data: [ 5.3591573396163199e+02, 0., 3.4228315473308373e+02, 0.,\n       \
        5.3591573396163199e+02, 2.3557082909788173e+02, 0., 0., 1. ]\n\
        distortion_coefficients: !!opencv-matrix\n   rows: 5\n   cols: 1\n   dt: d\n   \
        data: [ -2.66e-01, -3.85e-02, 1.78e-03, -2.81e-04, 2.38e-01 ]\n\
        avg_reprojection_error: 3.9259109564815858e-01\n";
    let camera = opencv::read(opencv_text).unwrap();
    assert_eq!(camera.focal_px[0], 5.359_157_339_616_32e2);
    assert!(matches!(camera.lens, Lens::Polynomial { k, .. } if k[2] == 0.238));
}

#[test]
fn what_cannot_be_used_is_refused_with_its_field() {
    let good = "cam0:\n  camera_model: pinhole\n  intrinsics: [400, 400, 320, 240]\n  \
        distortion_model: radtan\n  distortion_coeffs: [0, 0, 0, 0]\n  resolution: [640, 480]\n";
    assert!(kalibr::read(good).is_ok());
    for (from, to, field) in [
        ("pinhole", "omni", "cam0.camera_model"),
        ("radtan", "fov", "cam0.distortion_model"),
        ("[400, 400, 320, 240]", "[400, 400, 320]", "cam0.intrinsics"),
        ("[0, 0, 0, 0]", "[0, 0, 0, .nan]", "cam0.distortion_coeffs"),
        ("cam0", "cam1", "cameras"),
    ] {
        match kalibr::read(&good.replace(from, to)) {
            Err(FormatError::Field { field: found, .. }) => assert_eq!(found, field),
            other => panic!("{to}: {other:?}"),
        }
    }
    let unknown = format!("{good}  shutter: rolling\n");
    match kalibr::read(&unknown) {
        Err(FormatError::Structure { message }) => {
            assert!(
                message.contains("shutter") && message.contains("line 7"),
                "{message}"
            );
        }
        other => panic!("{other:?}"),
    }
    let ros_text = ros::write(&lens_camera(PLUMB_BOB), "a").unwrap();
    for (from, to, field) in [
        ("plumb_bob", "thin_prism", "distortion_model"),
        ("rows: 3\n  cols: 3", "rows: 2\n  cols: 3", "camera_matrix"),
    ] {
        match ros::read(&ros_text.replacen(from, to, 1)) {
            Err(FormatError::Field { field: found, .. }) => assert_eq!(found, field),
            other => panic!("{to}: {other:?}"),
        }
    }
    assert!(ros::read(&ros_text.replace("image_width: 640", "image_width: 0")).is_err());
}

#[test]
fn texts_that_grow_when_read_are_refused() {
    let mut bomb = "a: &a [x, x, x, x, x, x, x, x, x]\n".to_owned();
    for (name, of) in [("b", "a"), ("c", "b"), ("d", "c"), ("e", "d"), ("f", "e")] {
        let aliases = vec![format!("*{of}"); 9].join(", ");
        bomb += &format!("{name}: &{name} [{aliases}]\n");
    }
    let deep = "[".repeat(30_000);
    let long = "#".repeat(MAX_BYTES + 1);
    for text in [&bomb, &deep, &long] {
        assert!(ros::read(text).is_err());
        assert!(opencv::read(text).is_err());
        assert!(kalibr::read(text).is_err());
        assert!(read_toml(text).is_err());
    }
}

#[test]
fn cahvore_models_are_read_back_from_text_and_toml() {
    for reference in references() {
        let text = write_text(&reference.camera, Some("rover")).unwrap();
        let file = read_text(&text).unwrap();
        assert_eq!(file.camera().unwrap(), reference.camera);
        let toml_text = write_toml(&file).unwrap();
        assert_eq!(read_toml(&toml_text).unwrap(), file);
    }
}

#[test]
fn the_lines_of_the_pupil_are_checked_like_the_others() {
    let base = "C = 0 0 0\nA = 0 0 1\nH = 600 0 320\nV = 0 600 240\nO = 0 0 1\nR = 0 0 0\n";
    let with = |lines: &str| read_text(&format!("{base}{lines}"));
    for (lines, linearity) in [
        ("E = 0 0 0\nT = 1\n", 1.0),
        ("E = 0 0 0\nT = 1\nP = 0\n", 1.0),
        ("T = 2\nE = 0 0 0\nP = 0\n", 0.0),
        ("E = 0 0 0\nT = 3\nP = 0.37\n", 0.37),
    ] {
        match with(lines).unwrap().model {
            CameraModel::Cahvore(m) => assert_eq!(m.linearity, linearity),
            other => panic!("{other:?}"),
        }
    }
    for (lines, part) in [
        ("E = 0 0 0\n", "T is missing"),
        ("T = 3\nE = 0 0 0\n", "P is missing"),
        ("T = 2\nP = 0\n", "E is missing"),
        ("P = 0.3\nE = 0 0 0\n", "T is missing"),
        ("E = 0 0 0\nT = 4\n", "line 8: T"),
        ("E = 0 0 0\nT = 1\nP = 0.37\n", "line 9: P"),
        ("E = 0 0 0\nT = 3\nP = x\n", "line 9: P"),
        ("E = 0 0\nT = 3\nP = 1\n", "line 7: E"),
        ("E = 0 0 0\nT = 3\nP = 3\n", "linearity is 3"),
        ("S = 1\n", "line 7: unknown line"),
    ] {
        let message = with(lines).unwrap_err().to_string();
        assert!(message.contains(part), "{lines:?}: {message}");
    }
}

#[test]
fn a_toml_error_names_its_line() {
    let camera = Camera::pinhole(
        &Isometry3::identity(),
        [600.0; 2],
        [320.0, 240.0],
        [640, 480],
    );
    let file = ModelFile {
        frame: None,
        size_px: Some([640, 480]),
        model: camera.model,
    };
    let text = write_toml(&file).unwrap();
    let spoilt = text.replace("\na = ", "\nq = ");
    let line = spoilt.lines().position(|l| l.starts_with("q =")).unwrap() + 1;
    let message = read_toml(&spoilt).unwrap_err().to_string();
    assert!(message.contains(&format!("line {line}")), "{message}");
}

/// Words of the formats, so that random texts get far into the readers.
fn nearly_yaml() -> impl Strategy<Value = String> {
    let word = prop_oneof![
        Just("image_width: 640\n".to_owned()),
        Just("image_height: 480\n".to_owned()),
        Just("camera_matrix: [400, 0, 320, 0, 400, 240, 0, 0, 1]\n".to_owned()),
        Just("camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n".to_owned()),
        Just("distortion_model: plumb_bob\n".to_owned()),
        Just("distortion_coefficients: [0, 0, 0, 0, 0]\n".to_owned()),
        Just("cam0:\n  camera_model: pinhole\n".to_owned()),
        Just("  intrinsics: [1e300, -1, .inf, 5]\n".to_owned()),
        Just("  resolution: [99999999999, -1]\n".to_owned()),
        Just("   data: [1, 2, 3]\n".to_owned()),
        Just("%YAML:1.0\n---\n".to_owned()),
        "[-&*!|>%@?:{}\\[\\],# \n\ta-c0-9.]{0,16}",
        ".{0,8}",
    ];
    prop::collection::vec(word, 0..14).prop_map(|words| words.concat())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1500))]

    #[test]
    fn no_text_makes_a_reader_panic_or_talk_long(text in prop_oneof![nearly_yaml(), any::<String>()]) {
        let messages = [
            ros::read(&text).map(drop),
            opencv::read(&text).map(drop),
            kalibr::read(&text).map(drop),
            read_toml(&text).map(drop),
        ];
        for error in messages.into_iter().filter_map(Result::err) {
            prop_assert!(error.to_string().len() < 1500);
        }
    }
}
