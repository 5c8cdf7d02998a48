//! Where the instrument touched, seen along the surface normal.

use rover_messages::simulation::Score;
use std::{f64::consts::FRAC_1_SQRT_2, fmt::Write};

const SIZE: f64 = 320.0;
const MIDDLE: f64 = SIZE / 2.0;
const RADIUS: f64 = 128.0;

/// The contact relative to the true point at the designated pixel, with the circle that was
/// predicted to hold it in 95 % of cases; nothing without contact.
pub(super) fn bullseye(score: &Score, predicted_mm: Option<f64>) -> Option<String> {
    let contact = score.contact_in_world_m?;
    let n = score.normal_in_world;
    let offset_mm = [0, 1, 2].map(|i| (contact[i] - score.target_in_world_m[i]) * 1e3);
    // x of the world, laid into the surface; y completes it.
    let along = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let x = unit([1.0 - n[0] * n[0], -n[1] * n[0], -n[2] * n[0]])?;
    let y = [
        n[1] * x[2] - n[2] * x[1],
        n[2] * x[0] - n[0] * x[2],
        n[0] * x[1] - n[1] * x[0],
    ];
    let (dx, dy) = (along(offset_mm, x), along(offset_mm, y));
    let reach = (dx.hypot(dy) * 1.25)
        .max(predicted_mm.unwrap_or(0.0) * 1.15)
        .max(0.1);
    let ring = nice(reach / 3.0);
    let scale = RADIUS / (3.0 * ring).max(reach);
    let mut out = format!("<svg class=\"bullseye\" viewBox=\"0 0 {SIZE} {SIZE}\" role=\"img\">");
    for i in 1..=3 {
        let r = f64::from(i) * ring * scale;
        if r > RADIUS * 1.02 {
            break;
        }
        let _ = write!(
            out,
            "<circle cx=\"{MIDDLE}\" cy=\"{MIDDLE}\" r=\"{r:.1}\" fill=\"none\" class=\"grid zero\"/>\
             <text x=\"{:.1}\" y=\"{:.1}\">{}</text>",
            MIDDLE + FRAC_1_SQRT_2 * r + 3.0,
            MIDDLE + FRAC_1_SQRT_2 * r + 10.0,
            mm(f64::from(i) * ring),
        );
    }
    if let Some(predicted) = predicted_mm {
        let _ = write!(
            out,
            "<circle cx=\"{MIDDLE}\" cy=\"{MIDDLE}\" r=\"{:.1}\" fill=\"#aa4499\" \
             fill-opacity=\".10\" stroke=\"#aa4499\" stroke-width=\"1.5\" \
             stroke-dasharray=\"5 4\"/>",
            predicted * scale
        );
    }
    let (u, v) = (MIDDLE - dy * scale, MIDDLE - dx * scale);
    let _ = write!(
        out,
        "<path d=\"M{MIDDLE} {0}v16M{1} {MIDDLE}h16\" stroke=\"#d55e00\" stroke-width=\"2\"/>\
         <line x1=\"{MIDDLE}\" y1=\"{MIDDLE}\" x2=\"{u:.1}\" y2=\"{v:.1}\" stroke=\"#0072b2\" \
         stroke-width=\"1.5\"/><circle cx=\"{u:.1}\" cy=\"{v:.1}\" r=\"5\" fill=\"#0072b2\"/>\
         <text x=\"{MIDDLE}\" y=\"12\" text-anchor=\"middle\">x</text>\
         <text x=\"4\" y=\"{2}\">y</text></svg>",
        MIDDLE - 8.0,
        MIDDLE - 8.0,
        MIDDLE + 4.0,
    );
    Some(out)
}

fn unit(v: [f64; 3]) -> Option<[f64; 3]> {
    let norm = v.iter().map(|x| x * x).sum::<f64>().sqrt();
    (norm > 1e-6).then(|| v.map(|x| x / norm))
}

/// The next larger of 1, 2, 5 times a power of ten.
fn nice(x: f64) -> f64 {
    let magnitude = 10f64.powf(x.log10().floor());
    let factor = [1.0, 2.0, 5.0]
        .into_iter()
        .find(|f| f * magnitude >= x)
        .unwrap_or(10.0);
    factor * magnitude
}

fn mm(x: f64) -> String {
    let digits = if x >= 1.0 {
        0
    } else if x >= 0.1 {
        1
    } else {
        2
    };
    format!("{x:.digits$} mm")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn score(contact_in_world_m: Option<[f64; 3]>) -> Score {
        Score {
            believed_in_world_m: [0.0; 3],
            target_in_world_m: [0.5, 0.0, 0.4],
            normal_in_world: [0.0, 0.0, 1.0],
            contact_in_world_m,
            lateral_error_mm: None,
            range_error_mm: None,
            axis_error_deg: None,
            open_loop_lateral_error_mm: None,
            arm_model_error_mm: 1.0,
            target_error_mm: 0.1,
        }
    }

    #[test]
    fn a_contact_further_along_x_is_drawn_above_the_middle() {
        let svg = bullseye(&score(Some([0.501, 0.0, 0.4])), Some(0.5)).unwrap();
        assert!(svg.contains("cx=\"160.0\" cy=\""), "{svg}");
        let dot = svg.rsplit("<circle cx=\"160.0\" cy=\"").next().unwrap();
        let v: f64 = dot.split('"').next().unwrap().parse().unwrap();
        assert!(v < MIDDLE - 50.0, "{v}");
    }

    #[test]
    fn without_contact_there_is_nothing_to_draw() {
        assert!(bullseye(&score(None), None).is_none());
    }
}
