//! Points on a grid over the whole image, for obstacle maps.

use nalgebra::{Vector2, Vector3};
use rayon::prelude::*;
use rover_cameras::StereoPair;

use super::matching::{check_input, match_checked};
use super::{MatchFailure, MatchRules, PreparedImage};

/// Neighbouring grid points whose inverse ranges differ by less than this fraction support each
/// other.
const SUPPORT_FRACTION: f64 = 0.06;
/// Supporting neighbours (of 8) that a point needs.
const MIN_SUPPORT: usize = 2;

/// Matches every `step_px`-th pixel of the left image and returns each pixel with its point in the
/// cameras' frame, m. Pixels without a match, and lone points that no neighbour supports, are left
/// out.
///
/// # Errors
/// [`MatchFailure::BadInput`] for rules, images or a step that cannot be used.
pub fn sparse_points(
    left: &PreparedImage,
    right: &PreparedImage,
    pair: &StereoPair,
    step_px: u32,
    rules: &MatchRules,
) -> Result<Vec<(Vector2<f64>, Vector3<f64>)>, MatchFailure> {
    rules.validate().map_err(MatchFailure::BadInput)?;
    check_input(left, right, pair, &Vector2::zeros())?;
    if step_px == 0 {
        return Err(MatchFailure::BadInput(
            "the step is 0 px, expected at least 1 px".into(),
        ));
    }
    // many points of some certainty, not few of the best
    let rules = &MatchRules {
        max_half_window_px: rules.half_window_px,
        ..rules.clone()
    };
    let first = rules.half_window_px.max(rules.half_search_window_px) + 1;
    let places = |size: u32| -> Vec<u32> {
        (first..size.saturating_sub(first))
            .step_by(step_px as usize)
            .collect()
    };
    let (columns, rows) = (places(left.width_px), places(left.height_px));
    let range_at = |u: u32, v: u32| {
        let pixel = Vector2::new(f64::from(u), f64::from(v));
        let found = match_checked(left, right, pair, &pixel, rules).ok()?;
        Some(found.range_m)
    };
    let ranges: Vec<Option<f64>> = rows
        .par_iter()
        .flat_map_iter(|&v| columns.iter().map(move |&u| (u, v)))
        .map(|(u, v)| range_at(u, v))
        .collect();
    let at = |i: isize, j: isize| -> Option<f64> {
        let inside = i >= 0 && j >= 0 && (i as usize) < columns.len() && (j as usize) < rows.len();
        if inside {
            ranges[j as usize * columns.len() + i as usize]
        } else {
            None
        }
    };
    let mut points = Vec::new();
    for (j, &v) in rows.iter().enumerate() {
        for (i, &u) in columns.iter().enumerate() {
            let (i, j) = (i as isize, j as isize);
            let Some(range) = at(i, j) else { continue };
            let support = (0..9)
                .filter(|&k| k != 4)
                .filter_map(|k| at(i + k % 3 - 1, j + k / 3 - 1))
                .filter(|other| (other / range - 1.0).abs() < SUPPORT_FRACTION)
                .count();
            if support < MIN_SUPPORT {
                continue;
            }
            let pixel = Vector2::new(f64::from(u), f64::from(v));
            if let Ok(ray) = pair.left.ray(&pixel) {
                points.push((pixel, ray.at(range)));
            }
        }
    }
    Ok(points)
}
