//! Unsurveyed calibration of cameras that are known: the truth must lie where the covariance says,
//! whatever the start, and bad corners must not matter.

use nalgebra::{Isometry3, Translation3, Unit, UnitQuaternion, Vector2, Vector3};
use rover_cameras::calibration::{
    BoardPoint, BoardView, Calibration, CalibrationError, CalibrationRules, ModelKind, calibrate,
};
use rover_cameras::{Cahvore, Camera, CameraModel};

/// SplitMix64 with a normal distribution on top (Box and Muller).
struct Noise(u64);

impl Noise {
    fn uniform(&mut self, low: f64, high: f64) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        low + (high - low) * (((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64)
    }

    fn normal(&mut self) -> f64 {
        let radius = (-2.0 * self.uniform(1e-300, 1.0).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform(0.0, 1.0)).cos()
    }
}

pub const SIZE_PX: [u32; 2] = [640, 480];

pub struct Truth {
    pub cameras: Vec<Camera>,
    /// In the order of the calibration's parameters.
    pub values: Vec<f64>,
    pub kind: ModelKind,
}

/// Intrinsics: fx, fy, cx, cy, tilt (2), r1, r2, e (3).
fn camera(kind: ModelKind, p: &[f64]) -> Camera {
    let own = Isometry3::identity();
    let at = |i: usize| p.get(i).copied().unwrap_or(0.0);
    let plain = Camera::pinhole(&own, [at(0), at(1)], [at(2), at(3)], SIZE_PX);
    let axis = Unit::new_normalize(Vector3::new(at(4), at(5), 1.0));
    let r = [0.0, at(6), at(7)];
    match kind {
        ModelKind::Cahv => plain,
        ModelKind::Cahvor => {
            Camera::pinhole_distorted(&own, [at(0), at(1)], [at(2), at(3)], SIZE_PX, &axis, r)
        }
        ModelKind::Cahvore { linearity } => {
            let [c, a, h, v] = plain.model.cahv().map(|x| *x);
            let model = CameraModel::Cahvore(Cahvore {
                c,
                a,
                h,
                v,
                o: axis.into_inner(),
                r: r.into(),
                e: Vector3::new(at(8), at(9), at(10)),
                linearity,
            });
            Camera { model, ..plain }
        }
    }
}

fn truth(kind: ModelKind, left: &[f64], right: &[f64]) -> Truth {
    shifted(kind, left, right, Vector3::new(-0.08, 0.001, 0.002))
}

fn shifted(kind: ModelKind, left: &[f64], right: &[f64], shift: Vector3<f64>) -> Truth {
    let turn = Vector3::new(0.01, -0.02, 0.005);
    let right_from_left =
        Isometry3::from_parts(Translation3::from(shift), UnitQuaternion::new(turn));
    let mut values = left.to_vec();
    values.extend(turn.iter().chain(shift.iter()));
    values.extend(right);
    Truth {
        cameras: vec![
            camera(kind, left),
            camera(kind, right).transformed(&right_from_left.inverse()),
        ],
        values,
        kind,
    }
}

pub fn paper_pair() -> Truth {
    pair_with(Vector3::new(-0.08, 0.001, 0.002))
}

/// The pair with another place of the right camera: `shift` from left to right axes.
pub fn pair_with(shift: Vector3<f64>) -> Truth {
    shifted(
        ModelKind::Cahvor,
        &[602.0, 600.5, 322.0, 236.0, 0.004, -0.003, -0.12, 0.03],
        &[598.0, 599.0, 316.0, 241.0, -0.006, 0.002, -0.11, 0.02],
        shift,
    )
}

/// A board of 9 x 6 corners, 20 mm apart, `distance_m` in front of the pair and tilted.
pub fn views(truth: &Truth, n: usize, noise_px: f64, seed: u64, tilt_rad: f64) -> Vec<BoardView> {
    let mut noise = Noise(seed);
    (0..n)
        .map(|_| {
            let turn = Vector3::new(
                noise.uniform(-tilt_rad, tilt_rad),
                noise.uniform(-tilt_rad, tilt_rad),
                noise.uniform(-0.6, 0.6),
            );
            let shift = Vector3::new(
                noise.uniform(-0.04, 0.12),
                noise.uniform(-0.06, 0.06),
                noise.uniform(0.28, 0.5),
            );
            let pose = Isometry3::from_parts(Translation3::from(shift), UnitQuaternion::new(turn));
            let mut seen = |camera: &Camera| -> Vec<BoardPoint> {
                let mut points = Vec::new();
                for i in 0..54 {
                    let board_m = Vector2::new(f64::from(i % 9) - 4.0, f64::from(i / 9) - 2.5);
                    let board_m = board_m * 0.02;
                    let point = pose * nalgebra::Point3::new(board_m.x, board_m.y, 0.0);
                    let Ok(pixel) = camera.project_into_image(&point.coords, 1.0) else {
                        continue;
                    };
                    let pixel_px = pixel + Vector2::new(noise.normal(), noise.normal()) * noise_px;
                    points.push(BoardPoint { board_m, pixel_px });
                }
                if points.len() < 12 {
                    Vec::new()
                } else {
                    points
                }
            };
            truth.cameras.iter().map(&mut seen).collect()
        })
        .collect()
}

pub fn rules(kind: ModelKind) -> CalibrationRules {
    CalibrationRules {
        model: kind,
        ..CalibrationRules::default()
    }
}

/// How many sigma the truth is from each estimate.
fn pulls(found: &Calibration, truth: &Truth) -> Vec<f64> {
    assert_eq!(found.parameters.len(), truth.values.len());
    found
        .parameters
        .iter()
        .zip(&truth.values)
        .map(|(p, value)| (p.value - value) / p.sigma)
        .collect()
}

fn inside_three_sigma(truth: &Truth, seeds: std::ops::Range<u64>) {
    let mut all = Vec::new();
    for seed in seeds {
        let views = views(truth, 18, 0.1, seed, 0.6);
        let found = calibrate(&[SIZE_PX; 2], &views, &rules(truth.kind)).unwrap();
        assert!((0.09..0.11).contains(&found.sigma_px), "{}", found.sigma_px);
        for rms in &found.rms_px {
            assert!((0.11..0.16).contains(rms), "{rms}");
        }
        all.extend(pulls(&found, truth));
    }
    let inside = all.iter().filter(|x| x.abs() < 3.0).count() as f64 / all.len() as f64;
    let square = all.iter().map(|x| x * x).sum::<f64>() / all.len() as f64;
    println!(
        "{:?}: {inside} within 3 sigma, mean square pull {square}",
        truth.kind
    );
    assert!(inside >= 0.95, "{inside}");
    assert!((0.4..1.7).contains(&square), "{square}");
}

#[test]
fn the_truth_of_a_distorted_pair_lies_within_three_sigma() {
    inside_three_sigma(&paper_pair(), 0..6);
}

#[test]
fn the_truth_of_a_linear_pair_lies_within_three_sigma() {
    let pair = truth(
        ModelKind::Cahv,
        &[602.0, 600.5, 322.0, 236.0],
        &[598.0, 599.0, 316.0, 241.0],
    );
    inside_three_sigma(&pair, 0..6);
}

#[test]
fn the_truth_of_a_wide_pair_with_moving_pupils_lies_within_three_sigma() {
    let pair = truth(
        ModelKind::Cahvore { linearity: 0.37 },
        &[
            300.0, 301.0, 322.0, 236.0, 0.004, -0.003, -0.012, -0.0075, 0.0014, 0.0015, 0.0005,
        ],
        &[
            298.0, 299.0, 316.0, 241.0, -0.006, 0.002, -0.02, -0.004, -0.001, 0.002, 0.0,
        ],
    );
    inside_three_sigma(&pair, 0..3);
}

#[test]
fn perfect_corners_give_the_cameras_back() {
    let pair = paper_pair();
    let found = calibrate(
        &[SIZE_PX; 2],
        &views(&pair, 15, 0.0, 1, 0.6),
        &rules(pair.kind),
    )
    .unwrap();
    let point = Vector3::new(0.03, -0.05, 0.4);
    for (camera, expected) in found.cameras.iter().zip(&pair.cameras) {
        let error = camera.project(&point).unwrap() - expected.project(&point).unwrap();
        // What is left is the weak draw of O towards A.
        assert!(error.amax() < 1e-4, "{error}");
    }
}

#[test]
fn focal_lengths_from_wide_to_long_need_no_guess() {
    for focal in [230.0, 400.0, 1500.0] {
        let inner = [focal, focal * 1.003, 325.0, 232.0];
        let scale = focal / 600.0;
        let mut single = truth(ModelKind::Cahv, &inner, &inner);
        single.cameras.truncate(1);
        // The same boards, farther off for a longer lens.
        let views: Vec<BoardView> = (0..12)
            .map(|i| {
                let mut noise = Noise(100 + i);
                let turn = Vector3::new(
                    noise.uniform(-0.6, 0.6),
                    noise.uniform(-0.6, 0.6),
                    noise.uniform(-1.0, 1.0),
                );
                let shift = Vector3::new(0.0, 0.0, 0.35 * scale.max(0.5));
                let pose = Isometry3::new(shift, turn);
                let points = (0..54)
                    .filter_map(|k| {
                        let board_m =
                            Vector2::new(f64::from(k % 9) - 4.0, f64::from(k / 9) - 2.5) * 0.02;
                        let at = pose * nalgebra::Point3::new(board_m.x, board_m.y, 0.0);
                        let pixel = single.cameras[0].project_into_image(&at.coords, 0.0).ok()?;
                        let error = Vector2::new(noise.normal(), noise.normal()) * 0.1;
                        Some(BoardPoint {
                            board_m,
                            pixel_px: pixel + error,
                        })
                    })
                    .collect();
                vec![points]
            })
            .collect();
        let found = calibrate(&[SIZE_PX], &views, &rules(ModelKind::Cahv)).unwrap();
        let fx = &found.parameters[0];
        assert!((fx.value - focal).abs() < 4.0 * fx.sigma, "{focal}: {fx:?}");
        assert!(fx.sigma < 0.02 * focal, "{fx:?}");
    }
}

#[test]
fn corners_that_are_wrong_are_rejected_and_do_not_matter() {
    let pair = paper_pair();
    let mut views = views(&pair, 15, 0.1, 7, 0.6);
    let mut noise = Noise(70);
    let mut spoilt = 0;
    for point in views.iter_mut().flatten().flatten() {
        if noise.uniform(0.0, 1.0) < 0.03 {
            let angle = noise.uniform(0.0, std::f64::consts::TAU);
            let far = noise.uniform(3.0, 25.0);
            point.pixel_px += Vector2::new(angle.cos(), angle.sin()) * far;
            spoilt += 1;
        }
    }
    let found = calibrate(&[SIZE_PX; 2], &views, &rules(pair.kind)).unwrap();
    assert!(
        (spoilt..spoilt + 8).contains(&found.rejected),
        "{spoilt} {}",
        found.rejected
    );
    let inside = pulls(&found, &pair)
        .iter()
        .filter(|x| x.abs() < 3.5)
        .count();
    assert!(inside >= 21, "{inside} of 22");
    assert!((0.09..0.11).contains(&found.sigma_px), "{}", found.sigma_px);
}

#[test]
fn views_that_do_not_determine_the_cameras_are_refused() {
    let pair = paper_pair();
    let flat = views(&pair, 10, 0.1, 3, 0.0);
    let refused = calibrate(&[SIZE_PX; 2], &flat, &rules(pair.kind));
    assert!(
        matches!(refused, Err(CalibrationError::Undetermined { .. })),
        "{refused:?}"
    );
    let few = views(&pair, 2, 0.1, 3, 0.6);
    let refused = calibrate(&[SIZE_PX; 2], &few, &rules(pair.kind));
    assert!(
        matches!(refused, Err(CalibrationError::TooFewViews { found: 2, .. })),
        "{refused:?}"
    );
    let mut apart = views(&pair, 12, 0.1, 3, 0.6);
    for (n, view) in apart.iter_mut().enumerate() {
        view[n % 2].clear();
    }
    let refused = calibrate(&[SIZE_PX; 2], &apart, &rules(pair.kind));
    assert_eq!(refused.unwrap_err(), CalibrationError::NoCommonView);
    let mut broken = views(&pair, 8, 0.1, 3, 0.6);
    broken[4][0][2].pixel_px.x = f64::NAN;
    let refused = calibrate(&[SIZE_PX; 2], &broken, &rules(pair.kind));
    assert!(
        matches!(refused, Err(CalibrationError::View { view: 4, .. })),
        "{refused:?}"
    );
}
