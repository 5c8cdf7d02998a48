//! Fits between the families: as good at the worst pixel as the models allow, and what is reported
//! is true. The pixels are OpenCV's own (5.0, `projectPoints`, inverted by Newton steps).

use nalgebra::{Isometry3, Unit, Vector2, Vector3};
use rover_cameras::Camera;
use rover_cameras::formats::{ConversionError, ConversionRules, Family, Lens, LensCamera};

const ALL: [Family; 3] = [Family::PlumbBob, Family::Rational, Family::Equidistant];

fn lens(focal_px: [f64; 2], centre_px: [f64; 2], k: [f64; 6], p: [f64; 2]) -> LensCamera {
    LensCamera {
        frame_from_camera: Isometry3::identity(),
        focal_px,
        centre_px,
        size_px: [640, 480],
        lens: Lens::Polynomial { k, p },
    }
}

/// The sample calibration of OpenCV's `left_intrinsics.yml`: k3 and tangential terms.
fn opencv_sample() -> LensCamera {
    lens(
        [535.915_733_961_632; 2],
        [342.283_154_733_083_7, 235.570_829_097_881_7],
        [
            -0.266_372_609_096_606_8,
            -0.038_588_898_922_304_65,
            0.238_391_530_808_784_86,
            0.0,
            0.0,
            0.0,
        ],
        [0.001_783_194_704_285_296_4, -0.000_281_221_004_411_154_7],
    )
}

/// Coefficients as depth cameras have them, k1, k2, k3, k4, k5, k6 and p1, p2.
fn depth_camera(k: [f64; 6], p: [f64; 2]) -> LensCamera {
    lens([533.7, 534.1], [341.9, 235.3], k, p)
}

/// x, y of a direction (z = 1) and OpenCV's pixel for it.
type Seen = [[f64; 4]; 5];
const SAMPLE: Seen = [
    [-0.725372430467, -0.500971100755, 0.0, 0.0],
    [0.633842150570, -0.504394347502, 639.0, 0.0],
    [-0.721866950107, 0.511984314090, 0.0, 479.0],
    [0.631247777841, 0.516354735533, 639.0, 479.0],
    [-0.359448509953, -0.267758416034, 160.0, 100.0],
];
const STRONG: Seen = [
    [-0.808405229712, -0.557003165600, 0.0, 0.0],
    [0.671789120718, -0.531902291993, 639.0, 0.0],
    [-0.811480699156, 0.577579026277, 0.0, 479.0],
    [0.674362774412, 0.551887204714, 639.0, 479.0],
    [-0.361027440061, -0.268529082942, 160.0, 100.0],
];
const MILD: Seen = [
    [-0.810120249575, -0.557117677603, 0.0, 0.0],
    [0.669057572460, -0.529489546784, 639.0, 0.0],
    [-0.816524100803, 0.581567409763, 0.0, 479.0],
    [0.673529272563, 0.552057072094, 639.0, 479.0],
    [-0.360896223955, -0.268239085901, 160.0, 100.0],
];

fn rules(limit_px: f64) -> ConversionRules {
    ConversionRules {
        limit_px,
        ..ConversionRules::default()
    }
}

/// Largest distance over the image between two cameras, both ways.
fn apart_px(lens: &LensCamera, camera: &Camera) -> f64 {
    let mut worst = 0.0_f64;
    for i in 0..=32 {
        for j in 0..=24 {
            let pixel = Vector2::new(f64::from(i) * 20.0 - 0.5, f64::from(j) * 20.0 - 0.5);
            let there = camera.project(&lens.ray(&pixel).unwrap().at(1.0)).unwrap();
            let back = lens.project(&camera.ray(&pixel).unwrap().at(1.0)).unwrap();
            worst = worst.max((there - pixel).norm()).max((back - pixel).norm());
        }
    }
    worst
}

#[test]
fn lenses_that_the_family_cannot_hold_are_fitted_for_their_worst_pixel() {
    for (name, lens, seen, limit_px) in [
        ("sample", opencv_sample(), SAMPLE, 1.3),
        (
            "strong",
            depth_camera([2.1, 0.9, 0.05, 2.4, 1.5, 0.25], [6e-4, -4e-4]),
            STRONG,
            0.25,
        ),
        (
            "mild",
            depth_camera([0.5, 0.1, 0.01, 0.8, 0.2, 0.05], [0.0; 2]),
            MILD,
            0.3,
        ),
    ] {
        let found = lens.to_camera(&rules(limit_px));
        let found = found.unwrap();
        println!("{name}: {} px", found.worst_px);
        assert_eq!(found.camera.model.name(), "CAHVOR", "{name}");
        for [x, y, u, v] in seen {
            let image = found.camera.project(&Vector3::new(x, y, 1.0)).unwrap();
            let error = (image - Vector2::new(u, v)).norm();
            assert!(error <= 1.001 * found.worst_px + 1e-6, "{name}: {error}");
        }
        let apart = apart_px(&lens, &found.camera);
        assert!(apart <= 1.02 * found.worst_px, "{name}: {apart}");
        assert!(apart >= 0.9 * found.worst_px, "{name}: {apart}");
    }
}

/// A calibration of real pictures: O a quarter of a degree from A.
#[test]
fn a_calibrated_camera_goes_to_the_lenses_of_other_tools_within_a_tenth_of_a_pixel() {
    let axis = Vector3::new(
        -0.000_544_442_860_128_141_5,
        0.003_912_893_251_786_779_5,
        0.999_992_196_393_737_8,
    );
    let camera = Camera::pinhole_distorted(
        &Isometry3::identity(),
        [533.728_182_138_712_6, 533.741_351_948_331_7],
        [341.910_129_333_143_9, 235.317_530_637_753_98],
        [640, 480],
        &Unit::new_normalize(axis),
        [0.0, -0.289_360_618_746_689_06, 0.097_882_321_772_188_22],
    );
    let found = LensCamera::from_camera(&camera, &ALL, &ConversionRules::default()).unwrap();
    println!("to a lens: {} px {:?}", found.worst_px, found.camera.lens);
    assert!(found.worst_px < 0.1);
    let apart = apart_px(&found.camera, &camera);
    assert!(apart <= 1.02 * found.worst_px, "{apart}");
    let back = found.camera.to_camera(&rules(0.2)).unwrap();
    println!("and back: {} px", back.worst_px);
}

#[test]
fn a_fit_that_is_not_good_enough_names_the_models_and_both_numbers() {
    let message = opencv_sample().to_camera(&rules(0.1)).unwrap_err();
    assert!(matches!(message, ConversionError::TooFar { .. }));
    let text = message.to_string();
    assert!(
        text.contains("CAHVOR or CAHVORE") && text.contains("at most 0.1 px"),
        "{text}"
    );
    assert!(text.len() < 140, "{text}");
}
