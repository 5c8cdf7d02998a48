#![allow(clippy::unwrap_used, clippy::expect_used)]
//! Accuracy and refusal of stereo matching, on images whose truth is exact.

use std::sync::OnceLock;

use nalgebra::{Isometry3, Vector2, Vector3};
use rand::Rng;
use rover_cameras::StereoPair;

use super::*;
use crate::synthetic::{self, Rays, Region};

struct Rig {
    pair: StereoPair,
    rays: [Rays; 2],
}

fn rig() -> &'static Rig {
    static RIG: OnceLock<Rig> = OnceLock::new();
    RIG.get_or_init(|| {
        let pair = synthetic::pair();
        Rig {
            rays: [Rays::new(&pair.left), Rays::new(&pair.right)],
            pair,
        }
    })
}

/// What a ray meets: (distance along the unnormalised direction, grey value).
type Shade<'a> = dyn Fn(&Vector3<f64>, &Vector3<f64>) -> Option<f64> + 'a;

/// Both images of a scene, drawn only around a left pixel and its match.
fn images(
    shade: &Shade,
    around: Vector2<f64>,
    range_m: f64,
    noise_dn: f64,
    seed: u64,
) -> (PreparedImage, PreparedImage) {
    let rig = rig();
    let mut rng = synthetic::rng(seed);
    let target = rig.pair.left.ray(&around).unwrap().at(range_m);
    let mut draw = |side: usize, camera: &rover_cameras::Camera| {
        let at = camera.project(&target).unwrap();
        let mut picture = vec![110.0; 640 * 480];
        let clamp = |x: f64, size: usize| x.clamp(0.0, size as f64) as usize;
        let (u0, v0) = (clamp(at.x - 75.0, 640), clamp(at.y - 40.0, 480));
        let region: Region = (u0, v0, 150, 80);
        synthetic::draw(&mut picture, &rig.rays[side], region, 4, shade);
        let pixels = synthetic::expose(&picture, 640, region, 0.6, noise_dn, &mut rng);
        PreparedImage::new(&Image8::from_raw(640, 480, pixels).unwrap()).unwrap()
    };
    (draw(0, &rig.pair.left), draw(1, &rig.pair.right))
}

/// Rock texture on the plane z = 0 of a pose; equal octaves from 64 mm to 2 mm.
fn plane_shade(
    pose: Isometry3<f64>,
    seed: u64,
) -> impl Fn(&Vector3<f64>, &Vector3<f64>) -> Option<f64> {
    move |o, d| {
        let p = synthetic::hit_plane(&pose, o, d)?;
        Some(synthetic::texture(p.x, p.y, 0.064, 0.0015, 18.0, seed))
    }
}

/// A random plane through the ray of a random pixel.
fn random_plane(rng: &mut rand_chacha::ChaCha8Rng) -> (Vector2<f64>, f64, Isometry3<f64>) {
    let pixel = Vector2::new(
        rng.random_range(180.0..560.0),
        rng.random_range(80.0..400.0),
    );
    let range = rng.random_range(0.45..0.85);
    let pose = synthetic::facing_pose(
        &rig().pair.left,
        pixel,
        range,
        rng.random_range(0.0..0.87),
        rng.random_range(0.0..std::f64::consts::TAU),
        0.0,
    );
    (pixel, range, pose)
}

fn mean_and_spread(x: &[f64]) -> (f64, f64) {
    let n = x.len() as f64;
    let mean = x.iter().sum::<f64>() / n;
    (
        mean,
        (x.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt(),
    )
}

#[test]
fn a_tilted_plane_is_matched_without_bias_to_four_hundredths_of_a_pixel() {
    let mut rng = synthetic::rng(11);
    let rules = MatchRules::default();
    let (mut errors, mut normalised, mut epipolar) = (Vec::new(), Vec::new(), Vec::new());
    let mut refused = 0;
    for case in 0..80 {
        let (pixel, range, pose) = random_plane(&mut rng);
        let (left, right) = images(&plane_shade(pose, case), pixel, range, 1.5, case);
        let target = rig().pair.left.ray(&pixel).unwrap().at(range);
        let truth = rig().pair.right.project(&target).unwrap();
        match match_point(&left, &right, &rig().pair, &pixel, &rules) {
            Ok(found) => {
                let e = found.right_px - truth;
                errors.push(e.x);
                normalised.push(e.x / found.sigma_px);
                epipolar.push(found.epipolar_px);
            }
            Err(e) => {
                println!("case {case}: {e}");
                refused += 1;
            }
        }
    }
    let (bias, sigma) = mean_and_spread(&errors);
    let (_, ratio) = mean_and_spread(&normalised);
    let (_, off) = mean_and_spread(&epipolar);
    println!(
        "match: bias {bias:.4}, sigma {sigma:.4} px, {ratio:.2} of stated, across {off:.4}, {refused} refused"
    );
    assert!(refused <= 4);
    assert!(bias.abs() < 0.02 && sigma < 0.04);
    assert!((0.5..1.8).contains(&ratio));
}

#[test]
fn the_fused_surface_point_is_better_than_three_hundredths_of_a_pixel() {
    let mut rng = synthetic::rng(12);
    let rules = SurfaceRules::default();
    let (mut errors, mut normalised, mut tilt) = (Vec::new(), Vec::new(), Vec::new());
    let mut turned = Vec::new();
    let mut refused = 0;
    for case in 0..50 {
        let (pixel, range, pose) = random_plane(&mut rng);
        let (left, right) = images(&plane_shade(pose, case), pixel, range, 1.5, 1000 + case);
        match measure_surface(&left, &right, &rig().pair, &pixel, &rules) {
            Ok(found) => {
                let truth = rig().pair.left.ray(&pixel).unwrap().at(range);
                let at = rig().pair.right.project(&found.position).unwrap();
                let e = at - rig().pair.right.project(&truth).unwrap();
                errors.push(e.x);
                normalised.push(e.x / found.sigma_px);
                let normal = pose.rotation * Vector3::z();
                tilt.push(
                    found
                        .normal
                        .dot(&normal)
                        .clamp(-1.0, 1.0)
                        .acos()
                        .to_degrees(),
                );
                // two directions, each at most as uncertain as stated
                let off = tilt[tilt.len() - 1].to_radians();
                turned.push(off / found.normal_sigma_rad.unwrap());
                assert!(found.plane_rms_m < 1e-3, "{}", found.plane_rms_m);
                let d2 = (found.position - truth)
                    .dot(&(found.covariance.try_inverse().unwrap() * (found.position - truth)));
                assert!(d2 < 30.0, "case {case}: {d2}");
            }
            Err(e) => {
                println!("case {case}: {e}");
                refused += 1;
            }
        }
    }
    let (bias, sigma) = mean_and_spread(&errors);
    let (_, ratio) = mean_and_spread(&normalised);
    tilt.sort_by(f64::total_cmp);
    println!(
        "surface: bias {bias:.4}, sigma {sigma:.4} px, {ratio:.2} of stated, normal median {:.2} deg, \
         worst {:.2}, {refused} refused",
        tilt[tilt.len() / 2],
        tilt[tilt.len() - 1]
    );
    assert!(refused <= 4);
    assert!(bias.hypot(sigma) < 0.03);
    assert!((0.4..1.8).contains(&ratio));
    assert!(tilt[tilt.len() / 2] < 1.0);
    let mean_square = turned.iter().map(|x| x * x).sum::<f64>() / turned.len() as f64;
    println!("normal: {:.2} of stated", mean_square.sqrt());
    assert!((0.3..2.0).contains(&mean_square.sqrt()), "{mean_square}");
}

/// Nearest positive hit of a sphere: (parameter, point).
fn hit_sphere(
    centre: &Vector3<f64>,
    radius: f64,
    o: &Vector3<f64>,
    d: &Vector3<f64>,
) -> Option<(f64, Vector3<f64>)> {
    let oc = o - centre;
    let (a, b, c) = (d.dot(d), oc.dot(d), oc.dot(&oc) - radius * radius);
    let root = b * b - a * c;
    if root < 0.0 {
        return None;
    }
    let t = (-b - root.sqrt()) / a;
    (t > 0.0).then(|| (t, o + d * t))
}

#[test]
fn the_point_on_a_boulder_is_not_pulled_by_its_curvature() {
    let mut rng = synthetic::rng(13);
    let rules = SurfaceRules::default();
    let mut errors = Vec::new();
    for case in 0..25 {
        let pixel = Vector2::new(
            rng.random_range(200.0..520.0),
            rng.random_range(100.0..380.0),
        );
        let range = rng.random_range(0.5..0.8);
        let ray = rig().pair.left.ray(&pixel).unwrap();
        let top = ray.at(range);
        let radius = 0.12;
        let lean = Vector3::new(
            rng.random_range(-0.5..0.5),
            rng.random_range(-0.5..0.5),
            rng.random_range(-0.5..0.5),
        );
        let inward = (ray.direction.into_inner() + lean).normalize();
        let centre = top + inward * radius;
        let shade = |o: &Vector3<f64>, d: &Vector3<f64>| {
            let (_, p) = hit_sphere(&centre, radius, o, d)?;
            let q = (p - centre) / radius;
            let (a, b) = (q.x.atan2(q.y) * radius, q.z.asin() * radius);
            Some(synthetic::texture(a, b, 0.064, 0.0015, 18.0, case))
        };
        let (left, right) = images(&shade, pixel, range, 1.5, 2000 + case);
        match measure_surface(&left, &right, &rig().pair, &pixel, &rules) {
            Ok(found) => {
                let at = rig().pair.right.project(&found.position).unwrap();
                errors.push((at - rig().pair.right.project(&top).unwrap()).x);
                let angle = found
                    .normal
                    .dot(&-inward)
                    .clamp(-1.0, 1.0)
                    .acos()
                    .to_degrees();
                assert!(angle < 6.0, "case {case}: normal {angle:.1} deg off");
            }
            Err(e) => println!("case {case}: {e}"),
        }
    }
    let (bias, sigma) = mean_and_spread(&errors);
    println!(
        "boulder: bias {bias:.4}, sigma {sigma:.4} px of {}",
        errors.len()
    );
    assert!(errors.len() >= 18);
    assert!(bias.hypot(sigma) < 0.05);
}

#[test]
fn a_grey_area_the_sky_and_a_repeated_pattern_are_refused_by_name() {
    let pixel = Vector2::new(320.0, 240.0);
    let pose = synthetic::facing_pose(&rig().pair.left, pixel, 0.6, 0.3, 0.4, 0.0);
    let rules = SurfaceRules::default();
    let measure = |l: &PreparedImage, r: &PreparedImage| {
        measure_surface(l, r, &rig().pair, &pixel, &rules).unwrap_err()
    };
    let grey = |_: &Vector3<f64>, _: &Vector3<f64>| Some(120.0);
    let (left, right) = images(&grey, pixel, 0.6, 1.0, 1);
    assert!(matches!(
        measure(&left, &right),
        SurfaceFailure::NoTexture { .. }
    ));

    let (left, _) = images(&plane_shade(pose, 1), pixel, 0.6, 1.5, 1);
    let (_, right) = images(&plane_shade(pose, 99), pixel, 0.6, 1.5, 2);
    let refusal = measure(&left, &right);
    assert!(
        matches!(
            refusal,
            SurfaceFailure::NothingInRange { .. } | SurfaceFailure::Occluded(_)
        ),
        "{refusal}"
    );

    // stripes 8 mm apart look the same every few disparities
    let stripes = |o: &Vector3<f64>, d: &Vector3<f64>| {
        let p = synthetic::hit_plane(&pose, o, d)?;
        Some(110.0 + 50.0 * (p.x * std::f64::consts::TAU / 0.008).sin() * (p.y * 300.0).cos())
    };
    let (left, right) = images(&stripes, pixel, 0.6, 1.0, 3);
    let refusal = measure(&left, &right);
    assert!(
        matches!(
            refusal,
            SurfaceFailure::NotUnique { .. } | SurfaceFailure::Occluded(_)
        ),
        "{refusal}"
    );
}

#[test]
fn an_edge_and_a_rough_place_are_refused_by_name() {
    let pixel = Vector2::new(320.0, 240.0);
    let rig = rig();
    let rules = SurfaceRules::default();
    let near = synthetic::facing_pose(&rig.pair.left, pixel, 0.6, 0.0, 0.0, 0.0);
    // a plate ending 2 mm right of the pixel, the ground 15 cm behind it
    let behind = synthetic::facing_pose(&rig.pair.left, pixel, 0.75, 0.2, 0.0, 0.0);
    let edge = |o: &Vector3<f64>, d: &Vector3<f64>| {
        let p = synthetic::hit_plane(&near, o, d)?;
        if p.x < 0.002 {
            return Some(synthetic::texture(p.x, p.y, 0.064, 0.0015, 18.0, 5));
        }
        let p = synthetic::hit_plane(&behind, o, d)?;
        Some(synthetic::texture(p.x, p.y, 0.064, 0.0015, 18.0, 6))
    };
    let (left, right) = images(&edge, pixel, 0.6, 1.5, 1);
    let refusal = measure_surface(&left, &right, &rig.pair, &pixel, &rules).unwrap_err();
    assert!(matches!(refusal, SurfaceFailure::Occluded(_)), "{refusal}");

    // a ball of 12 mm radius on a plate
    let ball = near * nalgebra::Point3::new(0.0, 0.0, 0.0);
    let rough = |o: &Vector3<f64>, d: &Vector3<f64>| {
        if let Some((_, p)) = hit_sphere(&ball.coords, 0.016, o, d) {
            let q = p - ball.coords;
            return Some(synthetic::texture(
                q.x + q.z,
                q.y - q.z,
                0.032,
                0.0015,
                18.0,
                7,
            ));
        }
        let p = synthetic::hit_plane(&near, o, d)?;
        Some(synthetic::texture(p.x, p.y, 0.064, 0.0015, 18.0, 8))
    };
    let (left, right) = images(&rough, pixel, 0.584, 1.5, 2);
    let strict = SurfaceRules {
        max_roughness_m: 0.006,
        ..rules
    };
    let refusal = measure_surface(&left, &right, &rig.pair, &pixel, &strict).unwrap_err();
    assert!(
        matches!(
            refusal,
            SurfaceFailure::TooRough { .. } | SurfaceFailure::Occluded(_)
        ),
        "{refusal}"
    );
}

#[test]
fn a_camera_model_error_across_the_baseline_shows_and_does_not_disturb() {
    let mut rng = synthetic::rng(14);
    let rules = MatchRules::default();
    let mut believed = rig().pair.clone();
    if let rover_cameras::CameraModel::Cahvor(m) = &mut believed.right.model {
        m.v += m.a * 0.3; // the right image lies 0.3 px lower than it should
    }
    let (mut along, mut across) = (Vec::new(), Vec::new());
    for case in 0..20 {
        let (pixel, range, pose) = random_plane(&mut rng);
        let (left, right) = images(&plane_shade(pose, case), pixel, range, 1.5, 3000 + case);
        let truth = rig()
            .pair
            .right
            .project(&rig().pair.left.ray(&pixel).unwrap().at(range))
            .unwrap();
        if let Ok(found) = match_point(&left, &right, &believed, &pixel, &rules) {
            along.push(found.right_px.x - truth.x);
            across.push(found.epipolar_px.abs());
        }
    }
    assert!(along.len() >= 18);
    let (mean, _) = mean_and_spread(&across);
    assert!((mean - 0.3).abs() < 0.03, "{mean}");
    assert!(mean_and_spread(&along).1 < 0.04);
}

#[test]
fn sparse_points_lie_on_the_plane_they_were_drawn_from() {
    let pixel = Vector2::new(330.0, 240.0);
    let pose = synthetic::facing_pose(&rig().pair.left, pixel, 0.6, 0.6, 0.0, 0.0);
    let (left, right) = images(&plane_shade(pose, 3), pixel, 0.6, 1.5, 4);
    let points = sparse_points(&left, &right, &rig().pair, 6, &MatchRules::default()).unwrap();
    let inside = |at: &Vector2<f64>| (at.x - 330.0).abs() < 60.0 && (at.y - 240.0).abs() < 30.0;
    let points: Vec<_> = points.iter().filter(|(at, _)| inside(at)).collect();
    assert!(points.len() > 120, "{}", points.len());
    for (at, point) in points {
        let local = pose.inverse_transform_point(&nalgebra::Point3::from(*point));
        assert!(local.z.abs() < 0.004, "{at}: {}", local.z);
    }
}

#[test]
fn unusable_input_is_refused() {
    let image = Image8::from_raw(320, 240, vec![7; 320 * 240]).unwrap();
    let small = PreparedImage::new(&image).unwrap();
    let pixel = Vector2::new(100.0, 100.0);
    let refusal =
        match_point(&small, &small, &rig().pair, &pixel, &MatchRules::default()).unwrap_err();
    assert!(matches!(refusal, MatchFailure::BadInput(_)), "{refusal}");
    let rules = MatchRules {
        range_min_m: 2.0,
        range_max_m: 1.0,
        ..MatchRules::default()
    };
    assert!(rules.validate().unwrap_err().contains("range_max_m"));
    assert!(serde_json::from_str::<MatchRules>("{\"half_widow_px\": 3}").is_err());
    let text = serde_json::to_string(&SurfaceRules::default()).unwrap();
    assert_eq!(
        serde_json::from_str::<SurfaceRules>(&text).unwrap(),
        SurfaceRules::default()
    );
}
