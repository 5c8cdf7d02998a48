//! From the fiducial's seen poses to the end-effector's error anywhere (paper, section 3 *Motion
//! Correction*, carried further).
//!
//! The error at joint angles `q` is `e(q) = J(q) phi + b`: `phi` are the arm's and the mount's
//! parameter errors with the robot file's stated quality as prior, `b` is what the parameters
//! cannot express (lens, droop, second order), a random walk over the distance that the tip moves.
//! Both are linear in what is seen, so one Kalman filter of 32 numbers (five joints) carries them
//! with their covariance. With the walk's steps large the filter is the paper's rule, the last
//! vector; with no walk it is a full kinematic calibration. The walk is what anchors the field on
//! the last look: a lens error cannot pose as an arm error for long.

use crate::lateral;
use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, Matrix6xX, Unit, Vector3, Vector6};
use rover_compensation::{Compensation, CompensationError, ErrorModel};
use rover_messages::placement::Method;
use serde::{Deserialize, Serialize};

/// The estimator's assumptions, as standard deviations.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EstimatorRules {
    /// Unmodelled position error before anything was seen, m.
    pub unmodelled_m: f64,
    /// Unmodelled orientation error before anything was seen, rad.
    pub unmodelled_rad: f64,
    /// Growth of the unmodelled position error with the tip's way, m per m.
    pub drift_m_per_m: f64,
    /// Growth of the unmodelled orientation error with the tip's way, rad per m.
    pub drift_rad_per_m: f64,
    /// An observation whose squared Mahalanobis distance from the prediction exceeds this many
    /// times its number of rows is not the fiducial.
    pub gate_per_row: f64,
}

impl Default for EstimatorRules {
    fn default() -> Self {
        Self {
            unmodelled_m: 3e-3,
            unmodelled_rad: 5e-3,
            drift_m_per_m: 4e-3,
            drift_rad_per_m: 4e-3,
            gate_per_row: 10.0,
        }
    }
}

/// What was seen of the end-effector at known joint angles.
#[derive(Clone, Debug, PartialEq)]
#[allow(
    clippy::large_enum_variant,
    reason = "one at a time, never stored in bulk"
)]
pub enum Seen {
    /// Position of one point of the last link.
    Position {
        /// The point, last link frame, m.
        point_in_link: Vector3<f64>,
        /// Where stereo saw it, rover frame, m.
        seen_in_rover: Vector3<f64>,
        /// Its covariance, m^2.
        covariance: Matrix3<f64>,
    },
    /// Pose of the last link.
    Pose {
        /// Where stereo saw the tip, rover frame, m.
        tip_in_rover: Vector3<f64>,
        /// Rotation from the predicted to the seen orientation, rotation vector, rover frame, rad.
        rotation_error: Vector3<f64>,
        /// Covariance of both, m^2 and rad^2.
        covariance: Matrix6<f64>,
    },
}

/// Why an observation was not taken.
#[derive(Debug, thiserror::Error)]
pub enum EstimatorError {
    /// It contradicts what is known.
    #[error(
        "what was seen lies {distance:.1} sigma from the prediction, expected at most {limit:.1}"
    )]
    Inconsistent {
        /// Mahalanobis distance.
        distance: f64,
        /// Largest accepted.
        limit: f64,
    },
    /// The observation's covariance is singular or not finite.
    #[error("the observation has no usable covariance")]
    Covariance,
    /// Joint angles or parameters do not fit the arm.
    #[error(transparent)]
    Model(#[from] CompensationError),
}

impl From<rover_kinematics::ArmError> for EstimatorError {
    fn from(error: rover_kinematics::ArmError) -> Self {
        Self::Model(error.into())
    }
}

/// The filter.
#[derive(Clone, Debug)]
pub struct Estimator {
    model: ErrorModel,
    method: Method,
    rules: EstimatorRules,
    /// Parameters, then the unmodelled position and rotation at the tip.
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
    last: Option<LastLook>,
    /// What a method outside this filter applies.
    adopted: Option<Compensation>,
}

#[derive(Clone, Debug)]
struct LastLook {
    tip_in_rover: Vector3<f64>,
    /// Seen minus predicted position of the observed point, and rotation if it was observed.
    vector: Vector3<f64>,
    rotation: Vector3<f64>,
}

impl Estimator {
    /// Before anything was seen: parameters with standard deviations `angle_rad` and `length_m`.
    pub fn new(
        model: ErrorModel,
        method: Method,
        angle_rad: f64,
        length_m: f64,
        rules: EstimatorRules,
    ) -> Self {
        let n = model.parameter_count();
        let joints = model.arm.joint_count();
        let mut sigma = DVector::zeros(n + 6);
        for j in 0..joints {
            for (k, s) in [angle_rad, length_m, length_m, angle_rad]
                .into_iter()
                .enumerate()
            {
                sigma[4 * j + k] = s;
            }
        }
        for k in 0..3 {
            sigma[n - 6 + k] = angle_rad;
            sigma[n - 3 + k] = length_m;
            sigma[n + k] = rules.unmodelled_m;
            sigma[n + 3 + k] = rules.unmodelled_rad;
        }
        Self {
            covariance: DMatrix::from_diagonal(&sigma.component_mul(&sigma)),
            mean: DVector::zeros(n + 6),
            model,
            method,
            rules,
            last: None,
            adopted: None,
        }
    }

    /// The believed robot.
    pub fn model(&self) -> &ErrorModel {
        &self.model
    }

    /// Whether anything was seen yet.
    pub fn has_seen(&self) -> bool {
        self.last.is_some()
    }

    /// Takes in what was seen at joint angles `q`; nothing changes when it is refused.
    ///
    /// # Errors
    /// [`EstimatorError::Inconsistent`] when it lies too far from the prediction.
    pub fn observe(&mut self, q: &[f64], seen: &Seen) -> Result<(), EstimatorError> {
        let rover_from_link = self.model.rover_from_link(q)?;
        let tip_in_link = self.model.tool.tip_in_link;
        let predicted_tip = rover_from_link.transform_point(&tip_in_link.into()).coords;
        let (rows, observed, noise) = match seen {
            Seen::Position {
                point_in_link,
                seen_in_rover,
                covariance,
            } => {
                let predicted = rover_from_link
                    .transform_point(&(*point_in_link).into())
                    .coords;
                let lever = predicted - predicted_tip;
                let rows = self.rows(q, point_in_link, &lever)?.rows(0, 3).into_owned();
                let vector = seen_in_rover - predicted;
                (
                    rows,
                    DVector::from_column_slice(vector.as_slice()),
                    dynamic(covariance),
                )
            }
            Seen::Pose {
                tip_in_rover,
                rotation_error,
                covariance,
            } => {
                let rows = self.rows(q, &tip_in_link, &Vector3::zeros())?;
                let mut vector = DVector::zeros(6);
                vector
                    .fixed_rows_mut::<3>(0)
                    .copy_from(&(tip_in_rover - predicted_tip));
                vector.fixed_rows_mut::<3>(3).copy_from(rotation_error);
                (
                    DMatrix::from_column_slice(6, rows.ncols(), rows.as_slice()),
                    vector,
                    dynamic(covariance),
                )
            }
        };
        let prior = self.drifted(&predicted_tip);
        let innovation = &observed - &rows * &self.mean;
        let cross = &prior * rows.transpose();
        let spread = &rows * &cross + &noise;
        let Some(factor) = symmetric(spread).cholesky() else {
            return Err(EstimatorError::Covariance);
        };
        let distance2 = innovation.dot(&factor.solve(&innovation));
        let limit2 = self.rules.gate_per_row * observed.len() as f64;
        // A distance that is not a number is no agreement either.
        if distance2.is_nan() || distance2 > limit2 {
            return Err(EstimatorError::Inconsistent {
                distance: distance2.sqrt(),
                limit: limit2.sqrt(),
            });
        }
        let gain = factor.solve(&cross.transpose()).transpose();
        self.mean += &gain * innovation;
        // Joseph form: stays symmetric and positive for any gain.
        let identity = DMatrix::identity(prior.nrows(), prior.nrows());
        let kept = identity - &gain * &rows;
        self.covariance =
            symmetric(&kept * prior * kept.transpose() + &gain * noise * gain.transpose());
        self.last = Some(LastLook {
            tip_in_rover: predicted_tip,
            vector: observed.fixed_rows::<3>(0).into_owned(),
            rotation: match seen {
                Seen::Position { .. } => Vector3::zeros(),
                Seen::Pose { rotation_error, .. } => *rotation_error,
            },
        });
        Ok(())
    }

    /// Notes what a method outside this filter makes of all that was seen; the filter goes on to
    /// predict where the fiducial is and how far off the method's placement would be.
    pub fn adopt(&mut self, compensation: Compensation) {
        self.adopted = Some(compensation);
    }

    /// What the method makes of all that was seen.
    pub fn compensation(&self) -> Compensation {
        match (self.method, &self.last) {
            (Method::Kinematic, _) | (Method::Epec, None) => Compensation::none(),
            (Method::Epec, Some(last)) => Compensation {
                offset_m: last.vector.into(),
                offset_rad: last.rotation.into(),
                parameters: Vec::new(),
            },
            (Method::EpecField, _) => {
                let n = self.model.parameter_count();
                Compensation {
                    offset_m: Vector3::from(self.mean.fixed_rows::<3>(n)).into(),
                    offset_rad: Vector3::from(self.mean.fixed_rows::<3>(n + 3)).into(),
                    parameters: self.mean.rows(0, n).iter().copied().collect(),
                }
            }
            _ => self.adopted.clone().unwrap_or_else(Compensation::none),
        }
    }

    /// The filter's own prediction of position (m) and rotation (rad) error at `q`, whatever the
    /// method makes of it, with its covariance.
    ///
    /// # Errors
    /// [`EstimatorError::Model`] for joint angles that do not fit the arm.
    pub fn predict(&self, q: &[f64]) -> Result<(Vector6<f64>, Matrix6<f64>), EstimatorError> {
        let tip_in_link = self.model.tool.tip_in_link;
        let rows = self.rows(q, &tip_in_link, &Vector3::zeros())?;
        let tip = self
            .model
            .rover_from_link(q)?
            .transform_point(&tip_in_link.into())
            .coords;
        let covariance = &rows * self.drifted(&tip) * rows.transpose();
        let mean = &rows * &self.mean;
        Ok((
            Vector6::from_column_slice(mean.as_slice()),
            Matrix6::from_column_slice(covariance.as_slice()),
        ))
    }

    /// Bound that the tip's lateral error keeps in 95 % of cases when the present compensation
    /// places it at `q` on a target with position covariance `target_covariance` (m^2) and
    /// surface normal `normal`, m. It accounts for what the method leaves uncorrected: the
    /// distance between the filter's best estimate of the error and what is applied, plus the
    /// filter's own uncertainty. So it is the same measure for every method, also for those that
    /// have no idea of their own error.
    ///
    /// # Errors
    /// [`EstimatorError::Model`] for joint angles that do not fit the arm.
    pub fn predicted_lateral_error(
        &self,
        q: &[f64],
        normal: &Unit<Vector3<f64>>,
        target_covariance: &Matrix3<f64>,
    ) -> Result<f64, EstimatorError> {
        let (mean, covariance) = self.predict(q)?;
        let (applied, _) = self.model.error_at(&self.compensation(), q)?;
        let left = Vector3::from(mean.fixed_rows::<3>(0)) - applied;
        let position = covariance.fixed_view::<3, 3>(0, 0) + target_covariance;
        Ok(lateral::bound_95(&left, &position, normal))
    }

    /// `[J, B]` with the unmodelled part's rows for a point at `lever` from the tip.
    fn rows(
        &self,
        q: &[f64],
        point_in_link: &Vector3<f64>,
        lever: &Vector3<f64>,
    ) -> Result<Matrix6xX<f64>, EstimatorError> {
        let jacobian = self.model.pose_jacobian(q, point_in_link)?;
        let n = jacobian.ncols();
        let mut rows = Matrix6xX::zeros(n + 6);
        rows.columns_mut(0, n).copy_from(&jacobian);
        rows.fixed_view_mut::<6, 6>(0, n).fill_with_identity();
        rows.fixed_view_mut::<3, 3>(0, n + 3)
            .copy_from(&-lever.cross_matrix());
        Ok(rows)
    }

    /// The covariance after the tip has moved to `tip_in_rover` since the last look.
    fn drifted(&self, tip_in_rover: &Vector3<f64>) -> DMatrix<f64> {
        let mut covariance = self.covariance.clone();
        if let Some(last) = &self.last {
            let way = (tip_in_rover - last.tip_in_rover).norm();
            let n = self.model.parameter_count();
            for k in 0..3 {
                covariance[(n + k, n + k)] += (self.rules.drift_m_per_m * way).powi(2);
                covariance[(n + 3 + k, n + 3 + k)] += (self.rules.drift_rad_per_m * way).powi(2);
            }
        }
        covariance
    }
}

fn symmetric(m: DMatrix<f64>) -> DMatrix<f64> {
    let t = m.transpose();
    (m + t) * 0.5
}

fn dynamic<const N: usize>(m: &nalgebra::SMatrix<f64, N, N>) -> DMatrix<f64> {
    DMatrix::from_column_slice(N, N, m.as_slice())
}
