//! Whether a calibration can be trusted: figures per picture, stated limits, and the pictures that
//! contradict each other.

use super::{BoardPoint, BoardView, Calibration, CalibrationError, Parameter};
use nalgebra::Vector2;
use thiserror::Error;

/// Two views in which no corner moved by more than this are one placement of the board, px: some
/// times the noise of a corner, far less than a hand moves a board.
pub const SAME_PLACEMENT_PX: f64 = 0.5;
/// A view is left out if more than this share of the corners of one of its pictures is rejected:
/// the picture then does not show what the others explain, and its other corners fit by chance.
pub const MAX_PICTURE_REJECTED: f64 = 0.5;
/// Rejected corners that are off by less than this do not speak against the pictures, px: where the
/// others agree to a few hundredths, four sigma are a tenth.
pub const REJECTED_PX: f64 = 0.5;
/// Cells of the image, across and down, in which errors are averaged.
pub const CELLS: [usize; 2] = [8, 6];
/// Share of the squared error that neighbouring corners have in common from which the model is
/// said to leave distortion over; noise alone gives 0 ([`Calibration::structured_share`]).
pub const STRUCTURED_SHARE: f64 = 0.4;
/// Least root mean square of that common part, px: printed boards are not flat, and corners of one
/// picture are blurred alike, to about 0.1 px.
pub const STRUCTURED_PX: f64 = 0.2;

/// The limits of a calibration that is good enough to be used.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct QualityLimits {
    /// Largest share of rejected corners, off by more than [`REJECTED_PX`], in the views kept.
    pub max_rejected_share: f64,
    /// Largest share of views left out as a whole.
    pub max_dropped_share: f64,
    /// Largest root mean square error of a camera, px.
    pub max_rms_px: f64,
    /// Least ratio of the baseline to its standard deviation.
    pub min_baseline_sigmas: f64,
}

impl Default for QualityLimits {
    /// A tenth of the corners, a third of the views, 1 px, 10 sigma. Corners of a printed
    /// board are found to 0.1 or 0.2 px; what is beyond these limits is wrong, not imprecise.
    fn default() -> Self {
        Self {
            max_rejected_share: 0.1,
            max_dropped_share: 1.0 / 3.0,
            max_rms_px: 1.0,
            min_baseline_sigmas: 10.0,
        }
    }
}

/// A limit that a calibration does not keep.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum QualityProblem {
    /// Too many corners do not fit.
    #[error(
        "{found} of {corners} corners of the pictures kept were rejected and are off by more than \
         {REJECTED_PX} px, expected at most {:.0} %",
        100.0 * limit
    )]
    Rejected {
        /// Corners rejected in the views kept that are off by more than [`REJECTED_PX`].
        found: usize,
        /// Corners in the views kept.
        corners: usize,
        /// [`QualityLimits::max_rejected_share`].
        limit: f64,
    },
    /// Too many views do not fit.
    #[error(
        "{found} of {views} placements of the board were left out, expected at most {:.0} %",
        100.0 * limit
    )]
    Dropped {
        /// Views left out.
        found: usize,
        /// All views.
        views: usize,
        /// [`QualityLimits::max_dropped_share`].
        limit: f64,
    },
    /// The errors are too large.
    #[error("the {} camera errs by {rms_px:.3} px rms, expected at most {limit_px} px", side(*camera))]
    Rms {
        /// 0 left, 1 right.
        camera: usize,
        /// Its root mean square error, px.
        rms_px: f64,
        /// [`QualityLimits::max_rms_px`].
        limit_px: f64,
    },
    /// The cameras may as well stand in one place.
    #[error(
        "the baseline is {:.4} +- {:.4} mm, expected at least {limit} standard deviations",
        1e3 * baseline_m,
        1e3 * sigma_m
    )]
    Baseline {
        /// Distance between the two projection centres, metres.
        baseline_m: f64,
        /// Its standard deviation, metres.
        sigma_m: f64,
        /// [`QualityLimits::min_baseline_sigmas`].
        limit: f64,
    },
}

/// How one picture fits.
#[derive(Clone, Debug, PartialEq)]
pub struct PictureFit {
    /// Placement of the board, from 0.
    pub view: usize,
    /// 0 left, 1 right.
    pub camera: usize,
    /// Corners found in it.
    pub corners: usize,
    /// Corners rejected; all of a view that was left out.
    pub rejected: usize,
    /// Root mean square error of the corners used, px; `None` if none was.
    pub rms_px: Option<f64>,
    /// Median error of all its corners, px.
    pub median_px: f64,
    /// Whether its view was left out.
    pub dropped: bool,
}

/// `left` or `right`.
pub(super) fn side(camera: usize) -> &'static str {
    if camera == 0 { "left" } else { "right" }
}

/// Largest movement of a corner between two lists of the same corners, px; `None` if they are not
/// the same.
fn moved_px(a: &[BoardPoint], b: &[BoardPoint]) -> Option<f64> {
    if a.len() != b.len() || a.is_empty() {
        return None;
    }
    a.iter().zip(b).try_fold(0.0_f64, |most, (p, q)| {
        (p.board_m == q.board_m).then(|| most.max((p.pixel_px - q.pixel_px).norm()))
    })
}

fn still(a: &[BoardPoint], b: &[BoardPoint]) -> bool {
    moved_px(a, b).is_some_and(|px| px <= SAME_PLACEMENT_PX)
}

/// For every view the first one that it repeats: the board stands still ([`SAME_PLACEMENT_PX`])
/// in every camera that sees it, and the same cameras do. Only views that repeat none themselves
/// are repeated, so that a board that is moved slowly shows several placements.
pub fn repeats(views: &[BoardView]) -> Vec<Option<usize>> {
    let same = |a: &BoardView, b: &BoardView| {
        a.len() == b.len()
            && a.iter().any(|points| !points.is_empty())
            && a.iter()
                .zip(b)
                .all(|(p, q)| (p.is_empty() && q.is_empty()) || still(p, q))
    };
    let mut all: Vec<Option<usize>> = Vec::with_capacity(views.len());
    for view in views {
        let mut firsts = (0..all.len()).filter(|n| all[*n].is_none());
        let first = firsts.find(|n| same(view, &views[*n]));
        all.push(first);
    }
    all
}

/// Refuses views that cannot both be true, whatever the cameras.
pub(super) fn check_pairs(views: &[BoardView]) -> Result<(), CalibrationError> {
    for (n, view) in views.iter().enumerate() {
        let [left, right] = view.as_slice() else {
            continue;
        };
        if still(left, right) {
            return Err(CalibrationError::SamePicture { view: n });
        }
        for (first, other) in views[..n].iter().enumerate() {
            let both = |camera: usize| (&view[camera], &other[camera]);
            for camera in 0..2 {
                let (own, others) = (both(camera), both(1 - camera));
                if still(own.0, own.1)
                    && moved_px(others.0, others.1).is_some_and(|px| px > 10.0 * SAME_PLACEMENT_PX)
                {
                    return Err(CalibrationError::Mispaired {
                        camera,
                        views: [first, n],
                    });
                }
            }
        }
    }
    Ok(())
}

impl Calibration {
    /// How every picture fits, in the order of views and cameras.
    pub fn pictures(&self) -> Vec<PictureFit> {
        let mut all: Vec<PictureFit> = Vec::new();
        let mut rest = self.residuals.as_slice();
        while let Some(first) = rest.first() {
            let n = rest
                .iter()
                .take_while(|r| (r.view, r.camera) == (first.view, first.camera))
                .count();
            let (own, others) = rest.split_at(n);
            rest = others;
            let used = own.iter().filter(|r| r.used);
            let (sum, kept) = used.fold((0.0, 0_usize), |(sum, kept), r| {
                (sum + r.error_px.norm_squared(), kept + 1)
            });
            let mut lengths: Vec<f64> = own.iter().map(|r| r.error_px.norm()).collect();
            lengths.sort_by(f64::total_cmp);
            all.push(PictureFit {
                view: first.view,
                camera: first.camera,
                corners: n,
                rejected: n - kept,
                rms_px: (kept > 0).then(|| (sum / kept as f64).sqrt()),
                median_px: lengths[n / 2],
                dropped: self.dropped.contains(&first.view),
            });
        }
        all
    }

    /// The distance between the two cameras with its standard deviation, metres; `None` for one
    /// camera.
    pub fn baseline_m(&self) -> Option<Parameter> {
        let at = self
            .parameters
            .iter()
            .position(|p| p.name == "right.shift_x_m")?;
        let shift = nalgebra::Vector3::from_fn(|i, _| self.parameters[at + i].value);
        let value = shift.norm();
        let along = shift / value.max(f64::MIN_POSITIVE);
        let own = self.covariance.fixed_view::<3, 3>(at, at);
        // Of no length, in no direction: the largest of all.
        let sigma = if value > 0.0 {
            (along.transpose() * own * along).x.max(0.0).sqrt()
        } else {
            own.trace().sqrt()
        };
        Some(Parameter {
            name: "baseline_m".into(),
            value,
            sigma,
        })
    }

    /// Mean error of the corners used, its root mean square and their number for the [`CELLS`] of
    /// a camera's image, row by row.
    pub fn cells(&self, camera: usize) -> Vec<(Vector2<f64>, f64, usize)> {
        let mut cells = vec![(Vector2::zeros(), 0.0, 0_usize); CELLS[0] * CELLS[1]];
        let Some(of) = self.cameras.get(camera) else {
            return cells;
        };
        let size = [of.width_px, of.height_px];
        for r in self
            .residuals
            .iter()
            .filter(|r| r.camera == camera && r.used)
        {
            let [column, row] = [0, 1].map(|axis| {
                let share = (r.pixel_px[axis] + 0.5) / f64::from(size[axis]);
                ((share * CELLS[axis] as f64).max(0.0) as usize).min(CELLS[axis] - 1)
            });
            let cell = &mut cells[row * CELLS[0] + column];
            cell.0 += r.error_px;
            cell.1 += r.error_px.norm_squared();
            cell.2 += 1;
        }
        for (mean, rms, n) in cells.iter_mut().filter(|cell| cell.2 > 0) {
            *mean /= *n as f64;
            *rms = (*rms / *n as f64).sqrt();
        }
        cells
    }

    /// Share of a camera's squared error that a corner has in common with the nearest corner of the
    /// same picture: 0 for noise, near 1 for errors that vary smoothly.
    pub fn structured_share(&self, camera: usize) -> f64 {
        let own = |r: &&super::Residual| r.camera == camera && r.used;
        let used: Vec<_> = self.residuals.iter().filter(own).collect();
        let (mut common, mut total) = (0.0, 0.0);
        for picture in used.chunk_by(|a, b| a.view == b.view) {
            for (i, corner) in picture.iter().enumerate() {
                let apart = |j: &usize| (picture[*j].pixel_px - corner.pixel_px).norm_squared();
                let others = (0..picture.len()).filter(|j| *j != i);
                if let Some(j) = others.min_by(|a, b| apart(a).total_cmp(&apart(b))) {
                    common += corner.error_px.dot(&picture[j].error_px);
                    total += corner.error_px.norm_squared();
                }
            }
        }
        if total > 0.0 {
            (common / total).clamp(0.0, 1.0)
        } else {
            0.0
        }
    }

    /// The root mean square of the errors that neighbouring corners have in common, px, if it is so
    /// much ([`STRUCTURED_SHARE`], [`STRUCTURED_PX`]) that the model leaves distortion over, or
    /// the board is not flat.
    pub fn left_over_px(&self, camera: usize) -> Option<f64> {
        let share = self.structured_share(camera);
        let common_px = share.sqrt() * self.rms_px.get(camera)?;
        (share >= STRUCTURED_SHARE && common_px >= STRUCTURED_PX).then_some(common_px)
    }

    /// The limits that this calibration does not keep; none for one to be used.
    pub fn problems(&self, limits: &QualityLimits) -> Vec<QualityProblem> {
        let mut all = Vec::new();
        let (found, views) = (self.dropped.len(), self.camera_from_board.len());
        if found as f64 > limits.max_dropped_share * views as f64 {
            all.push(QualityProblem::Dropped {
                found,
                views,
                limit: limits.max_dropped_share,
            });
        }
        let kept = || {
            self.residuals
                .iter()
                .filter(|r| !self.dropped.contains(&r.view))
        };
        let far = |r: &&super::Residual| !r.used && r.error_px.norm() > REJECTED_PX;
        let (corners, found) = (kept().count(), kept().filter(far).count());
        if found as f64 > limits.max_rejected_share * corners as f64 {
            all.push(QualityProblem::Rejected {
                found,
                corners,
                limit: limits.max_rejected_share,
            });
        }
        for (camera, rms_px) in self.rms_px.iter().enumerate() {
            if !(*rms_px <= limits.max_rms_px) {
                all.push(QualityProblem::Rms {
                    camera,
                    rms_px: *rms_px,
                    limit_px: limits.max_rms_px,
                });
            }
        }
        if let Some(baseline) = self.baseline_m()
            && !(baseline.value >= limits.min_baseline_sigmas * baseline.sigma)
        {
            all.push(QualityProblem::Baseline {
                baseline_m: baseline.value,
                sigma_m: baseline.sigma,
                limit: limits.min_baseline_sigmas,
            });
        }
        all
    }
}
