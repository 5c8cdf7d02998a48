//! Position-based visual servoing with a fixed stereo pair (literature: Hager 1997; Hutchinson,
//! Hager and Corke 1996). With gain 1 and one move per image it is the paper's rule.

use crate::{Method, MethodError, Reference, Sample, Setup, setup::finite};
use nalgebra::Vector3;
use std::sync::Arc;

/// `p += (r' - r) + gain (r + lever - seen)`, from reference `r` to `r'`.
#[derive(Clone, Debug)]
pub struct PositionBased {
    setup: Arc<Setup>,
    gain: f64,
    /// What has to be added to a reference.
    offset_m: Vector3<f64>,
}

impl PositionBased {
    /// Before any image: no correction.
    pub fn new(setup: Arc<Setup>, gain: f64) -> Self {
        Self {
            setup,
            gain,
            offset_m: Vector3::zeros(),
        }
    }
}

impl Method for PositionBased {
    fn observe(&mut self, sample: &Sample) -> Result<(), MethodError> {
        let Some(reference) = &sample.reference else {
            return Ok(());
        };
        let q = &sample.joints_rad;
        let tip = self.setup.tip(q)?;
        let lever = self.setup.fiducial(q)? - tip;
        let wanted = reference.tip_in_rover + lever;
        let miss = wanted - self.setup.seen(sample)?;
        self.offset_m = finite(tip - reference.tip_in_rover + miss * self.gain)?;
        Ok(())
    }

    fn command(&self, reference: &Reference, _near: &[f64]) -> Result<Vector3<f64>, MethodError> {
        finite(reference.tip_in_rover + self.offset_m)
    }

    fn duplicate(&self) -> Box<dyn Method> {
        Box::new(self.clone())
    }

    fn state_bytes(&self) -> usize {
        size_of::<Vector3<f64>>()
    }
}
