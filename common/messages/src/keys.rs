//! Key expressions, all inside the robot's namespace, and the names of the services.

/// Arm state, stream of [`crate::arm::ArmState`].
pub const ARM_STATE: &str = "arm/state";
/// Joint trajectory execution, lockstep action ([`crate::arm::ExecuteGoal`]).
pub const ARM_EXECUTE: &str = "arm/execute";
/// Stops the arm now, query.
pub const ARM_STOP: &str = "arm/stop";
/// Target selection, query.
pub const TARGET_SELECT: &str = "target/select";
/// The target being worked on, stream.
pub const TARGET_CURRENT: &str = "target/current";
/// Arm planning, query.
pub const PLANNER_PLAN: &str = "planner/plan";
/// Builds the planner's obstacle map from one stereo frame, query.
pub const PLANNER_SURVEY: &str = "planner/survey";
/// End-effector position error compensation up to the standoff, action.
pub const SERVO_PLACE: &str = "servo/place";
/// Guarded motion along the normal, action.
pub const CONTACT_APPROACH: &str = "contact/approach";
/// Scores a placement against the truth; simulator only, query.
pub const SIM_TRUTH_SCORE: &str = "sim/truth/score";
/// What the simulator knows about the truth of this run; simulator only, query.
pub const SIM_TRUTH_STATE: &str = "sim/truth/state";
/// A view of the scene from an outside camera; simulator only, query.
pub const SIM_TRUTH_VIEW: &str = "sim/truth/view";
/// Lets time pass while no motion is under way; simulator only, query.
pub const SIM_STEP: &str = "sim/step";
/// Starts all over; simulator only, query.
pub const SIM_RESET: &str = "sim/reset";
/// Injects a fault; simulator only, query.
pub const SIM_FAULT_INJECT: &str = "sim/fault/inject";

/// Raw stereo pair from the hardware of `pair`, query.
pub fn camera_grab(pair: &str) -> String {
    format!("camera/{pair}/grab")
}
/// Stereo frame with camera models, query.
pub fn imaging_capture(pair: &str) -> String {
    format!("imaging/{pair}/capture")
}
/// Last left or right image of `pair` as a picture, stream.
pub fn imaging_picture(pair: &str, side: &str) -> String {
    format!("imaging/{pair}/{side}")
}
/// A service's status, stream.
pub fn status(service: &str) -> String {
    format!("{service}/status")
}
/// A service's liveliness token.
pub fn presence(service: &str) -> String {
    format!("presence/{service}")
}
/// The stream on which `service` reports its faults.
pub fn fault(service: &str) -> String {
    format!("fault/{service}")
}

/// Names under which the peers announce themselves.
pub mod service {
    /// The simulator, or the hardware driver of a real robot.
    pub const HARDWARE: &str = "rover_sim";
    /// Stereo frames with camera models.
    pub const MAST_IMAGING: &str = "mast_imaging";
    /// Pixel to target.
    pub const TARGET_SELECTION: &str = "target_selection";
    /// Arm trajectories.
    pub const ARM_PLANNER: &str = "arm_planner";
    /// Error compensation.
    pub const EPEC_SERVO: &str = "epec_servo";
    /// Guarded contact motion.
    pub const CONTACT_APPROACH: &str = "contact_approach";
    /// All services that a placement needs, in starting order; the hardware is not among them.
    pub const ALL: [&str; 5] = [
        MAST_IMAGING,
        TARGET_SELECTION,
        ARM_PLANNER,
        EPEC_SERVO,
        CONTACT_APPROACH,
    ];
}
