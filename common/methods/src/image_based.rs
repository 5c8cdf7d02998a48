//! Image-based visual servoing with a fixed stereo pair: the error is one of pixels, and the
//! stacked image Jacobian turns it into a move.

use crate::{Method, MethodError, Reference, Sample, Setup, setup::finite};
use nalgebra::{Matrix4x3, Vector3, Vector4};
use std::sync::Arc;

/// Moves below this teach Broyden's rule only noise, m.
const LEAST_MOVE_M: f64 = 4e-3;

/// `p += (r' - r) + gain J^+ (s* - s)`; the way between references is fed forward in space, not
/// in the image, where perspective would bend it.
#[derive(Clone, Debug)]
pub struct ImageBased {
    setup: Arc<Setup>,
    gain: f64,
    offset_m: Vector3<f64>,
    /// Learnt Jacobian and the last sighting; none if the believed one is taken.
    learnt: Option<Learnt>,
}

#[derive(Clone, Debug, Default)]
struct Learnt {
    jacobian: Option<Matrix4x3<f64>>,
    last: Option<(Vector3<f64>, Vector4<f64>)>,
}

impl ImageBased {
    /// With the believed cameras' Jacobian.
    pub fn modelled(setup: Arc<Setup>, gain: f64) -> Self {
        Self {
            setup,
            gain,
            offset_m: Vector3::zeros(),
            learnt: None,
        }
    }

    /// With a Jacobian that starts as the believed one and is updated by Broyden's rule
    /// `J += (ds - J dp) dp^T / dp.dp`.
    pub fn broyden(setup: Arc<Setup>, gain: f64) -> Self {
        Self {
            learnt: Some(Learnt::default()),
            ..Self::modelled(setup, gain)
        }
    }

    /// Stacked pixels and their Jacobian at a point.
    fn image(&self, p: &Vector3<f64>) -> Result<(Vector4<f64>, Matrix4x3<f64>), MethodError> {
        let left = self.setup.cameras.left.project_with_jacobian(p)?;
        let right = self.setup.cameras.right.project_with_jacobian(p)?;
        let mut jacobian = Matrix4x3::zeros();
        jacobian
            .fixed_view_mut::<2, 3>(0, 0)
            .copy_from(&left.jacobian);
        jacobian
            .fixed_view_mut::<2, 3>(2, 0)
            .copy_from(&right.jacobian);
        let (l, r) = (left.pixel_px, right.pixel_px);
        Ok((Vector4::new(l.x, l.y, r.x, r.y), jacobian))
    }
}

impl Method for ImageBased {
    fn observe(&mut self, sample: &Sample) -> Result<(), MethodError> {
        let Some(reference) = &sample.reference else {
            return Ok(());
        };
        let q = &sample.joints_rad;
        let tip = self.setup.tip(q)?;
        let fiducial = self.setup.fiducial(q)?;
        let (wanted, _) = self.image(&(reference.tip_in_rover + fiducial - tip))?;
        let (_, believed) = self.image(&fiducial)?;
        let (l, r) = (sample.left_px, sample.right_px);
        let seen = Vector4::new(l.x, l.y, r.x, r.y);
        let jacobian = match &mut self.learnt {
            None => believed,
            Some(learnt) => {
                let mut jacobian = learnt.jacobian.unwrap_or(believed);
                if let Some((p, s)) = learnt.last {
                    let (dp, ds) = (fiducial - p, seen - s);
                    if dp.norm() > LEAST_MOVE_M {
                        jacobian += (ds - jacobian * dp) * dp.transpose() / dp.norm_squared();
                    }
                }
                learnt.jacobian = Some(jacobian);
                learnt.last = Some((fiducial, seen));
                jacobian
            }
        };
        let normal = jacobian.transpose() * jacobian;
        let inverse = normal.try_inverse().ok_or(MethodError::Degenerate {
            what: "image Jacobian",
        })?;
        let step = inverse * (jacobian.transpose() * (wanted - seen));
        self.offset_m = finite(tip - reference.tip_in_rover + step * self.gain)?;
        Ok(())
    }

    fn command(&self, reference: &Reference, _near: &[f64]) -> Result<Vector3<f64>, MethodError> {
        finite(reference.tip_in_rover + self.offset_m)
    }

    fn duplicate(&self) -> Box<dyn Method> {
        Box::new(self.clone())
    }

    fn state_bytes(&self) -> usize {
        let learnt = self.learnt.as_ref().map_or(0, |_| 8 * (12 + 3 + 4));
        size_of::<Vector3<f64>>() + learnt
    }
}
