//! A panorama: pictures of the mast's left camera, all round, as one mosaic.

use crate::{
    imaging::{FrameReference, ImageData},
    mobility::MastState,
    wire::Wire,
};
use rover_cameras::Camera;
use serde::{Deserialize, Serialize};

/// Most pixels of a mosaic.
pub const MAX_MOSAIC_PX: u64 = 8_000_000;

/// Question to `imaging/<pair>/panorama`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PanoramaRequest {
    /// First and last pan of the mast, rad, positive to the left.
    pub pan_rad: [f64; 2],
    /// First and last tilt of the mast, rad, positive downwards.
    pub tilt_rad: [f64; 2],
    /// Least part of a picture that its neighbour shows, too.
    pub overlap: f64,
    /// Angle of a pixel of the mosaic, rad; none: that of the camera's middle.
    pub pixel_rad: Option<f64>,
}

impl Default for PanoramaRequest {
    fn default() -> Self {
        Self {
            pan_rad: [-1.2, 1.2],
            tilt_rad: [0.1, 0.5],
            overlap: 0.2,
            pixel_rad: None,
        }
    }
}

/// One picture of a panorama.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PanoramaView {
    /// Its stereo frame; the last few can be recalled.
    pub frame: FrameReference,
    /// The mast as it stood.
    pub mast: MastState,
    /// Believed model of the left camera, rover frame.
    pub left: Camera,
}

/// A mosaic of azimuth and elevation as seen from `eye_m`, with the ground taken for the plane on
/// which the rover stands. Column `u` looks to azimuth `azimuth_rad[0] - u * pixel_rad` (positive to
/// the left), row `v` to elevation `elevation_rad[0] - v * pixel_rad` (positive upwards); a pixel
/// that no picture shows is 0.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Panorama {
    /// The mosaic.
    pub mosaic: ImageData,
    /// Azimuth of the first and last column, rad.
    pub azimuth_rad: [f64; 2],
    /// Elevation of the first and last row, rad.
    pub elevation_rad: [f64; 2],
    /// Angle of a pixel, rad.
    pub pixel_rad: f64,
    /// Where it is seen from, rover frame, m.
    pub eye_m: [f64; 3],
    /// The pictures, in the order in which they were taken.
    pub views: Vec<PanoramaView>,
}

impl Wire for PanoramaRequest {
    const SCHEMA: &'static str = "panorama_request/1";
    fn validate(&self) -> Result<(), String> {
        for (field, range) in [("pan_rad", self.pan_rad), ("tilt_rad", self.tilt_rad)] {
            let [first, last] = range;
            if !(first.is_finite() && last.is_finite() && first <= last) {
                return Err(format!(
                    "{field}: [{first}, {last}], expected two finite numbers, the first not above \
                     the second"
                ));
            }
        }
        if !(0.0..=0.8).contains(&self.overlap) {
            return Err(format!("overlap: {}, expected 0 to 0.8", self.overlap));
        }
        match self.pixel_rad {
            Some(pixel) if !(1e-4..=0.1).contains(&pixel) => {
                Err(format!("pixel_rad: {pixel}, expected 0.0001 to 0.1"))
            }
            _ => Ok(()),
        }
    }
}

impl Wire for Panorama {
    const SCHEMA: &'static str = "panorama/1";
    fn validate(&self) -> Result<(), String> {
        self.mosaic.check("mosaic")
    }
}
