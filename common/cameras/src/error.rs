//! What can go wrong when a camera model is used.

use nalgebra::{Vector2, Vector3};
use thiserror::Error;

/// Why a camera model gave no answer.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum CameraError {
    /// The point does not lie in front of the camera, so it has no image.
    #[error(
        "the point [{} {} {}] m lies {range_m} m along the camera's axis A; only points in front \
         of the camera (> 0 m) have an image",
        point.x, point.y, point.z
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
        "the direction is {off_axis_deg} deg from the optical axis O; the distortion polynomial is \
         one-to-one only within {limit_deg} deg"
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
         last step was {last_step}, expected below 1e-12",
        pixel_px.x, pixel_px.y
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
        "the point [{} {} {}] m lies {distance_m} m in front of the entrance pupil, inside the \
         lens: no single ray reaches it",
        point.x, point.y, point.z
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
         step was {last_step} rad, expected below 1e-10",
        point.x, point.y, point.z
    )]
    PupilNotFound {
        /// The point, in the model's frame, metres.
        point: Vector3<f64>,
        /// Iterations made.
        iterations: u32,
        /// The last change of the angle from O, radians.
        last_step: f64,
    },
    /// The point is imaged beyond the borders of the image.
    #[error(
        "the point is imaged at ({}, {}) px, outside the {width_px} x {height_px} px image with a \
         margin of {margin_px} px",
        pixel_px.x, pixel_px.y
    )]
    OutsideImage {
        /// Where it is imaged.
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
