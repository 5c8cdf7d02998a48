//! Disparity of a pair as it was taken, and the disparity image as a file.

use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder};
use rover_cameras::Side;

use super::{DenseError, DenseRules, Disparity, NONE, STEPS, dense_disparity};
use crate::image::{Image8, ImageError};
use crate::stereo::{Rectifier, RectifyError};

/// Why a pair has no disparity image.
#[derive(Debug, thiserror::Error)]
pub enum PairDisparityError {
    /// An image cannot be rectified.
    #[error(transparent)]
    Rectify(#[from] RectifyError),
    /// The rectified images cannot be matched.
    #[error(transparent)]
    Dense(#[from] DenseError),
}

impl Rectifier {
    /// Rectifies both images and gives the disparity of every pixel of the rectified left one, less
    /// this rectifier's shift. A pixel has none where its window, or that of its match, reaches
    /// beyond what the taken images show: there the images' own rims would match.
    ///
    /// # Errors
    /// [`PairDisparityError`] for images or settings that cannot be used.
    pub fn disparity(
        &self,
        left: &Image8,
        right: &Image8,
        rules: &DenseRules,
    ) -> Result<Disparity, PairDisparityError> {
        let flat = [
            self.apply(left, Side::Left)?,
            self.apply(right, Side::Right)?,
        ];
        let mut found = dense_disparity(&flat[0], &flat[1], rules)?;
        // the derivative reaches a pixel beyond the window
        let half = i64::from(rules.half_window_px) + 1;
        let shows = |side, u: i64, v: i64| {
            [(-half, -half), (half, -half), (-half, half), (half, half)]
                .iter()
                .all(|(du, dv)| self.shows(side, u + du, v + dv))
        };
        let width = i64::from(found.width_px);
        for (i, held) in found.held.iter_mut().enumerate() {
            if *held == NONE {
                continue;
            }
            let (u, v) = (i as i64 % width, i as i64 / width);
            let other = u - i64::from((i32::from(*held) + STEPS / 2).div_euclid(STEPS));
            if !(shows(Side::Left, u, v) && shows(Side::Right, other, v)) {
                *held = NONE;
            }
        }
        Ok(found)
    }
}

impl Disparity {
    /// Steps per px of the values of [`Disparity::encode_png`].
    pub const STEPS_PER_PX: u32 = STEPS as u32;

    /// The disparities, `shift_px` added to each, as the bytes of a grey 16-bit PNG file: value =
    /// disparity times [`Disparity::STEPS_PER_PX`], 0 where there is none. Disparities that are not
    /// positive, of points beyond infinity, count as none.
    ///
    /// # Errors
    /// [`ImageError::Encode`] if a value exceeds 16 bits or the encoder refuses.
    pub fn encode_png(&self, shift_px: i32) -> Result<Vec<u8>, ImageError> {
        let mut bytes = Vec::with_capacity(2 * self.held.len());
        for &held in &self.held {
            let steps = if held == NONE {
                0
            } else {
                (i32::from(held) + shift_px * STEPS).max(0)
            };
            let value = u16::try_from(steps).map_err(|_| {
                let px = steps / STEPS;
                ImageError::Encode(format!("a disparity of {px} px exceeds 16 bits"))
            })?;
            bytes.extend(value.to_ne_bytes());
        }
        let mut png = Vec::new();
        PngEncoder::new(&mut png)
            .write_image(
                &bytes,
                self.width_px,
                self.height_px,
                ExtendedColorType::L16,
            )
            .map_err(|e| ImageError::Encode(e.to_string()))?;
        Ok(png)
    }
}
