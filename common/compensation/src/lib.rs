//! The end-effector position error: how it is carried from where it was seen to where it is
//! needed.
//!
//! The paper keeps one vector, seen minus predicted position, and applies it unchanged (section 3,
//! *Motion Correction*). To first order the error at a configuration `q` is `e(q) = J(q) phi` with
//! the arm's and the mount's parameter errors `phi`; a [`Compensation`] therefore carries an
//! offset, which is all that the paper's rule needs, and parameters, which let the error follow
//! the configuration.

mod model;

pub use model::{CompensationError, ErrorModel, SolvedPose};

use serde::{Deserialize, Serialize};

/// What is known of the end-effector's error: `error(q) = offset + J(q) parameters`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Compensation {
    /// Constant part of the tip's position error, seen minus predicted, rover frame, m.
    pub offset_m: [f64; 3],
    /// Constant part of the orientation error, rotation vector from predicted to seen, rover
    /// frame, rad.
    pub offset_rad: [f64; 3],
    /// Parameter errors: per joint theta (rad), d (m), a (m), alpha (rad); then the mount's
    /// rotation (rad) and translation (m). Empty for a constant error.
    pub parameters: Vec<f64>,
}

impl Compensation {
    /// No error at all: purely kinematic placement.
    pub fn none() -> Self {
        Self::constant([0.0; 3])
    }

    /// The paper's rule: one vector, the same everywhere.
    pub fn constant(offset_m: [f64; 3]) -> Self {
        Self {
            offset_m,
            offset_rad: [0.0; 3],
            parameters: Vec::new(),
        }
    }
}
