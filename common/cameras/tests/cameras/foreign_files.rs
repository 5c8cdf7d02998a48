//! Files of other tools that mean something else than they seem to: fisheye lenses named in words,
//! stereo files, rectified pairs.

use nalgebra::{Isometry3, Vector2, Vector3};
use rover_cameras::formats::opencv::{Choice, read_chosen};
use rover_cameras::formats::{FormatError, Lens, opencv, ros};

fn matrix(rows: usize, cols: usize, data: &str) -> String {
    format!("!!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {data} ]\n")
}

fn fisheye(extra: &str) -> String {
    format!(
        "%YAML:1.0\n---\n{extra}image_width: 640\nimage_height: 480\ncamera_matrix: {}\
         distortion_coefficients: {}",
        matrix(3, 3, "500., 0., 320., 0., 501., 240., 0., 0., 1."),
        matrix(4, 1, "0.02, -0.01, 0.004, -0.001")
    )
}

/// Pixels of `cv2.fisheye.projectPoints` and `cv2.projectPoints`, OpenCV 5.0.
#[test]
fn an_opencv_lens_named_in_words_is_that_lens() {
    let point = Vector3::new(0.6, -0.4, 1.0);
    let by_angle = Vector2::new(FISHEYE_PX[0], FISHEYE_PX[1]);
    let by_tangent = Vector2::new(PLUMB_BOB_PX[0], PLUMB_BOB_PX[1]);
    for (extra, expected) in [
        ("", by_tangent),
        ("fisheye_model: 1\n", by_angle),
        ("distortion_model: equidistant\n", by_angle),
        (
            "distortion_model: \"fisheye\"\nfisheye_model: 1\n",
            by_angle,
        ),
        ("camera_model: fisheye\n", by_angle),
        (
            "camera_model: pinhole\ndistortion_model: equidistant\n",
            by_angle,
        ),
        ("distortion_model: plumb_bob\n", by_tangent),
        (
            "distortion_model: radtan\ncamera_model: pinhole\n",
            by_tangent,
        ),
    ] {
        let camera = opencv::read(&fisheye(extra)).unwrap();
        let error = camera.project(&point).unwrap() - expected;
        assert!(error.amax() < 1e-6, "{extra:?}: {error}");
    }
}

const FISHEYE_PX: [f64; 2] = [581.602_111_466_219_4, 65.249_789_540_565_36];
const PLUMB_BOB_PX: [f64; 2] = [620.728_8, 39.981_561_6];

fn field_of(error: FormatError) -> String {
    match error {
        FormatError::Field { field, .. } => field,
        other => panic!("{other}"),
    }
}

#[test]
fn an_opencv_name_that_changes_the_meaning_is_refused() {
    for (extra, field) in [
        ("distortion_model: division\n", "distortion_model"),
        ("camera_model: omnidirectional\n", "camera_model"),
        (
            "distortion_model: plumb_bob\nfisheye_model: 1\n",
            "distortion_model",
        ),
        (
            "distortion_model: equidistant\nfisheye_model: 0\n",
            "distortion_model",
        ),
        ("fisheye_model: 2\n", "fisheye_model"),
        ("xi: 1.2\n", "xi"),
        ("alpha: 0.1\n", "skew"),
        ("fisheye: true\n", "fisheye"),
    ] {
        let refused = opencv::read(&fisheye(extra)).unwrap_err();
        assert_eq!(field_of(refused), field, "{extra:?}");
    }
    let odd = fisheye("").replace("rows: 4\n   cols: 1", "rows: 5\n   cols: 5");
    let text = opencv::read(&odd).unwrap_err().to_string();
    assert!(
        text.contains("found 4 numbers") && text.contains("expected 5 x 5"),
        "{text}"
    );
}

fn stereo_file(names: [&str; 4], pose: bool) -> String {
    let k = |f: &str, c: &str| matrix(3, 3, &format!("{f}, 0., {c}, 0., {f}, 240., 0., 0., 1."));
    let d = matrix(1, 5, "-0.28, 0.07, 0., 0., 0.");
    let pose = if pose {
        // 0.1 rad about y.
        format!(
            "R: {}T: {}",
            matrix(
                3,
                3,
                "0.99500416527802576, 0., 0.099833416646828155, 0., 1., 0., \
                 -0.099833416646828155, 0., 0.99500416527802576"
            ),
            matrix(3, 1, "-0.08, 0.001, 0.002")
        )
    } else {
        String::new()
    };
    format!(
        "%YAML:1.0\n{}: {}{}: {d}{}: {}{}: {d}{pose}",
        names[0],
        k("500.", "320."),
        names[1],
        names[2],
        k("510.", "330."),
        names[3],
    )
}

#[test]
fn both_cameras_of_an_opencv_stereo_file_are_read() {
    let size_px = Some([640, 480]);
    for names in [["M1", "D1", "M2", "D2"], ["K1", "D1", "K2", "D2"]] {
        let text = stereo_file(names, true);
        let found = |number| {
            read_chosen(
                &text,
                &Choice {
                    number,
                    size_px,
                    ..Choice::default()
                },
            )
            .unwrap()
        };
        let (first, second) = (found(Some(1)), found(Some(2)));
        assert_eq!(found(None), first);
        assert_eq!(first.camera.focal_px, [500.0; 2]);
        assert_eq!(first.camera.frame_from_camera, Isometry3::identity());
        assert_eq!(second.camera.focal_px, [510.0; 2]);
        assert_eq!([first.frame, second.frame], ["camera1_optical"; 2]);
        // X2 = R X1 + T.
        let (sine, cosine) = 0.1_f64.sin_cos();
        let x1 = Vector3::new(0.1, 0.05, 0.9);
        let x2 = Vector3::new(
            cosine * x1.x + sine * x1.z - 0.08,
            x1.y + 0.001,
            -sine * x1.x + cosine * x1.z + 0.002,
        );
        let own = rover_cameras::formats::LensCamera {
            frame_from_camera: Isometry3::identity(),
            ..second.camera.clone()
        };
        let error = second.camera.project(&x1).unwrap() - own.project(&x2).unwrap();
        assert!(error.amax() < 1e-9, "{error}");
    }
    let apart = stereo_file(["M1", "D1", "M2", "D2"], false);
    let choice = |number, size_px| {
        read_chosen(
            &apart,
            &Choice {
                number,
                size_px,
                ..Choice::default()
            },
        )
    };
    let second = choice(Some(2), size_px).unwrap();
    assert_eq!(second.frame, "camera2_optical");
    assert_eq!(second.camera.frame_from_camera, Isometry3::identity());
    assert!(choice(Some(3), size_px).is_err());
    let text = choice(None, None).unwrap_err().to_string();
    assert!(text.contains("--size"), "{text}");
}

#[test]
fn an_image_size_that_is_asked_for_must_be_that_of_the_file() {
    let text = fisheye("");
    let choice = |size_px| Choice {
        size_px: Some(size_px),
        ..Choice::default()
    };
    assert!(read_chosen(&text, &choice([640, 480])).is_ok());
    assert!(read_chosen(&text, &choice([320, 240])).is_err());
    let bare = text.replace("image_width: 640\nimage_height: 480\n", "");
    assert!(opencv::read(&bare).is_err());
    let found = read_chosen(&bare, &choice([320, 240])).unwrap();
    assert_eq!(found.camera.size_px, [320, 240]);
    assert!(matches!(found.camera.lens, Lens::Polynomial { .. }));
}

fn ros_file(r: &str, p: &str) -> String {
    format!(
        "image_width: 640\nimage_height: 480\ncamera_name: narrow/right\n\
         camera_matrix: {{rows: 3, cols: 3, data: [500, 0, 320, 0, 500, 240, 0, 0, 1]}}\n\
         distortion_model: plumb_bob\ndistortion_coefficients: [0, 0, 0, 0, 0]\n\
         rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [{r}]\n\
         projection_matrix:\n  rows: 3\n  cols: 4\n  data: [{p}]\n"
    )
}

#[test]
fn a_rectified_pair_gives_the_pose_of_its_right_camera() {
    // Turned by 0.1 rad about y, 0.08 m to the right.
    let turn = "0.99500416527802576, 0, 0.099833416646828155, 0, 1, 0, \
                -0.099833416646828155, 0, 0.99500416527802576";
    let info = ros::read(&ros_file(
        turn,
        "480, 0, 310, -38.4, 0, 480, 241, 0, 0, 0, 1, 0",
    ))
    .unwrap();
    assert!(info.posed);
    // The rectified pixel by P is that of the true direction: X_rectified = R X_own + B.
    let point = Vector3::new(0.2, -0.1, 1.5);
    let (sine, cosine) = 0.1_f64.sin_cos();
    let d = point - Vector3::new(0.08, 0.0, 0.0);
    let own = Vector3::new(cosine * d.x - sine * d.z, d.y, sine * d.x + cosine * d.z);
    let expected = Vector2::new(500.0 * own.x / own.z + 320.0, 500.0 * own.y / own.z + 240.0);
    let error = info.camera.project(&point).unwrap() - expected;
    assert!(error.amax() < 1e-9, "{error}");
}

#[test]
fn a_camera_without_rectification_stays_in_its_own_axes() {
    let one = "1, 0, 0, 0, 1, 0, 0, 0, 1";
    for (r, p) in [
        (one, "480, 0, 310, 0, 0, 480, 241, 0, 0, 0, 1, 0"),
        (
            "0, 0, 0, 0, 0, 0, 0, 0, 0",
            "0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0",
        ),
    ] {
        let info = ros::read(&ros_file(r, p)).unwrap();
        assert!(!info.posed);
        assert_eq!(info.camera.frame_from_camera, Isometry3::identity());
    }
    for (r, p, field) in [
        (
            "1, 0, 0, 0, 1, 0, 0, 0, 2",
            "1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0",
            "rectification_matrix",
        ),
        (
            one,
            "0, 0, 310, -38, 0, 480, 241, 0, 0, 0, 1, 0",
            "projection_matrix",
        ),
    ] {
        assert_eq!(field_of(ros::read(&ros_file(r, p)).unwrap_err()), field);
    }
}

#[test]
fn a_mark_after_the_document_is_not_another_document() {
    let one = "1, 0, 0, 0, 1, 0, 0, 0, 1";
    let text = ros_file(one, "480, 0, 310, 0, 0, 480, 241, 0, 0, 0, 1, 0");
    let plain = ros::read(&text).unwrap();
    for end in ["---\n", "---", "...\n", "\n---\n\n"] {
        assert_eq!(ros::read(&format!("{text}{end}")).unwrap(), plain);
    }
    assert_eq!(ros::read(&format!("---\n{text}---\n")).unwrap(), plain);
    assert!(ros::read(&format!("{text}---\n{text}")).is_err());
}

#[test]
fn a_matrix_that_is_none_is_named_by_its_line() {
    let one = "1, 0, 0, 0, 1, 0, 0, 0, 1";
    let text = ros_file(one, "480, 0, 310, 0, 0, 480, 241, 0, 0, 0, 1, 0");
    for (from, to) in [
        ("[0, 0, 0, 0, 0]", "none"),
        ("[0, 0, 0, 0, 0]", "[0, 0, a, 0, 0]"),
        (
            "[0, 0, 0, 0, 0]",
            "{rows: 1, columns: 5, data: [0, 0, 0, 0, 0]}",
        ),
    ] {
        let message = ros::read(&text.replace(from, to)).unwrap_err().to_string();
        println!("{message}");
        assert!(message.contains("line 6"), "{message}");
        assert!(message.contains("`distortion_coefficients: "), "{message}");
        assert!(!message.contains("untagged"), "{message}");
    }
}
