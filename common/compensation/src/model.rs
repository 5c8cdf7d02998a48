//! The believed robot's error model and the commands that it leads to.

use crate::Compensation;
use nalgebra::{DVector, Isometry3, Matrix6xX, Unit, UnitQuaternion, Vector3};
use rover_kinematics::{
    Arm, ArmError, AxisGoal, IkError, MOUNT_PARAMETERS, Tool, closest_solution,
    pose_error_jacobian_with_mount,
};

/// Why a compensated command could not be computed.
#[derive(Debug, thiserror::Error)]
pub enum CompensationError {
    /// The compensation has a number of parameters that does not fit the arm.
    #[error("compensation has {found} parameters, expected none or {expected}")]
    Parameters {
        /// Found.
        found: usize,
        /// Expected.
        expected: usize,
    },
    /// The joint angles do not fit the arm.
    #[error(transparent)]
    Arm(#[from] ArmError),
    /// The corrected pose cannot be reached.
    #[error("corrected pose: {0}")]
    Unreachable(#[from] IkError),
}

/// The believed arm with everything that relates parameter errors to the tip's error in the rover
/// frame.
#[derive(Clone, Debug)]
pub struct ErrorModel {
    /// Believed arm.
    pub arm: Arm,
    /// Tip and approach axis on the last link.
    pub tool: Tool,
    /// Believed pose of the arm's base.
    pub rover_from_arm_base: Isometry3<f64>,
    /// Point about which the mount's rotation error is parametrised, rover frame, m.
    pub mount_centre_in_rover: Vector3<f64>,
}

/// A commanded pose that puts the tip, as the cameras see it, on a reference pose.
#[derive(Clone, Debug, PartialEq)]
pub struct SolvedPose {
    /// Joint angles to command, rad.
    pub joints_rad: Vec<f64>,
    /// The tip's position for the believed kinematics, rover frame, m.
    pub tip_in_rover: Vector3<f64>,
    /// The approach axis for the believed kinematics, rover frame.
    pub axis_in_rover: Unit<Vector3<f64>>,
}

impl ErrorModel {
    /// Number of parameters: four for each joint and six for the mount.
    pub fn parameter_count(&self) -> usize {
        4 * self.arm.joint_count() + MOUNT_PARAMETERS
    }

    /// Derivative of the position of `point_in_link` (rows 0 to 2, m) and of the orientation (rows
    /// 3 to 5, rad) with respect to the parameters, rover frame, 6 x parameter count.
    ///
    /// # Errors
    /// [`ArmError`] for joint angles that do not fit the arm.
    pub fn pose_jacobian(
        &self,
        q: &[f64],
        point_in_link: &Vector3<f64>,
    ) -> Result<Matrix6xX<f64>, ArmError> {
        let mount_centre_in_base = self
            .rover_from_arm_base
            .inverse_transform_point(&self.mount_centre_in_rover.into());
        let in_base = pose_error_jacobian_with_mount(
            &self.arm,
            q,
            point_in_link,
            &mount_centre_in_base.coords,
        )?;
        // Into the rover frame. The mount's columns belong to rotations and translations along
        // the arm base's axes; turned on the right as well they belong to the rover's axes.
        let r = self.rover_from_arm_base.rotation.to_rotation_matrix();
        let mut out = Matrix6xX::zeros(in_base.ncols());
        for rows in [0, 3] {
            let turned = r.matrix() * in_base.rows(rows, 3);
            out.rows_mut(rows, 3).copy_from(&turned);
        }
        let mount = out.ncols() - MOUNT_PARAMETERS;
        for columns in [mount, mount + 3] {
            let turned = out.columns(columns, 3) * r.matrix().transpose();
            out.columns_mut(columns, 3).copy_from(&turned);
        }
        Ok(out)
    }

    /// The error of `point_in_link` at `q` that `compensation` predicts: position error (m) and
    /// rotation vector (rad), both seen minus predicted, rover frame. The constant offset belongs
    /// to the tip.
    ///
    /// # Errors
    /// [`CompensationError`] for parameters or joint angles that do not fit the arm.
    pub fn error_at(
        &self,
        compensation: &Compensation,
        q: &[f64],
    ) -> Result<(Vector3<f64>, Vector3<f64>), CompensationError> {
        let mut position = Vector3::from(compensation.offset_m);
        let mut rotation = Vector3::from(compensation.offset_rad);
        if !compensation.parameters.is_empty() {
            let found = compensation.parameters.len();
            let expected = self.parameter_count();
            if found != expected {
                return Err(CompensationError::Parameters { found, expected });
            }
            let jacobian = self.pose_jacobian(q, &self.tool.tip_in_link)?;
            let e = jacobian * DVector::from_column_slice(&compensation.parameters);
            position += Vector3::new(e[0], e[1], e[2]);
            rotation += Vector3::new(e[3], e[4], e[5]);
        }
        Ok((position, rotation))
    }

    /// The believed pose of the last link, rover frame.
    ///
    /// # Errors
    /// [`ArmError`] for joint angles that do not fit the arm.
    pub fn rover_from_link(&self, q: &[f64]) -> Result<Isometry3<f64>, ArmError> {
        Ok(self.rover_from_arm_base * self.arm.forward(q)?)
    }

    /// The command that brings the tip, as the cameras see it, to `tip_in_rover` with the approach
    /// axis along `axis_in_rover`: `p = reference - e(q)` (paper, *Motion Correction*) with `q` the
    /// joint angles of the command itself, found by fixed-point iteration from `near`.
    ///
    /// # Errors
    /// [`CompensationError::Unreachable`] with the constraint that fails.
    pub fn solve(
        &self,
        compensation: &Compensation,
        tip_in_rover: &Vector3<f64>,
        axis_in_rover: &Unit<Vector3<f64>>,
        near: &[f64],
    ) -> Result<SolvedPose, CompensationError> {
        let base_from_rover = self.rover_from_arm_base.inverse();
        let mut joints = near.to_vec();
        // The error changes by a few per cent of the move, so each round gains more than a digit.
        const ROUNDS: usize = 6;
        let mut command = (*tip_in_rover, *axis_in_rover);
        for _ in 0..ROUNDS {
            let (position, rotation) = self.error_at(compensation, &joints)?;
            command.0 = tip_in_rover - position;
            command.1 = UnitQuaternion::from_scaled_axis(-rotation) * axis_in_rover;
            let goal = AxisGoal {
                point: (base_from_rover * nalgebra::Point3::from(command.0)).coords,
                axis: base_from_rover.rotation * command.1,
            };
            let next = closest_solution(&self.arm, &self.tool, &goal, &joints)?;
            let moved = next
                .iter()
                .zip(&joints)
                .map(|(a, b)| (a - b).abs())
                .fold(0.0, f64::max);
            joints = next;
            if moved < 1e-9 {
                break;
            }
        }
        Ok(SolvedPose {
            joints_rad: joints,
            tip_in_rover: command.0,
            axis_in_rover: command.1,
        })
    }
}
