//! The plane of the surface under a pixel of a view.

use crate::error::TrackError;
use crate::view::View;
use nalgebra::{Vector2, Vector3};

pub use rover_vision::{PlaneRules, StereoPlane, SurfacePlane};

/// Measures the plane at a left pixel; the range is searched between `range_m`, and `normal` (rover
/// frame), if known, is one of the slants tried.
///
/// # Errors
/// [`TrackError::NoPlane`] with the match's own reason.
pub fn measure_plane(
    view: &View,
    pixel_px: &Vector2<f64>,
    range_m: [f64; 2],
    normal: Option<&Vector3<f64>>,
    rules: &PlaneRules,
) -> Result<StereoPlane, TrackError> {
    let images = (&view.left, &view.right);
    rover_vision::measure_plane(images, &view.cameras, pixel_px, range_m, normal, rules).map_err(
        |reason| TrackError::NoPlane {
            u_px: pixel_px.x,
            v_px: pixel_px.y,
            reason: reason.to_string(),
        },
    )
}
