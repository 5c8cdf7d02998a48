//! What an approach tells of itself: its sightings.

use crate::fix::{Attempt, Fix, Refusal};
use nalgebra::{Matrix2, Matrix3, Vector2};
use rover_messages::approach::Sighting;
use rover_messages::imaging::FrameReference;

/// Standard deviations along the axes, mm.
pub(crate) fn sigma_mm(covariance_m2: &Matrix3<f64>) -> [f64; 3] {
    [0, 1, 2].map(|i| covariance_m2[(i, i)].max(0.0).sqrt() * 1e3)
}

/// The largest of them, mm.
pub(crate) fn worst_sigma_mm(covariance_m2: &Matrix3<f64>) -> f64 {
    sigma_mm(covariance_m2).into_iter().fold(0.0, f64::max)
}

/// One look for the target.
pub(crate) fn sighting(
    reference: &FrameReference,
    predicted_px: Option<Vector2<f64>>,
    spread_px2: &Matrix2<f64>,
    sigmas: f64,
    found: &Result<Fix, Refusal>,
    new_image: bool,
) -> Sighting {
    let window = [0, 1].map(|k| sigmas * spread_px2[(k, k)].max(0.0).sqrt() + 2.0);
    let fix = found.as_ref().ok();
    let method = match fix.map(|f| f.attempt) {
        _ if new_image => "new_image",
        Some(Attempt::Translation) => "translation",
        Some(Attempt::PreviousAnchor) => "second_anchor",
        Some(Attempt::LastStop) => "last_stop",
        Some(Attempt::Affine) | None => "affine",
    };
    let predicted = predicted_px.or(fix.map(|f| f.pixel_px - f.innovation_px));
    Sighting {
        frame: reference.clone(),
        predicted_px: predicted.unwrap_or_default().into(),
        pixel_px: fix.map(|f| f.pixel_px.into()),
        window_px: window,
        score: fix.map_or(0.0, |f| f.score),
        forward_backward_px: fix.map(|f| f.back_px),
        relief_px: fix.filter(|f| f.anchored).map(|f| f.relief_px.norm()),
        method: method.into(),
        refusal: found.as_ref().err().map(ToString::to_string),
    }
}
