//! End-effector position error compensation: brings the instrument to the standoff of a target.
//!
//! | file | what |
//! |---|---|
//! | `observe` | fiducial detection and triangulation in one stereo frame |
//! | `estimator` | the error vector, and the error field with a kinematic prior |
//! | `lateral` | the error in the plane of the surface and its 95 % bound |
//! | `place` | the loop: look, correct, move; convergence, divergence and occlusion rules |
//! | `service` | the loop on the bus |

pub mod estimator;
pub mod lateral;
pub mod observe;
pub mod place;
mod service;

pub use service::serve;
