//! The plain text form of camera models, honest and hostile.

use crate::common::references;
use nalgebra::{Isometry3, Translation3, Unit, UnitQuaternion, Vector3};
use proptest::prelude::*;
use rover_cameras::formats::{FormatError, MAX_BYTES, ModelFile, read_text, write_text};
use rover_cameras::{Camera, CameraError, CameraModel};

const TEXT: &str = "\
# as the calibration programs write it
Model = CAHVOR = perspective, distortion

Dimensions = 1024 1024

C =      0.467260      0.130406     -1.240470
A =     -0.726097      0.604262      0.328103
H =  -1144.990000   -638.601000    168.422000
V =    -53.334600     50.732500   1320.910000  # px
O =     -0.735599      0.581747      0.347080
R =      9.6e-04      -2.183e-3      0.018547
Frame = MER ROVER_FRAME
";

fn without(name: &str) -> String {
    let start = format!("{name} =");
    TEXT.lines()
        .filter(|line| !line.starts_with(&start))
        .map(|line| format!("{line}\n"))
        .collect()
}

#[test]
fn a_text_model_is_read_whole() {
    let file = read_text(TEXT).unwrap();
    let reference = &references()[0];
    assert_eq!(file.camera().unwrap(), reference.camera);
    assert_eq!(file.frame.as_deref(), Some("MER ROVER_FRAME"));
    assert_eq!(file.size_px, Some([1024, 1024]));
    let windows = format!("\u{feff}{}", TEXT.replace('\n', "\r\n"));
    assert_eq!(read_text(&windows).unwrap(), file);
}

#[test]
fn vectors_alone_are_enough_for_a_model_but_not_for_a_camera() {
    let text = "C = 0 0 0\nA = 0 0 1\nH = 600 0 320\nV = 0 600 240\n";
    let file = read_text(text).unwrap();
    assert!(matches!(file.model, CameraModel::Cahv(_)));
    assert_eq!((file.frame.as_ref(), file.size_px), (None, None));
    assert_eq!(file.camera(), Err(FormatError::NoSize));
    assert_eq!(
        file.model.project(&Vector3::new(0.0, 0.0, 1.0)).unwrap().x,
        320.0
    );
}

#[test]
fn unknown_lines_are_refused_with_their_number() {
    for line in [
        "S =",
        "Hs = 1223.28",
        "c = 0 0 0",
        "0.1 0.2 0.3",
        "= 1 2 3",
        "\u{0}",
        "C",
    ] {
        let text = format!("{TEXT}\n{line}\n");
        match read_text(&text) {
            Err(FormatError::UnknownLine {
                line: number,
                found,
            }) => {
                assert_eq!((number, found.as_str()), (14, line));
            }
            other => panic!("expected UnknownLine for {line:?}, found {other:?}"),
        }
    }
}

#[test]
fn repeated_missing_and_contradicting_lines_are_refused() {
    let repeated = format!("{TEXT}A = 0 0 1\n");
    let expected = FormatError::Repeated {
        line: 13,
        name: "A",
        first: 7,
    };
    assert_eq!(read_text(&repeated), Err(expected));
    for name in ["C", "A", "H", "V", "O", "R"] {
        match read_text(&without(name)) {
            Err(FormatError::Missing { name: missing }) => assert_eq!(missing, name),
            other => panic!("expected Missing {name}, found {other:?}"),
        }
    }
    let linear = TEXT.replace("CAHVOR =", "CAHV =");
    let expected = FormatError::OtherModel {
        line: 2,
        found: "CAHV".into(),
        expected: "CAHVOR",
    };
    assert_eq!(read_text(&linear), Err(expected));
    assert!(matches!(
        read_text(""),
        Err(FormatError::Missing { name: "C" })
    ));
}

#[test]
fn values_that_are_not_what_they_should_be_are_refused_with_their_line() {
    for (name, value) in [
        ("C", "0 0"),
        ("C", "0 0 0 0"),
        ("A", "0 0 NaN"),
        ("H", "inf 0 0"),
        ("V", "1e999 0 0"),
        ("O", "0,0,1"),
        ("R", ""),
        ("R", "0x1 0 0"),
        ("Dimensions", "640"),
        ("Dimensions", "640 -480"),
        ("Dimensions", "640 0"),
        ("Dimensions", "640.0 480"),
        ("Dimensions", "99999999999 480"),
        ("Frame", ""),
        ("Frame", "r\u{f6}ver"),
        ("Frame", "bell\u{7}"),
    ] {
        let text = format!("{name} = {value}\n{}", without(name));
        match read_text(&text) {
            Err(FormatError::Value {
                line: 1,
                name: named,
                found,
                ..
            }) => {
                assert_eq!((named, found.as_str()), (name, value));
            }
            other => panic!("expected Value for {name} = {value:?}, found {other:?}"),
        }
    }
}

#[test]
fn numbers_that_make_no_camera_are_refused() {
    let text = format!("A = 0 0 2\n{}", without("A"));
    let refused = read_text(&text);
    let expected = FormatError::Camera(CameraError::InvalidModel {
        reason: "the length of A is 2, expected 1 within 0.001".into(),
    });
    assert_eq!(refused, Err(expected));
}

#[test]
fn messages_stay_short_for_hostile_texts() {
    let long = "x".repeat(MAX_BYTES - 10);
    let message = read_text(&long).unwrap_err().to_string();
    assert!(message.len() < 200, "{message}");
    let message = read_text(&format!("C = {}", "\u{1b}".repeat(1000)))
        .unwrap_err()
        .to_string();
    assert!(
        message.len() < 500 && !message.contains('\u{1b}'),
        "{message}"
    );
    let found = MAX_BYTES + 1;
    assert_eq!(
        read_text(&"#".repeat(found)),
        Err(FormatError::TooLong { found })
    );
}

#[test]
fn reference_models_are_read_back_exactly() {
    for model in references() {
        let text = write_text(&model.camera, Some("rover")).unwrap();
        let file = read_text(&text).unwrap();
        assert_eq!(file.camera().unwrap(), model.camera);
        assert_eq!(file.frame.as_deref(), Some("rover"));
        assert_eq!(
            read_text(&write_text(&model.camera, None).unwrap())
                .unwrap()
                .frame,
            None
        );
        let toml_text = toml::to_string(&file).unwrap();
        assert_eq!(toml::from_str::<ModelFile>(&toml_text).unwrap(), file);
    }
}

#[test]
fn what_could_not_be_read_back_is_not_written() {
    let camera = &references()[0].camera;
    for name in [
        "",
        " rover",
        "a\nC = 0 0 0",
        "a#b",
        "\u{fc}",
        &"x".repeat(65),
    ] {
        let refused = write_text(camera, Some(name));
        assert!(
            matches!(refused, Err(FormatError::FrameName { .. })),
            "{name:?}: {refused:?}"
        );
    }
    let nothing = Camera {
        width_px: 0,
        ..camera.clone()
    };
    assert!(matches!(
        write_text(&nothing, None),
        Err(FormatError::Camera(_))
    ));
}

fn any_camera() -> impl Strategy<Value = Camera> {
    let numbers = (
        prop::array::uniform3(-10.0..10.0),
        prop::array::uniform3(-3.0..3.0),
        prop::array::uniform2(50.0..5000.0),
        prop::array::uniform2(-100.0..3000.0),
        prop::array::uniform2(1..10_000_u32),
        prop::option::of((
            prop::array::uniform2(-0.1..0.1),
            prop::array::uniform3(-0.5..0.5),
        )),
    );
    numbers.prop_map(|(position, angles, focal, centre, size, lens)| {
        let pose = Isometry3::from_parts(
            Translation3::from(Vector3::from(position)),
            UnitQuaternion::from_euler_angles(angles[0], angles[1], angles[2]),
        );
        match lens {
            None => Camera::pinhole(&pose, focal, centre, size),
            Some((tilt, r)) => {
                let axis = Unit::new_normalize(Vector3::new(tilt[0], tilt[1], 1.0));
                Camera::pinhole_distorted(&pose, focal, centre, size, &axis, r)
            }
        }
    })
}

/// Words and signs of the format, so that random texts get far into the reader.
fn nearly_a_model() -> impl Strategy<Value = String> {
    let word = prop_oneof![
        Just("C = 0 0 0\n".to_owned()),
        Just("A = 0 0 1\n".to_owned()),
        Just("H = 600 0 320\n".to_owned()),
        Just("V = 0 600 240\n".to_owned()),
        Just("O = 0 0 1\n".to_owned()),
        Just("R = 0 0 0\n".to_owned()),
        Just("Dimensions = ".to_owned()),
        Just("Model = ".to_owned()),
        Just("Frame = ".to_owned()),
        Just("\n".to_owned()),
        "[-+=#.e0-9 CAHVOR\n]{0,12}",
        ".{0,8}",
    ];
    prop::collection::vec(word, 0..16).prop_map(|words| words.concat())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn every_valid_camera_is_read_back_exactly(camera in any_camera()) {
        prop_assert_eq!(camera.validate(), Ok(()));
        let text = write_text(&camera, Some("arm_base")).unwrap();
        prop_assert_eq!(read_text(&text).unwrap().camera().unwrap(), camera);
    }

    #[test]
    fn no_text_makes_the_reader_panic(text in any::<String>()) {
        let _ = read_text(&text);
    }

    #[test]
    fn whatever_is_read_is_a_valid_model(text in nearly_a_model()) {
        match read_text(&text) {
            Ok(file) => prop_assert_eq!(file.model.validate(), Ok(())),
            Err(error) => prop_assert!(error.to_string().len() < 600),
        }
    }

    #[test]
    fn a_changed_byte_never_passes_unnoticed_as_an_invalid_model(
        at in 0..TEXT.len(),
        byte in 0..128_u8,
    ) {
        let mut bytes = TEXT.as_bytes().to_vec();
        bytes[at] = byte;
        let text = String::from_utf8(bytes).unwrap();
        if let Ok(file) = read_text(&text) {
            prop_assert_eq!(file.model.validate(), Ok(()));
        }
    }
}
