#![allow(clippy::unwrap_used, clippy::expect_used)]
use super::dots::*;
use super::*;
use crate::image::Image8;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn noise(width: u32, height: u32, seed: u64) -> Image8 {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let pixels = (0..width * height).map(|_| rng.random()).collect();
    Image8::from_raw(width, height, pixels).unwrap()
}

fn smooth(width: u32, height: u32, seed: u64) -> Image8 {
    let blurred = crate::image::ImageF::from_image8(&noise(width, height, seed))
        .unwrap()
        .blurred(2.0);
    let values = blurred
        .values()
        .iter()
        .map(|x| (x - 127.5) * 6.0 + 127.5)
        .collect();
    crate::image::ImageF::from_raw(width, height, values)
        .unwrap()
        .to_image8()
}

/// The definition, in f64.
fn reference(image: &Image8, x: usize, y: usize, w: usize, t: &[f32], mask: &[bool]) -> f64 {
    let pairs: Vec<(f64, f64)> = (0..t.len())
        .filter(|&i| mask[i])
        .map(|i| {
            let p = image.get((x + i % w) as u32, (y + i / w) as u32).unwrap();
            (f64::from(p), f64::from(t[i]))
        })
        .collect();
    let n = pairs.len() as f64;
    let (ma, mb) = (
        pairs.iter().map(|p| p.0).sum::<f64>() / n,
        pairs.iter().map(|p| p.1).sum::<f64>() / n,
    );
    let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
    for (a, b) in pairs {
        ab += (a - ma) * (b - mb);
        aa += (a - ma).powi(2);
        bb += (b - mb).powi(2);
    }
    ab / (aa * bb).sqrt()
}

#[test]
fn scores_equal_the_definition_with_and_without_a_mask() {
    let image = noise(50, 40, 1);
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let (w, h) = (13, 9);
    let values: Vec<f32> = (0..w * h).map(|_| rng.random_range(0.0..200.0)).collect();
    for masked in [false, true] {
        let mask: Vec<bool> = (0..w * h)
            .map(|_| !masked || rng.random_bool(0.6))
            .collect();
        let template = Template::new(w, h, &values, Some(&mask)).unwrap();
        let search = SearchImage::whole(&image, 0);
        let map = score_map(&search, &template, 3, 2, 100, 100).unwrap();
        assert_eq!((map.left, map.top, map.width, map.height), (3, 2, 35, 30));
        for j in 0..map.height {
            for i in 0..map.width {
                let expected = reference(&image, 3 + i, 2 + j, w, &values, &mask);
                let got = f64::from(map.at(i, j));
                assert!((got - expected).abs() < 2e-4, "{i} {j}: {got} {expected}");
            }
        }
    }
}

#[test]
fn a_masked_template_scores_the_same_at_few_positions_and_at_many() {
    let image = noise(60, 50, 5);
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let search = SearchImage::whole(&image, 0);
    for (w, h) in [(5, 7), (16, 9), (21, 22)] {
        let values: Vec<f32> = (0..w * h).map(|_| rng.random_range(-1.0..0.0)).collect();
        let mask: Vec<bool> = (0..w * h).map(|_| rng.random_bool(0.7)).collect();
        let template = Template::new(w, h, &values, Some(&mask)).unwrap();
        let many = score_map(&search, &template, 0, 0, 100, 100).unwrap();
        assert!(many.width > 12);
        for (left, top) in [(0, 0), (3, 4), (many.width - 3, many.height - 3)] {
            let few = score_map(&search, &template, left, top, 3, 3).unwrap();
            for (i, j) in (0..9).map(|k| (k % 3, k / 3)) {
                assert_eq!(
                    few.at(i, j),
                    many.at(left + i, top + j),
                    "{w} {left} {i} {j}"
                );
            }
        }
    }
}

#[test]
fn reduced_search_images_hold_means() {
    let image = noise(37, 29, 3);
    for level in 1..=3u32 {
        let reduced = SearchImage::new(&image, 2, 3, 30, 20, level);
        let step = 1u32 << level;
        assert_eq!(reduced.width(), 30 >> level);
        for y in 0..reduced.height() {
            for x in 0..reduced.width() {
                let mut sum = 0.0;
                for k in 0..step * step {
                    let u = 2 + x as u32 * step + k % step;
                    let v = 3 + y as u32 * step + k / step;
                    sum += f64::from(image.get(u, v).unwrap());
                }
                let mean = sum / f64::from(step * step);
                let held = f64::from(i32::from(reduced.row(y)[x]) + OFFSET) / 8.0;
                assert!((held - mean).abs() <= 0.126, "{held} {mean}");
            }
        }
    }
}

#[test]
fn a_cut_out_is_found_where_it_was_through_the_pyramid() {
    let image = smooth(320, 240, 4);
    for (left, top) in [(0u32, 0u32), (101, 57), (200, 150), (289, 209), (33, 180)] {
        let values: Vec<f32> = (0..31 * 31)
            .map(|i| f32::from(image.get(left + i % 31, top + i / 31).unwrap()))
            .collect();
        for levels in 1..=3 {
            let template = TemplatePyramid::new(31, 31, &values, None, levels).unwrap();
            let peak = search(&image, &template, Window::whole(&image)).unwrap();
            assert!(
                (peak.u_px - f64::from(left + 15)).abs() < 0.2,
                "{peak:?} {left} {top}"
            );
            assert!(
                (peak.v_px - f64::from(top + 15)).abs() < 0.2,
                "{peak:?} {left} {top}"
            );
            assert!(peak.score > 0.999);
        }
    }
}

#[test]
fn gain_and_offset_do_not_matter_and_flat_areas_score_zero() {
    let image = smooth(64, 64, 5);
    let values: Vec<f32> = (0..15 * 15)
        .map(|i| 3.0 + 0.01 * f32::from(image.get(20 + i % 15, 30 + i / 15).unwrap()))
        .collect();
    let template = Template::new(15, 15, &values, None).unwrap();
    let map = score_map(&SearchImage::whole(&image, 0), &template, 20, 30, 1, 1).unwrap();
    assert!(map.at(0, 0) > 0.9995);
    let flat = Image8::from_raw(64, 64, vec![90; 64 * 64]).unwrap();
    let map = score_map(&SearchImage::whole(&flat, 0), &template, 0, 0, 64, 64).unwrap();
    assert!(map.scores.iter().all(|&s| s == 0.0));
}

#[test]
fn vector_units_give_the_same_sums() {
    let image = SearchImage::whole(&noise(90, 60, 6), 0);
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    for width in [3usize, 8, 13, 16, 20, 31, 40] {
        let values: Vec<f32> = (0..width * 11)
            .map(|_| rng.random_range(0.0..9.0))
            .collect();
        let template = Template::new(width, 11, &values, None).unwrap();
        let count = image.width() + 1 - width;
        let (mut fast, mut plain) = (vec![0; count], vec![0; count]);
        dots(&template, &image, 0, 5, &mut fast);
        dots_plain(&template, &image, 5 * image.stride, &mut plain);
        assert_eq!(fast, plain);
        #[cfg(target_arch = "x86_64")]
        {
            // SAFETY: `dots` has just checked the same positions.
            unsafe { dots_sse2(&template, &image, 5 * image.stride, &mut fast) };
            assert_eq!(fast, plain);
            if width <= LANES {
                fast.fill(0);
                // SAFETY: as above, and there are more positions than a step has.
                unsafe {
                    narrow::dots_sse2(&template, &image, 5 * image.stride, &mut fast);
                }
                assert_eq!(fast, plain);
            }
        }
    }
}

#[test]
fn short_and_long_sums_give_the_same_scores_to_the_last_bit() {
    let image = SearchImage::whole(&noise(120, 90, 8), 0);
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    for (width, height) in [(7usize, 7usize), (15, 15), (31, 31), (3, 40), (40, 3)] {
        let values: Vec<f32> = (0..width * height)
            .map(|_| rng.random_range(0.0..9.0))
            .collect();
        let template = Template::new(width, height, &values, None).unwrap();
        assert!(small::is_small(&template));
        // with a mask that hides nothing but is told as runs of pixels, the sums are 64 bits long
        let mut long = template.clone();
        long.rectangular = false;
        long.spans = (0..height)
            .map(|row| template::Span {
                row,
                start: 0,
                end: width,
            })
            .collect();
        assert!(!small::is_small(&long));
        for (left, top, columns, rows) in [(0, 0, 200, 200), (5, 9, 9, 4), (60, 30, 17, 3)] {
            let [a, b] =
                [&template, &long].map(|t| score_map(&image, t, left, top, columns, rows).unwrap());
            assert_eq!(
                a.scores.iter().map(|s| s.to_bits()).collect::<Vec<_>>(),
                b.scores.iter().map(|s| s.to_bits()).collect::<Vec<_>>()
            );
        }
    }
}

#[test]
fn unusable_templates_are_refused() {
    assert!(matches!(
        Template::new(3, 3, &[0.0; 8], None),
        Err(TemplateError::WrongLength { .. })
    ));
    assert!(matches!(
        Template::new(3, 3, &[7.0; 9], None),
        Err(TemplateError::NoContrast(_))
    ));
    let mask = [true, false, false, false, false, false, false, false, false];
    assert!(matches!(
        Template::new(3, 3, &[1.0; 9], Some(&mask)),
        Err(TemplateError::BadCount { found: 1, .. })
    ));
    let values = [1.0, f32::NAN, 2.0, 3.0];
    assert!(matches!(
        Template::new(2, 2, &values, None),
        Err(TemplateError::NoContrast(_))
    ));
}

#[test]
fn the_quadratic_peak_is_exact_for_a_quadratic() {
    let f = |x: f64, y: f64| {
        let (a, b) = (x - 0.3, y + 0.2);
        5.0 - 2.0 * a * a - 1.5 * b * b + 0.7 * a * b
    };
    let mut block = [[0.0; 3]; 3];
    for (y, row) in block.iter_mut().enumerate() {
        for (x, cell) in row.iter_mut().enumerate() {
            *cell = f(x as f64 - 1.0, y as f64 - 1.0);
        }
    }
    let (du, dv) = quadratic_peak(&block).unwrap();
    assert!((du - 0.3).abs() < 1e-12 && (dv + 0.2).abs() < 1e-12);
    assert!(quadratic_peak(&[[1.0; 3]; 3]).is_none());
}
