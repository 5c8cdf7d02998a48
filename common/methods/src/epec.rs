//! Kinematics alone, and the paper's rule.

use crate::{Method, MethodError, Reference, Sample, Setup, setup::finite};
use nalgebra::Vector3;
use std::sync::Arc;

/// No image of the arm: what the Mars Exploration Rovers practised (paper, section 2).
#[derive(Clone, Copy, Debug, Default)]
pub struct Kinematic;

impl Method for Kinematic {
    fn observe(&mut self, _sample: &Sample) -> Result<(), MethodError> {
        Ok(())
    }

    fn command(&self, reference: &Reference, _near: &[f64]) -> Result<Vector3<f64>, MethodError> {
        finite(reference.tip_in_rover)
    }

    fn duplicate(&self) -> Box<dyn Method> {
        Box::new(*self)
    }

    fn state_bytes(&self) -> usize {
        0
    }
}

/// The last error vector (paper, section 3, *Motion Correction*): `e = seen - predicted` of the
/// fiducial, `p = reference - e`. The vector is the total one and is replaced by every image,
/// never added up.
#[derive(Clone, Debug)]
pub struct Epec {
    setup: Arc<Setup>,
    vector_m: Vector3<f64>,
}

impl Epec {
    /// Before any image: no correction.
    pub fn new(setup: Arc<Setup>) -> Self {
        Self {
            setup,
            vector_m: Vector3::zeros(),
        }
    }

    /// The present vector, m.
    pub fn vector_m(&self) -> Vector3<f64> {
        self.vector_m
    }
}

impl Method for Epec {
    fn observe(&mut self, sample: &Sample) -> Result<(), MethodError> {
        let seen = self.setup.seen(sample)?;
        self.vector_m = finite(seen - self.setup.fiducial(&sample.joints_rad)?)?;
        Ok(())
    }

    fn command(&self, reference: &Reference, _near: &[f64]) -> Result<Vector3<f64>, MethodError> {
        finite(reference.tip_in_rover - self.vector_m)
    }

    fn duplicate(&self) -> Box<dyn Method> {
        Box::new(self.clone())
    }

    fn state_bytes(&self) -> usize {
        size_of::<Vector3<f64>>()
    }
}
