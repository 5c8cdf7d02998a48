//! The joint adjustment: robust weights, normal equations, rejection, covariance.

use super::rig::{Rig, difference_step, own_camera};
use super::{BoardView, CalibrationRules, MAX_PICTURE_REJECTED, Residual};
use crate::CameraModel;
use crate::least_squares::{Minimum, Normal, Problem, minimise};
use nalgebra::{DMatrix, DVector, Matrix2x3, Point3, SMatrix, Vector2, Vector3};

/// The observations with their weights.
pub(super) struct Adjustment<'a> {
    views: &'a [BoardView],
    /// Per view, camera, corner: whether it counts.
    used: Vec<Vec<Vec<bool>>>,
    /// Per view: whether it is left out as a whole, for good.
    dropped: Vec<bool>,
    sigma_px: f64,
    /// Errors beyond this many sigma weigh less; infinite for plain least squares.
    huber_sigma: f64,
    /// Prior standard deviations of the intrinsics from the fifth on.
    priors: [f64; 7],
}

/// Scale before anything is known, px.
const FIRST_SIGMA_PX: f64 = 1.0;
/// The scale is never taken to be smaller, px: perfect data have no noise to estimate it from.
const LEAST_SIGMA_PX: f64 = 1e-6;
/// Median of the length of a 2-D normal vector of unit sigma.
const MEDIAN_LENGTH: f64 = 1.177_410_022_515_474_6;

/// One corner's derivative: intrinsics, second camera, board.
struct Row {
    error: Vector2<f64>,
    inner: Vec<Vector2<f64>>,
    second: Option<SMatrix<f64, 2, 6>>,
    board: SMatrix<f64, 2, 6>,
}

/// Derivative of a pixel with respect to a nudge of the pose that made `turned` (before the
/// shift) part of the point.
fn by_nudge(by_point: &Matrix2x3<f64>, turned: &Vector3<f64>) -> SMatrix<f64, 2, 6> {
    let turn = -by_point * turned.cross_matrix();
    let mut all = SMatrix::<f64, 2, 6>::zeros();
    all.fixed_columns_mut::<3>(0).copy_from(&turn);
    all.fixed_columns_mut::<3>(3).copy_from(by_point);
    all
}

impl<'a> Adjustment<'a> {
    pub(super) fn new(views: &'a [BoardView], rules: &CalibrationRules) -> Self {
        let r = rules.distortion_sigma;
        let (o, e) = (rules.axis_sigma_rad, rules.pupil_sigma_m);
        Self {
            views,
            used: views
                .iter()
                .map(|view| view.iter().map(|points| vec![true; points.len()]).collect())
                .collect(),
            dropped: vec![false; views.len()],
            sigma_px: FIRST_SIGMA_PX,
            huber_sigma: rules.huber_sigma,
            priors: [o, o, r, r, e, e, e],
        }
    }

    pub(super) fn sigma_px(&self) -> f64 {
        self.sigma_px
    }

    /// The views that are left out.
    pub(super) fn dropped(&self) -> Vec<usize> {
        (0..self.dropped.len())
            .filter(|view| self.dropped[*view])
            .collect()
    }

    pub(super) fn run(&self, start: Rig, iterations: u32) -> Option<Minimum<Rig>> {
        minimise(self, start, iterations)
    }

    /// Visits every corner with its view, camera and index.
    fn each(&self, mut visit: impl FnMut(usize, usize, usize) -> Option<()>) -> Option<()> {
        for (view, cameras) in self.views.iter().enumerate() {
            for (camera, points) in cameras.iter().enumerate() {
                for point in 0..points.len() {
                    visit(view, camera, point)?;
                }
            }
        }
        Some(())
    }

    fn models(rig: &Rig) -> Vec<CameraModel> {
        rig.inner.iter().map(|p| own_camera(rig.kind, p)).collect()
    }

    /// The corner in the camera's axes.
    fn place(&self, rig: &Rig, view: usize, camera: usize, point: usize) -> [Vector3<f64>; 2] {
        let at = self.views[view][camera][point].board_m;
        let first = rig.camera_from_board[view]
            .transform_point(&Point3::new(at.x, at.y, 0.0))
            .coords;
        match (&rig.second_from_first, camera) {
            (Some(pose), 1) => [first, pose.transform_point(&Point3::from(first)).coords],
            _ => [first, first],
        }
    }

    /// Found minus modelled, px.
    fn error(
        &self,
        rig: &Rig,
        models: &[CameraModel],
        [view, camera, point]: [usize; 3],
    ) -> Option<Vector2<f64>> {
        let [_, seen] = self.place(rig, view, camera, point);
        let pixel = models[camera].project(&seen).ok()?;
        Some(self.views[view][camera][point].pixel_px - pixel)
    }

    /// Weight and half the (robust) square of an error.
    fn robust(&self, error: &Vector2<f64>) -> (f64, f64) {
        let x = error.norm() / self.sigma_px;
        let k = self.huber_sigma;
        if x <= k {
            (1.0, 0.5 * x * x)
        } else {
            (k / x, k * x - 0.5 * k * k)
        }
    }

    fn row(
        &self,
        rig: &Rig,
        models: &[CameraModel],
        nearby: &[Vec<[CameraModel; 2]>],
        [view, camera, point]: [usize; 3],
    ) -> Option<Row> {
        let [first, seen] = self.place(rig, view, camera, point);
        let image = models[camera].project_with_jacobian(&seen).ok()?;
        let error = self.views[view][camera][point].pixel_px - image.pixel_px;
        let inner = nearby[camera]
            .iter()
            .enumerate()
            .map(|(i, [ahead, back])| {
                let span = 2.0 * difference_step(i);
                Some((ahead.project(&seen).ok()? - back.project(&seen).ok()?) / span)
            })
            .collect::<Option<Vec<_>>>()?;
        let turned = first - rig.camera_from_board[view].translation.vector;
        let (by_first, second) = match (&rig.second_from_first, camera) {
            (Some(pose), 1) => {
                let rotation = pose.rotation.to_rotation_matrix();
                let rest = seen - pose.translation.vector;
                (
                    image.jacobian * rotation.matrix(),
                    Some(by_nudge(&image.jacobian, &rest)),
                )
            }
            _ => (image.jacobian, None),
        };
        Some(Row {
            error,
            inner,
            second,
            board: by_nudge(&by_first, &turned),
        })
    }

    /// Estimates the noise and decides anew which corners count; whether anything changed.
    pub(super) fn reweigh(&mut self, rig: &Rig, rules: &CalibrationRules, round: usize) -> bool {
        let residuals = self.residuals(rig);
        let mut lengths: Vec<f64> = residuals
            .iter()
            .filter(|r| !self.dropped[r.view])
            .map(|r| r.error_px.norm())
            .collect();
        lengths.sort_by(f64::total_cmp);
        let bulk = lengths.get(lengths.len() / 2).copied().unwrap_or(0.0) / MEDIAN_LENGTH;
        let before = (self.sigma_px, self.used.clone());
        if round == 0 {
            // Robust, now with the right scale.
            self.sigma_px = bulk.max(LEAST_SIGMA_PX);
            return true;
        }
        let limit = rules.reject_sigma * bulk.max(LEAST_SIGMA_PX);
        let mut lengths = residuals.iter().map(|r| r.error_px.norm());
        for (view, dropped) in self.used.iter_mut().zip(&mut self.dropped) {
            for used in view.iter_mut().flatten() {
                *used = lengths.next().is_some_and(|length| length <= limit) && !*dropped;
            }
            let lost = |picture: &Vec<bool>| {
                let rejected = picture.iter().filter(|used| !**used).count();
                rejected as f64 > MAX_PICTURE_REJECTED * picture.len() as f64
            };
            if *dropped || view.iter().any(lost) {
                *dropped = true;
                view.iter_mut().flatten().for_each(|used| *used = false);
            }
        }
        self.huber_sigma = f64::INFINITY;
        // Unbiased: as many degrees of freedom as there are unknowns are used up.
        let (sum, n) = self
            .residuals(rig)
            .iter()
            .filter(|r| r.used)
            .fold((0.0, 0_usize), |(sum, n), r| {
                (sum + r.error_px.norm_squared(), n + 2)
            });
        let kept = self.dropped.iter().filter(|dropped| !**dropped).count();
        let unknowns = rig.board_at(kept);
        let freedom = n.saturating_sub(unknowns).max(1);
        self.sigma_px = (sum / freedom as f64).sqrt().max(LEAST_SIGMA_PX);
        self.used != before.1 || (self.sigma_px / before.0 - 1.0).abs() > 1e-3
    }

    /// Every corner in order; one without an image has an infinite error and is not used.
    pub(super) fn residuals(&self, rig: &Rig) -> Vec<Residual> {
        let models = Self::models(rig);
        let mut all = Vec::new();
        let _ = self.each(|view, camera, point| {
            let error = self.error(rig, &models, [view, camera, point]);
            all.push(Residual {
                view,
                camera,
                pixel_px: self.views[view][camera][point].pixel_px,
                error_px: error.unwrap_or(Vector2::repeat(f64::MAX.sqrt() * 1e-10)),
                used: self.used[view][camera][point] && error.is_some(),
            });
            Some(())
        });
        all
    }

    /// Covariance of the cameras' parameters, the poses of the board left free, or the parameter
    /// that is determined least where there is none; nothing where a corner has no image.
    pub(super) fn covariance(&self, rig: &Rig) -> Option<Result<DMatrix<f64>, usize>> {
        let hessian = self.normal(rig)?.hessian;
        let n = rig.camera_n();
        // Scaled to a unit diagonal, so that units do not decide what is singular.
        let scale = hessian.diagonal().map(|d| 1.0 / d.sqrt());
        if let Some(i) = (0..n).find(|i| !scale[*i].is_finite()) {
            return Some(Err(i));
        }
        let mut scaled = hessian;
        for i in 0..scaled.nrows() {
            for j in 0..scaled.ncols() {
                scaled[(i, j)] *= scale[i] * scale[j];
            }
        }
        let Some(found) = scaled.clone().cholesky() else {
            return Some(Err(loosest(scaled, n)));
        };
        let inverse = found.inverse();
        Some(Ok(DMatrix::from_fn(n, n, |i, j| {
            inverse[(i, j)] * scale[i] * scale[j]
        })))
    }
}

/// Of the first `n` unknowns the one that takes the largest part in the direction that a singular
/// matrix leaves open.
fn loosest(matrix: DMatrix<f64>, n: usize) -> usize {
    let found = matrix.symmetric_eigen();
    let open = found.eigenvectors.column(found.eigenvalues.imin());
    (0..n)
        .max_by(|a, b| open[*a].abs().total_cmp(&open[*b].abs()))
        .unwrap_or(0)
}

impl Problem for Adjustment<'_> {
    type State = Rig;

    fn cost(&self, rig: &Rig) -> Option<f64> {
        let models = Self::models(rig);
        if !models.iter().all(|m| m.validate().is_ok()) {
            return None;
        }
        let mut cost = 0.0;
        self.each(|view, camera, point| {
            if self.used[view][camera][point] {
                cost += self
                    .robust(&self.error(rig, &models, [view, camera, point])?)
                    .1;
            }
            Some(())
        })?;
        for inner in &rig.inner {
            for (x, sigma) in inner.iter().skip(4).zip(self.priors) {
                cost += 0.5 * (x / sigma).powi(2);
            }
        }
        Some(cost)
    }

    fn normal(&self, rig: &Rig) -> Option<Normal> {
        let n = rig.board_at(rig.camera_from_board.len());
        let mut hessian = DMatrix::zeros(n, n);
        let mut gradient = DVector::zeros(n);
        let models = Self::models(rig);
        let nearby: Vec<Vec<[CameraModel; 2]>> = rig
            .inner
            .iter()
            .map(|inner| {
                let at = |i: usize, sign: f64| {
                    let mut p = inner.clone();
                    p[i] += sign * difference_step(i);
                    own_camera(rig.kind, &p)
                };
                (0..inner.len())
                    .map(|i| [at(i, 1.0), at(i, -1.0)])
                    .collect()
            })
            .collect();
        let scale = 1.0 / (self.sigma_px * self.sigma_px);
        let mut columns: Vec<(usize, Vector2<f64>)> = Vec::new();
        self.each(|view, camera, point| {
            if !self.used[view][camera][point] {
                return Some(());
            }
            let row = self.row(rig, &models, &nearby, [view, camera, point])?;
            let weight = self.robust(&row.error).0 * scale;
            columns.clear();
            let at = rig.inner_at(camera);
            columns.extend(row.inner.iter().enumerate().map(|(i, c)| (at + i, *c)));
            if let Some(second) = &row.second {
                let at = rig.second_at();
                columns.extend((0..6).map(|i| (at + i, second.column(i).into_owned())));
            }
            let at = rig.board_at(view);
            columns.extend((0..6).map(|i| (at + i, row.board.column(i).into_owned())));
            for (i, a) in &columns {
                // The error falls as the modelled pixel rises.
                gradient[*i] -= weight * a.dot(&row.error);
                for (j, b) in &columns {
                    hessian[(*i, *j)] += weight * a.dot(b);
                }
            }
            Some(())
        })?;
        for (camera, inner) in rig.inner.iter().enumerate() {
            let at = rig.inner_at(camera) + 4;
            for (i, (x, sigma)) in inner.iter().skip(4).zip(self.priors).enumerate() {
                hessian[(at + i, at + i)] += 1.0 / (sigma * sigma);
                gradient[at + i] += x / (sigma * sigma);
            }
        }
        // Nothing asks for the pose of a view left out: it stays.
        for view in self.dropped() {
            let at = rig.board_at(view);
            (at..at + 6).for_each(|i| hessian[(i, i)] = 1.0);
        }
        Some(Normal {
            hessian,
            gradient,
            cost: self.cost(rig)?,
        })
    }

    fn moved(&self, rig: &Rig, step: &DVector<f64>) -> Rig {
        rig.moved(step)
    }
}
