//! Errors of the servo's parts as faults with a stable name.

use crate::estimator::EstimatorError;
use rover_compensation::CompensationError;
use rover_messages::{Fault, keys::service::EPEC_SERVO, placement::Method};
use rover_methods::MethodError;

pub fn fault(name: &str, message: impl Into<String>) -> Fault {
    Fault::new(EPEC_SERVO, name, message)
}

pub fn compensation_fault(error: &CompensationError) -> Fault {
    match error {
        CompensationError::Unreachable(e) => fault(
            "corrected_pose_out_of_reach",
            format!("{e}; choose another target"),
        ),
        other => fault("internal", other.to_string()),
    }
}

pub fn method_fault(method: Method, error: &MethodError) -> Fault {
    match error {
        MethodError::Unreachable(e) => fault(
            "corrected_pose_out_of_reach",
            format!("{e}; choose another target"),
        ),
        other => fault(
            "method_has_no_command",
            format!("{}: {other}", method.name()),
        ),
    }
}

pub fn estimator_fault(error: &EstimatorError) -> Fault {
    fault("internal", error.to_string())
}
