//! Images and stereo frames.

use crate::{
    codec::bytes_or_base64,
    mobility::{MastState, WheelsState},
    wire,
    wire::Wire,
};
use rover_cameras::StereoPair;
use rover_geometry::{Rover, Site, Transform};
use serde::{Deserialize, Serialize};

/// An 8-bit grey image; pixels row by row from the top left, base64 in JSON.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageData {
    /// Columns.
    pub width_px: u32,
    /// Rows.
    pub height_px: u32,
    /// `width_px * height_px` grey levels.
    #[serde(with = "bytes_or_base64")]
    pub pixels: Vec<u8>,
}

impl ImageData {
    pub(crate) fn check(&self, field: &str) -> Result<(), String> {
        let expected = u64::from(self.width_px) * u64::from(self.height_px);
        if expected == self.pixels.len() as u64 {
            return Ok(());
        }
        Err(format!(
            "{field}.pixels: {} bytes, expected {} for {}x{} px",
            self.pixels.len(),
            expected,
            self.width_px,
            self.height_px
        ))
    }
}

/// Question to `camera/<pair>/grab` and `imaging/<pair>/capture`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CaptureRequest {
    /// Which of several exposures of the same instant: each has noise of its own, and asking for
    /// the same one again gives the same picture.
    pub exposure_n: u32,
}

/// One raw stereo pair from the hardware.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawPair {
    /// Name of the camera pair.
    pub pair: String,
    /// When it was exposed, s.
    pub sim_time_s: f64,
    /// Control step of the exposure.
    pub step: u64,
    /// Left image.
    pub left: ImageData,
    /// Right image.
    pub right: ImageData,
    /// The mast at the exposure, if the robot has one.
    #[serde(default)]
    pub mast: Option<MastState>,
    /// Odometry and attitude at the exposure, if the robot has wheels.
    #[serde(default)]
    pub wheels: Option<WheelsState>,
}

/// Names one stereo frame: the question to `imaging/<pair>/recall`, which the imaging service
/// answers for the last frames of each pair.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrameReference {
    /// Name of the camera pair.
    pub pair: String,
    /// Control step of the exposure.
    pub step: u64,
    /// Which of several exposures of that instant.
    pub exposure_n: u32,
}

/// One stereo frame with the camera models that belong to it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StereoFrame {
    /// The images.
    pub images: RawPair,
    /// Believed camera models at the exposure (a mast pair's placed by the mast's angles), rover
    /// frame.
    pub cameras: StereoPair,
}

impl StereoFrame {
    /// Believed pose of the rover at the exposure, by odometry and attitude sensor: takes what
    /// this frame's models yield (rover frame) to the site frame, where frames of different stops
    /// meet. `None` for a robot that does not drive.
    pub fn site_from_rover(&self) -> Option<Transform<Site, Rover>> {
        self.images
            .wheels
            .as_ref()
            .map(|w| w.pose.site_from_rover())
    }
}

wire! {
    CaptureRequest = "capture_request/1",
    FrameReference = "frame_reference/1",
}

impl Wire for RawPair {
    const SCHEMA: &'static str = "raw_pair/2";
    fn validate(&self) -> Result<(), String> {
        self.left.check("left")?;
        self.right.check("right")?;
        if let Some(mast) = &self.mast {
            mast.validate().map_err(|e| format!("mast.{e}"))?;
        }
        if let Some(wheels) = &self.wheels {
            wheels.validate().map_err(|e| format!("wheels.{e}"))?;
        }
        Ok(())
    }
}

impl Wire for StereoFrame {
    const SCHEMA: &'static str = "stereo_frame/2";
    fn validate(&self) -> Result<(), String> {
        self.images.validate()
    }
}
