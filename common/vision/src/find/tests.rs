#![allow(clippy::unwrap_used, clippy::expect_used)]
//! Detectors against rendered images whose truth is exact, and against images without a fiducial.

use nalgebra::{Isometry3, Point3, Vector2, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::tag_code::family;
use super::*;
use crate::fiducial::DetectionRules;
use crate::plate::PlateLayout;
use crate::synthetic::{self, Rays};

struct Rig {
    camera: rover_cameras::Camera,
    rays: Rays,
    /// Samples per side of a pixel.
    samples: usize,
}

impl Rig {
    fn new() -> Self {
        let camera = synthetic::camera(0.04);
        Self {
            rays: Rays::new(&camera),
            camera,
            samples: 10,
        }
    }

    fn pose(&self, rng: &mut ChaCha8Rng, max_tilt_rad: f64) -> Isometry3<f64> {
        let pixel = Vector2::new(
            rng.random_range(200.0..440.0),
            rng.random_range(140.0..340.0),
        );
        synthetic::facing_pose(
            &self.camera,
            pixel,
            rng.random_range(0.45..0.7),
            rng.random_range(0.0..max_tilt_rad),
            rng.random_range(0.0..std::f64::consts::TAU),
            rng.random_range(0.0..std::f64::consts::TAU),
        )
    }

    /// A flat thing of half size `half_m` with albedo `shade(x, y)` over a textured ground.
    fn image(
        &self,
        pose: &Isometry3<f64>,
        half_m: f64,
        noise_dn: f64,
        rng: &mut ChaCha8Rng,
        shade: &dyn Fn(f64, f64) -> Option<f64>,
    ) -> Image8 {
        let mut picture: Vec<f64> = (0..640 * 480)
            .map(|i| synthetic::texture((i % 640) as f64, (i / 640) as f64, 64.0, 3.0, 12.0, 5))
            .collect();
        let at = self.camera.project(&pose.translation.vector).unwrap();
        let range = (pose.translation.vector - self.camera.model.cahv()[0]).norm();
        let reach = 1.5 * half_m * synthetic::FOCAL_PX / range + 8.0;
        let clamp = |x: f64, size: f64| x.clamp(0.0, size) as usize;
        let (u0, v0) = (clamp(at.x - reach, 640.0), clamp(at.y - reach, 480.0));
        let side = (2.0 * reach) as usize;
        synthetic::draw(
            &mut picture,
            &self.rays,
            (u0, v0, side, side),
            self.samples,
            &|o, d| {
                let p = synthetic::hit_plane(pose, o, d)?;
                shade(p.x, p.y)
            },
        );
        let pixels = synthetic::expose(&picture, 640, (u0, v0, side, side), 0.6, noise_dn, rng);
        Image8::from_raw(640, 480, pixels).unwrap()
    }

    fn seen(&self, pose: &Isometry3<f64>, x: f64, y: f64) -> Vector2<f64> {
        let p = pose * Point3::new(x, y, 0.0);
        self.camera.project(&p.coords).unwrap()
    }
}

fn error(found: &Finding, truth: &Vector2<f64>) -> f64 {
    (found.u_px - truth.x).hypot(found.v_px - truth.y)
}

fn nearest<'a>(found: &'a [Finding], truth: &Vector2<f64>) -> &'a Finding {
    found
        .iter()
        .min_by(|a, b| error(a, truth).total_cmp(&error(b, truth)))
        .unwrap()
}

fn rms(errors: &[f64]) -> f64 {
    (errors.iter().map(|e| e * e).sum::<f64>() / (2 * errors.len()) as f64).sqrt()
}

#[test]
fn a_lone_disc_is_found_at_its_true_centre_and_not_at_its_ellipses() {
    let rig = Rig::new();
    let mut rng = synthetic::rng(1);
    let (mut corrected, mut plain, mut normalised) = (Vec::new(), Vec::new(), Vec::new());
    for case in 0..25 {
        let pose = rig.pose(&mut rng, 0.9);
        let radius = 0.018;
        let image = rig.image(&pose, 0.03, 1.0, &mut rng, &|x, y| {
            (x.abs().max(y.abs()) < 0.03).then(|| if x.hypot(y) < radius { 30.0 } else { 190.0 })
        });
        let truth = rig.seen(&pose, 0.0, 0.0);
        let window = near(&image, [truth.x + 9.0, truth.y - 7.0], 60.0).unwrap();
        let known = DiscTruth {
            camera: &rig.camera,
            normal: pose * Vector3::z(),
        };
        let rules = DiscRules::default();
        let found = disc(&image, window, &rules, Some(&known))
            .unwrap_or_else(|e| panic!("case {case}: {e}"));
        corrected.push(error(&found[0], &truth));
        normalised.push(error(&found[0], &truth) / found[0].sigma_px);
        plain.push(error(
            &disc(&image, window, &rules, None).unwrap()[0],
            &truth,
        ));
    }
    let (good, bad) = (rms(&corrected), rms(&plain));
    println!(
        "disc: {good:.4} px corrected, {bad:.4} px plain, {:.2} sigma",
        rms(&normalised)
    );
    assert!(good < 0.02, "{good}");
    assert!(bad > 3.0 * good, "{bad} {good}");
    assert!((0.4..2.5).contains(&rms(&normalised)));
}

#[test]
fn a_lone_saddle_is_found_to_two_hundredths_of_a_pixel() {
    // an edge along the pixels is as straight as the samples are fine, and the rules see a twentieth
    let rig = Rig {
        samples: 20,
        ..Rig::new()
    };
    let mut rng = synthetic::rng(2);
    for (noise, limit) in [(1.0, 0.02), (5.0, 0.05)] {
        let (mut errors, mut normalised) = (Vec::new(), Vec::new());
        for case in 0..25 {
            let pose = rig.pose(&mut rng, 0.8);
            let image = rig.image(&pose, 0.02, noise, &mut rng, &|x, y| {
                (x.abs().max(y.abs()) < 0.02).then_some(if x * y > 0.0 { 25.0 } else { 200.0 })
            });
            let truth = rig.seen(&pose, 0.0, 0.0);
            // only the drawn part of the image has the sensor's noise, by which the rules judge
            let window = near(&image, [truth.x + 4.0, truth.y - 3.0], 14.0).unwrap();
            let found = saddle(&image, window, &SaddleRules::default())
                .unwrap_or_else(|e| panic!("case {case}: {e}"));
            let best = nearest(&found, &truth);
            errors.push(error(best, &truth));
            normalised.push(error(best, &truth) / best.sigma_px);
        }
        println!(
            "saddle, noise {noise}: {:.4} px, {:.2} sigma",
            rms(&errors),
            rms(&normalised)
        );
        assert!(rms(&errors) < limit, "noise {noise}: {}", rms(&errors));
        // at 1 DN the renderer's own samples along the edges count more than the noise
        if noise > 2.0 {
            assert!((0.4..2.0).contains(&rms(&normalised)));
        }
    }
}

/// A picture of rock.
fn rock(side: u32, seed: u64) -> Image8 {
    let pixels = (0..side * side)
        .map(|i| {
            let (u, v) = (f64::from(i % side), f64::from(i / side));
            synthetic::texture(u, v, 40.0, 5.0, 30.0, seed).clamp(0.0, 255.0) as u8
        })
        .collect();
    Image8::from_raw(side, side, pixels).unwrap()
}

#[test]
fn a_warped_picture_is_found_where_the_plain_one_fails() {
    let rig = Rig::new();
    let mut rng = synthetic::rng(3);
    let (mut errors, mut plain_errors, mut plain_failures) = (Vec::new(), Vec::new(), 0);
    let picture = rock(120, 9);
    let (width_m, half) = (0.06, 0.03);
    for case in 0..15 {
        let mut pose = rig.pose(&mut rng, 0.8);
        if case % 3 == 0 {
            pose.rotation =
                synthetic::facing_pose(&rig.camera, rig.seen(&pose, 0.0, 0.0), 0.5, 0.2, 0.0, 0.1)
                    .rotation;
        }
        let image = rig.image(&pose, half, 1.5, &mut rng, &|x, y| {
            let (i, j) = (
                (x + half) / width_m * 120.0 - 0.5,
                (half - y) / width_m * 120.0 - 0.5,
            );
            (x.abs().max(y.abs()) < half).then(|| synthetic::texture(i, j, 40.0, 5.0, 30.0, 9))
        });
        let truth = rig.seen(&pose, 0.0, 0.0);
        let off = Isometry3::translation(0.004, -0.003, 0.002);
        let appearance = Appearance::Pose {
            camera: &rig.camera,
            camera_frame_from_picture: off * pose,
            width_m,
        };
        let rules = TemplateRules::default();
        let found = warped_template(&image, &picture, &appearance, 20.0, &rules)
            .unwrap_or_else(|e| panic!("case {case}: {e}"));
        errors.push(error(&found, &truth));
        match template(&image, &picture, Window::whole(&image), &rules) {
            Ok(found) => plain_errors.push(error(&found, &truth)),
            Err(_) => plain_failures += 1,
        }
    }
    println!(
        "warped: {:.4} px; plain: {plain_failures} refused, {plain_errors:?}",
        rms(&errors)
    );
    assert!(rms(&errors) < 0.05, "{}", rms(&errors));
    assert!(plain_failures >= 10);
}

#[test]
fn a_picture_cut_from_another_exposure_is_found_to_hundredths_of_a_pixel() {
    let mut rng = synthetic::rng(4);
    let mut errors = Vec::new();
    for case in 0..20u64 {
        let shift = Vector2::new(rng.random_range(-0.5..0.5), rng.random_range(-0.5..0.5));
        let place = Vector2::new(rng.random_range(60..250), rng.random_range(60..180));
        let at = |u: f64, v: f64| synthetic::texture(u, v, 32.0, 4.0, 25.0, case);
        let noisy = |x: f64, rng: &mut ChaCha8Rng| {
            (x + 2.0 * synthetic::normal(rng)).round().clamp(0.0, 255.0) as u8
        };
        let pixels = (0..320 * 240)
            .map(|i| noisy(at((i % 320) as f64, (i / 320) as f64), &mut rng))
            .collect();
        let image = Image8::from_raw(320, 240, pixels).unwrap();
        let corner = place.map(f64::from) + shift - Vector2::repeat(15.0);
        let pixels = (0..31 * 31)
            .map(|i| {
                let (u, v) = (corner.x + f64::from(i % 31), corner.y + f64::from(i / 31));
                noisy(20.0 + 0.8 * at(u, v), &mut rng)
            })
            .collect();
        let picture = Image8::from_raw(31, 31, pixels).unwrap();
        let truth = place.map(f64::from) + shift;
        let found = template(
            &image,
            &picture,
            Window::whole(&image),
            &TemplateRules::default(),
        )
        .unwrap();
        errors.push(error(&found, &truth));
    }
    println!("template: {:.4} px", rms(&errors));
    assert!(rms(&errors) < 0.04, "{}", rms(&errors));
}

#[test]
fn the_plate_is_found_in_the_whole_image_without_a_prediction() {
    let rig = Rig::new();
    let mut rng = synthetic::rng(5);
    let layout = PlateLayout::standard(0.08);
    let rules = DetectionRules::default();
    let (mut missed, mut worst) = (0, 0.0f64);
    for case in 0..15 {
        let pose = rig.pose(&mut rng, 0.85);
        let image = rig.image(&pose, 0.04, 2.0, &mut rng, &|x, y| {
            layout.albedo(x, y).map(|a| a * 210.0)
        });
        match plate(&image, &rig.camera, &layout, None, &rules) {
            Ok(found) => {
                let seen = found.pose.clone().unwrap();
                let off =
                    seen.camera_frame_from_fiducial.translation.vector - pose.translation.vector;
                worst = worst.max(off.norm());
                assert!(
                    error(&found, &rig.seen(&pose, 0.0, 0.0)) < 0.05,
                    "case {case}"
                );
                let turn = seen
                    .camera_frame_from_fiducial
                    .rotation
                    .angle_to(&pose.rotation);
                assert!(turn < 0.02, "case {case}: {turn} rad");
            }
            Err(e) => {
                println!("case {case}: {e}");
                missed += 1;
            }
        }
    }
    println!(
        "plate: {missed} missed, worst position {:.2} mm",
        worst * 1e3
    );
    assert!(missed <= 1 && worst < 2e-3);
}

#[test]
fn tags_of_every_family_are_read_with_their_pose() {
    let rig = Rig::new();
    let mut rng = synthetic::rng(6);
    for name in TAG_FAMILIES {
        let family = family(name).unwrap();
        let mut errors = Vec::new();
        for case in 0..8usize {
            let id = (case * 53 + 3) % family.codes.len();
            let word = family.codes[id];
            let pose = rig.pose(&mut rng, 0.7);
            let side = 0.05;
            let cell = side / family.cells as f64;
            let n = family.cells as f64;
            let image = rig.image(&pose, 0.06, 2.0, &mut rng, &|x, y| {
                // cells right and down from the border square's left upper corner
                let (i, j) = (x / cell + 0.5 * n, 0.5 * n - y / cell);
                let (ci, cj) = (i.floor() as i8, j.floor() as i8);
                let last = family.cells as i8 - 1;
                let bit = family.bits.iter().position(|b| *b == (ci, cj));
                let light = if let Some(bit) = bit {
                    word >> (family.bits.len() - 1 - bit) & 1 == 1
                } else if (0..=last).contains(&ci) && (0..=last).contains(&cj) {
                    family.light
                } else if family.light {
                    if !(-1..=last + 1).contains(&ci) || !(-1..=last + 1).contains(&cj) {
                        return None;
                    }
                    false
                } else if (-1..=last + 1).contains(&ci) && (-1..=last + 1).contains(&cj) {
                    true
                } else {
                    return None;
                };
                Some(if light { 205.0 } else { 25.0 })
            });
            let truth = rig.seen(&pose, 0.0, 0.0);
            let found = tags(
                &image,
                Window::whole(&image),
                name,
                Some((&rig.camera, side)),
                &TagRules::default(),
            )
            .unwrap_or_else(|e| panic!("{name} {case}: {e}"));
            assert_eq!(
                (found.len(), found[0].id),
                (1, Some(id as u32)),
                "{name} {case}"
            );
            errors.push(error(&found[0], &truth));
            let seen = found[0].pose.clone().unwrap();
            let off = seen.camera_frame_from_fiducial.translation.vector - pose.translation.vector;
            assert!(off.norm() < 4e-3, "{name} {case}: {} m", off.norm());
            let turn = seen
                .camera_frame_from_fiducial
                .rotation
                .angle_to(&pose.rotation);
            assert!(turn < 0.06, "{name} {case}: {turn} rad");
        }
        println!("{name}: {:.4} px", rms(&errors));
        assert!(rms(&errors) < 0.06, "{name}: {}", rms(&errors));
    }
}

#[test]
fn nothing_is_found_where_nothing_is() {
    let mut rng = synthetic::rng(7);
    let layout = PlateLayout::standard(0.08);
    let camera = synthetic::camera(0.04);
    let picture = rock(31, 77);
    for case in 0..150 {
        let contrast = rng.random_range(3.0..60.0);
        let finest = rng.random_range(1.0..16.0);
        let coarsest = rng.random_range(16.0..80.0);
        let binary = rng.random_bool(0.3);
        let pixels = (0..160 * 120)
            .map(|i| {
                let (u, v) = (f64::from(i % 160), f64::from(i / 160));
                let x = synthetic::texture(u, v, coarsest, finest, contrast, case);
                let x = if binary {
                    110.0 + (x - 110.0).clamp(-1.0, 1.0) * 80.0
                } else {
                    x
                };
                x.clamp(0.0, 255.0) as u8
            })
            .collect();
        let image = Image8::from_raw(160, 120, pixels).unwrap();
        let whole = Window::whole(&image);
        assert!(plate(&image, &camera, &layout, None, &DetectionRules::default()).is_err());
        assert!(template(&image, &picture, whole, &TemplateRules::default()).is_err());
        let read = tags(&image, whole, "tag36h11", None, &TagRules::default());
        assert!(read.is_err(), "case {case}: {read:?}");
    }
}

/// A blurred black ellipse on white, its outline moved by `bulge_px` cos 3 t; beside it a bar whose
/// edge is `gap_px` from the ellipse's.
fn outlined(axes: [f64; 2], bulge_px: f64, gap_px: f64) -> Image8 {
    let pixels = (0..64 * 64)
        .map(|i| {
            let sum: f64 = (0..64)
                .map(|k| {
                    let u = f64::from(i % 64) - 31.3 + (f64::from(k % 8) - 3.5) / 8.0;
                    let v = f64::from(i / 64) - 32.2 + (f64::from(k / 8) - 3.5) / 8.0;
                    let angle = (v / axes[1]).atan2(u / axes[0]);
                    let edge = (u / axes[0]).hypot(v / axes[1]) - 1.0;
                    let distance = edge * axes[0] - bulge_px * (3.0 * angle).cos();
                    let bar = u - axes[0] - gap_px;
                    let shade = |x: f64| 1.0 / (1.0 + (-2.2 * x).exp());
                    30.0 + 160.0 * shade(distance) * shade(-bar)
                })
                .sum();
            (sum / 64.0).round() as u8
        })
        .collect();
    Image8::from_raw(64, 64, pixels).unwrap()
}

#[test]
fn a_disc_is_round_large_enough_and_alone() {
    let rules = DiscRules::default();
    let found = |image: &Image8| disc(image, Window::whole(image), &rules, None);
    assert!(found(&outlined([8.0, 7.0], 0.0, 20.0)).is_ok());
    let bulging = found(&outlined([8.0, 7.0], 0.4, 20.0)).unwrap_err();
    assert!(["shape", "misfit"].contains(&bulging.rule()), "{bulging}");
    let small = found(&outlined([4.0, 3.9], 0.0, 20.0)).unwrap_err();
    assert_eq!(small.rule(), "too_small", "{small}");
    // clear of the fitted margin, within the quiet zone
    let crowded = found(&outlined([8.0, 7.0], 0.0, 4.4)).unwrap_err();
    assert!(crowded.to_string().contains("unevenness"), "{crowded}");
}

#[test]
fn refusals_name_their_rule() {
    let flat = Image8::from_raw(64, 64, vec![100; 64 * 64]).unwrap();
    let whole = Window::whole(&flat);
    let rule = |e: NoFinding| e.rule();
    assert_eq!(
        rule(disc(&flat, whole, &DiscRules::default(), None).unwrap_err()),
        "nothing_there"
    );
    assert_eq!(
        rule(saddle(&flat, whole, &SaddleRules::default()).unwrap_err()),
        "nothing_there"
    );
    assert_eq!(
        rule(harris(&flat, whole, &HarrisRules::default()).unwrap_err()),
        "nothing_there"
    );
    let small = rock(15, 1);
    let rules = TemplateRules::default();
    assert_eq!(
        rule(template(&flat, &small, whole, &rules).unwrap_err()),
        "low_score"
    );
    assert_eq!(
        rule(template(&small, &flat, whole, &rules).unwrap_err()),
        "bad_input"
    );
    let e = tags(&flat, whole, "tag99", None, &TagRules::default()).unwrap_err();
    assert!(
        e.is_bad_input() && e.to_string().contains("tag36h11"),
        "{e}"
    );
    assert_eq!(
        rule(near(&flat, [900.0, 3.0], 5.0).unwrap_err()),
        "bad_input"
    );
    assert_eq!(
        rule(near(&flat, [f64::NAN, 3.0], 5.0).unwrap_err()),
        "bad_input"
    );
    // a repeated picture is not unique
    let mut pixels = vec![100u8; 200 * 64];
    for (k, left) in [10usize, 110].into_iter().enumerate() {
        for i in 0..31 * 31usize {
            pixels[(i / 31 + 16) * 200 + left + i % 31] =
                rock(31, 3).pixels[i].saturating_add(k as u8);
        }
    }
    let twice = Image8::from_raw(200, 64, pixels).unwrap();
    let e = template(&twice, &rock(31, 3), Window::whole(&twice), &rules).unwrap_err();
    assert_eq!(e.rule(), "not_unique", "{e}");
}
