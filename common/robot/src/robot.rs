//! The checked robot and what is derived from its description.

use crate::{CameraPairDescription, PoseDescription, RobotDescription, check::Check};
use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use rover_files::FileError;
use rover_geometry::{ArmBase, Link, Rover, Transform};
use rover_kinematics::{Arm, DhRow, JointLimits, Tool};
use sha2::{Digest, Sha256};
use std::path::Path;

/// How far from the tip the last link is the tool, which may touch what it is placed on, m: the
/// plunger and the barrel that carries it. A map of the terrain whose cells are columns up to their
/// highest point reaches, beside a steep target, into the space that the barrel needs.
pub const TOOL_REACH_M: f64 = 0.12;

/// Why a robot description cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RobotError {
    /// The file could not be read.
    #[error("{path}: {source}")]
    File {
        /// The file.
        path: String,
        /// What the system said.
        source: FileError,
    },
    /// The text is not a robot description; the message has line and column.
    #[error("{origin}: {message}")]
    Syntax {
        /// Where the text came from.
        origin: String,
        /// What the parser found and expected.
        message: String,
    },
    /// A field has a value that cannot be.
    #[error("{origin}: {field}: {message}")]
    Field {
        /// Where the text came from.
        origin: String,
        /// The field's path.
        field: String,
        /// What was found and what was expected.
        message: String,
    },
    /// A part that the robot does not have.
    #[error("the robot `{robot}` has no {section}")]
    Lacks {
        /// Name of the robot.
        robot: String,
        /// The missing section of its file.
        section: &'static str,
    },
    /// A name that the robot does not have.
    #[error("no {kind} named `{name}`; the robot has: {known}")]
    Unknown {
        /// What was looked for.
        kind: &'static str,
        /// The name asked for.
        name: String,
        /// The names there are.
        known: String,
    },
}

/// A robot as the services believe it to be.
#[derive(Clone, Debug)]
pub struct Robot {
    description: RobotDescription,
    /// The arm's kinematics, arm base frame.
    pub arm: Arm,
    /// Tip and approach axis, last link frame.
    pub tool: Tool,
    /// Pose of the arm's base.
    pub rover_from_arm_base: Transform<Rover, ArmBase>,
    /// Pose of the fiducial plate's frame (x right, y up, z out of the front) on the last link.
    pub link_from_plate: Isometry3<f64>,
    configuration_sha256: String,
}

impl Robot {
    /// Reads and checks a robot file.
    ///
    /// # Errors
    /// [`RobotError`] with file, field, what was found and what was expected.
    pub fn read(path: &Path) -> Result<Self, RobotError> {
        let origin = path.display().to_string();
        let text = std::fs::read_to_string(path).map_err(|source| RobotError::File {
            path: origin.clone(),
            source: source.into(),
        })?;
        Self::parse(&text, &origin)
    }

    /// Checks a robot description given as TOML text; `origin` is named in errors.
    ///
    /// # Errors
    /// As [`Robot::read`].
    pub fn parse(text: &str, origin: &str) -> Result<Self, RobotError> {
        let description = toml::from_str(text).map_err(|e| RobotError::Syntax {
            origin: origin.into(),
            message: e.to_string(),
        })?;
        Self::new(description, origin).map_err(|error| match error {
            RobotError::Field {
                origin,
                field,
                message,
            } => RobotError::Field {
                origin: match line_of(text, &field) {
                    Some(line) => format!("{origin}:{line}"),
                    None => origin,
                },
                field,
                message,
            },
            other => other,
        })
    }

    /// Checks a description.
    ///
    /// # Errors
    /// [`RobotError::Field`].
    pub fn new(description: RobotDescription, origin: &str) -> Result<Self, RobotError> {
        let check = Check { origin };
        check.all(&description)?;
        let (rows, limits): (Vec<_>, Vec<_>) = description
            .arm
            .joints
            .iter()
            .map(|j| {
                let row = DhRow {
                    a_m: j.a_m,
                    alpha_rad: j.alpha_rad,
                    d_m: j.d_m,
                    theta_offset_rad: j.theta_offset_rad,
                };
                let limits = JointLimits {
                    lower_rad: j.lower_rad,
                    upper_rad: j.upper_rad,
                    max_rate_rad_s: j.max_rate_rad_s,
                    max_acceleration_rad_s2: j.max_acceleration_rad_s2,
                };
                (row, limits)
            })
            .unzip();
        let arm = Arm::new(rows, limits).map_err(|e| check.error("arm.joints", e.to_string()))?;
        let tool = Tool {
            tip_in_link: description.tool.tip_m.into(),
            axis_in_link: check.direction("tool.axis", description.tool.axis)?,
        };
        let link_from_plate = check.plate(&description)?;
        let text = toml::to_string(&description)
            .map_err(|e| check.error("robot", format!("cannot be written as TOML: {e}")))?;
        let configuration_sha256 = Sha256::digest(text.as_bytes())
            .iter()
            .map(|b| format!("{b:02x}"))
            .collect();
        Ok(Self {
            arm,
            tool,
            rover_from_arm_base: pose(&description.arm.base).into(),
            link_from_plate,
            configuration_sha256,
            description,
        })
    }

    /// The description with every default filled in.
    pub fn description(&self) -> &RobotDescription {
        &self.description
    }

    /// SHA-256 of the effective description, hexadecimal.
    pub fn configuration_sha256(&self) -> &str {
        &self.configuration_sha256
    }

    /// Name of the robot and namespace of its keys.
    pub fn name(&self) -> &str {
        &self.description.name
    }

    /// The camera pair of that name.
    ///
    /// # Errors
    /// [`RobotError::Unknown`] with the names there are.
    pub fn pair(&self, name: &str) -> Result<&CameraPairDescription, RobotError> {
        self.description
            .cameras
            .iter()
            .find(|p| p.name == name)
            .ok_or_else(|| RobotError::Unknown {
                kind: "camera pair",
                name: name.into(),
                known: list(self.description.cameras.iter().map(|p| p.name.as_str())),
            })
    }

    /// The joint angles of a named posture, rad.
    ///
    /// # Errors
    /// [`RobotError::Unknown`] with the names there are.
    pub fn posture(&self, name: &str) -> Result<&[f64], RobotError> {
        self.description
            .postures
            .get(name)
            .map(Vec::as_slice)
            .ok_or_else(|| RobotError::Unknown {
                kind: "posture",
                name: name.into(),
                known: list(self.description.postures.keys().map(String::as_str)),
            })
    }

    /// Pose of the last link for joint angles `q` (rad).
    ///
    /// # Errors
    /// [`rover_kinematics::ArmError`] for a wrong number of joints or a non-finite angle.
    pub fn rover_from_link(
        &self,
        q: &[f64],
    ) -> Result<Transform<Rover, Link>, rover_kinematics::ArmError> {
        let base_from_link: Transform<ArmBase, Link> = self.arm.forward(q)?.into();
        Ok(self.rover_from_arm_base * base_from_link)
    }

    /// Centre about which the mount error of the camera pairs is parametrised: the mean of the
    /// first pair's camera centres, rover frame, m.
    pub fn mount_centre(&self) -> Vector3<f64> {
        let pair = &self.description.cameras[0].cameras;
        (pair.left.model.cahv()[0] + pair.right.model.cahv()[0]) / 2.0
    }
}

/// The isometry of a described pose.
pub(crate) fn pose(p: &PoseDescription) -> Isometry3<f64> {
    let [r, pt, y] = p.rpy_deg.map(f64::to_radians);
    Isometry3::from_parts(
        Vector3::from(p.xyz_m).into(),
        UnitQuaternion::from_euler_angles(r, pt, y),
    )
}

fn list<'a>(names: impl Iterator<Item = &'a str>) -> String {
    names.collect::<Vec<_>>().join(", ")
}

/// The line, from 1, of a field like `arm.joints[2].shape` in a TOML text, or of what encloses it.
fn line_of(text: &str, field: &str) -> Option<usize> {
    use toml::de::{DeTable, DeValue};
    let root = DeTable::parse(text).ok()?;
    let mut offset = None;
    let mut table = Some(root.get_ref());
    for step in field.split('.') {
        let (key, index) = match step.split_once('[') {
            Some((key, rest)) => (key, rest.trim_end_matches(']').parse::<usize>().ok()),
            None => (step, None),
        };
        let Some((name, mut value)) = table.and_then(|t| t.get_key_value(key)) else {
            break;
        };
        offset = Some(name.span().start);
        if let (Some(index), DeValue::Array(items)) = (index, value.get_ref())
            && let Some(item) = items.get(index)
        {
            value = item;
            offset = Some(item.span().start);
        }
        table = match value.get_ref() {
            DeValue::Table(inner) => Some(inner),
            _ => None,
        };
    }
    Some(text.get(..offset?)?.matches('\n').count() + 1)
}
