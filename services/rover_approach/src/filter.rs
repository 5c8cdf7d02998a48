//! The target's position with its covariance, carried along by odometry and corrected by stereo.
//!
//! The position is kept in the rover frame of the present stop, not in the site frame: the rover's
//! own position in the site is never observed and its error would only be added and taken out
//! again (a robot-centred filter, J. A. Castellanos et al. 2007). A site position follows by the
//! believed pose whenever somebody wants one.

use crate::error::TrackError;
use nalgebra::{Isometry3, Matrix2, Matrix3, Matrix6, Point3, SMatrix, Vector3, Vector6};
use rover_cameras::Camera;

/// How far a turn in place leads off its place, m per rad, one sigma: the wheels scrub, each by
/// its load and soil.
const WANDER_M: f64 = 0.01;

/// One step of the rover as odometry and attitude sensor tell it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// Last stop's rover frame to the present one's.
    pub now_from_last: Isometry3<f64>,
    /// Covariance of translation (m) and rotation vector (rad) of that transform, present rover
    /// frame.
    pub covariance: Matrix6<f64>,
}

impl Motion {
    /// A motion with the covariance of (along, across, heading) of the drive, in the axes of its
    /// start (m^2, m rad, rad^2), and the standard deviation of roll and pitch at one stop, rad.
    #[must_use]
    pub fn from_drive(
        now_from_last: Isometry3<f64>,
        drive: &[[f64; 3]; 3],
        tilt_sigma_rad: f64,
    ) -> Self {
        let turn = now_from_last.rotation;
        // what the rover did more, the target does less; the same sign for all three
        let along = turn * Vector3::x();
        let across = turn * Vector3::y();
        let mut shape = SMatrix::<f64, 6, 3>::zeros();
        shape.fixed_view_mut::<3, 1>(0, 0).copy_from(&along);
        shape.fixed_view_mut::<3, 1>(0, 1).copy_from(&across);
        shape[(5, 2)] = 1.0;
        let drive = Matrix3::from_fn(|i, j| drive[i][j]);
        let mut covariance = shape * drive * shape.transpose();
        let tilt = 2.0 * tilt_sigma_rad * tilt_sigma_rad;
        let wander = WANDER_M * now_from_last.rotation.angle();
        for k in 0..2 {
            covariance[(k, k)] += wander * wander;
        }
        covariance[(2, 2)] += 0.01 * 0.01 * now_from_last.translation.vector.norm_squared();
        for (k, floor) in [1e-8, 1e-8, 1e-8, tilt, tilt, 1e-10]
            .into_iter()
            .enumerate()
        {
            covariance[(k, k)] += floor;
        }
        Self {
            now_from_last,
            covariance,
        }
    }

    /// This motion and then another one.
    #[must_use]
    pub fn then(&self, next: &Self) -> Self {
        let turn = next.now_from_last.rotation.to_rotation_matrix();
        let shift = &next.now_from_last.translation.vector;
        let mut carried = Matrix6::zeros();
        carried
            .fixed_view_mut::<3, 3>(0, 0)
            .copy_from(turn.matrix());
        carried
            .fixed_view_mut::<3, 3>(3, 3)
            .copy_from(turn.matrix());
        carried
            .fixed_view_mut::<3, 3>(0, 3)
            .copy_from(&(shift.cross_matrix() * turn.matrix()));
        Self {
            now_from_last: next.now_from_last * self.now_from_last,
            covariance: carried * self.covariance * carried.transpose() + next.covariance,
        }
    }

    /// The motion as a camera at `eye_m` (rover frame) shows it whose mount and mast are built into
    /// the rover with an error of `mount_rad` about each axis, and that is pointed with an error of
    /// `pointing_rad` at either stop, one sigma: the way then leads off aside, and a turn swings the
    /// camera about another place and axis.
    #[must_use]
    pub fn seen_from(&self, eye_m: &Vector3<f64>, mount_rad: f64, pointing_rad: f64) -> Self {
        let way_m = self.now_from_last.translation.vector.norm();
        let turn_rad = self.now_from_last.rotation.angle();
        let aside = (mount_rad * way_m).powi(2) + (mount_rad * turn_rad * eye_m.norm()).powi(2);
        let turned = (mount_rad * turn_rad).powi(2) + 2.0 * pointing_rad * pointing_rad;
        let mut covariance = self.covariance;
        for k in 0..3 {
            covariance[(k, k)] += aside;
            covariance[(k + 3, k + 3)] += turned;
        }
        Self {
            now_from_last: self.now_from_last,
            covariance,
        }
    }
}

/// How good odometry and attitude sensor are, one sigma.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OdometryModel {
    /// Error along the track over the distance driven.
    pub along: f64,
    /// Error across the track over the distance driven.
    pub across: f64,
    /// Vertical error over the distance driven.
    pub vertical: f64,
    /// Heading error after one metre, rad; grows with the root of the distance.
    pub heading_rad_per_root_m: f64,
    /// Error of roll and pitch at each stop, rad.
    pub tilt_rad: f64,
}

impl Default for OdometryModel {
    fn default() -> Self {
        Self {
            along: 0.03,
            across: 0.01,
            vertical: 0.01,
            heading_rad_per_root_m: 1.0_f64.to_radians(),
            tilt_rad: 0.2_f64.to_radians(),
        }
    }
}

impl OdometryModel {
    /// The motion between two stops, from their believed poses, with its covariance.
    #[must_use]
    pub fn motion(
        &self,
        site_from_last: &Isometry3<f64>,
        site_from_now: &Isometry3<f64>,
    ) -> Motion {
        let now_from_last = site_from_now.inverse() * site_from_last;
        let step_m = now_from_last.translation.vector.norm();
        let [along, across, vertical] =
            [self.along, self.across, self.vertical].map(|s| (s * step_m).powi(2) + 1e-8);
        // the two attitudes are independent of each other
        let tilt = 2.0 * self.tilt_rad.powi(2);
        let heading = self.heading_rad_per_root_m.powi(2) * step_m + 1e-10;
        let diagonal = Vector6::new(along, across, vertical, tilt, tilt, heading);
        Motion {
            now_from_last,
            covariance: Matrix6::from_diagonal(&diagonal),
        }
    }
}

/// What a measurement had to say against the prediction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Innovation {
    /// Measured minus predicted, rover frame, m.
    pub difference_m: Vector3<f64>,
    /// Its length in standard deviations (Mahalanobis distance; three degrees of freedom).
    pub sigmas: f64,
}

/// The target's position in the present rover frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TargetEstimate {
    /// Position, m.
    pub position_m: Vector3<f64>,
    /// Covariance, m^2.
    pub covariance_m2: Matrix3<f64>,
}

impl TargetEstimate {
    /// Starts with a measured point.
    ///
    /// # Errors
    /// [`TrackError::BadInput`] unless everything is finite and the covariance has a positive
    /// diagonal.
    pub fn new(position_m: Vector3<f64>, covariance_m2: Matrix3<f64>) -> Result<Self, TrackError> {
        let finite = position_m
            .iter()
            .chain(&covariance_m2)
            .all(|x| x.is_finite());
        if finite && covariance_m2.diagonal().iter().all(|x| *x > 0.0) {
            return Ok(Self {
                position_m,
                covariance_m2,
            });
        }
        Err(TrackError::BadInput {
            what: "the measured point".into(),
            found: format!("{position_m} with covariance {covariance_m2}"),
            expected: "finite numbers and positive variances".into(),
        })
    }

    /// The estimate after a motion.
    #[must_use]
    pub fn predicted(&self, motion: &Motion) -> Self {
        let r = motion.now_from_last.rotation.to_rotation_matrix();
        let position_m = (motion.now_from_last * Point3::from(self.position_m)).coords;
        let mut shift = SMatrix::<f64, 3, 6>::zeros();
        shift.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
        shift
            .fixed_view_mut::<3, 3>(0, 3)
            .copy_from(&-position_m.cross_matrix());
        let covariance_m2 =
            r * self.covariance_m2 * r.transpose() + shift * motion.covariance * shift.transpose();
        Self {
            position_m,
            covariance_m2,
        }
    }

    /// Covariance of the pixel at which a camera sees the estimate, px^2, with the camera's own
    /// pointing error (px, one sigma) in it; `None` if the camera cannot see the point.
    #[must_use]
    pub fn pixel_covariance(&self, camera: &Camera, pointing_px: f64) -> Option<Matrix2<f64>> {
        let j = camera
            .project_with_jacobian(&self.position_m)
            .ok()?
            .jacobian;
        let spread = j * self.covariance_m2 * j.transpose()
            + Matrix2::identity() * (pointing_px * pointing_px);
        spread.iter().all(|x| x.is_finite()).then_some(spread)
    }

    /// Takes in a measured point with its covariance (Joseph's form keeps the covariance
    /// symmetric and positive).
    ///
    /// # Errors
    /// [`TrackError::BadInput`] for numbers that are not finite or a covariance that is none.
    pub fn update(
        &mut self,
        point_m: &Vector3<f64>,
        covariance_m2: &Matrix3<f64>,
    ) -> Result<Innovation, TrackError> {
        let measured = Self::new(*point_m, *covariance_m2)?;
        let spread = self.covariance_m2 + measured.covariance_m2;
        let bad = || TrackError::BadInput {
            what: "the covariance of an innovation".into(),
            found: format!("{spread}"),
            expected: "a positive definite matrix".into(),
        };
        let inverse = spread.cholesky().ok_or_else(bad)?.inverse();
        let difference_m = point_m - self.position_m;
        let gain = self.covariance_m2 * inverse;
        let rest = Matrix3::identity() - gain;
        self.position_m += gain * difference_m;
        let covariance = rest * self.covariance_m2 * rest.transpose()
            + gain * measured.covariance_m2 * gain.transpose();
        self.covariance_m2 = (covariance + covariance.transpose()) * 0.5;
        Ok(Innovation {
            difference_m,
            sigmas: difference_m.dot(&(inverse * difference_m)).sqrt(),
        })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use nalgebra::UnitQuaternion;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    fn normal(rng: &mut rand_chacha::ChaCha8Rng) -> f64 {
        StandardNormal.sample(rng)
    }

    #[test]
    fn the_covariance_of_a_prediction_is_that_of_drawn_motions() {
        let model = OdometryModel::default();
        let last = Isometry3::identity();
        let now = Isometry3::from_parts(
            Vector3::new(0.8, 0.1, 0.0).into(),
            UnitQuaternion::from_euler_angles(0.02, -0.03, 0.1),
        );
        let motion = model.motion(&last, &now);
        let start = TargetEstimate::new(
            Vector3::new(5.0, 0.4, 0.1),
            Matrix3::from_diagonal(&Vector3::new(1e-4, 4e-6, 9e-6)),
        )
        .unwrap();
        let predicted = start.predicted(&motion);
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(5);
        let root = |m: &Matrix3<f64>| m.cholesky().unwrap().l();
        let part = |at: usize| motion.covariance.fixed_view::<3, 3>(at, at).into_owned();
        let (p, t, r) = (root(&start.covariance_m2), root(&part(0)), root(&part(3)));
        let n = 40_000;
        let mut sum = Matrix3::zeros();
        for _ in 0..n {
            let mut draw = || Vector3::from_fn(|_, _| normal(&mut rng));
            let point = start.position_m + p * draw();
            let moved = (motion.now_from_last * Point3::from(point)).coords;
            let turned = UnitQuaternion::from_scaled_axis(r * draw()) * moved + t * draw();
            let d = turned - predicted.position_m;
            sum += d * d.transpose();
        }
        let drawn = sum / f64::from(n);
        let difference = (drawn - predicted.covariance_m2).norm() / drawn.norm();
        assert!(difference < 0.03, "{difference}");
    }

    #[test]
    fn two_motions_spread_a_point_as_drawn_ones_one_after_the_other_do() {
        let model = OdometryModel::default();
        let pose = |x: f64, yaw: f64| {
            let turn = UnitQuaternion::from_euler_angles(0.03, -0.02, yaw);
            Isometry3::from_parts(Vector3::new(x, 0.2 * x, 0.01).into(), turn)
        };
        let places = [pose(0.0, 0.0), pose(0.1, 0.9), pose(0.9, 0.5)];
        let motions = [0, 1].map(|k| model.motion(&places[k], &places[k + 1]));
        let both = motions[0].then(&motions[1]);
        let point = Vector3::new(2.0, -0.7, 0.3);
        let expected = TargetEstimate {
            position_m: point,
            covariance_m2: Matrix3::zeros(),
        }
        .predicted(&both);
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(7);
        let mut sum = Matrix3::zeros();
        let n = 40_000;
        for _ in 0..n {
            let mut at = point;
            for motion in &motions {
                let root = motion.covariance.cholesky().unwrap().l();
                let error = root * Vector6::from_fn(|_, _| normal(&mut rng));
                let turn = UnitQuaternion::from_scaled_axis(error.fixed_rows::<3>(3).into_owned());
                at = turn * (motion.now_from_last * Point3::from(at)).coords
                    + error.fixed_rows::<3>(0);
            }
            let d = at - expected.position_m;
            sum += d * d.transpose();
        }
        let drawn = sum / f64::from(n);
        let difference = (drawn - expected.covariance_m2).norm() / drawn.norm();
        assert!(difference < 0.03, "{difference}");
    }

    #[test]
    fn an_update_is_the_mean_weighted_by_information() {
        let mut estimate = TargetEstimate::new(
            Vector3::new(3.0, 0.0, 0.0),
            Matrix3::from_diagonal(&Vector3::new(0.04, 0.01, 0.01)),
        )
        .unwrap();
        let point = Vector3::new(3.1, -0.1, 0.02);
        let spread = Matrix3::new(0.01, 0.002, 0.0, 0.002, 0.03, 0.0, 0.0, 0.0, 0.01);
        let a = estimate.covariance_m2.try_inverse().unwrap();
        let b = spread.try_inverse().unwrap();
        let expected_spread = (a + b).try_inverse().unwrap();
        let expected = expected_spread * (a * estimate.position_m + b * point);
        let innovation = estimate.update(&point, &spread).unwrap();
        assert!((estimate.position_m - expected).norm() < 1e-12);
        assert!((estimate.covariance_m2 - expected_spread).norm() < 1e-12);
        assert!((innovation.difference_m - Vector3::new(0.1, -0.1, 0.02)).norm() < 1e-12);
    }

    #[test]
    fn numbers_that_are_none_are_refused() {
        let nan = Vector3::new(f64::NAN, 0.0, 0.0);
        assert!(TargetEstimate::new(nan, Matrix3::identity()).is_err());
        let mut estimate = TargetEstimate::new(Vector3::x(), Matrix3::identity()).unwrap();
        let before = estimate;
        assert!(estimate.update(&nan, &Matrix3::identity()).is_err());
        assert!(estimate.update(&Vector3::x(), &Matrix3::zeros()).is_err());
        assert_eq!(estimate, before);
    }
}
