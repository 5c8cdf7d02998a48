//! Images and what is measured in them: interest points, the end-effector's fiducial, and the
//! surface under a pixel of a stereo pair.

pub mod image;
pub mod ncc;
pub mod plate;
pub mod sample;
