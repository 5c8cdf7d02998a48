//! Hybrid image plane/stereo: the camera models are adjusted until they show the fiducial where
//! the arm's believed kinematics put it; a target triangulated with the adjusted pair is then in
//! the arm's own coordinates (Robinson, Baumgartner, Nickels and Litwin 2007).
//!
//! Free are position and orientation of each camera, with soft priors; Gauss-Newton from the last
//! fit. A sighting counts less the further it is from the target, because a camera model that is
//! bent to fit one place is wrong in another.

use crate::{Method, MethodError, Reference, Sample, Setup, linear::solve_scaled, setup::finite};
use nalgebra::{
    Isometry3, Matrix2x6, Matrix6, Translation3, UnitQuaternion, Vector2, Vector3, Vector6,
};
use rover_cameras::{Camera, StereoPair};
use std::sync::Arc;

/// Prior of a camera's position, m per degree of the error level; it covers the arm's strain too.
const POSITION_M: f64 = 0.020;
/// Prior of a camera's orientation, rad per degree of the error level.
const ROTATION_RAD: f64 = 2.0 * std::f64::consts::PI / 180.0;
/// Growth of a sighting's standard deviation with its distance from the target, px/m per degree.
pub(crate) const STRAIN_PX_M: f64 = 8.0;
/// Standard deviation of every sighting where the fit has to serve the whole view, px.
const LIMITED_PX: f64 = 3.0;
/// Gauss-Newton steps of one fit.
const STEPS: usize = 4;

/// Which sightings are fitted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Samples {
    /// Only those before the approach: the limited version.
    Initial,
    /// All: the full on-line version.
    All,
}

/// One camera's adjustment: `x = exp(w) (P - C - shift) + C` is what the believed camera sees.
#[derive(Clone, Copy, Debug)]
struct Adjustment {
    shift: Vector3<f64>,
    rotation: UnitQuaternion<f64>,
}

#[derive(Clone, Copy, Debug)]
struct Sighting {
    /// Predicted fiducial, rover frame, m.
    predicted: Vector3<f64>,
    pixels: [Vector2<f64>; 2],
}

/// The method.
#[derive(Clone, Debug)]
pub struct Hips {
    setup: Arc<Setup>,
    target: Reference,
    samples: Samples,
    sightings: Vec<Sighting>,
    adjusted: [Adjustment; 2],
}

impl Adjustment {
    fn none() -> Self {
        Self {
            shift: Vector3::zeros(),
            rotation: UnitQuaternion::identity(),
        }
    }

    /// The camera with this adjustment.
    fn apply(&self, camera: &Camera) -> Camera {
        let c = *camera.model.cahv()[0];
        let adjusted_from_believed =
            Isometry3::from_parts(Translation3::from(c + self.shift), self.rotation.inverse())
                * Translation3::from(-c);
        camera.transformed(&adjusted_from_believed)
    }

    /// Where the adjusted camera sees a point of the arm's coordinates, px, and the derivative by
    /// shift (m) and by a rotation vector applied on the left of the rotation (rad).
    fn projection(
        &self,
        camera: &Camera,
        point: &Vector3<f64>,
    ) -> Result<(Vector2<f64>, Matrix2x6<f64>), MethodError> {
        let c = *camera.model.cahv()[0];
        let from_centre = self.rotation * (point - c - self.shift);
        let projection = camera.project_with_jacobian(&(from_centre + c))?;
        let mut jacobian = Matrix2x6::zeros();
        jacobian
            .fixed_view_mut::<2, 3>(0, 0)
            .copy_from(&(-projection.jacobian * self.rotation.to_rotation_matrix().matrix()));
        jacobian
            .fixed_view_mut::<2, 3>(0, 3)
            .copy_from(&(-projection.jacobian * from_centre.cross_matrix()));
        Ok((projection.pixel_px, jacobian))
    }

    /// One Gauss-Newton step for the sightings of one camera; `sigma_px` belongs to each.
    fn step(
        &mut self,
        camera: &Camera,
        sightings: &[Sighting],
        side: usize,
        sigma_px: &[f64],
        level_deg: f64,
    ) -> Result<(), MethodError> {
        let weights = Vector6::from_fn(|i, _| {
            let sigma = if i < 3 { POSITION_M } else { ROTATION_RAD };
            1.0 / (sigma * level_deg).powi(2)
        });
        let w = self.rotation.scaled_axis();
        let now = Vector6::new(self.shift.x, self.shift.y, self.shift.z, w.x, w.y, w.z);
        let mut normal = Matrix6::from_diagonal(&weights);
        let mut gradient = -weights.component_mul(&now);
        for (sighting, sigma) in sightings.iter().zip(sigma_px) {
            let (pixel_px, jacobian) = self.projection(camera, &sighting.predicted)?;
            let residual = sighting.pixels[side] - pixel_px;
            let weighted = jacobian.transpose() / (sigma * sigma);
            normal += weighted * jacobian;
            gradient += weighted * residual;
        }
        let step = solve_scaled(&normal, &gradient, "camera model")?;
        self.shift += step.fixed_rows::<3>(0);
        self.rotation =
            UnitQuaternion::from_scaled_axis(step.fixed_rows::<3>(3).into_owned()) * self.rotation;
        Ok(())
    }
}

impl Hips {
    /// With the believed camera models.
    pub fn new(setup: Arc<Setup>, target: Reference, samples: Samples) -> Self {
        Self {
            setup,
            target,
            samples,
            sightings: Vec::new(),
            adjusted: [Adjustment::none(); 2],
        }
    }

    fn cameras(&self) -> [&Camera; 2] {
        [&self.setup.cameras.left, &self.setup.cameras.right]
    }

    /// A point of the believed cameras' view in the arm's coordinates.
    fn in_arm(
        &self,
        adjusted: &[Adjustment; 2],
        point: &Vector3<f64>,
    ) -> Result<Vector3<f64>, MethodError> {
        let [left, right] = self.cameras();
        let pair = StereoPair {
            left: adjusted[0].apply(left),
            right: adjusted[1].apply(right),
        };
        finite(
            pair.triangulate(&left.project(point)?, &right.project(point)?)?
                .point,
        )
    }

    /// Standard deviation of each sighting for a target at `target` in the arm's coordinates.
    fn sigmas(&self, target: &Vector3<f64>) -> Vec<f64> {
        let own = self.setup.sigma_px();
        let far = |s: &Sighting| match self.samples {
            Samples::Initial => LIMITED_PX,
            Samples::All => STRAIN_PX_M * self.setup.level_deg() * (s.predicted - target).norm(),
        };
        self.sightings.iter().map(|s| own.hypot(far(s))).collect()
    }
}

impl Method for Hips {
    fn observe(&mut self, sample: &Sample) -> Result<(), MethodError> {
        if self.samples == Samples::Initial && sample.reference.is_some() {
            return Ok(());
        }
        self.sightings.push(Sighting {
            predicted: self.setup.fiducial(&sample.joints_rad)?,
            pixels: [sample.left_px, sample.right_px],
        });
        let mut adjusted = self.adjusted;
        for _ in 0..STEPS {
            let target = self.in_arm(&adjusted, &self.target.tip_in_rover)?;
            let sigma = self.sigmas(&target);
            for (side, camera) in self.cameras().into_iter().enumerate() {
                let level = self.setup.level_deg();
                adjusted[side].step(camera, &self.sightings, side, &sigma, level)?;
            }
        }
        self.adjusted = adjusted;
        Ok(())
    }

    fn command(&self, reference: &Reference, _near: &[f64]) -> Result<Vector3<f64>, MethodError> {
        self.in_arm(&self.adjusted, &reference.tip_in_rover)
    }

    fn duplicate(&self) -> Box<dyn Method> {
        Box::new(self.clone())
    }

    fn state_bytes(&self) -> usize {
        size_of_val(self.sightings.as_slice()) + size_of_val(&self.adjusted)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::tests::setup;

    fn adjustment() -> Adjustment {
        Adjustment {
            shift: Vector3::new(0.012, -0.007, 0.004),
            rotation: UnitQuaternion::from_scaled_axis(Vector3::new(0.02, -0.03, 0.015)),
        }
    }

    /// The derivative is used as it stands in the normal equations; a wrong sign or frame in it
    /// would still let the fit creep towards an answer.
    #[test]
    fn the_derivative_of_an_adjusted_camera_is_that_of_finite_differences() {
        const STEP: f64 = 1e-6;
        let setup = setup(0.13);
        for camera in [&setup.cameras.left, &setup.cameras.right] {
            for point in [
                Vector3::new(0.5, 0.05, 0.2),
                Vector3::new(0.42, -0.12, 0.05),
            ] {
                let at = adjustment();
                let (_, jacobian) = at.projection(camera, &point).unwrap();
                for k in 0..6 {
                    let moved = |step: f64| {
                        let mut a = at;
                        if k < 3 {
                            a.shift[k] += step;
                        } else {
                            let mut turn = Vector3::zeros();
                            turn[k - 3] = step;
                            a.rotation = UnitQuaternion::from_scaled_axis(turn) * a.rotation;
                        }
                        // Through the camera model itself, not through the derivative's formula.
                        a.apply(camera).project(&point).unwrap()
                    };
                    let numeric = (moved(STEP) - moved(-STEP)) / (2.0 * STEP);
                    let apart = (jacobian.column(k) - numeric).norm();
                    assert!(apart < 1e-5 * (1.0 + numeric.norm()), "column {k}: {apart}");
                }
            }
        }
    }

    #[test]
    fn the_adjusted_camera_shows_what_its_projection_says() {
        let setup = setup(0.13);
        let point = Vector3::new(0.47, 0.1, 0.15);
        let at = adjustment();
        let (pixel, _) = at.projection(&setup.cameras.left, &point).unwrap();
        let shown = at.apply(&setup.cameras.left).project(&point).unwrap();
        assert!((pixel - shown).norm() < 1e-9);
    }
}
