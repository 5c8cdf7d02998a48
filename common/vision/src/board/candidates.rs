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
/// How far from straight an edge may run through the ring, samples of the ring.
const BEND: f32 = 2.0;
/// How far from the middle of dark and bright the crossing itself may be, as a part of the swing:
/// between two things that only come close to each other it is as bright as the gap.
const OFF_MIDDLE: f32 = 0.25;
/// Least swing of the ring, DN.
const MIN_SWING: f32 = 8.0;

/// A point where dark and bright cross.
#[derive(Clone, Copy, Debug)]
pub(super) struct Crossing {
    /// Where, px of the picture searched.
    pub(super) at: Vector2<f64>,
    /// Swing of the ring around it, DN.
    pub(super) swing: f64,
}

/// Crossings, strongest saddle first, at most `most`.
pub(super) fn saddles(smooth: &ImageF, most: usize) -> Vec<Crossing> {
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
        .filter_map(|(_, u, v)| crossing(smooth, Vector2::new(u as f64, v as f64)))
        .take(most)
        .collect()
}

/// The point as a crossing, if a ring around it is dark, bright, dark, bright, opposite sides alike.
fn crossing(smooth: &ImageF, at: Vector2<f64>) -> Option<Crossing> {
    let here = bilinear(smooth, at.x, at.y)?.value;
    RADII_PX.iter().find_map(|radius| {
        let mut ring = [0.0_f32; RING];
        for (i, value) in ring.iter_mut().enumerate() {
            let (sine, cosine) = (TAU * i as f64 / RING as f64).sin_cos();
            *value = bilinear(smooth, at.x + radius * cosine, at.y + radius * sine)?.value;
        }
        let (low, high) = ring
            .iter()
            .fold((f32::MAX, f32::MIN), |(l, h), x| (l.min(*x), h.max(*x)));
        let swing = high - low;
        if !(swing > MIN_SWING) {
            return None;
        }
        let middle = 0.5 * (low + high);
        let changes = changes(&ring, middle)?;
        // Each edge goes straight through: it leaves the ring opposite to where it entered.
        let straight =
            (0..2).all(|i| (changes[i + 2] - changes[i] - 0.5 * RING as f32).abs() < BEND);
        let opposite: f32 = (0..RING / 2)
            .map(|i| (ring[i] - ring[i + RING / 2]).abs())
            .sum::<f32>()
            / (RING / 2) as f32;
        let between = (here - middle).abs() < OFF_MIDDLE * swing;
        (straight && between && opposite < 0.3 * swing).then_some(Crossing {
            at,
            swing: f64::from(swing),
        })
    })
}

/// Where on the ring it changes between dark and bright, in samples, if it does so four times.
fn changes(ring: &[f32; RING], middle: f32) -> Option<[f32; 4]> {
    let mut places = [0.0; 4];
    let mut found = 0;
    for i in 0..RING {
        let (a, b) = (ring[i] - middle, ring[(i + 1) % RING] - middle);
        if (a > 0.0) != (b > 0.0) {
            *places.get_mut(found)? = i as f32 + a / (a - b);
            found += 1;
        }
    }
    (found == 4).then_some(places)
}
