//! Camera models of the CAHV family, rays, and stereo triangulation.

// `!(x > limit)` is meant: a NaN has to take the branch of the error.
#![allow(clippy::neg_cmp_op_on_partial_ord)]

mod cahv;
mod cahvor;
mod camera;
mod error;
pub mod formats;
mod intrinsics;
mod linear;
mod radial;
mod stereo;

pub use cahv::Cahv;
pub use cahvor::Cahvor;
pub use camera::{Camera, CameraModel, Projection, Ray};
pub use error::CameraError;
pub use intrinsics::Intrinsics;
pub use stereo::{MissLimit, Side, StereoPair, Triangulation, TriangulationError, closest_point};
