//! Targets: from a pixel to a place with a normal.

use crate::wire::{Wire, finite, in_range};
use rover_geometry::{Direction, Point, Rover};
use serde::{Deserialize, Serialize};

/// Question to `target/select`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SelectRequest {
    /// Camera pair whose left image the pixel belongs to.
    pub pair: String,
    /// Column and row, px; (0, 0) is the centre of the first pixel.
    pub pixel_px: [f64; 2],
}

/// A place on a surface, chosen by one pixel.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Target {
    /// Camera pair it was chosen in.
    pub pair: String,
    /// The pixel in the left image.
    pub pixel_px: [f64; 2],
    /// The matched pixel in the right image.
    pub right_pixel_px: [f64; 2],
    /// Believed position, rover frame, m.
    pub position_m: Point<Rover>,
    /// Outward unit normal, rover frame.
    pub normal: Direction<Rover>,
    /// Covariance of the position, rover frame, m^2, row by row.
    pub covariance_m2: [[f64; 3]; 3],
    /// Root mean square distance of the surface points from the fitted plane, mm.
    pub plane_rms_mm: f64,
    /// Peak-to-valley height within the instrument's footprint, mm.
    pub roughness_mm: f64,
    /// Surface points used.
    pub points_n: u32,
    /// When the image was taken, s.
    pub sim_time_s: f64,
}

impl Target {
    /// Standard deviations of the position along the rover axes, mm.
    pub fn sigma_mm(&self) -> [f64; 3] {
        [0, 1, 2].map(|i| self.covariance_m2[i][i].max(0.0).sqrt() * 1e3)
    }
}

impl Wire for SelectRequest {
    const SCHEMA: &'static str = "select_request/1";
    fn validate(&self) -> Result<(), String> {
        finite("pixel_px", &self.pixel_px)
    }
}

impl Wire for Target {
    const SCHEMA: &'static str = "target/1";
    fn validate(&self) -> Result<(), String> {
        finite("pixel_px", &self.pixel_px)?;
        finite("right_pixel_px", &self.right_pixel_px)?;
        self.covariance_m2
            .iter()
            .try_for_each(|row| finite("covariance_m2", row))?;
        in_range("plane_rms_mm", self.plane_rms_mm, 0.0, 1e3)?;
        in_range("roughness_mm", self.roughness_mm, 0.0, 1e4)
    }
}
