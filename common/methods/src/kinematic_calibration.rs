//! Full kinematic calibration: all model errors from the fiducial's pixels by Gauss-Newton with
//! the stated quality as prior (for Robonaut's arm: paper, section 2).
//!
//! Six of the 26 directions are invisible to a point fiducial however many poses there are
//! (parallel joints, base against mount, the last link against the fiducial), so there is no
//! solution without a prior, and dropping parameters until it works is none.

use crate::{
    Method, MethodError, Reference, Sample, Setup, field::prior_sigma,
    linear::solve_scaled_dynamic, setup::finite,
};
use nalgebra::{DMatrix, DVector, Matrix2xX, Matrix3xX, Point3, UnitQuaternion, Vector2, Vector3};
use rover_kinematics::{Arm, MOUNT_PARAMETERS, point_error_jacobian};
use std::sync::Arc;

/// Gauss-Newton steps of one fit, from the fit before.
const STEPS: usize = 5;

/// The method.
#[derive(Clone, Debug)]
pub struct KinematicCalibration {
    setup: Arc<Setup>,
    sightings: Vec<Sample>,
    fitted: Fitted,
}

#[derive(Clone, Debug)]
struct Fitted {
    /// Errors of the rows.
    rows: DVector<f64>,
    arm: Arm,
    rotation: UnitQuaternion<f64>,
    translation: Vector3<f64>,
}

impl Fitted {
    /// Where the cameras see a point of the last link, rover frame, m.
    fn seen(
        &self,
        setup: &Setup,
        q: &[f64],
        in_link: &Vector3<f64>,
    ) -> Result<Vector3<f64>, MethodError> {
        let model = &setup.model;
        let p = model.rover_from_arm_base * Point3::from(self.arm.point(q, in_link)?);
        let centre = model.mount_centre_in_rover;
        Ok(self.rotation * (p.coords - centre) + centre + self.translation)
    }

    /// The same with its derivative by all parameters.
    fn seen_with_jacobian(
        &self,
        setup: &Setup,
        q: &[f64],
    ) -> Result<(Vector3<f64>, Matrix3xX<f64>), MethodError> {
        let point = self.seen(setup, q, &setup.fiducial_in_link)?;
        let in_base = point_error_jacobian(&self.arm, q, &setup.fiducial_in_link)?;
        let n = in_base.ncols();
        let turn = self.rotation * setup.model.rover_from_arm_base.rotation;
        let mut jacobian = Matrix3xX::zeros(n + MOUNT_PARAMETERS);
        jacobian
            .columns_mut(0, n)
            .copy_from(&(turn.to_rotation_matrix().matrix() * in_base));
        let lever = point - setup.model.mount_centre_in_rover - self.translation;
        jacobian
            .fixed_view_mut::<3, 3>(0, n)
            .copy_from(&-lever.cross_matrix());
        jacobian
            .fixed_view_mut::<3, 3>(0, n + 3)
            .fill_with_identity();
        Ok((point, jacobian))
    }

    /// One Gauss-Newton step.
    fn improved(&self, setup: &Setup, sightings: &[Sample]) -> Result<Self, MethodError> {
        let weights = prior_sigma(setup).map(|s| 1.0 / (s * s));
        let n = self.rows.len();
        let mut now = DVector::zeros(n + MOUNT_PARAMETERS);
        now.rows_mut(0, n).copy_from(&self.rows);
        now.fixed_rows_mut::<3>(n)
            .copy_from(&self.rotation.scaled_axis());
        now.fixed_rows_mut::<3>(n + 3).copy_from(&self.translation);
        let mut normal = DMatrix::from_diagonal(&weights);
        let mut gradient = -weights.component_mul(&now);
        let precision = 1.0 / setup.sigma_px().powi(2);
        for sample in sightings {
            let (point, by_parameters) = self.seen_with_jacobian(setup, &sample.joints_rad)?;
            let sides = [
                (&setup.cameras.left, &sample.left_px),
                (&setup.cameras.right, &sample.right_px),
            ];
            for (camera, pixel) in sides {
                let projection = camera.project_with_jacobian(&point)?;
                let jacobian: Matrix2xX<f64> = projection.jacobian * &by_parameters;
                let residual: Vector2<f64> = pixel - projection.pixel_px;
                normal += jacobian.transpose() * &jacobian * precision;
                gradient += jacobian.transpose() * residual * precision;
            }
        }
        let step = solve_scaled_dynamic(&normal, &gradient, "kinematic calibration")?;
        let rows = &self.rows + step.rows(0, n);
        let turn = UnitQuaternion::from_scaled_axis(step.fixed_rows::<3>(n).into_owned());
        Ok(Self {
            arm: setup.model.arm.perturbed(rows.as_slice())?,
            rows,
            rotation: turn * self.rotation,
            translation: self.translation + step.fixed_rows::<3>(n + 3),
        })
    }
}

impl KinematicCalibration {
    /// Before any image: the believed robot.
    pub fn new(setup: Arc<Setup>) -> Self {
        let arm = setup.model.arm.clone();
        Self {
            fitted: Fitted {
                rows: DVector::zeros(4 * arm.joint_count()),
                arm,
                rotation: UnitQuaternion::identity(),
                translation: Vector3::zeros(),
            },
            setup,
            sightings: Vec::new(),
        }
    }
}

impl Method for KinematicCalibration {
    fn observe(&mut self, sample: &Sample) -> Result<(), MethodError> {
        self.sightings.push(sample.clone());
        let mut fitted = self.fitted.clone();
        for _ in 0..STEPS {
            fitted = fitted.improved(&self.setup, &self.sightings)?;
        }
        self.fitted = fitted;
        Ok(())
    }

    fn command(&self, reference: &Reference, near: &[f64]) -> Result<Vector3<f64>, MethodError> {
        const ROUNDS: usize = 3;
        let tip = self.setup.model.tool.tip_in_link;
        let mut q = near.to_vec();
        let mut command = reference.tip_in_rover;
        for round in 0..=ROUNDS {
            let vector = self.fitted.seen(&self.setup, &q, &tip)? - self.setup.tip(&q)?;
            command = reference.tip_in_rover - vector;
            if round < ROUNDS {
                q = self.setup.joints(&command, &reference.axis_in_rover, &q)?;
            }
        }
        finite(command)
    }

    fn duplicate(&self) -> Box<dyn Method> {
        Box::new(self.clone())
    }

    fn state_bytes(&self) -> usize {
        let joints = self.setup.model.arm.joint_count();
        self.sightings.len() * 8 * (joints + 4) + 8 * (self.fitted.rows.len() + 7)
    }
}
