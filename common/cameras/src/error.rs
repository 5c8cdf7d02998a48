//! What can go wrong when a camera model is used.

use nalgebra::{Vector2, Vector3};
use std::fmt;
use thiserror::Error;

/// A number for a reader: five significant digits.
#[derive(Clone, Copy)]
pub(crate) struct Short(pub(crate) f64);

impl fmt::Display for Short {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const DIGITS: i32 = 5;
        let size = self.0.abs();
        if !size.is_finite() || size == 0.0 || size == size.trunc() && size < 1e9 {
            return write!(f, "{}", self.0);
        }
        let whole = size.log10().floor() as i32 + 1;
        if !(-3..=9).contains(&whole) {
            return write!(f, "{:.4e}", self.0);
        }
        let decimals = usize::try_from(DIGITS - whole).unwrap_or(0);
        let text = format!("{:.decimals$}", self.0);
        let text = if text.contains('.') {
            text.trim_end_matches('0').trim_end_matches('.')
        } else {
            &text
        };
        f.write_str(text)
    }
}

/// Why a camera model gave no answer.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum CameraError {
    /// The point does not lie in front of the camera, so it has no image.
    #[error(
        "the point [{} {} {}] m lies {} m along the camera's axis A; only points in front \
         of the camera (> 0 m) have an image",
        Short(point.x), Short(point.y), Short(point.z), Short(*range_m)
    )]
    BehindCamera {
        /// The point, in the model's frame, metres.
        point: Vector3<f64>,
        /// Its signed distance along A from the projection centre, metres.
        range_m: f64,
    },
    /// The point or pixel lies so far from the optical axis that the distortion polynomial is no
    /// longer one-to-one there: the model says nothing about it.
    #[error(
        "the direction is {} deg from the optical axis O; the distortion is one-to-one and ahead \
         of the camera only within {} deg",
        Short(*off_axis_deg), Short(*limit_deg)
    )]
    OutsideField {
        /// Angle from the optical axis O: of the direction itself in a projection, of the
        /// distorted direction that the pixel stands for in a ray, degrees.
        off_axis_deg: f64,
        /// The largest such angle that the model covers, degrees.
        limit_deg: f64,
    },
    /// The inversion of the distortion polynomial did not settle.
    #[error(
        "the distortion of pixel ({}, {}) could not be inverted: after {iterations} iterations the \
         last step was {last_step:.1e}, expected below 1e-12",
        Short(pixel_px.x), Short(pixel_px.y)
    )]
    NoConvergence {
        /// The pixel whose ray was asked for.
        pixel_px: Vector2<f64>,
        /// Iterations made.
        iterations: u32,
        /// The last change of the ratio of undistorted to distorted radius.
        last_step: f64,
    },
    /// The point lies at the entrance pupil, or so near that several rays of the lens reach it.
    #[error(
        "the point [{} {} {}] m lies {} m in front of the entrance pupil, inside the lens: no \
         single ray reaches it",
        Short(point.x), Short(point.y), Short(point.z), Short(*distance_m)
    )]
    NearPupil {
        /// The point, in the model's frame, metres.
        point: Vector3<f64>,
        /// Its distance along the ray from the moving entrance pupil, metres.
        distance_m: f64,
    },
    /// The angle at which a point is seen through the moving entrance pupil did not settle.
    #[error(
        "the ray to the point [{} {} {}] m was not found: after {iterations} iterations the last \
         step was {last_step:.1e} rad, expected below 1e-10",
        Short(point.x), Short(point.y), Short(point.z)
    )]
    PupilNotFound {
        /// The point, in the model's frame, metres.
        point: Vector3<f64>,
        /// Iterations made.
        iterations: u32,
        /// The last change of the angle from O, radians.
        last_step: f64,
    },
    /// The point is imaged beyond the borders of the image, or the pixel asked for lies there.
    #[error(
        "the pixel ({}, {}) is outside the {width_px} x {height_px} px image with a margin of \
         {margin_px} px",
        Short(pixel_px.x), Short(pixel_px.y)
    )]
    OutsideImage {
        /// The pixel.
        pixel_px: Vector2<f64>,
        /// Width of the image, px.
        width_px: u32,
        /// Height of the image, px.
        height_px: u32,
        /// The distance from the border that was asked for, px.
        margin_px: f64,
    },
    /// An input or a vector of the model is NaN or infinite, or the answer overflows.
    #[error("the point, the pixel or a vector of the camera model is not a finite number")]
    NotFinite,
    /// The model's own numbers do not describe a camera.
    #[error("invalid camera model: {reason}")]
    InvalidModel {
        /// Which vector or size is wrong, what was found and what was expected.
        reason: String,
    },
}
