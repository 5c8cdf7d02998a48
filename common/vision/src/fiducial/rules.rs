//! The thresholds of the fiducial search.

use serde::{Deserialize, Serialize};

/// Every threshold of the fiducial search, with its unit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DetectionRules {
    /// Least NCC of the first correlation, at reduced resolution and with the pose as predicted.
    pub min_coarse_score: f64,
    /// Above this NCC of the first correlation no other rotations, scales and tilts are tried.
    pub good_coarse_score: f64,
    /// Rotations about the viewing direction that are tried beside the predicted one, degrees.
    pub rotations_deg: Vec<f64>,
    /// Sizes that are tried beside the predicted one (1.05: five per cent larger).
    pub scales: Vec<f64>,
    /// Foreshortenings that are tried beside the predicted one, as factors on the plate's image
    /// along its shortest direction.
    pub foreshortenings: Vec<f64>,
    /// Correlation peaks that are followed up.
    pub max_candidates: usize,
    /// Least NCC of the aligned plate.
    pub min_score: f64,
    /// Least NCC of the aligned saddle, when it is searched alone.
    pub min_saddle_score: f64,
    /// Least number of good points of a plate.
    pub min_points: usize,
    /// Least difference between white and black around a point, DN.
    pub min_contrast_dn: f64,
    /// Largest difference of a point's contrast, as a part of its white, from the median of the
    /// plate's points, as a fraction of that median.
    pub max_contrast_change: f64,
    /// Largest rms difference between a point's image and its model, as a fraction of contrast;
    /// `noise_dn` is granted on top. Shadow edges, reflections and occlusions exceed it.
    pub max_residual_fraction: f64,
    /// Largest grey noise that the residual check puts up with, DN.
    pub noise_dn: f64,
    /// Pixels at or above this value count as saturated, DN.
    pub saturation_dn: u8,
    /// Largest fraction of saturated pixels in a point's window.
    pub max_saturated_fraction: f64,
    /// Largest distance of a point from its place in the plate's fitted pose, px.
    pub max_reprojection_px: f64,
    /// Largest correction of a point against its prediction in one fit, px.
    pub max_correction_px: f64,
    /// Blur assumed first (lens and pixel together, standard deviation), px.
    pub blur_sigma_px: f64,
    /// Least radius of a mark along its shortest direction, px.
    pub min_mark_radius_px: f64,
    /// White that a point's window takes in beyond the edge of a disc, px.
    pub window_margin_px: f64,
    /// Largest distance from the crossing that is used of a saddle, px.
    pub saddle_window_px: f64,
    /// Least distance of a point's window from the image border, px.
    pub image_border_px: f64,
    /// Smallest standard deviation that is ever claimed for a point, px.
    pub sigma_floor_px: f64,
}

impl Default for DetectionRules {
    fn default() -> Self {
        Self {
            min_coarse_score: 0.35,
            good_coarse_score: 0.85,
            rotations_deg: vec![-8.0, -4.0, 4.0, 8.0],
            scales: vec![0.94, 1.06],
            foreshortenings: vec![0.85, 1.15],
            max_candidates: 4,
            min_score: 0.45,
            min_saddle_score: 0.9,
            min_points: 6,
            min_contrast_dn: 15.0,
            max_contrast_change: 0.25,
            max_residual_fraction: 0.05,
            noise_dn: 6.0,
            saturation_dn: 253,
            max_saturated_fraction: 0.02,
            max_reprojection_px: 0.4,
            max_correction_px: 2.5,
            blur_sigma_px: 0.67,
            min_mark_radius_px: 1.8,
            window_margin_px: 2.5,
            saddle_window_px: 9.0,
            image_border_px: 1.0,
            sigma_floor_px: 0.004,
        }
    }
}

impl DetectionRules {
    /// Checks that every number can be worked with.
    ///
    /// # Errors
    /// A sentence that names the field, its value and what was expected.
    pub fn validate(&self) -> Result<(), String> {
        let unit = [
            ("min_coarse_score", self.min_coarse_score),
            ("good_coarse_score", self.good_coarse_score),
            ("min_score", self.min_score),
            ("min_saddle_score", self.min_saddle_score),
            ("max_saturated_fraction", self.max_saturated_fraction),
        ];
        for (name, x) in unit {
            if !(0.0..=1.0).contains(&x) {
                return Err(format!("detection rules: {name} is {x}, expected 0 to 1"));
            }
        }
        let positive = [
            ("min_contrast_dn", self.min_contrast_dn),
            ("max_contrast_change", self.max_contrast_change),
            ("max_residual_fraction", self.max_residual_fraction),
            ("noise_dn", self.noise_dn),
            ("max_reprojection_px", self.max_reprojection_px),
            ("max_correction_px", self.max_correction_px),
            ("blur_sigma_px", self.blur_sigma_px),
            ("min_mark_radius_px", self.min_mark_radius_px),
            ("window_margin_px", self.window_margin_px),
            ("saddle_window_px", self.saddle_window_px),
            ("sigma_floor_px", self.sigma_floor_px),
        ];
        for (name, x) in positive {
            if !(x.is_finite() && x > 0.0) {
                return Err(format!(
                    "detection rules: {name} is {x}, expected a positive number"
                ));
            }
        }
        if !(self.image_border_px.is_finite() && self.image_border_px >= 0.0) {
            return Err(format!(
                "detection rules: image_border_px is {}, expected 0 or more",
                self.image_border_px
            ));
        }
        for (name, list, low, high) in [
            ("rotations_deg", &self.rotations_deg, -45.0, 45.0),
            ("scales", &self.scales, 0.5, 2.0),
            ("foreshortenings", &self.foreshortenings, 0.5, 2.0),
        ] {
            if let Some(x) = list.iter().find(|x| !(low..=high).contains(*x)) {
                return Err(format!(
                    "detection rules: {name} contains {x}, expected {low} to {high}"
                ));
            }
        }
        if self.max_candidates == 0 {
            return Err("detection rules: max_candidates is 0, expected at least 1".into());
        }
        if self.min_points < 4 {
            return Err(format!(
                "detection rules: min_points is {}, expected at least 4",
                self.min_points
            ));
        }
        Ok(())
    }
}
