//! The robot as its users describe it: one TOML file with arm, tool, fiducial, cameras, shape,
//! postures and stated calibration quality. Services believe it; the simulator perturbs its own
//! copy.
//!
//! Arms can also be read from URDF files: [`urdf`].
//!
//! Every field is checked when a file is read and the message names the field, what was found and
//! what was expected; unknown fields are refused.

mod check;
mod description;
mod mobile;
mod placing;
mod robot;
pub mod urdf;

pub use description::{
    ArmDescription, CameraPairDescription, Capsule, ContactSwitch, Dynamics, FiducialDescription,
    JointDescription, LinkDynamics, ModelQuality, PoseDescription, RobotDescription,
    ToolDescription,
};
pub use mobile::{
    CameraMount, ComplianceDescription, MastDescription, MastQuality, MobilityDescription,
    MobilityLimits, OdometryQuality, VehicleDynamics,
};
pub use robot::{Robot, RobotError, TOOL_REACH_M};
