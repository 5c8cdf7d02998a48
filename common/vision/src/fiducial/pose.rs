//! The plate's pose from its points, by Gauss-Newton on the reprojection errors.

use nalgebra::{Isometry3, Matrix6, Translation3, UnitQuaternion, Vector2, Vector3, Vector6};
use rover_cameras::{Camera, StereoPair};

use super::{NotFound, PlateObservation};
use crate::plate::PlateLayout;

/// The plate's pose in the rover frame (the frame of the camera models).
#[derive(Clone, Debug, PartialEq)]
pub struct PlatePose {
    /// Takes plate coordinates to the rover frame.
    pub rover_from_plate: Isometry3<f64>,
    /// Covariance of (plate origin, m; rotation vector about the rover axes, rad), from the
    /// points' standard deviations, enlarged where the residuals are larger than those say.
    pub covariance: Matrix6<f64>,
    /// Root mean square reprojection error per coordinate, px.
    pub rms_px: f64,
    /// Points used, both images together.
    pub points_used: usize,
    /// Points left out because they did not fit.
    pub rejected: usize,
}

/// One point in one camera.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sighting {
    pub camera: usize,
    pub index: usize,
    pub point_in_plate: Vector3<f64>,
    pub pixel_px: Vector2<f64>,
    pub sigma_px: f64,
}

/// A solved pose.
pub(crate) struct Solved {
    pub pose: Isometry3<f64>,
    /// J^T W J at the solution.
    pub information: Matrix6<f64>,
    /// Length of each reprojection error, px.
    residuals_px: Vec<f64>,
    /// Weighted sum of squares.
    chi2: f64,
}

impl Solved {
    /// Index and length (px) of the largest residual.
    pub fn worst(&self) -> Option<(usize, f64)> {
        self.residuals_px
            .iter()
            .copied()
            .enumerate()
            .max_by(|a, b| a.1.total_cmp(&b.1))
    }

    pub fn rms_px(&self) -> f64 {
        let sum: f64 = self.residuals_px.iter().map(|r| r * r).sum();
        (sum / (2.0 * self.residuals_px.len().max(1) as f64)).sqrt()
    }
}

const MAX_STEPS: usize = 30;
/// Steps below this (m, rad) end the iteration.
const SETTLED: f64 = 1e-10;
/// Residuals up to this are never rejected, px.
const ACCEPTED_PX: f64 = 0.1;
/// Residuals above this multiple of the robust standard deviation are rejected.
const OUTLIER_FACTOR: f64 = 4.5;
/// Largest rms of an accepted two-camera pose, px: more means that the images or the camera models
/// do not belong together.
const MAX_RMS_PX: f64 = 1.5;
/// Points needed over both images, and in each.
const MIN_POINTS_TOTAL: usize = 6;

/// Errors and normal equations at a pose; `None` if a point cannot be seen from there.
fn linearise(
    cameras: &[&Camera],
    seen: &[Sighting],
    pose: &Isometry3<f64>,
) -> Option<(Matrix6<f64>, Vector6<f64>, f64, Vec<f64>)> {
    let mut normal = Matrix6::zeros();
    let mut right = Vector6::zeros();
    let mut chi2 = 0.0;
    let mut residuals = Vec::with_capacity(seen.len());
    for s in seen {
        let arm = pose.rotation * s.point_in_plate;
        let seen_at = cameras
            .get(s.camera)?
            .project_with_jacobian(&(arm + pose.translation.vector))
            .ok()?;
        let error = s.pixel_px - seen_at.pixel_px;
        let turn = seen_at.jacobian * (-arm.cross_matrix());
        let weight = 1.0 / (s.sigma_px * s.sigma_px);
        for row in 0..2 {
            let jt = seen_at.jacobian.row(row);
            let jr = turn.row(row);
            let j = Vector6::new(jt[0], jt[1], jt[2], jr[0], jr[1], jr[2]);
            normal.ger(weight, &j, &j, 1.0);
            right.axpy(weight * error[row], &j, 1.0);
        }
        chi2 += weight * error.norm_squared();
        residuals.push(error.norm());
    }
    Some((normal, right, chi2, residuals))
}

/// Minimises the weighted reprojection errors, Levenberg-Marquardt from `start`.
pub(crate) fn solve_pose(
    cameras: &[&Camera],
    seen: &[Sighting],
    start: &Isometry3<f64>,
) -> Result<Solved, NotFound> {
    let mut pose = *start;
    let mut damping = 1e-6;
    let mut now =
        linearise(cameras, seen, &pose).ok_or_else(|| NotFound::NotVisible("pose fit".into()))?;
    for _ in 0..MAX_STEPS {
        let mut damped = now.0;
        for i in 0..6 {
            damped[(i, i)] *= 1.0 + damping;
        }
        let step = damped
            .cholesky()
            .ok_or(NotFound::PoseUndetermined)?
            .solve(&now.1);
        if !step.iter().all(|x| x.is_finite()) {
            return Err(NotFound::PoseUndetermined);
        }
        let turn = UnitQuaternion::from_scaled_axis(step.fixed_rows::<3>(3).into_owned());
        let next = Isometry3::from_parts(
            Translation3::from(pose.translation.vector + step.fixed_rows::<3>(0)),
            turn * pose.rotation,
        );
        match linearise(cameras, seen, &next) {
            Some(better) if better.2 <= now.2 * (1.0 + 1e-12) => {
                pose = next;
                now = better;
                damping = (damping * 0.1).max(1e-12);
                if step.amax() < SETTLED {
                    break;
                }
            }
            _ if step.amax() < SETTLED => break,
            _ => damping = (damping * 10.0).max(1e-6),
        }
        if damping > 1e8 {
            break;
        }
    }
    if now.0.cholesky().is_none() {
        return Err(NotFound::PoseUndetermined);
    }
    Ok(Solved {
        pose,
        information: now.0,
        residuals_px: now.3,
        chi2: now.2,
    })
}

/// Six-DoF pose of the plate from its points in both images, in the rover frame.
///
/// Points whose error exceeds 4.5 robust standard deviations of all errors (and 0.1 px) are left
/// out, the worst first, and the pose is solved again.
///
/// # Errors
/// [`NotFound::TooFewPoints`] below six points or without two points in each image,
/// [`NotFound::PoseUndetermined`], [`NotFound::PoseMisfit`] if what remains has more than 1.5 px
/// rms, [`NotFound::BadInput`] for observations that do not belong to the layout.
pub fn estimate_plate_pose(
    pair: &StereoPair,
    layout: &PlateLayout,
    left: &PlateObservation,
    right: &PlateObservation,
    start: &Isometry3<f64>,
) -> Result<PlatePose, NotFound> {
    let mut seen = sightings(layout, left, 0)?;
    seen.extend(sightings(layout, right, 1)?);
    settle(&[&pair.left, &pair.right], seen, start)
}

/// Six-DoF pose of the plate from its points in one image, in the frame of the camera's vectors
/// (`rover_from_plate` of the result). By the same rules as [`estimate_plate_pose`]; range comes
/// from the plate's size alone and is several times less certain than with two images.
///
/// # Errors
/// As [`estimate_plate_pose`].
pub fn estimate_plate_pose_single(
    camera: &Camera,
    layout: &PlateLayout,
    observation: &PlateObservation,
    start: &Isometry3<f64>,
) -> Result<PlatePose, NotFound> {
    settle(&[camera], sightings(layout, observation, 0)?, start)
}

/// The points of an observation, checked.
fn sightings(
    layout: &PlateLayout,
    observation: &PlateObservation,
    camera: usize,
) -> Result<Vec<Sighting>, NotFound> {
    let mut seen = Vec::with_capacity(observation.points.len());
    for p in &observation.points {
        let point_in_plate = layout.point(p.index).ok_or_else(|| {
            NotFound::BadInput(format!(
                "an observation has point {}, the layout has {} points",
                p.index,
                layout.point_count()
            ))
        })?;
        if !(p.sigma_px > 0.0 && p.sigma_px.is_finite() && p.pixel_px.iter().all(|x| x.is_finite()))
        {
            return Err(NotFound::BadInput(format!(
                "point {} has pixel ({}, {}) and sigma {} px, expected finite numbers and a \
                 positive sigma",
                p.index, p.pixel_px.x, p.pixel_px.y, p.sigma_px
            )));
        }
        seen.push(Sighting {
            camera,
            index: p.index,
            point_in_plate,
            pixel_px: p.pixel_px,
            sigma_px: p.sigma_px,
        });
    }
    Ok(seen)
}

/// Solves the pose, leaving out what does not fit, the worst first.
fn settle(
    cameras: &[&Camera],
    mut seen: Vec<Sighting>,
    start: &Isometry3<f64>,
) -> Result<PlatePose, NotFound> {
    let total = seen.len();
    let mut pose = *start;
    loop {
        let in_camera = |k: usize| seen.iter().filter(|s| s.camera == k).count();
        let enough =
            seen.len() >= MIN_POINTS_TOTAL && (0..cameras.len()).all(|k| in_camera(k) >= 2);
        if !enough {
            return Err(NotFound::TooFewPoints {
                found: seen.len(),
                needed: MIN_POINTS_TOTAL,
                first_fault: None,
            });
        }
        let solved = solve_pose(cameras, &seen, &pose)?;
        pose = solved.pose;
        let mut sorted = solved.residuals_px.clone();
        sorted.sort_by(f64::total_cmp);
        // median of a 2-D normal's length is 1.1774 sigma
        let sigma = sorted[sorted.len() / 2] / 1.1774;
        let limit = ACCEPTED_PX.max(OUTLIER_FACTOR * sigma);
        if let Some((worst, residual)) = solved.worst()
            && residual > limit
        {
            seen.remove(worst);
            continue;
        }
        let rms_px = solved.rms_px();
        if !(rms_px <= MAX_RMS_PX) {
            return Err(NotFound::PoseMisfit {
                rms_px,
                limit_px: MAX_RMS_PX,
            });
        }
        let freedom = (2 * seen.len()) as f64 - 6.0;
        let inflation = (solved.chi2 / freedom).max(1.0);
        let inverse = solved
            .information
            .cholesky()
            .ok_or(NotFound::PoseUndetermined)?
            .inverse();
        return Ok(PlatePose {
            rover_from_plate: pose,
            covariance: inverse * inflation,
            rms_px,
            points_used: seen.len(),
            rejected: total - seen.len(),
        });
    }
}
