//! A part of a camera's image, or the image at a lower resolution, as a camera of its own.

use crate::camera::invalid;
use crate::{Camera, CameraError};

impl Camera {
    /// The camera of a part of the image: its first pixel is `origin_px` (column, row), its size
    /// `size_px` (width, height), as a sensor's subframe or a cut-out gives it.
    ///
    /// `H - u0 A` and `V - v0 A`: exact for every model.
    ///
    /// # Errors
    /// `InvalidModel` if the part is empty or reaches beyond the image.
    pub fn subframe(&self, origin_px: [u32; 2], size_px: [u32; 2]) -> Result<Camera, CameraError> {
        let ends = [0, 1].map(|i| u64::from(origin_px[i]) + u64::from(size_px[i]));
        if size_px.contains(&0)
            || ends[0] > u64::from(self.width_px)
            || ends[1] > u64::from(self.height_px)
        {
            return Err(invalid(format!(
                "a subframe of {} x {} px from pixel ({}, {}) does not lie within the image of \
                 {} x {} px",
                size_px[0], size_px[1], origin_px[0], origin_px[1], self.width_px, self.height_px
            )));
        }
        let mut camera = self.clone();
        let [a, h, v] = camera.model.ahv_mut();
        *h -= *a * f64::from(origin_px[0]);
        *v -= *a * f64::from(origin_px[1]);
        [camera.width_px, camera.height_px] = size_px;
        Ok(camera)
    }

    /// The camera of the image in which every pixel is the mean of `factor` x `factor` ones,
    /// starting at the first; what is left over at the right and lower border is dropped.
    ///
    /// With the centre of the first pixel at zero, `H' = (H + A/2) / factor - A/2`: exact for
    /// every model.
    ///
    /// # Errors
    /// `InvalidModel` if `factor` is 0 or the image has fewer pixels than that on a side.
    pub fn downsampled(&self, factor: u32) -> Result<Camera, CameraError> {
        if factor == 0 || factor > self.width_px || factor > self.height_px {
            return Err(invalid(format!(
                "an image of {} x {} px cannot be downsampled by {factor}, expected 1 to {}",
                self.width_px,
                self.height_px,
                self.width_px.min(self.height_px)
            )));
        }
        let mut camera = self.clone();
        let [a, h, v] = camera.model.ahv_mut();
        let half = *a * 0.5;
        for axis in [h, v] {
            *axis = (*axis + half) / f64::from(factor) - half;
        }
        camera.width_px /= factor;
        camera.height_px /= factor;
        Ok(camera)
    }
}
