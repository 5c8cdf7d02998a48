//! One stereo frame as the algorithms see it: both images made ready, and their camera models.

use crate::error::TrackError;
use crate::own_shadow::OwnShadow;
use rover_cameras::{Camera, StereoPair};
use rover_vision::PreparedImage;
use std::sync::OnceLock;

/// A stereo frame taken at one stop.
#[derive(Clone, Debug)]
pub struct View {
    /// Left image.
    pub left: PreparedImage,
    /// Right image.
    pub right: PreparedImage,
    /// Believed camera models, rover frame of this stop, m.
    pub cameras: StereoPair,
    /// Where the rover's own shadow falls, if sun and shape are known.
    pub own_shadow: Option<OwnShadow>,
    /// Left image and camera a quarter as wide and high, made when first asked for.
    quarter: OnceLock<Option<(PreparedImage, Camera)>>,
}

impl View {
    /// Puts a view together.
    ///
    /// # Errors
    /// [`TrackError::BadView`] if a camera model is none or an image has another size than its
    /// model.
    pub fn new(
        left: PreparedImage,
        right: PreparedImage,
        cameras: StereoPair,
    ) -> Result<Self, TrackError> {
        cameras
            .validate()
            .map_err(|e| TrackError::BadView(e.to_string()))?;
        for (side, image, camera) in [
            ("left", &left, &cameras.left),
            ("right", &right, &cameras.right),
        ] {
            let (found, expected) = (
                (image.width_px(), image.height_px()),
                (camera.width_px, camera.height_px),
            );
            if found != expected {
                return Err(TrackError::BadView(format!(
                    "the {side} image has {} x {} px, its camera model {} x {} px",
                    found.0, found.1, expected.0, expected.1
                )));
            }
        }
        Ok(Self {
            left,
            right,
            cameras,
            own_shadow: None,
            quarter: OnceLock::new(),
        })
    }

    /// Left image and camera a quarter as wide and high; `None` if they are too small for that.
    /// A pixel `p` is there `(p + 0.5) / 4 - 0.5`.
    #[must_use]
    pub fn quarter(&self) -> Option<(&PreparedImage, &Camera)> {
        let made = self.quarter.get_or_init(|| {
            let camera = self.cameras.left.downsampled(4).ok()?;
            Some((self.left.quarter()?, camera))
        });
        made.as_ref().map(|(image, camera)| (image, camera))
    }

    /// The same with the rover's own shadow known.
    #[must_use]
    pub fn shadowed(mut self, own_shadow: Option<OwnShadow>) -> Self {
        self.own_shadow = own_shadow;
        self
    }
}
