//! Stereo: the same surface point in both images, to hundredths of a pixel.
//!
//! Nothing is rectified. Around a pixel the epipolar geometry of the two camera models gives an
//! affine map between the images with three free numbers, the local inverse range and its slopes
//! (a plane through the point); they and a weakly held offset across the epipolar curve are fitted
//! by least squares on grey values. Foreshortening, which costs an unwarped window about 0.2 px on
//! ground seen obliquely, is thereby part of the model.

mod coarse;
mod dense;
mod link;
mod matching;
mod patch_plane;
mod rectify;
mod refine;
mod rules;
mod sparse;
mod surface;
mod surface_fit;
mod window;

pub use dense::{DenseError, DenseRules, Disparity, PairDisparityError, dense_disparity};
pub use matching::{MatchFailure, StereoMatch, match_point};
pub use patch_plane::{
    PlaneFailure, PlaneRules, StereoPlane, SurfacePlane, measure_distant_surface, measure_plane,
};
pub use rectify::{Rectifier, RectifyError};
pub use rules::{MatchRules, SurfaceRules};
pub use sparse::sparse_points;
pub use surface::{Surface, SurfaceFailure, measure_surface};

use std::sync::OnceLock;

use crate::find::noise_dn;
use crate::image::{Image8, ImageError, ImageF};
use crate::ncc::{SearchImage, Window};
use crate::sample::{Sample, SplineImage};

/// An image prepared for matching: make it once per image, use it for any number of matches.
#[derive(Clone, Debug)]
pub struct PreparedImage {
    width_px: u32,
    height_px: u32,
    grey: SearchImage,
    spline: SplineImage,
    /// Standard deviation of the grey noise, DN; measured when first asked for.
    noise_dn: OnceLock<f64>,
}

/// Tiles that the noise is measured in, and their distance, px.
const NOISE_TILE_PX: u32 = 32;
const NOISE_STEP_PX: usize = 96;

impl PreparedImage {
    /// Prepares an image (about a millisecond for 640 x 480).
    ///
    /// # Errors
    /// [`ImageError`] if the pixel buffer does not belong to the size.
    pub fn new(image: &Image8) -> Result<Self, ImageError> {
        let working = ImageF::from_image8(image)?;
        Ok(Self {
            width_px: image.width_px,
            height_px: image.height_px,
            grey: SearchImage::whole(image, 0),
            spline: SplineImage::new(&working),
            noise_dn: OnceLock::new(),
        })
    }

    /// Standard deviation of the grey noise, DN: the lower quartile over tiles of the image, since
    /// fine texture looks like noise.
    fn noise_dn(&self) -> f64 {
        *self.noise_dn.get_or_init(|| {
            let Ok(image) = self.image8() else {
                return 0.0;
            };
            let mut found = Vec::new();
            for top in (0..self.height_px).step_by(NOISE_STEP_PX) {
                for left in (0..self.width_px).step_by(NOISE_STEP_PX) {
                    let tile = Window {
                        left,
                        top,
                        width: NOISE_TILE_PX,
                        height: NOISE_TILE_PX,
                    };
                    found.push(noise_dn(&image, tile.clipped(&image)));
                }
            }
            found.sort_by(f64::total_cmp);
            found.get(found.len() / 4).copied().unwrap_or(0.0)
        })
    }

    fn image8(&self) -> Result<Image8, ImageError> {
        let rows = 0..self.height_px as usize;
        let pixels = rows.flat_map(|v| self.grey.values(v).iter());
        let pixels = pixels.map(|&held| SearchImage::grey(held).round() as u8);
        Image8::from_raw(self.width_px, self.height_px, pixels.collect())
    }

    /// The image a quarter as wide and high, each pixel the mean of sixteen; `None` if it is too
    /// small for that.
    #[must_use]
    pub fn quarter(&self) -> Option<Self> {
        let working = ImageF::from_image8(&self.image8().ok()?).ok()?;
        Self::new(&working.half()?.half()?.to_image8()).ok()
    }

    /// Value and gradient between the pixels (cubic B-spline); `None` closer than one pixel to the
    /// border.
    #[must_use]
    pub fn sample(&self, u_px: f64, v_px: f64) -> Option<Sample> {
        self.spline.sample(u_px, v_px)
    }

    /// The value of [`PreparedImage::sample`] alone, in a third of the time.
    #[must_use]
    pub fn value(&self, u_px: f64, v_px: f64) -> Option<f32> {
        self.spline.value(u_px, v_px)
    }

    /// Width, px.
    #[must_use]
    pub fn width_px(&self) -> u32 {
        self.width_px
    }

    /// Height, px.
    #[must_use]
    pub fn height_px(&self) -> u32 {
        self.height_px
    }
}

impl TryFrom<&Image8> for PreparedImage {
    type Error = ImageError;

    fn try_from(image: &Image8) -> Result<Self, ImageError> {
        Self::new(image)
    }
}

#[cfg(test)]
mod tests;
