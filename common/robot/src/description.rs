//! The robot file, field by field.

use crate::{CameraMount, MastDescription, MobilityDescription, VehicleDynamics};
use rover_cameras::StereoPair;
use rover_vision::PlateLayout;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// A robot file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotDescription {
    /// Name of the robot and namespace of its keys: lower-case letters, digits, `_`.
    pub name: String,
    /// Stated calibration quality: the prior of the error field.
    pub model_quality: ModelQuality,
    /// The arm.
    pub arm: ArmDescription,
    /// The instrument.
    pub tool: ToolDescription,
    /// The plate on the last link.
    pub fiducial: FiducialDescription,
    /// Camera pairs.
    pub cameras: Vec<CameraPairDescription>,
    /// Named joint postures, rad.
    pub postures: BTreeMap<String, Vec<f64>>,
    /// The body to which the arm is mounted, for collision checks, rover frame.
    #[serde(default)]
    pub body: Vec<Capsule>,
    /// The mast, if there is one.
    #[serde(default)]
    pub mast: Option<MastDescription>,
    /// The wheels, if there are any.
    #[serde(default)]
    pub mobility: Option<MobilityDescription>,
    /// Masses and stiffnesses; only a simulator needs them.
    #[serde(default)]
    pub dynamics: Option<Dynamics>,
}

/// Standard deviations of the believed model's parameters.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelQuality {
    /// Joint offsets, twist angles and camera mount rotation, deg, one sigma.
    pub angle_deg: f64,
    /// Link lengths, offsets and camera mount translation, mm, one sigma.
    pub length_mm: f64,
}

/// Position and fixed-axis roll, pitch, yaw.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PoseDescription {
    /// Position, m.
    pub xyz_m: [f64; 3],
    /// Roll, pitch, yaw about fixed axes, deg.
    pub rpy_deg: [f64; 3],
}

/// The arm.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ArmDescription {
    /// Pose of the arm's base frame in the rover frame.
    pub base: PoseDescription,
    /// Heartbeat period of the arm's driver, s: simulated time never passes it without a
    /// heartbeat from the commander.
    pub heartbeat_s: f64,
    /// Joints, base to tip.
    pub joints: Vec<JointDescription>,
}

/// One joint and the link that it carries: a classic Denavit-Hartenberg row,
/// `Rz(q + theta_offset) Tz(d) Tx(a) Rx(alpha)`, with limits and shape.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JointDescription {
    /// Name for messages.
    pub name: String,
    /// Link length, m.
    pub a_m: f64,
    /// Link twist, rad.
    pub alpha_rad: f64,
    /// Link offset, m.
    pub d_m: f64,
    /// Joint angle at encoder zero, rad.
    #[serde(default)]
    pub theta_offset_rad: f64,
    /// Lower limit, rad.
    pub lower_rad: f64,
    /// Upper limit, rad.
    pub upper_rad: f64,
    /// Largest rate, rad/s.
    pub max_rate_rad_s: f64,
    /// Largest acceleration, rad/s^2.
    pub max_acceleration_rad_s2: f64,
    /// Shape of the link, in the link's own frame.
    #[serde(default)]
    pub shape: Vec<Capsule>,
}

/// A capsule: all points within `radius_m` of a segment.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Capsule {
    /// One end of the segment, m.
    pub from_m: [f64; 3],
    /// The other end, m.
    pub to_m: [f64; 3],
    /// Radius, m.
    pub radius_m: f64,
}

/// The instrument on the last link.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ToolDescription {
    /// Contact point with the switch released, last link frame, m.
    pub tip_m: [f64; 3],
    /// Approach direction (into the surface), last link frame.
    pub axis: [f64; 3],
    /// The contact switch.
    pub switch: ContactSwitch,
}

/// A sprung plunger that closes a switch.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ContactSwitch {
    /// Radius of the plunger's ball tip, m.
    pub ball_radius_m: f64,
    /// Travel at which the switch closes, m.
    pub closes_at_m: f64,
    /// Travel at the end stop, m.
    pub travel_m: f64,
    /// Spring rate, N/m.
    pub spring_n_m: f64,
    /// Spring force with the plunger released, N.
    pub preload_n: f64,
}

/// The plate with the fiducial marks on the last link.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FiducialDescription {
    /// Centre of the plate, last link frame, m.
    pub centre_m: [f64; 3],
    /// Outward normal of the plate, last link frame.
    pub normal: [f64; 3],
    /// Direction of the plate's x axis (to the right, seen from the front), last link frame; made
    /// orthogonal to the normal.
    pub right: [f64; 3],
    /// The marks.
    pub layout: PlateLayout,
}

/// A calibrated stereo pair.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraPairDescription {
    /// Name of the pair, as in the keys.
    pub name: String,
    /// What the pair is mounted on.
    #[serde(default, skip_serializing_if = "CameraMount::is_body")]
    pub mount: CameraMount,
    /// Camera models, in the frame of what the pair is mounted on: the rover frame or the mast's
    /// head. [`crate::Robot::cameras_at`] places them.
    pub cameras: StereoPair,
    /// Nearest range at which surfaces are measured, m.
    pub range_min_m: f64,
    /// Farthest range at which surfaces are measured, m.
    pub range_max_m: f64,
}

/// Masses and stiffnesses for simulation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Dynamics {
    /// Gravity, rover frame, m/s^2.
    pub gravity_m_s2: [f64; 3],
    /// One per joint.
    pub links: Vec<LinkDynamics>,
    /// Body, suspension and wheels of a robot that drives.
    #[serde(default)]
    pub vehicle: Option<VehicleDynamics>,
}

/// Dynamics of one joint and its link.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LinkDynamics {
    /// Mass of the link, kg.
    pub mass_kg: f64,
    /// Centre of mass, link frame, m.
    pub com_m: [f64; 3],
    /// Principal moments of inertia about the centre of mass, kg m^2.
    pub inertia_kg_m2: [f64; 3],
    /// Stiffness of drive and link in series, N m/rad: gravity droop is torque over this.
    pub stiffness_nm_rad: f64,
    /// Damping of the drive, N m s/rad.
    pub damping_nms_rad: f64,
    /// Largest drive torque, N m.
    pub max_torque_nm: f64,
}
