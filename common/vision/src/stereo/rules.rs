//! The thresholds of stereo matching and of surface measurement.

use serde::{Deserialize, Serialize};

/// Thresholds of one match.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MatchRules {
    /// Half the side of the fitted window less half a pixel: 7 means 15 x 15 px.
    pub half_window_px: u32,
    /// Half the side less half a pixel that the fitted window may be widened to where noise leaves
    /// the match more uncertain than `aim_sigma_px`; no more than `half_window_px` never widens. The
    /// wider window counts only if it agrees with the smaller one and fits as well.
    pub max_half_window_px: u32,
    /// Standard deviation from which a window is widened, px.
    pub aim_sigma_px: f64,
    /// Half the side of the window that is searched for along the epipolar curve less half a pixel.
    pub half_search_window_px: u32,
    /// Nearest range searched, along the left ray, m.
    pub range_min_m: f64,
    /// Farthest range searched, along the left ray, m.
    pub range_max_m: f64,
    /// Surface normals (frame of the camera models) that the search tries beside a surface facing
    /// the camera.
    pub slant_normals: Vec<[f64; 3]>,
    /// Least standard deviation of grey values in the left window, DN.
    pub min_texture_dn: f64,
    /// Least NCC in the search, with whole-pixel shifts.
    pub min_search_score: f64,
    /// Least NCC of the fitted windows, freed of what the images' grey noise takes off it.
    pub min_score: f64,
    /// Largest NCC of any other place, as a fraction of the best one's.
    pub uniqueness_ratio: f64,
    /// Largest distance between the pixel and where the match leads back to, px (whole-pixel
    /// search).
    pub left_right_tolerance_px: f64,
    /// Largest change of the displacement per pixel: steeper surfaces are refused.
    pub max_slope: f64,
    /// Largest correction of the search's result by the fit, px.
    pub max_correction_px: f64,
    /// How far the match may be expected off the epipolar curve (camera model error), px.
    pub epipolar_sigma_px: f64,
    /// Largest accepted distance from the epipolar curve, px.
    pub max_epipolar_px: f64,
    /// Largest accepted standard deviation along the epipolar curve, px.
    pub max_sigma_px: f64,
    /// Smallest standard deviation that is ever claimed, px.
    pub sigma_floor_px: f64,
}

impl Default for MatchRules {
    fn default() -> Self {
        Self {
            half_window_px: 7,
            max_half_window_px: 16,
            aim_sigma_px: 0.05,
            half_search_window_px: 6,
            range_min_m: 0.35,
            range_max_m: 1.5,
            slant_normals: vec![[0.0, 0.0, 1.0], [-0.7, 0.7, 0.1], [-0.7, -0.7, 0.1]],
            min_texture_dn: 3.0,
            min_search_score: 0.5,
            min_score: 0.8,
            uniqueness_ratio: 0.9,
            left_right_tolerance_px: 1.5,
            max_slope: 0.8,
            max_correction_px: 2.5,
            epipolar_sigma_px: 0.3,
            max_epipolar_px: 1.0,
            max_sigma_px: 0.15,
            sigma_floor_px: 0.01,
        }
    }
}

fn need(name: &str, found: f64, ok: bool, expected: &str) -> Result<(), String> {
    if ok {
        Ok(())
    } else {
        Err(format!(
            "stereo rules: {name} is {found}, expected {expected}"
        ))
    }
}

impl MatchRules {
    /// Checks that every number can be worked with.
    ///
    /// # Errors
    /// A sentence that names the field, its value and what was expected.
    pub fn validate(&self) -> Result<(), String> {
        for (name, half) in [
            ("half_window_px", self.half_window_px),
            ("max_half_window_px", self.max_half_window_px),
            ("half_search_window_px", self.half_search_window_px),
        ] {
            need(name, f64::from(half), (2..=30).contains(&half), "2 to 30")?;
        }
        let near = self.range_min_m;
        need(
            "range_min_m",
            near,
            near.is_finite() && near > 0.0,
            "a positive length",
        )?;
        let far = self.range_max_m;
        need(
            "range_max_m",
            far,
            far.is_finite() && far > near,
            "more than range_min_m",
        )?;
        for (name, x) in [
            ("min_search_score", self.min_search_score),
            ("min_score", self.min_score),
            ("uniqueness_ratio", self.uniqueness_ratio),
        ] {
            need(name, x, (0.0..=1.0).contains(&x), "0 to 1")?;
        }
        for (name, x) in [
            ("aim_sigma_px", self.aim_sigma_px),
            ("min_texture_dn", self.min_texture_dn),
            ("left_right_tolerance_px", self.left_right_tolerance_px),
            ("max_slope", self.max_slope),
            ("max_correction_px", self.max_correction_px),
            ("epipolar_sigma_px", self.epipolar_sigma_px),
            ("max_epipolar_px", self.max_epipolar_px),
            ("max_sigma_px", self.max_sigma_px),
            ("sigma_floor_px", self.sigma_floor_px),
        ] {
            need(name, x, x.is_finite() && x > 0.0, "a positive number")?;
        }
        for n in &self.slant_normals {
            let length = n.iter().map(|x| x * x).sum::<f64>().sqrt();
            need(
                "a slant normal's length",
                length,
                length.is_finite() && length > 0.0,
                "above 0",
            )?;
        }
        Ok(())
    }
}

/// Thresholds of a surface measurement.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SurfaceRules {
    /// How single points are matched.
    pub matching: MatchRules,
    /// Half the side of the window of the surrounding matches less half a pixel; those that noise
    /// leaves more uncertain than `matching.max_sigma_px` are widened up to
    /// `matching.max_half_window_px`.
    pub half_window_px: u32,
    /// Matches are made at offsets up to this many steps from the pixel.
    pub half_grid: u32,
    /// Step of the grid of matches, px.
    pub grid_step_px: f64,
    /// Points farther than this from the middle one are left out, m (flight rule SEPARATION).
    pub separation_m: f64,
    /// Least number of points (flight rule MIN_POINTS, raised for the finer grid).
    pub min_points: usize,
    /// Least fraction of the grid in each of the four quadrants around the pixel: less means that
    /// the pixel is at an edge.
    pub min_quadrant_fraction: f64,
    /// Mean distance from the plane above which outliers are dropped, m (flight rule ERROR).
    pub plane_error_m: f64,
    /// Points farther from the plane than this multiple of the mean distance are dropped (flight
    /// rule REJECT).
    pub reject_factor: f64,
    /// Largest accepted rms distance from the plane, m.
    pub max_plane_rms_m: f64,
    /// Largest accepted extent of the surface along its normal, m.
    pub max_roughness_m: f64,
    /// Largest accepted standard deviation of the normal, in its worst direction, deg.
    pub max_normal_sigma_deg: f64,
    /// Least cosine between normal and direction to the left camera.
    pub min_facing_cosine: f64,
    /// Largest jump of the displacement against the prediction from a neighbour, px.
    pub max_jump_px: f64,
    /// Matching error common to all points (interpolation, blur), px.
    pub common_sigma_px: f64,
    /// Lateral standard deviation of the designated ray (camera model), px.
    pub pixel_sigma_px: f64,
}

impl Default for SurfaceRules {
    fn default() -> Self {
        Self {
            matching: MatchRules::default(),
            half_window_px: 5,
            half_grid: 7,
            grid_step_px: 2.5,
            separation_m: 0.03,
            min_points: 40,
            min_quadrant_fraction: 0.15,
            plane_error_m: 0.0005,
            reject_factor: 2.0,
            max_plane_rms_m: 0.004,
            max_roughness_m: 0.015,
            max_normal_sigma_deg: 5.0,
            min_facing_cosine: 0.2,
            max_jump_px: 1.0,
            common_sigma_px: 0.01,
            pixel_sigma_px: 0.02,
        }
    }
}

impl SurfaceRules {
    /// Checks that every number can be worked with.
    ///
    /// # Errors
    /// A sentence that names the field, its value and what was expected.
    pub fn validate(&self) -> Result<(), String> {
        self.matching.validate()?;
        let half = self.half_window_px;
        need(
            "half_window_px",
            f64::from(half),
            (2..=30).contains(&half),
            "2 to 30",
        )?;
        let grid = self.half_grid;
        need(
            "half_grid",
            f64::from(grid),
            (2..=40).contains(&grid),
            "2 to 40",
        )?;
        let points = self.min_points;
        need("min_points", points as f64, points >= 12, "12 or more")?;
        for (name, x) in [
            ("grid_step_px", self.grid_step_px),
            ("separation_m", self.separation_m),
            ("plane_error_m", self.plane_error_m),
            ("reject_factor", self.reject_factor),
            ("max_plane_rms_m", self.max_plane_rms_m),
            ("max_roughness_m", self.max_roughness_m),
            ("max_normal_sigma_deg", self.max_normal_sigma_deg),
            ("max_jump_px", self.max_jump_px),
            ("common_sigma_px", self.common_sigma_px),
            ("pixel_sigma_px", self.pixel_sigma_px),
        ] {
            need(name, x, x.is_finite() && x > 0.0, "a positive number")?;
        }
        for (name, x) in [
            ("min_quadrant_fraction", self.min_quadrant_fraction),
            ("min_facing_cosine", self.min_facing_cosine),
        ] {
            need(name, x, (0.0..=1.0).contains(&x), "0 to 1")?;
        }
        Ok(())
    }
}
