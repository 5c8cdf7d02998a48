//! Images and what is measured in them: interest points, the end-effector's fiducial, and the
//! surface under a pixel of a stereo pair.

// `!(x >= limit)` refuses a NaN as well, which `x < limit` would let through
#![allow(clippy::neg_cmp_op_on_partial_ord)]

pub mod board;
pub mod fiducial;
pub mod find;
pub mod harris;
pub mod image;
pub mod ncc;
pub mod picture;
pub mod plate;
pub mod sample;
pub mod stereo;
#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod synthetic;
pub mod texture;

// the reference renderer is shared with the benches, which see this crate from outside
#[cfg(test)]
extern crate self as rover_vision;

pub use fiducial::{
    DetectionRules, NotFound, PlateObservation, PlatePose, PlateSearch, PointFault, PointKind,
    PointObservation, estimate_plate_pose, estimate_plate_pose_single, find_plate, find_saddle,
};
pub use image::{Image8, ImageError, ImageF, encode_png};
pub use plate::{Disc, LayoutError, PlateLayout, Saddle};
pub use stereo::{
    DenseError, DenseRules, Disparity, MatchFailure, MatchRules, PairDisparityError, PlaneFailure,
    PlaneRules, PreparedImage, Rectifier, RectifyError, StereoMatch, StereoPlane, Surface,
    SurfaceFailure, SurfacePlane, SurfaceRules, dense_disparity, match_point,
    measure_distant_surface, measure_plane, measure_surface, sparse_points,
};
