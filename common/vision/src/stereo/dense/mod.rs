//! Disparity of every pixel of a rectified pair, for the operator's view and for obstacles.
//!
//! Both images are reduced to their horizontal derivative (Sobel, clipped), which takes out light
//! and gain. Sums of absolute differences over a square window are compared ([`costs`]): the least
//! wins if it is clearly less than any other two or more pixels away, if the way back from the right
//! image leads to the same pixel, and if there is texture. Two lines of opposite slope through three
//! sums give a start to a hundredth of a pixel; windows over slanted ground blur it, so a plane
//! through the agreeing neighbours replaces it where they lie on one.
//! All arithmetic is in whole numbers: the result does not depend on the vector unit.

mod costs;
mod export;
mod lanes;
mod regions;
mod smoothing;

pub use export::PairDisparityError;

use serde::{Deserialize, Serialize};

use crate::image::{Image8, ImageError};

/// Settings of the dense matcher.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DenseRules {
    /// Disparities searched: 0 to this, exclusive; 16 to 256.
    pub disparities: u32,
    /// Half the side of the window less half a pixel: 3, 4 or 5 (7 x 7 to 11 x 11 px).
    pub half_window_px: u32,
    /// How much larger, in per cent, every sum two or more pixels away must be.
    pub uniqueness_percent: u32,
    /// Largest difference between the disparities of both directions, px.
    pub left_right_px: u32,
    /// Least mean clipped derivative in the window, DN/px (of 31).
    pub min_texture_dn: u32,
    /// Half the side of the window of the plane through neighbours, less half a pixel; 0 for none.
    pub half_plane_px: u32,
    /// A pair of opposite neighbours agrees with a pixel if their differences from its disparity add
    /// up to no more, px (those of a slope cancel).
    pub agreement_px: f32,
    /// Connected regions of fewer pixels are dropped.
    pub min_region_px: u32,
}

impl Default for DenseRules {
    fn default() -> Self {
        Self {
            disparities: 64,
            half_window_px: 4,
            uniqueness_percent: 8,
            left_right_px: 1,
            min_texture_dn: 2,
            half_plane_px: 3,
            agreement_px: 1.5,
            min_region_px: 80,
        }
    }
}

/// Why there is no disparity image.
#[derive(Debug, thiserror::Error)]
pub enum DenseError {
    /// A setting that cannot be worked with.
    #[error("dense rules: {name} is {found}, expected {expected}")]
    Rules {
        /// The field.
        name: &'static str,
        /// Its value.
        found: f64,
        /// What was expected.
        expected: &'static str,
    },
    /// Images of different sizes, or too small.
    #[error(
        "the images have {left:?} and {right:?} px, expected equal sizes of at least {least:?} px"
    )]
    Sizes {
        /// Left width and height, px.
        left: [u32; 2],
        /// Right width and height, px.
        right: [u32; 2],
        /// Least width and height, px.
        least: [u32; 2],
    },
    /// An image cannot be used.
    #[error(transparent)]
    Image(#[from] ImageError),
}

/// Steps of a held disparity per px.
pub(super) const STEPS: i32 = 64;
/// Mark of a pixel without disparity.
pub(super) const NONE: i16 = i16::MIN;

/// The disparity of every pixel of the left image: left column less right column, px.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Disparity {
    /// Width, px.
    pub width_px: u32,
    /// Height, px.
    pub height_px: u32,
    pub(super) held: Vec<i16>,
}

impl Disparity {
    /// Disparity at a pixel, px; `None` where there is none.
    #[must_use]
    pub fn at(&self, u: u32, v: u32) -> Option<f64> {
        if u >= self.width_px || v >= self.height_px {
            return None;
        }
        let held = self.held[v as usize * self.width_px as usize + u as usize];
        (held != NONE).then(|| f64::from(held) / f64::from(STEPS))
    }

    /// Pixels with a disparity.
    #[must_use]
    pub fn count(&self) -> usize {
        self.held.iter().filter(|&&d| d != NONE).count()
    }
}

impl DenseRules {
    fn validate(&self) -> Result<(), DenseError> {
        let check = |name, found: f64, low: f64, high: f64, expected| {
            if (low..=high).contains(&found) {
                Ok(())
            } else {
                Err(DenseError::Rules {
                    name,
                    found,
                    expected,
                })
            }
        };
        check(
            "disparities",
            self.disparities.into(),
            16.0,
            256.0,
            "16 to 256",
        )?;
        check(
            "half_window_px",
            self.half_window_px.into(),
            3.0,
            5.0,
            "3, 4 or 5",
        )?;
        check(
            "uniqueness_percent",
            self.uniqueness_percent.into(),
            0.0,
            100.0,
            "0 to 100",
        )?;
        check(
            "left_right_px",
            self.left_right_px.into(),
            0.0,
            16.0,
            "0 to 16",
        )?;
        check(
            "min_texture_dn",
            self.min_texture_dn.into(),
            0.0,
            31.0,
            "0 to 31",
        )?;
        check(
            "half_plane_px",
            self.half_plane_px.into(),
            0.0,
            7.0,
            "0 to 7",
        )?;
        check(
            "agreement_px",
            self.agreement_px.into(),
            0.1,
            4.0,
            "0.1 to 4",
        )?;
        check(
            "min_region_px",
            self.min_region_px.into(),
            0.0,
            1e9,
            "0 or more",
        )
    }
}

/// Disparity of every pixel of a rectified pair (see [`super::Rectifier`]).
///
/// # Errors
/// [`DenseError`] for settings or images that cannot be used.
pub fn dense_disparity(
    left: &Image8,
    right: &Image8,
    rules: &DenseRules,
) -> Result<Disparity, DenseError> {
    rules.validate()?;
    left.validate()?;
    right.validate()?;
    let side = 2 * rules.half_window_px + 1;
    let least = [rules.disparities + side, side + 2];
    let sizes = [left, right].map(|i| [i.width_px, i.height_px]);
    if sizes[0] != sizes[1] || sizes[0][0] < least[0] || sizes[0][1] < least[1] {
        return Err(DenseError::Sizes {
            left: sizes[0],
            right: sizes[1],
            least,
        });
    }
    let mut disparity = Disparity {
        width_px: left.width_px,
        height_px: left.height_px,
        held: costs::matched(left, right, rules),
    };
    regions::drop_small(&mut disparity, rules.min_region_px as usize);
    if rules.half_plane_px > 0 {
        let agreement = (rules.agreement_px * STEPS as f32) as i16;
        smoothing::smooth(&mut disparity, rules.half_plane_px as usize, agreement);
    }
    Ok(disparity)
}

#[cfg(test)]
mod tests;
