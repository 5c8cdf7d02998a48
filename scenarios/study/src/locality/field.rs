//! The way on which vectors are seen, and the field with a kinematic prior that they make.

use super::{LOOKS, MIDDLE_X_M};
use crate::{
    StudyError,
    compare::believed_cameras,
    workspace::{LEVELS, usual_posture},
};
use nalgebra::{DMatrix, DVector, Matrix3, Matrix3xX, Vector3};
use rover_compensation::ErrorModel;
use rover_kinematics::AxisGoal;

/// The way on which the field's vectors are seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Approach {
    /// The last 12 cm along the tool.
    Straight,
    /// From a neutral place this high above (m) and towards the middle, bending down.
    Bent(f64),
}

impl Approach {
    /// The bent way from as high, up to 20 cm, as leaves the tip in both cameras' view at every
    /// look.
    pub(super) fn bent_in_view(goal: &AxisGoal) -> Self {
        const HIGHEST_CM: u32 = 20;
        const MARGIN_PX: f64 = 20.0;
        let cameras = believed_cameras();
        let in_view = |way: Self| {
            stations(goal, way).iter().all(|station| {
                [&cameras.left, &cameras.right]
                    .iter()
                    .all(|c| c.project_into_image(&station.point, MARGIN_PX).is_ok())
            })
        };
        let lower = (1..HIGHEST_CM)
            .rev()
            .map(|cm| Self::Bent(f64::from(cm) * 0.01));
        let highest = Self::Bent(f64::from(HIGHEST_CM) * 0.01);
        std::iter::once(highest)
            .chain(lower)
            .find(|way| in_view(*way))
            .unwrap_or(Self::Straight)
    }

    /// Offset from the goal with a share `t` of the way left.
    fn offset(self, goal: &AxisGoal, t: f64) -> Vector3<f64> {
        match self {
            Self::Straight => goal.axis.into_inner() * (-0.12 * t),
            Self::Bent(height_m) => {
                let middle = MIDDLE_X_M - goal.point.x;
                let inward = if goal.point.y > 0.0 { -1.0 } else { 1.0 };
                Vector3::new(
                    middle.clamp(-0.12, 0.12) * t,
                    inward * 0.20 * t * t,
                    -height_m * t * (3.0 - 2.0 * t),
                )
            }
        }
    }
}

/// Where the looks on the way to `goal` are taken.
fn stations(goal: &AxisGoal, way: Approach) -> Vec<AxisGoal> {
    (0..LOOKS)
        .map(|k| {
            let left = 1.0 - k as f64 / (LOOKS - 1) as f64;
            AxisGoal {
                point: goal.point + way.offset(goal, left),
                axis: goal.axis,
            }
        })
        .collect()
}

/// The field of one approach: what it makes of the vectors seen is linear in them and, for
/// commands that do not depend on the draw, the same for every draw.
pub(super) struct Field {
    /// Joint angles of the looks, rad.
    pub(super) looks: Vec<Vec<f64>>,
    last: Matrix3xX<f64>,
    /// Parameters from the stacked vectors.
    pub(super) gain: DMatrix<f64>,
    covariance: DMatrix<f64>,
    /// Assumed noise of one seen position, m.
    pub(super) noise_m: f64,
}

/// Rows of the error model's Jacobian for the tip's position.
fn rows(model: &ErrorModel, q: &[f64]) -> Result<Matrix3xX<f64>, StudyError> {
    let jacobian = model.pose_jacobian(q, &model.tool.tip_in_link)?;
    Ok(jacobian.fixed_rows::<3>(0).into_owned())
}

impl Field {
    /// Looks along the way to `goal`, those that are within reach.
    pub(super) fn new(
        model: &ErrorModel,
        goal: &AxisGoal,
        way: Approach,
        noise_m: f64,
    ) -> Result<Self, StudyError> {
        let level = &LEVELS[2];
        let looks: Vec<Vec<f64>> = stations(goal, way)
            .iter()
            .filter_map(|station| usual_posture(&model.arm, station))
            .collect();
        let n = model.parameter_count();
        let arm_columns = n - 6;
        let sigma = DVector::from_fn(n, |i, _| match i {
            i if i < arm_columns && (i % 4 == 1 || i % 4 == 2) => level.length_m(),
            i if i >= arm_columns + 3 => level.length_m(),
            _ => level.angle_rad(),
        });
        let prior = DMatrix::from_diagonal(&sigma.component_mul(&sigma));
        let mut h = DMatrix::zeros(3 * looks.len(), n);
        for (k, q) in looks.iter().enumerate() {
            h.rows_mut(3 * k, 3).copy_from(&rows(model, q)?);
        }
        let noise = DMatrix::identity(h.nrows(), h.nrows()) * noise_m.powi(2);
        let spread = &h * &prior * h.transpose() + noise;
        let factor = spread.cholesky().ok_or(StudyError::NoTrials {
            what: "locality: the field's observations are degenerate",
        })?;
        let gain = factor.solve(&(&h * &prior)).transpose();
        let covariance = &prior - &gain * &h * &prior;
        let last = looks.last().map(|q| rows(model, q)).transpose()?;
        Ok(Self {
            last: last.ok_or(StudyError::NoTrials { what: "locality" })?,
            looks,
            gain,
            covariance,
            noise_m,
        })
    }

    /// Predicted minus last vector and its covariance at `q`: anchored on the last vector, so
    /// that only the difference comes from the parameters.
    pub(super) fn beyond_last(
        &self,
        model: &ErrorModel,
        q: &[f64],
        parameters: &DVector<f64>,
    ) -> Result<(Vector3<f64>, Matrix3<f64>), StudyError> {
        let change = rows(model, q)? - &self.last;
        let step = &change * parameters;
        let spread = &change * &self.covariance * change.transpose();
        let spread = Matrix3::from_column_slice(spread.as_slice())
            + Matrix3::identity() * self.noise_m.powi(2);
        Ok((Vector3::new(step[0], step[1], step[2]), spread))
    }
}
