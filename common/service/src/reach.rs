//! Why the arm cannot take a pose, as a fault with numbers.

use rover_kinematics::{ArmError, IkError};
use rover_messages::Fault;
use rover_robot::Robot;

/// The fault for `what` (e.g. `the pose`) that has no joint angles: `target_out_of_reach`,
/// `axis_infeasible`, `joint_limit`, `no_solution` or `bad_joints`.
pub fn reach_refusal(robot: &Robot, service: &str, what: &str, error: &IkError) -> Fault {
    let fault = |name, message: String| Fault::new(service, name, message);
    match error {
        IkError::OutOfReach { by_m, .. } => {
            fault("target_out_of_reach", format!("{what}: {error}")).with("beyond_reach_m", *by_m)
        }
        IkError::AxisInfeasible { by_rad } => {
            fault("axis_infeasible", format!("{what}: {error}")).with("axis_miss_rad", *by_rad)
        }
        IkError::JointLimit {
            joint,
            value_rad,
            lower_rad,
            upper_rad,
        } => limit_refusal(
            robot,
            service,
            what,
            *joint,
            *value_rad,
            [*lower_rad, *upper_rad],
        ),
        IkError::Arm(error) => joints_refusal(robot, service, what, error),
        IkError::NoConvergence {
            position_error_m,
            axis_error_rad,
            ..
        } => fault("no_solution", format!("{what}: {error}"))
            .with("position_error_m", *position_error_m)
            .with("axis_error_rad", *axis_error_rad),
        other => fault("no_solution", format!("{what}: {other}")),
    }
}

/// The fault for joint angles that the arm cannot take: `joint_limit` or `bad_joints`.
pub fn joints_refusal(robot: &Robot, service: &str, what: &str, error: &ArmError) -> Fault {
    match error {
        ArmError::OutsideLimit {
            joint,
            value_rad,
            lower_rad,
            upper_rad,
        } => limit_refusal(
            robot,
            service,
            what,
            *joint,
            *value_rad,
            [*lower_rad, *upper_rad],
        ),
        other => Fault::new(service, "bad_joints", format!("{what}: {other}")),
    }
}

fn limit_refusal(
    robot: &Robot,
    service: &str,
    what: &str,
    joint: usize,
    value_rad: f64,
    limits_rad: [f64; 2],
) -> Fault {
    let name = robot
        .description()
        .arm
        .joints
        .get(joint)
        .map_or("?", |j| j.name.as_str());
    let [lower_rad, upper_rad] = limits_rad;
    let message = format!(
        "{what}: joint {joint} `{name}` would be at {value_rad:.4} rad, expected {lower_rad:.4} \
         to {upper_rad:.4} rad"
    );
    Fault::new(service, "joint_limit", message)
        .with("joint_n", joint as f64)
        .with("value_rad", value_rad)
        .with("lower_rad", lower_rad)
        .with("upper_rad", upper_rad)
}
