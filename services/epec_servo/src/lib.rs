//! End-effector position error compensation: brings the instrument to the standoff of a target.
//!
//! | file | what |
//! |---|---|
//! | `observe` | fiducial detection and triangulation in one stereo frame |
//! | `estimator` | the error vector, and the error field with a kinematic prior |
//! | `driven` | every other method of `rover-methods` in the same loop |
//! | `survey` | the poses at which some of them look before the approach |
//! | `lateral` | the error in the plane of the surface and its 95 % bound |
//! | `place` | the loop: look, correct, move; convergence, divergence and occlusion rules |
//! | `refusal` | errors as faults with a name |
//! | `service` | the loop on the bus |

pub mod driven;
pub mod estimator;
pub mod lateral;
pub mod observe;
pub mod place;
mod refusal;
mod service;
pub mod survey;

pub use service::serve;
