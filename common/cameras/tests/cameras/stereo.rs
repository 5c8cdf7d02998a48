//! Triangulation against independent computations.

use nalgebra::{
    Isometry3, Matrix2, Matrix3, Matrix3x2, Translation3, Unit, UnitQuaternion, Vector2, Vector3,
};
use rover_cameras::{
    Camera, CameraError, MissLimit, Ray, Side, StereoPair, TriangulationError, closest_point,
};

/// The paper's pair: 8 cm baseline, 45 degrees down, 602.15 px, 640 x 480, with lenses.
fn pair() -> StereoPair {
    let camera = |y_m: f64, tilt: [f64; 2]| {
        // x right = -y, y down, z forward and 45 degrees down.
        let look = UnitQuaternion::face_towards(
            &Vector3::new(1.0, 0.0, -1.0),
            &Vector3::new(-1.0, 0.0, -1.0),
        );
        let pose = Isometry3::from_parts(Translation3::new(0.2, y_m, 0.6), look);
        let axis = Unit::new_normalize(Vector3::new(tilt[0], tilt[1], 1.0));
        Camera::pinhole_distorted(
            &pose,
            [602.15; 2],
            [319.5, 239.5],
            [640, 480],
            &axis,
            [0.0, -0.12, 0.03],
        )
    };
    let pair = StereoPair {
        left: camera(0.04, [0.004, -0.003]),
        right: camera(-0.04, [-0.003, 0.005]),
    };
    pair.validate().unwrap();
    pair
}

fn points() -> impl Iterator<Item = Vector3<f64>> {
    let steps = [-0.1, -0.03, 0.02, 0.12];
    steps.into_iter().flat_map(move |x| {
        steps.into_iter().flat_map(move |y| {
            steps
                .into_iter()
                .map(move |z| Vector3::new(0.55 + x, y, 0.2 + z))
        })
    })
}

fn pixels(pair: &StereoPair, point: &Vector3<f64>) -> (Vector2<f64>, Vector2<f64>) {
    (
        pair.left.project(point).unwrap(),
        pair.right.project(point).unwrap(),
    )
}

#[test]
fn the_right_camera_sees_nearer_points_further_left() {
    let pair = pair();
    let (left, right) = pixels(&pair, &Vector3::new(0.7, 0.0, 0.1));
    // 8 cm * 602 px / 0.707 m.
    assert!((left.x - right.x - 68.1).abs() < 1.0, "{left} {right}");
    assert!((pair.baseline_m() - 0.08).abs() < 1e-15);
}

#[test]
fn projected_points_are_triangulated_exactly() {
    let pair = pair();
    for point in points() {
        let (left, right) = pixels(&pair, &point);
        let found = pair.triangulate(&left, &right).unwrap();
        assert!((found.point - point).norm() < 1e-12);
        assert!(found.miss_m < 1e-12);
        let [left_c, ..] = pair.left.model.cahv();
        assert!((found.range_left_m - (point - left_c).norm()).abs() < 1e-12);
        let [right_c, ..] = pair.right.model.cahv();
        assert!((found.range_right_m - (point - right_c).norm()).abs() < 1e-12);
    }
}

/// The paper's form: `[u, -v] [s, t] = b` in the least-squares sense, solved by an SVD.
#[test]
fn closest_point_equals_the_least_squares_solution_of_the_paper() {
    let pair = pair();
    for (index, point) in points().enumerate() {
        let (left, right) = pixels(&pair, &point);
        let off = Vector2::new(0.7, -2.0) * (index % 5) as f64;
        let (left, right) = (
            pair.left.ray(&left).unwrap(),
            pair.right.ray(&(right + off)).unwrap(),
        );
        let matrix =
            Matrix3x2::from_columns(&[left.direction.into_inner(), -right.direction.into_inner()]);
        let b = right.origin - left.origin;
        let ranges = matrix.svd(true, true).solve(&b, 1e-15).unwrap();
        let found = closest_point(&left, &right).unwrap();
        assert!((found.range_left_m - ranges.x).abs() < 1e-11);
        assert!((found.range_right_m - ranges.y).abs() < 1e-11);
        let (p, q) = (left.at(ranges.x), right.at(ranges.y));
        assert!((found.point - (p + q) * 0.5).norm() < 1e-11);
        assert!((found.miss_m - (p - q).norm()).abs() < 1e-11);
    }
}

#[test]
fn a_vertical_mismatch_shows_as_a_miss() {
    let pair = pair();
    let (left, right) = pixels(&pair, &Vector3::new(0.6, 0.05, 0.1));
    let found = pair
        .triangulate(&left, &(right + Vector2::new(0.0, 6.0)))
        .unwrap();
    // 6 px at 0.64 m and 602 px.
    assert!((found.miss_m - 0.0064).abs() < 0.001, "{}", found.miss_m);
    let refused = found.check_miss(&MissLimit::default()).unwrap_err();
    match refused {
        TriangulationError::Miss {
            miss_m,
            range_m,
            limit_m,
        } => {
            assert_eq!(miss_m, found.miss_m);
            assert_eq!(range_m, found.range_left_m.min(found.range_right_m));
            assert_eq!(limit_m, 0.005 * range_m);
        }
        other => panic!("expected Miss, found {other:?}"),
    }
    found
        .check_miss(&MissLimit {
            absolute_m: 0.05,
            per_range: 0.02,
        })
        .unwrap();
}

#[test]
fn parallel_and_diverging_rays_are_refused_with_numbers() {
    let left = Ray {
        origin: Vector3::zeros(),
        direction: Vector3::x_axis(),
    };
    let right = Ray {
        origin: Vector3::y(),
        direction: Vector3::x_axis(),
    };
    assert_eq!(
        closest_point(&left, &right),
        Err(TriangulationError::Parallel { sine: 0.0 })
    );
    let direction = Unit::new_normalize(Vector3::new(1.0, 1.0, 0.0));
    match closest_point(&left, &Ray { direction, ..right }) {
        Err(TriangulationError::BehindCamera {
            range_left_m,
            range_right_m,
        }) => {
            assert!((range_left_m + 1.0).abs() < 1e-12);
            assert!((range_right_m + 2.0_f64.sqrt()).abs() < 1e-12);
        }
        other => panic!("expected BehindCamera, found {other:?}"),
    }
    let nowhere = Ray {
        origin: Vector3::new(f64::NAN, 0.0, 0.0),
        direction,
    };
    let refused = closest_point(&left, &nowhere);
    assert_eq!(
        refused,
        Err(TriangulationError::Camera(CameraError::NotFinite))
    );
    let pair = pair();
    let refused = pair.triangulate(&Vector2::new(f64::NAN, 0.0), &Vector2::zeros());
    assert_eq!(
        refused,
        Err(TriangulationError::Camera(CameraError::NotFinite))
    );
}

/// Also for rays that miss each other, where the terms with the miss matter.
#[test]
fn triangulation_jacobian_matches_central_differences() {
    let pair = pair();
    let step_px = 1e-3;
    for (index, point) in points().enumerate() {
        let (left, mut right) = pixels(&pair, &point);
        right.y += 8.0 * (index % 3) as f64;
        let (_, [by_left, by_right]) = pair.triangulate_with_jacobian(&left, &right).unwrap();
        for (axis, offset) in [Vector2::x() * step_px, Vector2::y() * step_px]
            .iter()
            .enumerate()
        {
            let at = |l: &Vector2<f64>, r: &Vector2<f64>| pair.triangulate(l, r).unwrap().point;
            let expected =
                (at(&(left + offset), &right) - at(&(left - offset), &right)) / (2.0 * step_px);
            assert!((by_left.column(axis) - expected).amax() < 1e-8);
            let expected =
                (at(&left, &(right + offset)) - at(&left, &(right - offset))) / (2.0 * step_px);
            assert!((by_right.column(axis) - expected).amax() < 1e-8);
        }
    }
}

/// `sigma_Z = sqrt(2) Z^2 s / (f b)` for equal noise s in both images, on the axis.
#[test]
fn range_uncertainty_follows_the_stereo_formula() {
    let pair = pair();
    let forward = Vector3::new(1.0, 0.0, -1.0).normalize();
    let point = Vector3::new(0.2, 0.0, 0.6) + forward * 0.5;
    let (left, right) = pixels(&pair, &point);
    let cov = Matrix2::identity() * 0.01;
    let (found, point_cov) = pair
        .triangulate_with_covariance(&left, &right, &cov, &cov)
        .unwrap();
    assert!((found.point - point).norm() < 1e-12);
    assert_eq!(point_cov, point_cov.transpose());
    let sigma_mm = forward.dot(&(point_cov * forward)).sqrt() * 1e3;
    assert!((sigma_mm - 0.73).abs() < 0.03, "{sigma_mm} mm");
    let across = Vector3::y();
    let sigma_mm = across.dot(&(point_cov * across)).sqrt() * 1e3;
    let expected_mm = 0.1 * 500.0 / 602.15 / 2.0_f64.sqrt();
    assert!((sigma_mm - expected_mm).abs() < 0.01, "{sigma_mm} mm");
    assert!(point_cov.symmetric_eigenvalues().min() > 0.0);
    assert_ne!(point_cov, Matrix3::zeros());
}

#[test]
fn matrices_that_are_no_covariance_are_refused() {
    let pair = pair();
    let (left, right) = pixels(&pair, &Vector3::new(0.6, 0.05, 0.1));
    let good = Matrix2::new(0.04, 0.01, 0.01, 0.02);
    let bad = [
        Matrix2::new(0.04, 0.01, 0.0, 0.02),
        Matrix2::new(-0.04, 0.0, 0.0, 0.02),
        Matrix2::new(0.01, 0.03, 0.03, 0.01),
        Matrix2::new(f64::NAN, 0.0, 0.0, 0.02),
    ];
    for found in bad {
        for side in [Side::Left, Side::Right] {
            let (l, r) = if side == Side::Left {
                (found, good)
            } else {
                (good, found)
            };
            match pair.triangulate_with_covariance(&left, &right, &l, &r) {
                Err(TriangulationError::Covariance { side: named, .. }) => assert_eq!(named, side),
                other => panic!("expected Covariance, found {other:?}"),
            }
        }
    }
    let singular = Matrix2::new(0.04, 0.02, 0.02, 0.01);
    pair.triangulate_with_covariance(&left, &right, &singular, &Matrix2::zeros())
        .unwrap();
}

#[test]
fn epipolar_points_run_through_the_match_with_the_right_slope() {
    let pair = pair();
    for point in points() {
        let (left, right) = pixels(&pair, &point);
        let [c, ..] = pair.left.model.cahv();
        let range_m = (point - c).norm();
        let (pixel, slope) = pair.epipolar_point(&left, range_m).unwrap();
        assert!((pixel - right).norm() < 1e-9);
        let step_m = 1e-5;
        let ahead = pair.epipolar_point(&left, range_m + step_m).unwrap().0;
        let back = pair.epipolar_point(&left, range_m - step_m).unwrap().0;
        assert!(((ahead - back) / (2.0 * step_m) - slope).norm() < 1e-5 * slope.norm());
    }
    let left = Vector2::new(320.0, 240.0);
    let behind = pair.epipolar_point(&left, -1.0);
    assert!(
        matches!(behind, Err(CameraError::BehindCamera { .. })),
        "{behind:?}"
    );
    assert_eq!(
        pair.epipolar_point(&left, f64::NAN),
        Err(CameraError::NotFinite)
    );
}

#[test]
fn a_moved_pair_triangulates_the_moved_point() {
    let to_from = Isometry3::from_parts(
        Translation3::new(1.0, -2.0, 0.3),
        UnitQuaternion::from_euler_angles(0.1, -0.7, 2.2),
    );
    let pair = pair();
    let moved = pair.transformed(&to_from);
    for point in points() {
        let (left, right) = pixels(&pair, &point);
        let expected = to_from.transform_point(&point.into()).coords;
        assert!((moved.triangulate(&left, &right).unwrap().point - expected).norm() < 1e-12);
    }
}

#[test]
fn a_pair_without_a_baseline_is_invalid() {
    let mut pair = pair();
    pair.right = pair.left.clone();
    assert!(
        pair.validate()
            .unwrap_err()
            .to_string()
            .contains("baseline is 0 m")
    );
    pair.right.height_px = 0;
    assert!(
        pair.validate()
            .unwrap_err()
            .to_string()
            .contains("right camera: the image is 640 x 0")
    );
}
