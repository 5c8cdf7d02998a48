//! The small rigid motion that puts most landmarks where they were found.

use nalgebra::{
    Isometry3, Matrix6, SMatrix, Translation3, UnitQuaternion, Vector2, Vector3, Vector6,
};
use rover_cameras::Camera;

/// Landmarks near to each other share errors of range and slant: so many count as one.
const ALIKE_N: f64 = 4.0;
/// Least standard deviation of a found pixel, px.
const LEAST_SIGMA_PX: f64 = 0.3;
const ITERATIONS: usize = 12;

/// A landmark found again.
pub(super) struct Found {
    /// Where odometry puts it, present rover frame, m.
    pub point_m: Vector3<f64>,
    /// Where it is seen, px.
    pub pixel_px: Vector2<f64>,
}

/// What odometry is off: translation (m) and rotation vector (rad), present rover frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Correction(pub Vector6<f64>);

impl Correction {
    pub fn identity() -> Self {
        Self(Vector6::zeros())
    }

    pub fn isometry(&self) -> Isometry3<f64> {
        let x = &self.0;
        Isometry3::from_parts(
            Translation3::new(x[0], x[1], x[2]),
            UnitQuaternion::from_scaled_axis(Vector3::new(x[3], x[4], x[5])),
        )
    }

    /// The turn about the camera that brings one landmark to its pixel.
    fn of_one(found: &Found, camera: &Camera) -> Option<Self> {
        let eye = camera.model.cahv()[0];
        let sight = camera.ray(&found.pixel_px).ok()?.direction.into_inner();
        let turn = UnitQuaternion::rotation_between(&(found.point_m - eye), &sight)?;
        let shift = eye - turn * eye;
        let axis = turn.scaled_axis();
        Some(Self(Vector6::new(
            shift.x, shift.y, shift.z, axis.x, axis.y, axis.z,
        )))
    }

    /// Distance of a landmark from where the corrected motion puts it, px.
    fn distance_px(&self, found: &Found, camera: &Camera) -> f64 {
        let place = self.isometry() * nalgebra::Point3::from(found.point_m);
        let pixel = camera.project(&place.coords);
        pixel.map_or(f64::INFINITY, |pixel| (pixel - found.pixel_px).norm())
    }
}

/// A correction, and how well it is known.
pub(super) struct Fit {
    pub correction: Correction,
    pub covariance: Matrix6<f64>,
    pub agreeing_n: usize,
    pub rms_px: f64,
}

impl Fit {
    /// The correction that most landmarks agree on within `agree_px`, pulled towards none by
    /// `prior`, what odometry is off. Without a start each landmark proposes one. `None` if there
    /// is none or the prior is no covariance.
    pub fn of(
        found: &[Found],
        camera: &Camera,
        prior: &Matrix6<f64>,
        start: Option<Correction>,
        agree_px: f64,
    ) -> Option<Self> {
        let information = prior.cholesky()?.inverse();
        let start = start.or_else(|| proposed(found, camera, agree_px))?;
        let (correction, _) = refined(found, camera, &information, start, agree_px, 1.0)?;
        let agreeing: Vec<f64> = found
            .iter()
            .map(|f| correction.distance_px(f, camera))
            .filter(|distance| *distance <= agree_px)
            .collect();
        let n = agreeing.len();
        if n == 0 {
            return None;
        }
        let squares: f64 = agreeing.iter().map(|d| d * d).sum();
        let rms_px = (squares / n as f64).sqrt();
        // once more with the deviation that they show
        let sigma_px = rms_px.max(LEAST_SIGMA_PX);
        let (correction, hessian) =
            refined(found, camera, &information, correction, agree_px, sigma_px)?;
        Some(Self {
            correction,
            covariance: hessian.cholesky()?.inverse(),
            agreeing_n: n,
            rms_px,
        })
    }
}

/// The proposal of one landmark that most others agree with.
fn proposed(found: &[Found], camera: &Camera, agree_px: f64) -> Option<Correction> {
    /// A turn alone does not explain what odometry is off along the way.
    const WIDER: f64 = 2.5;
    let limit = WIDER * agree_px;
    let mut best: Option<(f64, Correction)> = None;
    for one in found {
        let Some(proposal) = Correction::of_one(one, camera) else {
            continue;
        };
        // each speaks for it by how near it is
        let votes: f64 = found
            .iter()
            .map(|f| (1.0 - proposal.distance_px(f, camera) / limit).max(0.0))
            .sum();
        if best.is_none_or(|(most, _)| votes > most) {
            best = Some((votes, proposal));
        }
    }
    best.map(|(_, proposal)| proposal)
}

/// Gauss-Newton steps with Tukey's weights, and the Hessian at the end.
fn refined(
    found: &[Found],
    camera: &Camera,
    information: &Matrix6<f64>,
    start: Correction,
    agree_px: f64,
    sigma_px: f64,
) -> Option<(Correction, Matrix6<f64>)> {
    let mut x = start;
    let mut hessian = *information;
    for k in 0..ITERATIONS {
        // wide at first, so that what the start does not explain is not left out
        let cut = agree_px * if k < ITERATIONS / 2 { 3.0 } else { 1.5 };
        let motion = x.isometry();
        hessian = *information;
        let mut gradient = information * x.0;
        for f in found {
            let turned = motion.rotation * f.point_m;
            let place = turned + motion.translation.vector;
            let Ok(seen) = camera.project_with_jacobian(&place) else {
                continue;
            };
            let error = seen.pixel_px - f.pixel_px;
            let part = error.norm() / cut;
            if part >= 1.0 {
                continue;
            }
            let weight = (1.0 - part * part).powi(2) / (sigma_px * sigma_px * ALIKE_N);
            let mut shape = SMatrix::<f64, 3, 6>::zeros();
            shape.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
            shape
                .fixed_view_mut::<3, 3>(0, 3)
                .copy_from(&-turned.cross_matrix());
            let j = seen.jacobian * shape;
            hessian += j.transpose() * j * weight;
            gradient += j.transpose() * error * weight;
        }
        let step = hessian.cholesky()?.solve(&gradient);
        x = Correction(x.0 - step);
        if !x.0.iter().all(|v| v.is_finite()) {
            return None;
        }
    }
    Some((x, hessian))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use nalgebra::Point3;
    use rover_cameras::{Cahv, CameraModel};

    fn camera() -> Camera {
        Camera {
            model: CameraModel::Cahv(Cahv {
                c: Vector3::new(0.2, 0.05, 1.2),
                a: Vector3::new(0.96, 0.0, -0.28),
                h: Vector3::new(480.0, -1290.0, -140.0),
                v: Vector3::new(7.2, 0.0, -1348.0),
            }),
            width_px: 1024,
            height_px: 768,
        }
    }

    /// Landmarks on uneven ground seen after a motion that is `off` from odometry; every fourth is
    /// mistaken for another place.
    fn landmarks(off: &Correction) -> Vec<Found> {
        let camera = camera();
        let mut found = Vec::new();
        for i in 0..6 {
            for j in 0..5 {
                let k = i * 5 + j;
                let [x, y] = [2.5 + 0.6 * f64::from(i), 0.35 * f64::from(j - 2)];
                let point_m = Vector3::new(x, y, 0.04 * f64::from(k % 7));
                let place = (off.isometry() * Point3::from(point_m)).coords;
                let Ok(mut pixel_px) = camera.project(&place) else {
                    continue;
                };
                if k % 4 == 0 {
                    pixel_px += Vector2::new(40.0 - 11.0 * f64::from(i), 25.0 - 9.0 * f64::from(j));
                }
                found.push(Found { point_m, pixel_px });
            }
        }
        found
    }

    fn prior() -> Matrix6<f64> {
        Matrix6::from_diagonal(&Vector6::new(9e-4, 1e-4, 1e-4, 2e-5, 2e-5, 4e-4))
    }

    #[test]
    fn the_motion_is_that_of_the_many_in_spite_of_mistaken_ones() {
        let off = Correction(Vector6::new(0.03, -0.008, 0.004, 0.004, -0.003, 0.03));
        let found = landmarks(&off);
        let loose = prior() * 25.0;
        let fit = Fit::of(&found, &camera(), &loose, None, 6.0).unwrap();
        let at = |c: &Correction| (c.isometry() * Point3::new(3.5, 0.2, 0.1)).coords;
        let right = found.len() - found.len().div_ceil(4);
        assert!(fit.agreeing_n >= right, "{}", fit.agreeing_n);
        let fine = Fit::of(&found, &camera(), &loose, Some(fit.correction), 2.0).unwrap();
        // odometry pulls a little
        let rest = (at(&fine.correction) - at(&off)).norm();
        assert!(rest < 0.002, "{rest} m, {} px", fine.rms_px);
        assert!(fine.rms_px < 0.2);
    }

    #[test]
    fn its_covariance_shrinks_from_that_of_odometry() {
        let found = landmarks(&Correction::identity());
        let fit = Fit::of(&found, &camera(), &prior(), None, 2.0).unwrap();
        for k in 0..6 {
            assert!(fit.covariance[(k, k)] < prior()[(k, k)]);
        }
        assert!(fit.covariance[(5, 5)].sqrt() < 1e-3);
    }

    #[test]
    fn nothing_found_gives_nothing() {
        assert!(Fit::of(&[], &camera(), &prior(), None, 6.0).is_none());
    }
}
