//! The crossing's model against a numerical convolution and its own differences; what only looks
//! like a crossing is refused.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use super::*;
use crate::synthetic;

/// Edges that meet at an angle of about 66 degrees.
fn crossing() -> Crossing {
    Crossing {
        normals: [[0.8, 0.6], [-0.28, 0.96]],
        window_px: 8.0,
        max_blur_px: 2.0,
    }
}

const AT: [f64; 5] = [20.3, 19.6, 0.04, -0.03, 0.9];

#[test]
fn the_model_is_the_blurred_crossing_at_any_angle() {
    let model = crossing();
    let (a, b) = (model.turned(0, AT[2]), model.turned(1, AT[3]));
    let blur = AT[4];
    for (u, v) in [(20.0, 19.0), (20.3, 19.6), (21.0, 20.0), (19.0, 21.0)] {
        let (mut sum, mut weights) = (0.0, 0.0);
        for k in 0..401 * 401 {
            let part = |k: i32| f64::from(k - 200) / 200.0 * 5.0;
            let (x, y) = (part(k % 401), part(k / 401));
            let weight = (-0.5 * (x * x + y * y)).exp();
            let (du, dv) = (u - AT[0] + blur * x, v - AT[1] + blur * y);
            let sign = (a[0] * du + a[1] * dv).signum() * (b[0] * du + b[1] * dv).signum();
            sum += weight * sign;
            weights += weight;
        }
        let (value, _) = model.at(&model.shared(&AT), u, v, &mut [0.0; 5]);
        let expected = sum / weights;
        assert!(
            (value - expected).abs() < 5e-3,
            "({u}, {v}): {value} {expected}"
        );
    }
}

#[test]
fn the_models_slopes_are_its_differences() {
    let model = crossing();
    for k in 0..81 {
        let (u, v) = (16.0 + f64::from(k % 9), 16.0 + f64::from(k / 9));
        let mut slopes = [0.0; 5];
        model.at(&model.shared(&AT), u, v, &mut slopes);
        for (i, slope) in slopes.iter().enumerate() {
            let moved = |h: f64| {
                let mut p = AT;
                p[i] += h;
                model.at(&model.shared(&p), u, v, &mut [0.0; 5]).0
            };
            // the model grows by p where the image would: its slopes are those of the parameters
            let difference = (moved(0.01) - moved(-0.01)) / 0.02;
            let error = (slope - difference).abs();
            assert!(error < 0.02, "{i} at ({u}, {v}): {slope} {difference}");
        }
    }
}

/// Dark where x y > `gap`^2 / 2, the axes turned by 0.3 rad: with a gap the dark quadrants keep
/// `gap` px from the crossing, as those of thresholded texture do.
fn picture(gap_px: f64, contrast_dn: f64, noise_dn: f64) -> Image8 {
    let (s, c) = 0.3f64.sin_cos();
    let side = 64;
    let picture: Vec<f64> = (0..side * side)
        .map(|i| {
            let dark = (0..225)
                .filter(|k| {
                    let part = |k: usize| (k as f64 + 0.5) / 15.0 - 0.5;
                    let du = (i % side) as f64 + part(k % 15) - 31.7;
                    let dv = (i / side) as f64 + part(k / 15) - 32.2;
                    (c * du - s * dv) * (s * du + c * dv) > 0.5 * gap_px * gap_px
                })
                .count();
            180.0 - contrast_dn * dark as f64 / 225.0
        })
        .collect();
    let mut rng = synthetic::rng(3);
    let whole = (0, 0, side, side);
    let pixels = synthetic::expose(&picture, side, whole, 0.7, noise_dn, &mut rng);
    Image8::from_raw(side as u32, side as u32, pixels).unwrap()
}

#[test]
fn patches_that_meet_with_a_gap_are_no_crossing() {
    let find = |image: &Image8| saddle(image, Window::whole(image), &SaddleRules::default());
    for noise_dn in [1.0, 5.0] {
        let found = find(&picture(0.0, 150.0, noise_dn)).unwrap();
        assert!((found[0].u_px - 31.7).hypot(found[0].v_px - 32.2) < 0.05);
        let refusal = find(&picture(2.0, 150.0, noise_dn)).unwrap_err().rule();
        assert!(["shape", "misfit"].contains(&refusal), "{refusal}");
    }
}

#[test]
fn a_crossing_must_stand_out_from_the_noise() {
    let rules = SaddleRules::default();
    let find = |image: &Image8| saddle(image, Window::whole(image), &rules);
    assert!(find(&picture(0.0, 45.0, 1.0)).is_ok());
    let refusal = find(&picture(0.0, 45.0, 5.0)).unwrap_err();
    match refusal {
        NoFinding::LowContrast { needed_dn, .. } => {
            assert!((80.0..95.0).contains(&needed_dn), "{needed_dn}");
        }
        other => panic!("{other}"),
    }
}
