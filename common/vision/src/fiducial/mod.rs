//! The end-effector's fiducial: where its plate, and every point on it, is in an image.
//!
//! The pose predicted from the arm and the camera model says what the plate should look like
//! (paper section 3, "Fiducial Detection": a local search at the position that the kinematics
//! predict). The search runs in stages: correlation with the warped appearance, alignment of the
//! whole plate, then a separate fit of each point's blurred image model, so that perspective needs
//! no correction afterwards and a shadow, a reflection or an occlusion spoils single points only.

mod align;
mod lanes;
mod local_map;
mod locate;
mod mark;
mod model;
mod points;
mod pose;
mod rules;
mod window;

use nalgebra::{Isometry3, Vector2, Vector3};
use rover_cameras::Camera;

use crate::image::Image8;
use crate::plate::PlateLayout;

pub(crate) use lanes::normal_at;
pub use mark::PointFault;
pub use pose::{PlatePose, estimate_plate_pose, estimate_plate_pose_single};
pub(crate) use pose::{Sighting, solve_pose};
pub use rules::DetectionRules;

/// What to look for, and where.
#[derive(Clone, Copy, Debug)]
pub struct PlateSearch<'a> {
    /// The camera that took the image.
    pub camera: &'a Camera,
    /// The plate's pattern.
    pub layout: &'a PlateLayout,
    /// Predicted pose of the plate in the frame of the camera model's vectors.
    pub predicted_camera_frame_from_plate: Isometry3<f64>,
    /// How far the plate's centre may be from its predicted pixel, px in u and in v.
    pub search_radius_px: f64,
    /// Thresholds.
    pub rules: &'a DetectionRules,
}

/// What kind of mark a point is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PointKind {
    /// The centre of a disc.
    Disc,
    /// The crossing of the central checker.
    Saddle,
}

/// One point of the plate seen in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointObservation {
    /// Disc index; `layout.discs.len()` is the saddle.
    pub index: usize,
    /// The point in the plate frame, m.
    pub point_in_plate: Vector3<f64>,
    /// Its image, px: the projection of the point itself, perspective accounted for.
    pub pixel_px: Vector2<f64>,
    /// Standard deviation of `pixel_px` in each direction, px.
    pub sigma_px: f64,
    /// Disc or saddle.
    pub kind: PointKind,
}

/// The plate seen in an image.
#[derive(Clone, Debug, PartialEq)]
pub struct PlateObservation {
    /// The points that passed all checks, by index.
    pub points: Vec<PointObservation>,
    /// NCC of the image with the aligned appearance of the plate.
    pub score: f64,
    /// Points that were tried and refused, and why.
    pub refused: Vec<(usize, PointFault)>,
    /// Standard deviation of the blur that fits the edges best, px.
    pub blur_sigma_px: f64,
}

/// Why a plate, a saddle or a pose was not found.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum NotFound {
    /// The predicted plate does not lie in the image.
    #[error(
        "the plate is predicted at pixel ({u_px:.1}, {v_px:.1}); with its size and a search of \
         {search_radius_px} px it does not fit the image"
    )]
    OutsideImage {
        /// Predicted centre, px.
        u_px: f64,
        /// Predicted centre, px.
        v_px: f64,
        /// Search radius, px.
        search_radius_px: f64,
    },
    /// The predicted plate is behind the camera or shows its back or edge.
    #[error("the predicted plate cannot be seen: {0}")]
    NotVisible(String),
    /// The predicted plate is too small in the image for its marks to be measured.
    #[error("the plate's marks would be {found_px:.2} px in radius, {needed_px} px are needed")]
    TooSmall {
        /// Smallest mark's radius, px.
        found_px: f64,
        /// Least radius, px.
        needed_px: f64,
    },
    /// Nothing in the search window looks enough like the plate.
    #[error("the best correlation with the plate is {score:.3}, at least {limit} is needed")]
    LowScore {
        /// Best NCC.
        score: f64,
        /// Least NCC.
        limit: f64,
    },
    /// The plate was recognised, but too few of its points can be measured.
    #[error("{found} of the plate's points could be measured, {needed} are needed{}", because(.first_fault))]
    TooFewPoints {
        /// Points that passed.
        found: usize,
        /// Least number of points.
        needed: usize,
        /// One of the refused points and why it was refused.
        first_fault: Option<(usize, PointFault)>,
    },
    /// The layout has no saddle, and a saddle was asked for.
    #[error("the plate's layout has no saddle")]
    NoSaddle,
    /// The pose did not settle, or the points do not fit one rigid plate.
    #[error("the plate's pose does not fit its points: {rms_px:.3} px rms, limit {limit_px} px")]
    PoseMisfit {
        /// Root mean square reprojection error per coordinate, px.
        rms_px: f64,
        /// Largest accepted value, px.
        limit_px: f64,
    },
    /// The points do not determine a pose.
    #[error("the plate's points do not determine its pose")]
    PoseUndetermined,
    /// Image, layout, rules or prediction cannot be used.
    #[error("{0}")]
    BadInput(String),
}

fn because(fault: &Option<(usize, PointFault)>) -> String {
    match fault {
        Some((index, fault)) => format!("; point {index}: {fault}"),
        None => String::new(),
    }
}

/// Checks that hold for every search, and the map of the plate around its centre.
fn prepare(image: &Image8, search: &PlateSearch) -> Result<local_map::LocalMap, NotFound> {
    let bad = |e: &dyn std::fmt::Display| NotFound::BadInput(e.to_string());
    image.validate().map_err(|e| bad(&e))?;
    search.layout.validate().map_err(|e| bad(&e))?;
    search.rules.validate().map_err(NotFound::BadInput)?;
    if (image.width_px, image.height_px) != (search.camera.width_px, search.camera.height_px) {
        return Err(NotFound::BadInput(format!(
            "the image has {} x {} px, the camera model {} x {} px",
            image.width_px, image.height_px, search.camera.width_px, search.camera.height_px
        )));
    }
    if !(search.search_radius_px.is_finite() && search.search_radius_px >= 0.0) {
        return Err(NotFound::BadInput(format!(
            "the search radius is {} px, expected 0 or more",
            search.search_radius_px
        )));
    }
    let pose = &search.predicted_camera_frame_from_plate;
    local_map::LocalMap::new(search.camera, pose, &Vector3::zeros())
}

/// Finds the plate and measures its points.
///
/// # Errors
/// [`NotFound`] with the reason and the numbers behind it. An image without a plate gives
/// [`NotFound::LowScore`] or [`NotFound::TooFewPoints`].
pub fn find_plate(image: &Image8, search: &PlateSearch) -> Result<PlateObservation, NotFound> {
    let map = prepare(image, search)?;
    locate::locate(image, search, &map, model::Part::Plate, &|candidate| {
        points::measure(image, search, candidate)
    })
}

/// Finds the central marker alone: the position-only fiducial of the paper.
///
/// # Errors
/// [`NotFound`] with the reason and the numbers behind it.
pub fn find_saddle(image: &Image8, search: &PlateSearch) -> Result<PointObservation, NotFound> {
    let saddle = search.layout.saddle.as_ref().ok_or(NotFound::NoSaddle)?;
    let mut map = prepare(image, search)?;
    let centre = Vector3::new(saddle.x_m, saddle.y_m, 0.0);
    if centre != Vector3::zeros() {
        let pose = &search.predicted_camera_frame_from_plate;
        map = local_map::LocalMap::new(search.camera, pose, &centre)?;
    }
    locate::locate(image, search, &map, model::Part::Saddle, &|candidate| {
        points::measure_saddle(image, search, candidate)
    })
}

#[cfg(test)]
mod tests;
