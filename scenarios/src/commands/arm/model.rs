//! The arm of a command: from a robot file or a URDF.

use crate::commands::CommandError;
use crate::scenario::load_robot;
use nalgebra::{Isometry3, Unit, Vector3};
use rover_kinematics::{Arm, ArmError, Tool};
use rover_robot::{
    Robot,
    urdf::{ChainOptions, Urdf, UrdfArm, UrdfError},
};
use std::path::PathBuf;
use std::sync::Arc;

/// Which arm.
#[derive(Clone, Debug, clap::Args)]
pub struct ModelArgs {
    /// Robot file, name of a shipped robot, or URDF (by its ending .urdf or .xml)
    #[arg(value_name = "ROBOT")]
    pub robot: PathBuf,
    /// URDF: link that the arm stands on; the only root if not given
    #[arg(long, value_name = "LINK")]
    pub base: Option<String>,
    /// URDF: link whose origin is the tool point; if not given the only end of an arm of 4 to 7
    /// joints, refused where this arm has other ends
    #[arg(long, value_name = "LINK")]
    pub tip: Option<String>,
    /// URDF: approach axis in the tip link; its z axis if not given (info; ik without --pose)
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true)]
    pub tool_axis: Option<String>,
    /// URDF: folder that holds packages, or a package, for `package://` (info; repeatable)
    #[arg(long, value_name = "DIR")]
    pub package_path: Vec<PathBuf>,
    /// URDF: rate limit of joints that have none in the file; only the nearest of several answers
    /// depends on it (info; ik without --all)
    #[arg(long, value_name = "RATE")]
    pub max_rate_rad_s: Option<f64>,
}

/// Where an arm comes from.
pub enum Source {
    /// A robot file.
    Robot(Arc<Robot>),
    /// A URDF.
    Urdf(Box<(Urdf, UrdfArm)>),
}

/// An arm and its tool.
pub struct ArmModel {
    /// The arm.
    pub arm: Arm,
    /// Tip and approach axis on the last link.
    pub tool: Tool,
    /// The tool's frame on the last link.
    pub last_from_tool: Isometry3<f64>,
    /// The frame in which the rows start, in the frame that poses are given in: the same for a robot
    /// file, the base link for a URDF.
    pub base_from_arm_base: Isometry3<f64>,
    /// Where it comes from.
    pub source: Source,
}

impl From<UrdfError> for CommandError {
    fn from(error: UrdfError) -> Self {
        Self::BadInput(error.to_string())
    }
}

impl ModelArgs {
    /// Whether the robot is a URDF.
    pub fn is_urdf(&self) -> bool {
        let ending = self.robot.extension().and_then(|e| e.to_str());
        ending.is_some_and(|e| ["urdf", "xml", "xacro"].contains(&e.to_lowercase().as_str()))
    }

    /// Refuses options of a URDF that `verb` does not look at.
    ///
    /// # Errors
    /// [`CommandError::BadInput`] naming the option and what it is for.
    pub(super) fn check_used(&self, verb: &str, used: &[&str]) -> Result<(), CommandError> {
        let options = [
            (
                "--tool-axis",
                self.tool_axis.is_some(),
                "`arm info`, and `arm ik` without --pose",
            ),
            (
                "--package-path",
                !self.package_path.is_empty(),
                "`arm info`, which looks for the meshes",
            ),
            (
                "--max-rate-rad-s",
                self.max_rate_rad_s.is_some(),
                "`arm info`, and `arm ik` without --all",
            ),
        ];
        let idle = |(name, is_given, _): &&(&str, bool, &str)| *is_given && !used.contains(name);
        match options.iter().find(idle) {
            Some((name, _, place)) if self.is_urdf() => Err(CommandError::BadInput(format!(
                "{name} has no effect on `{verb}`: it is for {place}"
            ))),
            _ => Ok(()),
        }
    }

    /// Reads and checks it.
    ///
    /// # Errors
    /// [`CommandError::BadInput`] with file and line.
    pub fn load(&self) -> Result<ArmModel, CommandError> {
        if self.is_urdf() {
            return self.load_urdf();
        }
        for (flag, is_given) in [
            ("--base", self.base.is_some()),
            ("--tip", self.tip.is_some()),
            ("--tool-axis", self.tool_axis.is_some()),
            ("--package-path", !self.package_path.is_empty()),
            ("--max-rate-rad-s", self.max_rate_rad_s.is_some()),
        ] {
            if is_given {
                return Err(CommandError::BadInput(format!(
                    "{flag} is for a URDF; a robot file has its own"
                )));
            }
        }
        let robot = load_robot(&self.robot.display().to_string())?;
        Ok(ArmModel {
            arm: robot.arm.clone(),
            tool: robot.tool.clone(),
            last_from_tool: robot.tool.frame(),
            base_from_arm_base: Isometry3::identity(),
            source: Source::Robot(robot),
        })
    }

    fn load_urdf(&self) -> Result<ArmModel, CommandError> {
        let axis = match &self.tool_axis {
            None => Vector3::z_axis(),
            Some(text) => {
                let xyz = numbers("--tool-axis", text)?;
                let vector = Vector3::from_iterator(xyz.iter().copied().chain([0.0; 3]));
                Unit::try_new(vector, 1e-9)
                    .filter(|_| xyz.len() == 3)
                    .ok_or_else(|| {
                        let message = format!("--tool-axis {text}: expected a direction x,y,z");
                        CommandError::BadInput(message)
                    })?
            }
        };
        if let Some(rate) = self.max_rate_rad_s
            && !(rate.is_finite() && rate > 0.0)
        {
            let message = format!("--max-rate-rad-s {rate}: expected a positive rate");
            return Err(CommandError::BadInput(message));
        }
        let urdf = Urdf::read(&self.robot, &self.package_path)?;
        let arm = urdf.arm(&ChainOptions {
            base: self.base.clone(),
            tip: self.tip.clone(),
            max_rate_rad_s: self.max_rate_rad_s,
            max_acceleration_rad_s2: None,
        })?;
        Ok(ArmModel {
            arm: arm.arm.clone(),
            tool: arm.tool(&axis),
            last_from_tool: arm.last_from_tip,
            base_from_arm_base: arm.base_from_arm_base,
            source: Source::Urdf(Box::new((urdf, arm))),
        })
    }
}

impl ArmModel {
    /// The tool's pose at joint angles `q` (rad).
    ///
    /// # Errors
    /// As [`Arm::forward`].
    pub fn forward(&self, q: &[f64]) -> Result<Isometry3<f64>, ArmError> {
        Ok(self.base_from_arm_base * self.arm.forward(q)? * self.last_from_tool)
    }

    /// Joints beyond those that a goal of `fixed` conditions fixes; where there are any its answers
    /// are a continuum.
    pub fn free_joints(&self, fixed: usize) -> usize {
        self.arm.joint_count().saturating_sub(fixed)
    }

    /// The middle of the joint limits, rad.
    pub fn middle(&self) -> Vec<f64> {
        let limits = self.arm.limits().iter();
        limits.map(|l| 0.5 * (l.lower_rad + l.upper_rad)).collect()
    }

    /// Joint angles given as the name of a posture or as numbers, rad.
    ///
    /// # Errors
    /// [`CommandError::BadInput`] naming `flag`.
    pub fn joints(&self, flag: &str, text: &str) -> Result<Vec<f64>, CommandError> {
        let bad = |message: String| CommandError::BadInput(format!("{flag} {text}: {message}"));
        let joints = match &self.source {
            Source::Robot(robot) if !text.contains(',') => robot
                .posture(text)
                .map_err(|e| bad(e.to_string()))?
                .to_vec(),
            _ => numbers(flag, text)?,
        };
        self.arm
            .check_limits(&joints)
            .map_err(|e| bad(e.to_string()))?;
        Ok(joints)
    }
}

/// Numbers separated by commas.
///
/// # Errors
/// [`CommandError::BadInput`] naming `flag`.
pub(super) fn numbers(flag: &str, text: &str) -> Result<Vec<f64>, CommandError> {
    let each = text.split(',').map(|word| {
        let number = word.trim().parse().ok().filter(|v: &f64| v.is_finite());
        number.ok_or_else(|| {
            let message = format!("{flag} {text}: `{word}` is no finite number");
            CommandError::BadInput(message)
        })
    });
    each.collect()
}
