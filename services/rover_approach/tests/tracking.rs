//! Tracking and hand-over on a drawn plane, where the right answer is known exactly.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use nalgebra::{Isometry3, Matrix2, Point3, UnitQuaternion, Vector2, Vector3};
use rover_approach::egomotion::{EgomotionRules, Landmark, egomotion};
use rover_approach::filter::Motion;
use rover_approach::handover::{HandoverRules, hand_over};
use rover_approach::surface::SurfacePlane;
use rover_approach::view::View;
use rover_approach::warp::PlaneWarp;
use rover_approach::{anchor::TrackRules, track::Tracker};
use rover_cameras::{Cahv, Camera, CameraModel, StereoPair};
use rover_vision::{Image8, PreparedImage};
use std::sync::Arc;

/// Smooth noise on a lattice, -1 to 1.
fn noise(x: f64, y: f64, seed: u64) -> f64 {
    let (i, j) = (x.floor(), y.floor());
    let at = |a: f64, b: f64| {
        let mut h = (a as i64 as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
            ^ (b as i64 as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F)
            ^ seed.wrapping_mul(0x1656_67B1_9E37_79F9);
        h ^= h >> 31;
        h = h.wrapping_mul(0xBF58_476D_1CE4_E5B9);
        h ^= h >> 29;
        (h >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    };
    let s = |t: f64| t * t * (3.0 - 2.0 * t);
    let (u, v) = (s(x - i), s(y - j));
    let top = at(i, j) * (1.0 - u) + at(i + 1.0, j) * u;
    let bottom = at(i, j + 1.0) * (1.0 - u) + at(i + 1.0, j + 1.0) * u;
    top * (1.0 - v) + bottom * v
}

/// Grey value of the ground z = 0 of the site, without detail finer than `footprint_m`.
fn albedo(x: f64, y: f64, footprint_m: f64, seed: u64) -> f64 {
    let mut wave = 0.4;
    let mut sum = 120.0;
    while wave > 1.6 * footprint_m && wave > 0.004 {
        sum += 16.0 * noise(x / wave, y / wave, seed + (1.0 / wave) as u64);
        wave *= 0.5;
    }
    sum
}

fn camera(c: Vector3<f64>, axis: Vector3<f64>, focal_px: f64, size: [u32; 2]) -> Camera {
    let right = axis.cross(&Vector3::z()).normalize();
    let centre = size.map(|n| (f64::from(n) - 1.0) / 2.0);
    let model = CameraModel::Cahv(Cahv {
        c,
        a: axis,
        h: right * focal_px + axis * centre[0],
        v: axis.cross(&right) * focal_px + axis * centre[1],
    });
    Camera {
        model,
        width_px: size[0],
        height_px: size[1],
    }
}

fn pair(c: Vector3<f64>, aim: Vector3<f64>, focal_px: f64, baseline_m: f64) -> StereoPair {
    let axis = (aim - c).normalize();
    let side = axis.cross(&Vector3::z()).normalize() * (0.5 * baseline_m);
    StereoPair {
        left: camera(c - side, axis, focal_px, [360, 220]),
        right: camera(c + side, axis, focal_px, [360, 220]),
    }
}

fn draw(site_camera: &Camera, seed: u64) -> PreparedImage {
    let (w, h) = (site_camera.width_px, site_camera.height_px);
    let mut pixels = Vec::new();
    for v in 0..h {
        for u in 0..w {
            let mut sum = 0.0;
            for k in 0..4 {
                let part = Vector2::new(
                    0.25 * f64::from(k % 2) - 0.125,
                    0.25 * f64::from(k / 2) - 0.125,
                );
                let pixel = Vector2::new(f64::from(u), f64::from(v)) + part * 2.0;
                let ray = site_camera.ray(&pixel).unwrap();
                let range = -ray.origin.z / ray.direction.z;
                let p = ray.at(range);
                let footprint = range / 1290.0 / -ray.direction.z;
                sum += albedo(p.x, p.y, footprint, seed);
            }
            pixels.push((sum / 4.0).round().clamp(0.0, 255.0) as u8);
        }
    }
    PreparedImage::new(&Image8::from_raw(w, h, pixels).unwrap()).unwrap()
}

fn view(cameras: &StereoPair, site_from_rover: &Isometry3<f64>, seed: u64) -> Arc<View> {
    let there = cameras.transformed(site_from_rover);
    let view = View::new(
        draw(&there.left, seed),
        draw(&there.right, seed),
        cameras.clone(),
    );
    Arc::new(view.unwrap())
}

fn pose(x: f64, yaw: f64) -> Isometry3<f64> {
    Isometry3::from_parts(
        Vector3::new(x, 0.0, 0.0).into(),
        UnitQuaternion::from_euler_angles(0.01, -0.02, yaw),
    )
}

const TARGET: [f64; 3] = [4.0, 0.1, 0.0];
const MAST: [f64; 3] = [0.0, 0.0, 1.2];

fn mast(site_from_rover: &Isometry3<f64>) -> (StereoPair, Vector3<f64>) {
    let target = (site_from_rover.inverse() * Point3::from(TARGET)).coords;
    let aim = target + Vector3::new(0.01, -0.02, 0.0);
    (pair(MAST.into(), aim, 1290.0, 0.2), target)
}

fn designated(seed: u64) -> (Tracker, Isometry3<f64>) {
    let start = pose(0.0, 0.0);
    let (cameras, target) = mast(&start);
    let pixel = cameras.left.project(&target).unwrap();
    let view = view(&cameras, &start, seed);
    let tracker = Tracker::designate(view, pixel, [1.0, 10.0], TrackRules::default()).unwrap();
    (tracker, start)
}

/// Three stops with odometry wrong by 3 % and a degree, then the body pair.
#[test]
fn a_target_is_tracked_to_subpixel_and_handed_over() {
    let (mut tracker, mut last) = designated(1);
    let error = Isometry3::from_parts(
        Vector3::new(0.02, -0.006, 0.0).into(),
        UnitQuaternion::from_euler_angles(0.001, -0.001, 0.012),
    );
    let mut end = None;
    for (x, yaw) in [(0.7, 0.02), (1.4, -0.01), (2.1, 0.03), (2.9, 0.02)] {
        let now = pose(x, yaw);
        let (cameras, target) = mast(&now);
        let view = view(&cameras, &now, 1);
        let motion = error * now.inverse() * last;
        let spread = Matrix2::from_diagonal(&Vector2::new(400.0, 200.0));
        let fix = tracker.update(&view, &motion, &spread, x > 2.5).unwrap();
        let truth = cameras.left.project(&target).unwrap();
        let off = (fix.pixel_px - truth).norm();
        // On the surface, at 1290 px focal length.
        let off_mm = off * fix.surface.range_m / 1290.0 * 1e3;
        assert!(off_mm < 1.5, "{off_mm} mm at {x} m: {fix:?}");
        let point = (fix.surface.plane.point - target).norm();
        assert!(point < 0.03, "{point}");
        last = now;
        end = Some((view, target, now));
    }
    let (mast_view, target, now) = end.unwrap();
    let aim = Vector3::new(target.x, target.y, 0.0);
    let believed = pair(Vector3::new(0.1, 0.0, 0.6), aim, 602.0, 0.08);
    let mount = Isometry3::from_parts(
        Vector3::new(0.002, -0.002, 0.001).into(),
        UnitQuaternion::from_euler_angles(0.002, 0.001, -0.002),
    );
    let body = view(&believed.transformed(&mount), &now, 1);
    // the mount error is in the images, not in the models
    let body = View::new(body.left.clone(), body.right.clone(), believed.clone()).unwrap();
    let (pixel, surface) = tracker.target();
    let found = hand_over(&mast_view, pixel, surface, &body, &HandoverRules::default()).unwrap();
    let truth = believed.transformed(&mount).left.project(&target).unwrap();
    let off = (found.pixel_px - truth).norm();
    assert!(off < 0.7, "{off} px: {found:?}");
    assert!((found.geometric_px - truth).norm() > 1.0);
}

#[test]
fn a_warp_carries_every_point_of_its_plane() {
    let (cameras, target) = mast(&pose(0.0, 0.0));
    let camera = &cameras.left;
    let plane = SurfacePlane {
        point: target,
        normal: Vector3::new(-0.1, 0.05, 1.0).normalize(),
    };
    let pixel = camera.project(&target).unwrap();
    let motion = Isometry3::from_parts(
        Vector3::new(-0.8, 0.1, 0.02).into(),
        UnitQuaternion::from_euler_angles(0.02, -0.01, 0.1),
    );
    let warp = PlaneWarp::new(camera, &pixel, &plane).unwrap();
    let moved = warp.moved(&motion);
    for (u, v) in [(0.0, 0.0), (12.0, -7.0), (-9.0, 10.0)] {
        let d = Vector2::new(u, v);
        let ray = camera.ray(&(pixel + d)).unwrap();
        let n = plane.normal;
        let range = n.dot(&(plane.point - ray.origin)) / n.dot(ray.direction.as_ref());
        let expected = (motion * Point3::from(ray.at(range))).coords;
        assert!((moved.point(&d).unwrap() - expected).norm() < 1e-10);
        let seen = camera.project(&expected).unwrap();
        assert!((moved.offset(camera, &seen).unwrap() - d).norm() < 1e-8);
        let other = SurfacePlane {
            point: motion.transform_point(&Point3::from(target)).coords,
            normal: Vector3::new(0.2, 0.1, 1.0).normalize(),
        };
        let slid = moved.onto(camera, &other).unwrap();
        assert!((slid.pixel(camera, &d).unwrap() - seen).norm() < 1e-8);
        let height = other.normal.dot(&(slid.point(&d).unwrap() - other.point));
        assert!(height.abs() < 1e-10);
    }
    let step = 1e-4;
    let j = moved.jacobian(camera).unwrap();
    for k in 0..2 {
        let mut d = Vector2::zeros();
        d[k] = step;
        let a = moved.pixel(camera, &d).unwrap();
        let b = moved.pixel(camera, &-d).unwrap();
        assert!(((a - b) / (2.0 * step) - j.column(k)).norm() < 1e-6);
    }
    let behind = SurfacePlane {
        point: Vector3::new(-1.0, 0.0, 0.0),
        normal: Vector3::x(),
    };
    assert!(PlaneWarp::new(camera, &pixel, &behind).is_none());
}

/// Places of the ground that a view's left image shows, every 20 px, as stereo would put them.
fn landmarks(cameras: &StereoPair, site_from_rover: &Isometry3<f64>) -> Vec<Landmark> {
    let camera = cameras.left.transformed(site_from_rover);
    let pixels = (1..11).flat_map(|v| (1..18).map(move |u| [u, v].map(|k| f64::from(k) * 20.0)));
    pixels
        .filter_map(|pixel| {
            let pixel_px = Vector2::from(pixel);
            let ray = camera.ray(&pixel_px).ok()?;
            let range = -ray.origin.z / ray.direction.z;
            let place = site_from_rover.inverse() * Point3::from(ray.at(range));
            (range > 0.0).then_some(Landmark {
                pixel_px,
                point_m: place.coords,
            })
        })
        .collect()
}

/// Views of two stops, landmarks of the first, odometry that is off by `error`, and the truth.
fn two_stops(
    error: Isometry3<f64>,
    seeds: [u64; 2],
) -> ([Arc<View>; 2], Vec<Landmark>, Motion, Isometry3<f64>) {
    let [last, now] = [pose(0.4, 0.0), pose(1.0, 0.05)];
    let [before, after] = [mast(&last).0, mast(&now).0];
    let marks = landmarks(&before, &last);
    let truth = now.inverse() * last;
    let drive = [[4e-4, 0.0, 0.0], [0.0, 1e-4, 0.0], [0.0, 0.0, 4e-4]];
    let odometry = Motion::from_drive(error * truth, &drive, 0.004);
    let views = [view(&before, &last, seeds[0]), view(&after, &now, seeds[1])];
    (views, marks, odometry, truth)
}

#[test]
fn landmarks_tell_the_motion_that_odometry_has_wrong_by_a_degree() {
    let error = Isometry3::from_parts(
        Vector3::new(0.03, -0.012, 0.004).into(),
        UnitQuaternion::from_euler_angles(0.003, -0.004, 0.018),
    );
    let ([last, now], marks, odometry, truth) = two_stops(error, [1, 1]);
    let rules = EgomotionRules::default();
    let everywhere = |_: &View, _: &Vector3<f64>| true;
    let seen = egomotion([&last, &now], &marks, &odometry, everywhere, &rules).unwrap();
    let camera = &now.cameras.left;
    for mark in marks.iter().step_by(7) {
        let pixel = |motion: &Isometry3<f64>| {
            camera
                .project(&(motion * Point3::from(mark.point_m)).coords)
                .unwrap()
        };
        let off = (pixel(&seen.motion.now_from_last) - pixel(&truth)).norm();
        let before = (pixel(&odometry.now_from_last) - pixel(&truth)).norm();
        assert!(off < 0.5 && before > 15.0, "{off} px, odometry {before} px");
    }
    let rest = seen.motion.now_from_last * truth.inverse();
    let sigma = |k: usize| seen.motion.covariance[(k, k)].sqrt();
    for (k, x) in rest.translation.vector.iter().enumerate() {
        assert!(x.abs() < 4.0 * sigma(k), "{x} m, {} m", sigma(k));
    }
    for (k, x) in rest.rotation.scaled_axis().iter().enumerate() {
        assert!(
            x.abs() < 4.0 * sigma(k + 3),
            "{x} rad, {} rad",
            sigma(k + 3)
        );
    }
}

#[test]
fn a_picture_of_other_ground_tells_no_motion() {
    let ([last, now], marks, odometry, _) = two_stops(Isometry3::identity(), [1, 2]);
    let rules = EgomotionRules::default();
    let refused = egomotion([&last, &now], &marks, &odometry, |_, _| true, &rules).unwrap_err();
    assert!(refused.shown_n > 20 && refused.agreeing_n < refused.least_n.max(refused.found_n / 2));
    let hidden = egomotion([&last, &now], &marks, &odometry, |_, _| false, &rules).unwrap_err();
    assert_eq!(hidden.shown_n, 0);
}

/// Smooth noise warped freely enough is alike now and then; what keeps it from doing harm is that
/// the motion is known, so that it is alike near the target or not at all.
#[test]
fn other_ground_is_seldom_taken_for_the_target_and_never_far_from_where_that_is_expected() {
    let mut taken = 0;
    for seed in 2..14 {
        let (mut tracker, start) = designated(1);
        let now = pose(0.7, 0.02);
        let (cameras, _) = mast(&now);
        let view = view(&cameras, &now, seed);
        let motion = now.inverse() * start;
        let sigma_px = 2.0;
        let spread = Matrix2::identity() * (sigma_px * sigma_px);
        if let Ok(fix) = tracker.update(&view, &motion, &spread, false) {
            taken += 1;
            let away_px = fix.innovation_px.norm();
            assert!(away_px <= 5.0 * sigma_px, "seed {seed}: {away_px} px");
        }
    }
    assert!(taken <= 2, "{taken} of 12");
}
