//! The camera mount from point correspondences, fiducial predicted against fiducial seen.

use crate::{Method, MethodError, Reference, Sample, Setup, linear::solve_scaled, setup::finite};
use nalgebra::{Matrix3, Matrix3x6, Matrix6, Rotation3, Vector3, Vector6};
use std::sync::Arc;

/// A rigid fit `seen = R predicted + t` by the singular value decomposition (Kabsch 1976,
/// Umeyama 1991); translation alone below three poses.
#[derive(Clone, Debug)]
pub struct Kabsch {
    setup: Arc<Setup>,
    pairs: Vec<(Vector3<f64>, Vector3<f64>)>,
    rotation: Rotation3<f64>,
    translation: Vector3<f64>,
}

/// The proper rotation and the translation that take the first points of `pairs` to the second
/// with least squares; the determinant is kept positive also where the points lie on a line.
///
/// # Errors
/// [`MethodError`] for no points or a decomposition that fails.
pub fn rigid_fit(
    pairs: &[(Vector3<f64>, Vector3<f64>)],
) -> Result<(Rotation3<f64>, Vector3<f64>), MethodError> {
    let what = "rigid fit";
    if pairs.is_empty() {
        return Err(MethodError::TooFew {
            found: 0,
            needed: 1,
        });
    }
    let n = pairs.len() as f64;
    let from = pairs.iter().map(|p| p.0).sum::<Vector3<f64>>() / n;
    let to = pairs.iter().map(|p| p.1).sum::<Vector3<f64>>() / n;
    let mut h = Matrix3::zeros();
    for (a, b) in pairs {
        h += (a - from) * (b - to).transpose();
    }
    let svd = h.svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else {
        return Err(MethodError::Degenerate { what });
    };
    let v = v_t.transpose();
    let sign = (v * u.transpose()).determinant().signum();
    let rotation = v * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * u.transpose();
    let rotation = Rotation3::from_matrix_unchecked(rotation);
    Ok((rotation, to - rotation * from))
}

impl Kabsch {
    /// Before any image: the believed mount.
    pub fn new(setup: Arc<Setup>) -> Self {
        Self {
            setup,
            pairs: Vec::new(),
            rotation: Rotation3::identity(),
            translation: Vector3::zeros(),
        }
    }
}

impl Method for Kabsch {
    fn observe(&mut self, sample: &Sample) -> Result<(), MethodError> {
        let predicted = self.setup.fiducial(&sample.joints_rad)?;
        self.pairs.push((predicted, self.setup.seen(sample)?));
        if self.pairs.len() < 3 {
            let shifts = self.pairs.iter().map(|(a, b)| b - a);
            self.translation = shifts.sum::<Vector3<f64>>() / self.pairs.len() as f64;
        } else {
            (self.rotation, self.translation) = rigid_fit(&self.pairs)?;
        }
        Ok(())
    }

    fn command(&self, reference: &Reference, _near: &[f64]) -> Result<Vector3<f64>, MethodError> {
        finite(self.rotation.inverse() * (reference.tip_in_rover - self.translation))
    }

    fn duplicate(&self) -> Box<dyn Method> {
        Box::new(self.clone())
    }

    fn state_bytes(&self) -> usize {
        size_of_val(self.pairs.as_slice()) + 8 * 12
    }
}

/// Prior of the mount, rad and m per degree of the error level; it covers the arm's strain too.
const ROTATION_RAD: f64 = 2.0 * std::f64::consts::PI / 180.0;
const TRANSLATION_M: f64 = 0.020;
/// Growth of a sighting's standard deviation with its distance from the target, m/m per degree.
/// It is the same in all directions: with the triangulation's covariance alone, range would be
/// cheap and the fit would shift everything in range to imitate the arm's strain.
const STRAIN: f64 = 0.02;

/// Maximum a posteriori of `seen - predicted = w x (predicted - c0) + t`, near sightings first.
#[derive(Clone, Debug)]
pub struct MountMap {
    setup: Arc<Setup>,
    target: Reference,
    pairs: Vec<(Vector3<f64>, Vector3<f64>)>,
    rotation: Vector3<f64>,
    translation: Vector3<f64>,
}

impl MountMap {
    /// Before any image: the believed mount.
    pub fn new(setup: Arc<Setup>, target: Reference) -> Self {
        Self {
            setup,
            target,
            pairs: Vec::new(),
            rotation: Vector3::zeros(),
            translation: Vector3::zeros(),
        }
    }

    fn vector(&self, p: &Vector3<f64>) -> Vector3<f64> {
        let centre = self.setup.model.mount_centre_in_rover;
        self.rotation.cross(&(p - centre)) + self.translation
    }

    /// A point that the cameras see, in the arm's coordinates.
    fn in_arm(&self, seen: &Vector3<f64>) -> Vector3<f64> {
        let mut p = *seen;
        for _ in 0..4 {
            p = seen - self.vector(&p);
        }
        p
    }
}

impl Method for MountMap {
    fn observe(&mut self, sample: &Sample) -> Result<(), MethodError> {
        let predicted = self.setup.fiducial(&sample.joints_rad)?;
        self.pairs.push((predicted, self.setup.seen(sample)?));
        let level = self.setup.level_deg();
        let centre = self.setup.model.mount_centre_in_rover;
        let prior = Vector6::from_fn(|i, _| {
            let sigma = if i < 3 { ROTATION_RAD } else { TRANSLATION_M };
            1.0 / (sigma * level).powi(2)
        });
        for _ in 0..3 {
            // Distances are taken in the arm's coordinates; the believed cameras' would be
            // centimetres off.
            let target = self.in_arm(&self.target.tip_in_rover);
            let mut normal = Matrix6::from_diagonal(&prior);
            let mut right = Vector6::zeros();
            for (predicted, seen) in &self.pairs {
                let what = "triangulation covariance";
                let information = self.setup.pixel_information(seen)?;
                let own = information
                    .try_inverse()
                    .ok_or(MethodError::Degenerate { what })?
                    * self.setup.sigma_px().powi(2);
                let far = STRAIN * level * (predicted - target).norm();
                let weight = (own + Matrix3::identity() * (far * far))
                    .try_inverse()
                    .ok_or(MethodError::Degenerate { what })?;
                let mut rows = Matrix3x6::zeros();
                rows.fixed_view_mut::<3, 3>(0, 0)
                    .copy_from(&-(predicted - centre).cross_matrix());
                rows.fixed_view_mut::<3, 3>(0, 3).fill_with_identity();
                let left = rows.transpose() * weight;
                normal += left * rows;
                right += left * (seen - predicted);
            }
            let mount = solve_scaled(&normal, &right, "mount")?;
            self.rotation = mount.fixed_rows::<3>(0).into_owned();
            self.translation = mount.fixed_rows::<3>(3).into_owned();
        }
        Ok(())
    }

    fn command(&self, reference: &Reference, _near: &[f64]) -> Result<Vector3<f64>, MethodError> {
        finite(self.in_arm(&reference.tip_in_rover))
    }

    fn duplicate(&self) -> Box<dyn Method> {
        Box::new(self.clone())
    }

    fn state_bytes(&self) -> usize {
        size_of_val(self.pairs.as_slice()) + 8 * 6
    }
}
