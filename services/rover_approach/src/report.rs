//! What an approach tells of itself: sightings, and the error of the position by source.

use crate::first_ray::FirstRayFix;
use crate::fix::{Attempt, Fix, Refusal};
use crate::handover::Handover;
use crate::surface::StereoPlane;
use nalgebra::{Matrix2, Matrix3, Vector2};
use rover_messages::approach::{ErrorShare, Sighting};
use rover_messages::imaging::FrameReference;

/// Standard deviations along the axes, mm.
pub(crate) fn sigma_mm(covariance_m2: &Matrix3<f64>) -> [f64; 3] {
    [0, 1, 2].map(|i| covariance_m2[(i, i)].max(0.0).sqrt() * 1e3)
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

/// Variances along the surface by source, m^2.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Budget {
    designation: f64,
    tracking: f64,
    relief: f64,
    handover: f64,
    stereo: f64,
}

/// Part of a relief correction that is taken to remain.
const RELIEF_REST: f64 = 0.5;
/// Smallest error of one match that is claimed, px.
const MATCH_FLOOR_PX: f64 = 0.05;

/// Less than this is never claimed for all of tracking, px of the image in which the target was
/// named: matches from anchor to anchor share errors that none of them shows.
const TRACKING_FLOOR_PX: f64 = 0.2;
/// What shape, cameras and body do besides, one sigma along the surface, m. With it and the floor
/// the prediction held in 93 of the 97 placements that both were fitted to.
const UNMODELLED_M: f64 = 0.5e-3;

/// 95 % of the losses of tracking, px of the image in which the target was named.
const FORECAST_PX: f64 = 0.9;
/// 95 % of the errors of hand-over, servo and contact together, mm.
const FORECAST_ARM_MM: f64 = 3.0;

/// Metres along the surface of one pixel at a surface, along its flattest direction.
fn metres_per_px(surface: &StereoPlane, focal_px: f64) -> f64 {
    let n = &surface.plane.normal;
    // the sight line is not known here; the covariance's range direction stands for it
    let eigen = surface.covariance_m2.symmetric_eigen();
    let sight = eigen
        .eigenvectors
        .column(eigen.eigenvalues.imax())
        .into_owned();
    surface.range_m / focal_px / n.dot(&sight).abs().clamp(0.1, 1.0)
}

impl Budget {
    /// At the designation: half a pixel is the person's own.
    pub fn designated(surface: &StereoPlane, focal_px: f64) -> Self {
        Self {
            designation: (metres_per_px(surface, focal_px) / 12.0_f64.sqrt()).powi(2),
            ..Self::default()
        }
    }

    /// Error along the surface that 95 % of placements stay below, mm, as it can be told from the
    /// image in which the target was named: what tracking loses over an approach is so many of
    /// that image's pixels, whatever the range, and a pixel of a surface seen flat covers much.
    pub fn forecast_mm(&self) -> f64 {
        (FORECAST_PX * self.named_px_m() * 1e3).hypot(FORECAST_ARM_MM)
    }

    /// A pixel of the image in which the target was named, m along the surface.
    fn named_px_m(&self) -> f64 {
        (12.0 * self.designation).sqrt()
    }

    /// Variance of all tracking, not below its floor, m^2.
    fn tracking_m2(&self) -> f64 {
        let floor = TRACKING_FLOOR_PX * self.named_px_m();
        self.tracking.max(floor * floor)
    }

    /// One more match against an anchor; only where a new anchor is made does its error stay.
    pub fn tracked(&mut self, fix: &Fix, focal_px: f64) {
        let scale = metres_per_px(&fix.surface, focal_px);
        if fix.anchored || fix.attempt == Attempt::LastStop {
            self.tracking += (fix.sigma_px.max(MATCH_FLOOR_PX) * scale).powi(2);
            self.relief += (RELIEF_REST * fix.relief_px.norm() * scale).powi(2);
        }
    }

    /// Tracking and relief together, one sigma, m.
    pub fn tracking_m(&self) -> f64 {
        (self.tracking + self.relief).sqrt()
    }

    /// The first ray takes the place of all tracking.
    pub fn met(&mut self, met: &FirstRayFix) {
        self.tracking = met.sigma_m.powi(2);
        self.relief = 0.0;
    }

    /// After the hand-over.
    pub fn handed(&mut self, found: &Handover, focal_px: f64) {
        let scale = metres_per_px(&found.surface, focal_px);
        self.handover = (found.sigma_px * scale).powi(2);
        self.stereo = found.surface.covariance_m2.trace() / 3.0;
    }

    /// Error along the surface since the designation, one sigma, m; the body pair's stereo is in
    /// the target's own covariance.
    pub fn lateral_m(&self) -> f64 {
        let unmodelled = UNMODELLED_M * UNMODELLED_M;
        (self.tracking_m2() + self.relief + self.handover + unmodelled).sqrt()
    }

    /// The shares, mm.
    pub fn shares(&self) -> Vec<ErrorShare> {
        [
            ("designation", self.designation),
            ("tracking", self.tracking_m2()),
            ("relief", self.relief),
            ("handover", self.handover),
            ("stereo", self.stereo),
            ("unmodelled", UNMODELLED_M * UNMODELLED_M),
        ]
        .map(|(source, variance)| ErrorShare {
            source: source.into(),
            sigma_mm: variance.sqrt() * 1e3,
        })
        .into()
    }
}
