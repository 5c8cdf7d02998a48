//! Saddle points of the smoothed image that a ring around them confirms.

use crate::image::ImageF;
use crate::sample::bilinear;
use nalgebra::Vector2;
use std::f64::consts::TAU;

/// Least saddle strength, as a fraction of the strongest.
const RELATIVE: f32 = 0.01;
/// Least saddle strength, (DN/px^2)^2: below it is noise.
const ABSOLUTE: f32 = 0.3;
/// Radii of the ring that are tried, px.
const RADII_PX: [f64; 3] = [4.0, 5.5, 7.5];
const RING: usize = 32;
/// Least swing of the ring, DN.
const MIN_SWING: f32 = 8.0;

/// Saddle points, strongest first, at most `most`.
pub(super) fn saddles(smooth: &ImageF, most: usize) -> Vec<Vector2<f64>> {
    let (w, h) = (smooth.width(), smooth.height());
    if w < 8 || h < 8 {
        return Vec::new();
    }
    let mut strength = vec![0.0_f32; w * h];
    for v in 1..h - 1 {
        let (up, here, down) = (smooth.row(v - 1), smooth.row(v), smooth.row(v + 1));
        for u in 1..w - 1 {
            let uu = here[u + 1] - 2.0 * here[u] + here[u - 1];
            let vv = down[u] - 2.0 * here[u] + up[u];
            let uv = 0.25 * (down[u + 1] - down[u - 1] - up[u + 1] + up[u - 1]);
            strength[v * w + u] = uv * uv - uu * vv;
        }
    }
    let strongest = strength.iter().copied().fold(0.0, f32::max);
    let limit = (strongest * RELATIVE).max(ABSOLUTE);
    let mut peaks: Vec<(f32, usize, usize)> = Vec::new();
    for v in 3..h - 3 {
        for u in 3..w - 3 {
            let s = strength[v * w + u];
            if s < limit {
                continue;
            }
            let beaten = (v - 2..=v + 2).any(|y| {
                (u - 2..=u + 2).any(|x| {
                    let other = strength[y * w + x];
                    other > s || (other == s && (y, x) < (v, u))
                })
            });
            if !beaten {
                peaks.push((s, u, v));
            }
        }
    }
    peaks.sort_by(|a, b| b.0.total_cmp(&a.0).then((a.2, a.1).cmp(&(b.2, b.1))));
    peaks
        .into_iter()
        .map(|(_, u, v)| Vector2::new(u as f64, v as f64))
        .filter(|p| is_crossing(smooth, p))
        .take(most)
        .collect()
}

/// Whether a ring around the point is dark, bright, dark, bright, opposite sides alike.
pub(super) fn is_crossing(smooth: &ImageF, at: &Vector2<f64>) -> bool {
    RADII_PX.iter().any(|radius| {
        let mut ring = [0.0_f32; RING];
        for (i, value) in ring.iter_mut().enumerate() {
            let (sine, cosine) = (TAU * i as f64 / RING as f64).sin_cos();
            match bilinear(smooth, at.x + radius * cosine, at.y + radius * sine) {
                Some(sample) => *value = sample.value,
                None => return false,
            }
        }
        let (low, high) = ring
            .iter()
            .fold((f32::MAX, f32::MIN), |(l, h), x| (l.min(*x), h.max(*x)));
        let swing = high - low;
        if !(swing > MIN_SWING) {
            return false;
        }
        let middle = 0.5 * (low + high);
        let changes = (0..RING)
            .filter(|i| (ring[*i] > middle) != (ring[(i + 1) % RING] > middle))
            .count();
        let opposite: f32 = (0..RING / 2)
            .map(|i| (ring[i] - ring[i + RING / 2]).abs())
            .sum::<f32>()
            / (RING / 2) as f32;
        changes == 4 && opposite < 0.3 * swing
    })
}
