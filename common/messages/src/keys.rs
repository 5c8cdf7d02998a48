//! Key expressions, all inside the robot's namespace, and the names of the services.

/// Arm state, stream of [`crate::arm::ArmState`].
pub const ARM_STATE: &str = "arm/state";
/// Joint trajectory execution, lockstep action ([`crate::arm::ExecuteGoal`]).
pub const ARM_EXECUTE: &str = "arm/execute";
/// Stops the arm now, query.
pub const ARM_STOP: &str = "arm/stop";
/// Mast angles, stream of [`crate::mobility::MastState`].
pub const MAST_STATE: &str = "mast/state";
/// Points the mast, lockstep action ([`crate::mobility::PointGoal`]).
pub const MAST_POINT: &str = "mast/point";
/// Odometry and attitude, stream of [`crate::mobility::WheelsState`].
pub const WHEELS_STATE: &str = "wheels/state";
/// Drives one arc or turns in place, lockstep action ([`crate::mobility::DriveGoal`]).
pub const WHEELS_DRIVE: &str = "wheels/drive";
/// Stops the wheels now, query.
pub const WHEELS_STOP: &str = "wheels/stop";
/// Drives until a target lies in the arm's workspace, action
/// ([`crate::approach::DriveToGoal`]).
pub const APPROACH_DRIVE_TO: &str = "approach/drive_to";
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
/// Remembers the true surface point of a pixel; simulator only, query.
pub const SIM_TRUTH_DESIGNATE: &str = "sim/truth/designate";
/// A place that a person might choose as a target; simulator only, query.
pub const SIM_TRUTH_PICK: &str = "sim/truth/pick";
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
/// One of the last stereo frames again, query ([`crate::imaging::FrameReference`]).
pub fn imaging_recall(pair: &str) -> String {
    format!("imaging/{pair}/recall")
}
/// Pictures all round as one mosaic, query ([`crate::panorama::PanoramaRequest`]); the mast moves.
pub fn imaging_panorama(pair: &str) -> String {
    format!("imaging/{pair}/panorama")
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
    /// Drives to a target and tracks it; only for a robot with mast and wheels.
    pub const ROVER_APPROACH: &str = "rover_approach";
    /// Arm trajectories.
    pub const ARM_PLANNER: &str = "arm_planner";
    /// Error compensation.
    pub const EPEC_SERVO: &str = "epec_servo";
    /// Guarded contact motion.
    pub const CONTACT_APPROACH: &str = "contact_approach";
    /// All services that a placement with any robot needs, in starting order; the hardware is
    /// not among them, nor is [`ROVER_APPROACH`].
    pub const ALL: [&str; 5] = [
        MAST_IMAGING,
        TARGET_SELECTION,
        ARM_PLANNER,
        EPEC_SERVO,
        CONTACT_APPROACH,
    ];
}
