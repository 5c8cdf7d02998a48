#![allow(clippy::unwrap_used, clippy::expect_used)]
//! Accuracy and refusal of the fiducial search, on images whose truth is exact.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector2, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rover_cameras::{Camera, StereoPair};

use super::*;
use crate::synthetic::{self, Rays, Region};

const WHITE_DN: f64 = 190.0;

struct Rig {
    pair: StereoPair,
    rays: [Rays; 2],
    layout: PlateLayout,
    rules: DetectionRules,
}

impl Rig {
    fn new() -> Self {
        let pair = synthetic::pair();
        Self {
            rays: [Rays::new(&pair.left), Rays::new(&pair.right)],
            pair,
            layout: PlateLayout::standard(0.08),
            rules: DetectionRules::default(),
        }
    }

    fn camera(&self, side: usize) -> &Camera {
        [&self.pair.left, &self.pair.right][side]
    }

    /// Linear picture with the plate over a textured ground, and the part that is drawn.
    fn picture(&self, side: usize, pose: &Isometry3<f64>, seed: u64) -> (Vec<f64>, Region) {
        let reach = 0.06;
        let (mut low, mut high) = (Vector2::repeat(1e9f64), Vector2::repeat(-1e9f64));
        for k in 0..4 {
            let corner = Vector3::new(
                if k % 2 == 0 { -reach } else { reach },
                if k < 2 { -reach } else { reach },
                0.0,
            );
            let corner = (pose * nalgebra::Point3::from(corner)).coords;
            let at = self.camera(side).project(&corner).unwrap();
            low = low.inf(&at);
            high = high.sup(&at);
        }
        let region = |margin: f64| -> Region {
            let clamp = |x: f64, size: f64| x.clamp(0.0, size) as usize;
            let (u0, v0) = (clamp(low.x - margin, 640.0), clamp(low.y - margin, 480.0));
            let (u1, v1) = (clamp(high.x + margin, 640.0), clamp(high.y + margin, 480.0));
            (u0, v0, u1 - u0, v1 - v0)
        };
        let wide = region(80.0);
        let mut picture = vec![110.0; 640 * 480];
        for v in wide.1..wide.1 + wide.3 {
            for u in wide.0..wide.0 + wide.2 {
                picture[v * 640 + u] =
                    synthetic::texture(u as f64, v as f64, 64.0, 3.0, 18.0, seed);
            }
        }
        let scale = WHITE_DN / self.layout.white;
        synthetic::draw(&mut picture, &self.rays[side], region(0.0), 8, &|o, d| {
            let p = synthetic::hit_plane(pose, o, d)?;
            self.layout.albedo(p.x, p.y).map(|a| a * scale)
        });
        (picture, wide)
    }

    fn image(
        &self,
        (picture, region): &(Vec<f64>, Region),
        noise_dn: f64,
        rng: &mut ChaCha8Rng,
    ) -> Image8 {
        let pixels = synthetic::expose(picture, 640, *region, 0.6, noise_dn, rng);
        Image8::from_raw(640, 480, pixels).unwrap()
    }

    fn search<'a>(
        &'a self,
        side: usize,
        prediction: Isometry3<f64>,
        radius_px: f64,
    ) -> PlateSearch<'a> {
        PlateSearch {
            camera: self.camera(side),
            layout: &self.layout,
            predicted_camera_frame_from_plate: prediction,
            search_radius_px: radius_px,
            rules: &self.rules,
        }
    }

    /// Reprojection errors of an observation against the true pose.
    fn errors(
        &self,
        side: usize,
        pose: &Isometry3<f64>,
        points: &[PointObservation],
    ) -> Vec<Vector2<f64>> {
        let camera = self.camera(side);
        points
            .iter()
            .map(|p| {
                let at = pose * nalgebra::Point3::from(p.point_in_plate);
                p.pixel_px - camera.project(&at.coords).unwrap()
            })
            .collect()
    }
}

fn random_pose(rig: &Rig, rng: &mut ChaCha8Rng) -> Isometry3<f64> {
    let pixel = Vector2::new(
        rng.random_range(200.0..420.0),
        rng.random_range(120.0..360.0),
    );
    synthetic::facing_pose(
        &rig.pair.left,
        pixel,
        rng.random_range(0.45..0.8),
        rng.random_range(0.0..0.87),
        rng.random_range(0.0..std::f64::consts::TAU),
        rng.random_range(0.0..std::f64::consts::TAU),
    )
}

/// A prediction that is off by up to `shift_px`, `angle_rad` and `scale` of range.
fn spoil(
    pose: &Isometry3<f64>,
    camera: &Camera,
    shift_px: f64,
    angle_rad: f64,
    scale: f64,
    rng: &mut ChaCha8Rng,
) -> Isometry3<f64> {
    let at = camera.project(&pose.translation.vector).unwrap();
    let shift = Vector2::new(
        rng.random_range(-shift_px..=shift_px),
        rng.random_range(-shift_px..=shift_px),
    );
    let ray = camera.ray(&at).unwrap();
    let range = (pose.translation.vector - ray.origin).norm();
    let moved = camera.ray(&(at + shift)).unwrap();
    let axis = Vector3::new(
        synthetic::normal(rng),
        synthetic::normal(rng),
        synthetic::normal(rng),
    )
    .normalize();
    let turn = UnitQuaternion::from_scaled_axis(axis * angle_rad * rng.random_range(0.5..=1.0));
    Isometry3::from_parts(
        Translation3::from(moved.at(range * (1.0 + rng.random_range(-scale..=scale)))),
        turn * pose.rotation,
    )
}

fn rms(errors: &[Vector2<f64>]) -> f64 {
    (errors.iter().map(|e| e.norm_squared()).sum::<f64>() / (2 * errors.len()) as f64).sqrt()
}

#[test]
fn points_are_found_to_two_hundredths_of_a_pixel_despite_a_poor_prediction() {
    let rig = Rig::new();
    let mut rng = synthetic::rng(1);
    for (noise, limit) in [(1.0, 0.02), (5.0, 0.05)] {
        let mut all = Vec::new();
        let mut normalised = Vec::new();
        for case in 0..25 {
            let pose = random_pose(&rig, &mut rng);
            let image = rig.image(&rig.picture(0, &pose, case), noise, &mut rng);
            let prediction = spoil(&pose, &rig.pair.left, 55.0, 0.14, 0.07, &mut rng);
            let found = find_plate(&image, &rig.search(0, prediction, 60.0))
                .unwrap_or_else(|e| panic!("case {case}: {e}"));
            assert!(found.points.len() >= 10, "case {case}: {:?}", found.refused);
            assert!(found.score > 0.9, "case {case}: {}", found.score);
            let errors = rig.errors(0, &pose, &found.points);
            for (e, p) in errors.iter().zip(&found.points) {
                normalised.push(e / p.sigma_px);
            }
            all.extend(errors);
        }
        let (found, normalised) = (rms(&all), rms(&normalised));
        println!(
            "noise {noise}: {} points, rms {found:.4} px, {normalised:.2} sigma",
            all.len()
        );
        assert!(found < limit, "noise {noise}: {found}");
        assert!(
            (0.6..1.7).contains(&normalised),
            "noise {noise}: {normalised}"
        );
    }
}

#[test]
fn the_saddle_alone_is_found_to_two_hundredths_of_a_pixel() {
    let rig = Rig::new();
    let mut rng = synthetic::rng(2);
    for (noise, limit) in [(1.0, 0.02), (5.0, 0.05)] {
        let mut all = Vec::new();
        for case in 0..20 {
            let pose = random_pose(&rig, &mut rng);
            let image = rig.image(&rig.picture(0, &pose, 100 + case), noise, &mut rng);
            let prediction = spoil(&pose, &rig.pair.left, 30.0, 0.14, 0.07, &mut rng);
            let found = find_saddle(&image, &rig.search(0, prediction, 35.0))
                .unwrap_or_else(|e| panic!("case {case}: {e}"));
            assert_eq!((found.kind, found.index), (PointKind::Saddle, 11));
            all.extend(rig.errors(0, &pose, &[found]));
        }
        println!("saddle, noise {noise}: rms {:.4} px", rms(&all));
        assert!(rms(&all) < limit, "noise {noise}: {}", rms(&all));
    }
}

#[test]
fn the_pose_from_two_images_is_as_good_as_its_covariance_says() {
    let rig = Rig::new();
    let mut rng = synthetic::rng(3);
    let mut mahalanobis = Vec::new();
    let (mut shift, mut angle) = (0.0f64, 0.0f64);
    let cases = 15;
    for case in 0..cases {
        let pose = random_pose(&rig, &mut rng);
        let prediction = spoil(&pose, &rig.pair.left, 20.0, 0.1, 0.04, &mut rng);
        let seen: Vec<PlateObservation> = (0..2)
            .map(|side| {
                let image = rig.image(&rig.picture(side, &pose, case), 1.0, &mut rng);
                find_plate(&image, &rig.search(side, prediction, 60.0)).unwrap()
            })
            .collect();
        let found =
            estimate_plate_pose(&rig.pair, &rig.layout, &seen[0], &seen[1], &prediction).unwrap();
        assert!(found.rms_px < 0.03, "{}", found.rms_px);
        let error = found.rover_from_plate.translation.vector - pose.translation.vector;
        let turn = (found.rover_from_plate.rotation * pose.rotation.inverse()).scaled_axis();
        let e = nalgebra::Vector6::new(error.x, error.y, error.z, turn.x, turn.y, turn.z);
        mahalanobis.push((found.covariance.try_inverse().unwrap() * e).dot(&e));
        shift = shift.max(error.norm());
        angle = angle.max(turn.norm());
    }
    let mean = mahalanobis.iter().sum::<f64>() / f64::from(cases as u32);
    println!(
        "pose: worst {:.3} mm, {:.4} deg, d2 {mean:.1}",
        shift * 1e3,
        angle.to_degrees()
    );
    assert!(
        (2.0..15.0).contains(&mean),
        "mean squared Mahalanobis distance {mean}, 6 expected"
    );
    assert!(shift < 1.0e-3 && angle < 0.01);
}

/// Searches `cases` images without a plate; panics at the first false acceptance.
fn search_without_a_plate(cases: u64, seed: u64) {
    let rig = Rig::new();
    let mut rng = synthetic::rng(seed);
    let (mut plate, mut saddle) = (0.0f64, 0.0f64);
    let score = |e: NotFound, best: &mut f64| {
        if let NotFound::LowScore { score, .. } = e {
            *best = best.max(score);
        }
    };
    for case in 0..cases {
        let contrast = rng.random_range(3.0..60.0);
        let finest = rng.random_range(1.0..16.0);
        let coarsest = rng.random_range(16.0..80.0);
        let binary = rng.random_bool(0.3);
        let mut pixels = vec![0u8; 640 * 480];
        let pose = random_pose(&rig, &mut rng);
        let at = rig.pair.left.project(&pose.translation.vector).unwrap();
        // texture only where the search looks
        for v in (at.y as usize).saturating_sub(130)..(at.y as usize + 130).min(480) {
            for u in (at.x as usize).saturating_sub(130)..(at.x as usize + 130).min(640) {
                let x = synthetic::texture(u as f64, v as f64, coarsest, finest, contrast, case);
                let x = if binary {
                    110.0 + (x - 110.0).clamp(-1.0, 1.0) * 80.0
                } else {
                    x
                };
                pixels[v * 640 + u] = x.clamp(0.0, 255.0) as u8;
            }
        }
        let image = Image8::from_raw(640, 480, pixels).unwrap();
        let search = rig.search(0, pose, 60.0);
        score(
            find_plate(&image, &search).expect_err("a plate"),
            &mut plate,
        );
        score(
            find_saddle(&image, &search).expect_err("a saddle"),
            &mut saddle,
        );
    }
    println!("{cases} images without a plate: best scores {plate:.3} plate, {saddle:.3} saddle");
}

#[test]
fn textured_noise_without_a_plate_is_never_accepted() {
    search_without_a_plate(300, 4);
}

#[test]
fn a_shadow_edge_or_an_occluder_costs_points_but_not_accuracy() {
    let rig = Rig::new();
    let mut rng = synthetic::rng(5);
    for case in 0..12 {
        let pose = random_pose(&rig, &mut rng);
        let mut picture = rig.picture(0, &pose, case);
        let at = rig.pair.left.project(&pose.translation.vector).unwrap();
        let direction: f64 = rng.random_range(0.0..std::f64::consts::TAU);
        let offset: f64 = rng.random_range(4.0..12.0);
        for (i, x) in picture.0.iter_mut().enumerate() {
            let (u, v) = ((i % 640) as f64 - at.x, (i / 640) as f64 - at.y);
            let side = u * direction.cos() + v * direction.sin() - offset;
            let covered = (side + 0.5).clamp(0.0, 1.0);
            // even cases: a shadow with a fifth of the light; odd: something grey in front
            let other = if case % 2 == 0 { *x * 0.2 } else { 90.0 };
            *x += (other - *x) * covered;
        }
        let image = rig.image(&picture, 1.5, &mut rng);
        let prediction = spoil(&pose, &rig.pair.left, 15.0, 0.05, 0.03, &mut rng);
        match find_plate(&image, &rig.search(0, prediction, 30.0)) {
            Ok(found) => {
                let errors = rig.errors(0, &pose, &found.points);
                let worst = errors.iter().map(|e| e.norm()).fold(0.0, f64::max);
                println!(
                    "case {case}: {} points, worst {worst:.3} px",
                    found.points.len()
                );
                assert!(rms(&errors) < 0.05 && worst < 0.25, "case {case}: {worst}");
                // only the marks on a shadow's edge are lost
                let least = if case % 2 == 0 { 7 } else { 6 };
                assert!(
                    found.points.len() >= least,
                    "case {case}: {:?}",
                    found.refused
                );
            }
            Err(e) => assert!(case % 2 == 1, "case {case}: {e}"),
        }
    }
}

#[test]
fn saturated_white_is_refused() {
    let rig = Rig::new();
    let mut rng = synthetic::rng(6);
    let pose = random_pose(&rig, &mut rng);
    let mut picture = rig.picture(0, &pose, 1);
    picture.0.iter_mut().for_each(|x| *x *= 1.6);
    let image = rig.image(&picture, 1.0, &mut rng);
    let refusal = find_plate(&image, &rig.search(0, pose, 30.0)).unwrap_err();
    assert!(
        matches!(
            refusal,
            NotFound::TooFewPoints {
                first_fault: Some((_, PointFault::Saturated { .. })),
                ..
            }
        ),
        "{refusal}"
    );
}

#[test]
fn impossible_searches_are_refused_with_the_reason() {
    let rig = Rig::new();
    let image = Image8::from_raw(640, 480, vec![100; 640 * 480]).unwrap();
    let straight =
        |pixel, range| synthetic::facing_pose(&rig.pair.left, pixel, range, 0.0, 0.0, 0.0);
    let good = straight(Vector2::new(320.0, 240.0), 0.6);
    let refused = |pose, image: &Image8| find_plate(image, &rig.search(0, pose, 20.0)).unwrap_err();
    assert!(matches!(refused(good, &image), NotFound::LowScore { .. }));
    let beside = straight(Vector2::new(-300.0, 240.0), 0.6);
    assert!(matches!(
        refused(beside, &image),
        NotFound::OutsideImage { .. }
    ));
    let far = straight(Vector2::new(320.0, 240.0), 3.0);
    assert!(matches!(refused(far, &image), NotFound::TooSmall { .. }));
    let back = good * UnitQuaternion::from_axis_angle(&Vector3::x_axis(), 3.0);
    assert!(matches!(refused(back, &image), NotFound::NotVisible(_)));
    let behind = Isometry3::translation(-0.5, 0.0, 0.5) * good.rotation;
    assert!(matches!(refused(behind, &image), NotFound::NotVisible(_)));
    let small = Image8::from_raw(320, 240, vec![0; 320 * 240]).unwrap();
    assert!(matches!(refused(good, &small), NotFound::BadInput(_)));
    let mut layout = rig.layout.clone();
    layout.saddle = None;
    let search = PlateSearch {
        layout: &layout,
        ..rig.search(0, good, 20.0)
    };
    assert!(matches!(
        find_saddle(&image, &search),
        Err(NotFound::NoSaddle)
    ));
}

#[test]
fn the_result_does_not_depend_on_how_often_it_is_computed() {
    let rig = Rig::new();
    let mut rng = synthetic::rng(7);
    let pose = random_pose(&rig, &mut rng);
    let image = rig.image(&rig.picture(0, &pose, 1), 1.0, &mut rng);
    let search = rig.search(0, pose, 30.0);
    assert_eq!(
        find_plate(&image, &search).unwrap(),
        find_plate(&image, &search).unwrap()
    );
}

#[test]
fn a_glance_gives_the_place_and_score_of_the_full_search() {
    let rig = Rig::new();
    let mut rng = synthetic::rng(31);
    let mut told = 0;
    for case in 0..6 {
        let pixel = Vector2::new(280.0 + 11.3 * case as f64, 230.0 - 6.7 * case as f64);
        let tilt = 0.1 * case as f64;
        let pose = synthetic::facing_pose(&rig.pair.left, pixel, 0.6, tilt, 1.0, 0.3);
        let image = rig.image(&rig.picture(0, &pose, 40 + case), 1.5, &mut rng);
        let search = rig.search(0, Translation3::new(0.004, -0.003, 0.0) * pose, 16.0);
        let map = local_map::LocalMap::new(
            search.camera,
            &(Translation3::new(0.004, -0.003, 0.0) * pose),
            &Vector3::zeros(),
        )
        .unwrap();
        let (glance, full) = locate::both_ways(&image, &search, &map).unwrap();
        let Some(glance) = glance.first() else {
            continue;
        };
        assert_eq!(glance.score, full[0].score, "{case}");
        assert_eq!(glance.map.pixel_px, full[0].map.pixel_px, "{case}");
        told += 1;
    }
    assert!(told >= 5, "{told}");
}
