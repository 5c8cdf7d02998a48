#![allow(clippy::unwrap_used, clippy::expect_used)]
//! Rectification and dense disparity on rendered planes, against the cameras' own geometry.

use nalgebra::{Isometry3, Vector2, Vector3};
use rover_cameras::Side;

use super::*;
use crate::stereo::*;
use crate::synthetic::{self, Rays};

/// Both images of a textured plane, through the distorted test cameras.
fn plane_images(pose: &Isometry3<f64>, noise_dn: f64, seed: u64) -> [Image8; 2] {
    let pair = synthetic::pair();
    let mut rng = synthetic::rng(seed);
    [&pair.left, &pair.right].map(|camera| {
        let mut picture = vec![110.0; 640 * 480];
        let whole = (0, 0, 640, 480);
        synthetic::draw(&mut picture, &Rays::new(camera), whole, 2, &|o, d| {
            let p = synthetic::hit_plane(pose, o, d)?;
            Some(synthetic::texture(p.x, p.y, 0.064, 0.0015, 18.0, seed))
        });
        let pixels = synthetic::expose(&picture, 640, whole, 0.6, noise_dn, &mut rng);
        Image8::from_raw(640, 480, pixels).unwrap()
    })
}

#[test]
fn a_point_lies_on_the_same_row_of_both_rectified_images() {
    let pair = synthetic::pair();
    let rectifier = Rectifier::new(&pair, 30.0).unwrap();
    for (u, v, range) in [(60.0, 40.0, 0.5), (320.0, 240.0, 0.7), (600.0, 440.0, 2.0)] {
        let point = pair.left.ray(&Vector2::new(u, v)).unwrap().at(range);
        let left = rectifier.pair.left.project(&point).unwrap();
        let right = rectifier.pair.right.project(&point).unwrap();
        assert!((left.y - right.y).abs() < 1e-9, "{left} {right}");
        assert!(left.x - right.x > -30.0);
    }
    assert!(matches!(
        Rectifier::new(
            &rover_cameras::StereoPair {
                left: pair.left.clone(),
                right: pair.left.clone()
            },
            0.0
        ),
        Err(RectifyError::Geometry(_))
    ));
}

#[test]
fn a_slanted_plane_gets_dense_disparities_to_a_tenth_of_a_pixel() {
    let pair = synthetic::pair();
    for (case, tilt) in [0.0, 0.4, 0.8].into_iter().enumerate() {
        let pixel = Vector2::new(340.0, 240.0);
        let pose = synthetic::facing_pose(&pair.left, pixel, 0.75, tilt, 0.3, 0.0);
        let images = plane_images(&pose, 1.5, case as u64);
        let rectifier = Rectifier::new(&pair, 34.0).unwrap();
        let left = rectifier.apply(&images[0], Side::Left).unwrap();
        let right = rectifier.apply(&images[1], Side::Right).unwrap();
        let found = dense_disparity(&left, &right, &DenseRules::default()).unwrap();
        let normal = pose * Vector3::z();
        let (mut square, mut n, mut gross, mut possible) = (0.0, 0.0, 0, 0);
        for v in (20..460).step_by(3) {
            for u in (110..600).step_by(3) {
                let at = Vector2::new(f64::from(u), f64::from(v));
                let ray = rectifier.pair.left.ray(&at).unwrap();
                let d = ray.direction.into_inner();
                let range = normal.dot(&(pose.translation.vector - ray.origin)) / normal.dot(&d);
                let Ok(seen) = rectifier.pair.right.project(&ray.at(range)) else {
                    continue;
                };
                let truth = at.x - seen.x;
                if !(3.0..60.0).contains(&truth) || left.get(u, v) == Some(0) {
                    continue;
                }
                possible += 1;
                let Some(disparity) = found.at(u, v) else {
                    continue;
                };
                let e = disparity - truth;
                if e.abs() > 1.0 {
                    gross += 1;
                } else {
                    square += e * e;
                    n += 1.0;
                }
            }
        }
        let rms = f64::sqrt(square / n);
        let share = n / f64::from(possible);
        println!("tilt {tilt}: rms {rms:.3} px, {share:.3} of {possible}, {gross} gross");
        assert!(rms < 0.12, "tilt {tilt}: {rms} px");
        assert!(share > 0.8, "tilt {tilt}: {share}");
        assert!(f64::from(gross) < 0.005 * n, "tilt {tilt}: {gross}");
    }
}

#[test]
fn nothing_is_claimed_without_texture_or_for_unrelated_images() {
    let flat = Image8::from_raw(200, 60, vec![120; 200 * 60]).unwrap();
    let rules = DenseRules::default();
    assert_eq!(dense_disparity(&flat, &flat, &rules).unwrap().count(), 0);
    let noise = |seed: u64| {
        use rand::Rng;
        let mut rng = synthetic::rng(seed);
        let pixels = (0..200 * 60).map(|_| rng.random()).collect();
        Image8::from_raw(200, 60, pixels).unwrap()
    };
    let found = dense_disparity(&noise(1), &noise(2), &rules).unwrap();
    assert!(found.count() < 200 * 60 / 100, "{}", found.count());
    let small = Image8::from_raw(50, 60, vec![0; 3000]).unwrap();
    assert!(matches!(
        dense_disparity(&flat, &small, &rules),
        Err(DenseError::Sizes { .. })
    ));
    let bad = DenseRules {
        half_window_px: 9,
        ..rules
    };
    let text = dense_disparity(&flat, &flat, &bad).unwrap_err().to_string();
    assert!(
        text.contains("half_window_px") && text.contains('9'),
        "{text}"
    );
}

#[test]
fn what_repeats_itself_has_no_disparity() {
    let stripes = |shift: u32| {
        let grey = |u: u32| [40, 90, 200, 160, 70][((u + shift) / 4 % 5) as usize];
        let pixels = (0..240 * 60).map(|i| grey(i % 240)).collect();
        Image8::from_raw(240, 60, pixels).unwrap()
    };
    for uniqueness_percent in [0, 8] {
        let rules = DenseRules {
            uniqueness_percent,
            ..DenseRules::default()
        };
        let found = dense_disparity(&stripes(0), &stripes(6), &rules).unwrap();
        // right of column 64 a whole period or more is searched
        let wrong = (0..60).flat_map(|v| (70..240).map(move |u| (u, v)));
        assert_eq!(wrong.filter(|&(u, v)| found.at(u, v).is_some()).count(), 0);
    }
}

#[test]
fn a_plane_needs_a_quarter_of_its_window() {
    let (w, h, half) = (7, 7, 3);
    // one disparity off the plane in the middle, and so many pairs on the plane
    let smoothed = |pairs: usize| {
        let mut held = vec![NONE; w * h];
        held[24] = 640 + 30;
        for k in 0..pairs {
            held[k] = 640;
            held[48 - k] = 640;
        }
        let mut disparity = Disparity {
            width_px: w as u32,
            height_px: h as u32,
            held,
        };
        smoothing::smooth(&mut disparity, half, 96);
        disparity.held[24]
    };
    assert_eq!(smoothed(5), 670);
    assert_eq!(smoothed(6), 640 + 2); // 30 / 13
}

/// The same rules pixel by pixel, every window summed anew.
fn brute_force(left: &Image8, right: &Image8, rules: &DenseRules, u: i64, v: i64) -> Option<f64> {
    let slope = |image: &Image8, u: i64, v: i64| {
        let (w, h) = (i64::from(image.width_px), i64::from(image.height_px));
        if u < 1 || v < 1 || u >= w - 1 || v >= h - 1 {
            return 0;
        }
        let grey =
            |du: i64, dv: i64| i32::from(image.get((u + du) as u32, (v + dv) as u32).unwrap());
        let step = |dv| grey(1, dv) - grey(-1, dv);
        ((step(-1) + 2 * step(0) + step(1)) >> 1).clamp(-31, 31)
    };
    let half = i64::from(rules.half_window_px);
    let around = |u: i64, v: i64| {
        (v - half..=v + half).flat_map(move |y| (u - half..=u + half).map(move |x| (x, y)))
    };
    let sum = |u: i64, d: i64| -> i32 {
        around(u, v)
            .map(|(x, y)| (slope(left, x, y) - slope(right, x - d, y)).abs())
            .sum()
    };
    let texture: i32 = around(u, v).map(|(x, y)| slope(left, x, y).abs()).sum();
    let side = 2 * half + 1;
    if i64::from(texture) < i64::from(rules.min_texture_dn) * side * side {
        return None;
    }
    let most = i64::from(rules.disparities);
    let best = (0..most).min_by_key(|&d| (sum(u, d), d)).unwrap();
    let least = sum(u, best);
    let second = (0..most)
        .filter(|d| (d - best).abs() > 1)
        .map(|d| sum(u, d))
        .min()
        .unwrap();
    let unique = second > least && second * 100 >= least * (100 + rules.uniqueness_percent as i32);
    let back = (0..most)
        .filter(|d| u - best + d < i64::from(left.width_px) - half)
        .min_by_key(|&d| (sum(u - best + d, d), d))
        .unwrap();
    let (before, after) = (sum(u, best - 1), sum(u, best + 1));
    let steep = before.max(after) - least;
    let fine = best > 0 && best + 1 < most && steep > 0;
    (unique && fine && (back - best).abs() <= i64::from(rules.left_right_px))
        .then(|| (best * 64 + i64::from((before - after) * 64 / (2 * steep))) as f64 / 64.0)
}

#[test]
fn sums_that_are_carried_along_find_what_a_plain_search_finds() {
    let pixel = Vector2::new(340.0, 240.0);
    let pair = synthetic::pair();
    let pose = synthetic::facing_pose(&pair.left, pixel, 0.75, 0.6, 0.3, 0.0);
    let images = plane_images(&pose, 4.0, 7);
    let rectifier = Rectifier::new(&pair, 50.0).unwrap();
    let cut = |image: &Image8| {
        let rows = (150..190).flat_map(|v| (300..460).map(move |u| (u, v)));
        let pixels = rows.map(|(u, v)| image.get(u, v).unwrap()).collect();
        Image8::from_raw(160, 40, pixels).unwrap()
    };
    let left = cut(&rectifier.apply(&images[0], Side::Left).unwrap());
    let right = cut(&rectifier.apply(&images[1], Side::Right).unwrap());
    let (mut with, mut without) = (0, 0);
    for (disparities, half_window_px) in [(16, 3), (21, 4), (64, 5)] {
        let rules = DenseRules {
            disparities,
            half_window_px,
            half_plane_px: 0,
            min_region_px: 0,
            ..DenseRules::default()
        };
        let found = dense_disparity(&left, &right, &rules).unwrap();
        for v in (half_window_px..40 - half_window_px).step_by(3) {
            for u in (disparities + half_window_px..160 - half_window_px).step_by(3) {
                let plain = brute_force(&left, &right, &rules, i64::from(u), i64::from(v));
                assert_eq!(found.at(u, v), plain, "{disparities} at {u}, {v}");
                *(if plain.is_some() {
                    &mut with
                } else {
                    &mut without
                }) += 1;
            }
        }
    }
    assert!(with > 500 && without > 300, "{with} {without}");
}

#[test]
fn small_regions_go_and_large_ones_stay_whatever_their_shape() {
    // a comb: its teeth meet only in the last row; and beside it a lone tooth
    let (w, h) = (12, 6);
    let mut held = vec![NONE; w * h];
    for v in 0..h {
        for u in (0..9).step_by(2) {
            held[v * w + u] = 640;
        }
        held[v * w + 11] = 640;
    }
    for u in 0..9 {
        held[(h - 1) * w + u] = 640;
    }
    // a step of more than a pixel parts a region
    held[(h - 2) * w] = 640 + 65;
    held[(h - 2) * w + 2] = 640 + 64;
    let kept = |least: usize| {
        let mut disparity = Disparity {
            width_px: w as u32,
            height_px: h as u32,
            held: held.clone(),
        };
        regions::drop_small(&mut disparity, least);
        let alone = disparity.at(11, 0).is_some();
        [disparity.count(), usize::from(alone)]
    };
    // 5 teeth of 6 and 4 between; less the parted pixel and the 4 above it
    assert_eq!(kept(2), [34 - 1 + 6, 1]);
    assert_eq!(kept(6), [34 - 5 + 6, 1]);
    assert_eq!(kept(7), [34 - 5, 0]);
    assert_eq!(kept(29), [29, 0]);
    assert_eq!(kept(30), [0, 0]);
}
