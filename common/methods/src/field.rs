//! The error vector as a field: `e(q) = J(q) phi` with the 26 model errors `phi`, whose prior is
//! the stated quality of arm and mount.

use crate::{
    Method, MethodError, Reference, Sample, Setup, linear::solve_scaled_dynamic, setup::finite,
};
use nalgebra::{DMatrix, DVector, Matrix3xX, Vector3};
use std::sync::Arc;

/// What carries the part of the vector that the parameters do not explain.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Anchor {
    /// Nothing: the parameters are all.
    None,
    /// The last vector; the parameters only say how it changes from there, so that a lens error
    /// cannot pose as an arm error.
    LastVector,
}

/// The field: information form of the linear-Gaussian update.
#[derive(Clone, Debug)]
pub struct Field {
    setup: Arc<Setup>,
    anchor: Anchor,
    information: DMatrix<f64>,
    weighted: DVector<f64>,
    parameters: DVector<f64>,
    last: Option<Last>,
}

#[derive(Clone, Debug)]
struct Last {
    vector_m: Vector3<f64>,
    rows: Matrix3xX<f64>,
}

/// Standard deviations of the model errors: per joint theta, d, a, alpha; mount rotation and
/// translation.
pub(crate) fn prior_sigma(setup: &Setup) -> DVector<f64> {
    let n = setup.model.parameter_count();
    DVector::from_fn(n, |i, _| {
        let is_length = if i < n - 6 {
            i % 4 == 1 || i % 4 == 2
        } else {
            i >= n - 3
        };
        if is_length {
            setup.length_m
        } else {
            setup.angle_rad
        }
    })
}

impl Field {
    /// Before any image: the prior.
    pub fn new(setup: Arc<Setup>, anchor: Anchor) -> Self {
        let sigma = prior_sigma(&setup);
        let n = sigma.len();
        Self {
            information: DMatrix::from_diagonal(&sigma.map(|s| 1.0 / (s * s))),
            weighted: DVector::zeros(n),
            parameters: DVector::zeros(n),
            setup,
            anchor,
            last: None,
        }
    }

    fn rows(&self, q: &[f64], point: &Vector3<f64>) -> Result<Matrix3xX<f64>, MethodError> {
        let jacobian = self.setup.model.pose_jacobian(q, point)?;
        Ok(jacobian.fixed_rows::<3>(0).into_owned())
    }

    /// The tip's predicted error vector at joint angles `q`, m.
    ///
    /// # Errors
    /// [`MethodError::Arm`].
    pub fn vector_at(&self, q: &[f64]) -> Result<Vector3<f64>, MethodError> {
        let at_tip = self.rows(q, &self.setup.model.tool.tip_in_link)?;
        let vector = match (self.anchor, &self.last) {
            (Anchor::LastVector, Some(last)) => {
                let change = (at_tip - &last.rows) * &self.parameters;
                last.vector_m + Vector3::new(change[0], change[1], change[2])
            }
            _ => {
                let e = at_tip * &self.parameters;
                Vector3::new(e[0], e[1], e[2])
            }
        };
        finite(vector)
    }
}

impl Method for Field {
    fn observe(&mut self, sample: &Sample) -> Result<(), MethodError> {
        let q = &sample.joints_rad;
        let seen = self.setup.seen(sample)?;
        let vector_m = finite(seen - self.setup.fiducial(q)?)?;
        // The row is that of the fiducial; the prediction's is that of the tip.
        let rows = self.rows(q, &self.setup.fiducial_in_link)?;
        let weight = self.setup.pixel_information(&seen)? / self.setup.sigma_px().powi(2);
        let left = rows.transpose() * weight;
        let information = &self.information + &left * &rows;
        let weighted = &self.weighted + left * vector_m;
        self.parameters = solve_scaled_dynamic(&information, &weighted, "error field")?;
        self.information = information;
        self.weighted = weighted;
        self.last = Some(Last { vector_m, rows });
        Ok(())
    }

    fn command(&self, reference: &Reference, near: &[f64]) -> Result<Vector3<f64>, MethodError> {
        const ROUNDS: usize = 2;
        let (at, axis) = (&reference.tip_in_rover, &reference.axis_in_rover);
        if self.last.is_none() {
            return finite(*at);
        }
        let first = at - self.vector_at(near)?;
        let mut command = first;
        for _ in 0..ROUNDS {
            let q = self.setup.joints(&command, axis, near)?;
            command = at - self.vector_at(&q)?;
        }
        finite(command)
    }

    fn duplicate(&self) -> Box<dyn Method> {
        Box::new(self.clone())
    }

    fn state_bytes(&self) -> usize {
        let n = self.parameters.len();
        8 * (n * n + 2 * n + self.last.as_ref().map_or(0, |l| 3 + 3 * l.rows.ncols()))
    }
}
