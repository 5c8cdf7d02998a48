//! Arms from robot models in the Unified Robot Description Format (URDF).
//!
//! A file is read into links and joints ([`Urdf`]); the chain of revolute joints between two links is
//! then converted to Denavit-Hartenberg rows ([`UrdfArm`]). The conversion is exact: where two
//! neighbouring joint axes are nearly parallel a row gets Hayati's fifth number
//! ([`Arm::with_tilts`](rover_kinematics::Arm::with_tilts)).
//!
//! What a URDF cannot say, or says in a way that is not understood, is reported with its line: an error
//! where it concerns the chain, a [`Note`] otherwise. Numbers that are missing are never made up: rate
//! and acceleration limits that the file lacks have to be given in [`ChainOptions`].

mod chain;
mod convert;
mod parse;
mod xml;

pub use chain::{ChainOptions, UrdfArm};

use nalgebra::{Isometry3, Unit, Vector3};
use rover_files::FileError;
use std::path::PathBuf;

/// Why a URDF cannot be used. Lines count from 1.
#[derive(Debug, thiserror::Error)]
pub enum UrdfError {
    /// The file could not be read.
    #[error("{file}: {source}")]
    File {
        /// The file.
        file: String,
        /// What the system said.
        source: FileError,
    },
    /// The text is not what was expected.
    #[error("{file}:{line}:{column}: {message}")]
    Text {
        /// The file.
        file: String,
        /// Line.
        line: u32,
        /// Column.
        column: u32,
        /// What was found, and what was expected.
        message: String,
    },
    /// The links asked for do not make an arm.
    #[error("{file}: {message}")]
    Chain {
        /// The file.
        file: String,
        /// What was found, and what was expected.
        message: String,
    },
}

/// Something in the file that has no part in the arm, or was taken in a way worth knowing.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Note {
    /// Line, from 1.
    pub line: u32,
    /// What it is.
    pub message: String,
}

/// What a joint does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JointKind {
    /// It turns, between limits.
    Revolute,
    /// It turns without end.
    Continuous,
    /// It slides.
    Prismatic,
    /// It does not move.
    Fixed,
    /// It moves freely.
    Floating,
    /// It moves in a plane.
    Planar,
}

/// The limits of a joint as far as the file has them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct UrdfLimits {
    /// Lower limit, rad.
    pub lower_rad: Option<f64>,
    /// Upper limit, rad.
    pub upper_rad: Option<f64>,
    /// Largest rate, rad/s.
    pub velocity_rad_s: Option<f64>,
    /// Largest torque, N m.
    pub effort_nm: Option<f64>,
}

/// A joint.
#[derive(Clone, Debug, PartialEq)]
pub struct UrdfJoint {
    /// Its name.
    pub name: String,
    /// Its line, from 1.
    pub line: u32,
    /// What it does.
    pub kind: JointKind,
    /// Index of the parent link.
    pub parent: usize,
    /// Index of the child link.
    pub child: usize,
    /// Pose of the joint's frame in the parent link.
    pub parent_from_joint: Isometry3<f64>,
    /// Its axis in its own frame.
    pub axis: Unit<Vector3<f64>>,
    /// Its limits.
    pub limits: UrdfLimits,
    /// The joint that it copies, if it does.
    pub mimics: Option<String>,
}

/// A link.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UrdfLink {
    /// Its name.
    pub name: String,
    /// Its line, from 1.
    pub line: u32,
}

/// A mesh that the file refers to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MeshReference {
    /// The link that it belongs to.
    pub link: String,
    /// Its line, from 1.
    pub line: u32,
    /// As it is written, `package://arm/meshes/link.stl`.
    pub uri: String,
    /// The file that it names, if there is one.
    pub path: Option<PathBuf>,
}

/// A robot model.
#[derive(Clone, Debug, PartialEq)]
pub struct Urdf {
    /// The file, for messages.
    pub file: String,
    /// Name of the robot.
    pub name: String,
    /// Links.
    pub links: Vec<UrdfLink>,
    /// Joints.
    pub joints: Vec<UrdfJoint>,
    /// Meshes.
    pub meshes: Vec<MeshReference>,
    /// What was passed over.
    pub notes: Vec<Note>,
}
