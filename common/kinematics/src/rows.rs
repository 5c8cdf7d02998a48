//! What an arm is described by: Denavit-Hartenberg rows and joint limits.

use crate::arm::{MAX_JOINTS, MIN_JOINTS};
use serde::{Deserialize, Serialize};

/// One row of the classic Denavit-Hartenberg table:
/// `Rz(theta + theta_offset_rad) Tz(d_m) Tx(a_m) Rx(alpha_rad)`.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq)]
#[serde(deny_unknown_fields)]
pub struct DhRow {
    /// Length along the new x axis, metres.
    pub a_m: f64,
    /// Twist about the new x axis, radians.
    pub alpha_rad: f64,
    /// Offset along the old z axis, metres.
    pub d_m: f64,
    /// Added to the joint angle, radians.
    pub theta_offset_rad: f64,
}

/// Rate of a joint without a limit, rad/s. Where joint travel is weighed by rates, such a joint
/// counts as the slowest of those that have one.
pub const NO_RATE_LIMIT_RAD_S: f64 = 1e100;

/// What one joint may do.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq)]
#[serde(deny_unknown_fields)]
pub struct JointLimits {
    /// Smallest joint angle, radians.
    pub lower_rad: f64,
    /// Largest joint angle, radians.
    pub upper_rad: f64,
    /// Largest magnitude of the joint rate, rad/s, positive; [`NO_RATE_LIMIT_RAD_S`] if it has no
    /// limit.
    pub max_rate_rad_s: f64,
    /// Largest magnitude of the joint acceleration, rad/s^2, positive.
    pub max_acceleration_rad_s2: f64,
}

/// Why an arm cannot be built or asked. Joint indices count from 0.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ArmError {
    /// Too few or too many rows.
    #[error("an arm has {MIN_JOINTS} to {MAX_JOINTS} joints, got {found} Denavit-Hartenberg rows")]
    JointCount {
        /// Rows given.
        found: usize,
    },
    /// A list has the wrong length for this arm.
    #[error("{what}: expected {expected} values, got {found}")]
    WrongLength {
        /// Which list.
        what: &'static str,
        /// Length that fits the arm.
        expected: usize,
        /// Length given.
        found: usize,
    },
    /// A number is NaN or infinite.
    #[error("{what}[{index}] = {value} is not a finite number")]
    NotFinite {
        /// Which list or vector.
        what: &'static str,
        /// Place in it, from 0.
        index: usize,
        /// The offending value.
        value: f64,
    },
    /// A joint's limits contradict themselves.
    #[error("joint[{joint}]: {what} = {value}, expected {expected}")]
    BadLimit {
        /// Joint, from 0.
        joint: usize,
        /// Field of [`JointLimits`].
        what: &'static str,
        /// Value given.
        value: f64,
        /// What would be right.
        expected: &'static str,
    },
    /// A joint angle is outside its limits.
    #[error("joint[{joint}] = {value_rad:.6} rad is outside {lower_rad:.6} to {upper_rad:.6} rad")]
    OutsideLimit {
        /// Joint, from 0.
        joint: usize,
        /// Joint angle, radians.
        value_rad: f64,
        /// Lower limit, radians.
        lower_rad: f64,
        /// Upper limit, radians.
        upper_rad: f64,
    },
}

/// Refuses a vector with a component that is not finite.
pub(crate) fn finite(what: &'static str, values: &[f64]) -> Result<(), ArmError> {
    match values.iter().position(|v| !v.is_finite()) {
        None => Ok(()),
        Some(index) => Err(ArmError::NotFinite {
            what,
            index,
            value: values[index],
        }),
    }
}
