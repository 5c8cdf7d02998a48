//! Unsurveyed calibration: one camera or a stereo pair from views of a planar board whose poses
//! nobody measured (paper, reference 14).
//!
//! Start values come from the views alone (homographies, focal length from their orthogonality
//! conditions, poses from the homographies); then intrinsics, the pose of the right camera and all
//! poses of the board are adjusted together by robust least squares, outliers are rejected, and
//! the covariance of everything follows from the normal equations.
//!
//! **Frame.** The models are given in the axes of the left camera: origin at its C, x along H'
//! (right), z along A (forward), y completing them (down). Nothing in the views says where the
//! rover is; [`crate::Camera::transformed`] takes both to another frame. The scale is that of the
//! board.
//!
//! **What is held.** The pixel grid is rectangular (no skew), and `r0 = 0`, which is a factor of the
//! focal lengths. O and E are drawn weakly to `O = A` and `E = 0` ([`CalibrationRules`]), because a
//! lens with little distortion does not show where its axis is, nor one far from the board where
//! its pupil is.
//!
//! **What is refused.** A view of which one picture loses more than half of its corners
//! ([`MAX_PICTURE_REJECTED`]) is left out as a whole and listed ([`Calibration::dropped`]): a pair
//! that is none, a board that moved between the exposures. Placements that repeat another do not
//! count ([`repeats`]), pictures that contradict each other are refused, and
//! [`Calibration::problems`] says which of the stated limits ([`QualityLimits`]) a result does not
//! keep.

mod adjust;
mod quality;
mod rig;
mod start;

use crate::error::Short;
use crate::{Camera, CameraError};
use adjust::Adjustment;
use nalgebra::{DMatrix, Isometry3, Vector2};
pub use quality::{
    CELLS, MAX_PICTURE_REJECTED, PictureFit, QualityLimits, QualityProblem, REJECTED_PX,
    SAME_PLACEMENT_PX, STRUCTURED_PX, STRUCTURED_SHARE, repeats,
};
use quality::{check_pairs, side};
use rig::Rig;
use thiserror::Error;

/// A corner of the board, seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoardPoint {
    /// Its place on the board, metres.
    pub board_m: Vector2<f64>,
    /// Where it was found, px.
    pub pixel_px: Vector2<f64>,
}

/// The corners that each camera found in one placement of the board, in the order of the cameras
/// (left, right); empty for a camera that did not find it.
pub type BoardView = Vec<Vec<BoardPoint>>;

/// The model to be fitted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ModelKind {
    /// Without distortion.
    Cahv,
    /// Radial distortion about O.
    Cahvor,
    /// Any field of view and a moving pupil, with this linearity (see [`crate::Cahvore`]).
    Cahvore {
        /// 1 perspective, 0 fisheye, or between.
        linearity: f64,
    },
}

/// How a calibration is done.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CalibrationRules {
    /// The model of every camera.
    pub model: ModelKind,
    /// Errors beyond this many sigma weigh less (Huber) until the outliers are known.
    pub huber_sigma: f64,
    /// Corners farther off than this many sigma are rejected.
    pub reject_sigma: f64,
    /// Prior standard deviation of O's tilt against A, radians per axis.
    pub axis_sigma_rad: f64,
    /// Prior standard deviation of each coefficient of R.
    pub distortion_sigma: f64,
    /// Prior standard deviation of each coefficient of E, metres.
    pub pupil_sigma_m: f64,
}

impl Default for CalibrationRules {
    fn default() -> Self {
        Self {
            model: ModelKind::Cahvor,
            huber_sigma: 2.0,
            reject_sigma: 4.0,
            axis_sigma_rad: 0.01,
            distortion_sigma: 1.0,
            pupil_sigma_m: 0.003,
        }
    }
}

/// One estimated number.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameter {
    /// `left.fx_px`, `right.r1`, `right.turn_x_rad`, ...
    pub name: String,
    /// Its value.
    pub value: f64,
    /// Its standard deviation.
    pub sigma: f64,
}

/// One corner after the adjustment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Residual {
    /// Placement of the board, from 0.
    pub view: usize,
    /// Camera: 0 left, 1 right.
    pub camera: usize,
    /// Where it was found, px.
    pub pixel_px: Vector2<f64>,
    /// Found minus modelled, px.
    pub error_px: Vector2<f64>,
    /// Whether it was used; `false` for an outlier.
    pub used: bool,
}

/// The result.
#[derive(Clone, Debug)]
pub struct Calibration {
    /// The cameras, all in the axes of the first.
    pub cameras: Vec<Camera>,
    /// Parameters of the cameras; those of the board's poses are not listed.
    pub parameters: Vec<Parameter>,
    /// Covariance of `parameters` in their order, the poses of the board left free.
    pub covariance: DMatrix<f64>,
    /// Takes the board's coordinates to the axes of the first camera, per view.
    pub camera_from_board: Vec<Isometry3<f64>>,
    /// Every corner.
    pub residuals: Vec<Residual>,
    /// Root mean square of the distance found to modelled over the corners used, px, per camera.
    pub rms_px: Vec<f64>,
    /// Standard deviation of one coordinate of one corner, px.
    pub sigma_px: f64,
    /// Corners rejected, with all of the views left out.
    pub rejected: usize,
    /// Views left out because most corners of one of their pictures were rejected.
    pub dropped: Vec<usize>,
}

/// Why there is no calibration.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum CalibrationError {
    /// Too little was seen.
    #[error(
        "the {} camera sees {found} different placements of the board, expected at least {expected}",
        side(*camera)
    )]
    TooFewViews {
        /// 0 left, 1 right.
        camera: usize,
        /// Placements seen; one that repeats another does not count.
        found: usize,
        /// The least number.
        expected: usize,
    },
    /// Too little is left of what was seen.
    #[error(
        "{} of {views} placements of the board do not fit the others, leaving {left} to the {} \
         camera, expected at least {expected}",
        dropped.len(), side(*camera)
    )]
    Inconsistent {
        /// 0 left, 1 right.
        camera: usize,
        /// All views.
        views: usize,
        /// Views left to the camera.
        left: usize,
        /// The least number.
        expected: usize,
        /// Views that do not fit.
        dropped: Vec<usize>,
    },
    /// Both pictures of a pair are one picture.
    #[error(
        "view {view}: both cameras see every corner within {SAME_PLACEMENT_PX} px of the same \
         pixel, expected pictures of two cameras"
    )]
    SamePicture {
        /// Placement of the board, from 0.
        view: usize,
    },
    /// The board stands still for one camera and moves for the other.
    #[error(
        "views {} and {}: the board is in one place for the {} camera and in two for the other, \
         expected pictures taken at the same time",
        views[0], views[1], side(*camera)
    )]
    Mispaired {
        /// The camera for which it stands still: 0 left, 1 right.
        camera: usize,
        /// The two placements, from 0.
        views: [usize; 2],
    },
    /// Two cameras never saw the board together.
    #[error("no view that can be used shows the board to both cameras")]
    NoCommonView,
    /// A view's content cannot be used.
    #[error("view {view}: {reason}")]
    View {
        /// Placement of the board, from 0.
        view: usize,
        /// What is wrong.
        reason: String,
    },
    /// No start values led to an image of the board.
    #[error("no focal length explains the views of the {} camera", side(*camera))]
    NoStart {
        /// 0 left, 1 right.
        camera: usize,
    },
    /// The views leave a parameter open.
    #[error(
        "the views do not determine {parameter}: it is {} +- {}; views of the board tilted by 20 \
         to 50 degrees about both axes are needed",
        Short(*value), Short(*sigma)
    )]
    Undetermined {
        /// The parameter.
        parameter: String,
        /// Its value.
        value: f64,
        /// Its standard deviation.
        sigma: f64,
    },
    /// The adjustment did not settle.
    #[error(
        "the adjustment did not settle within {iterations} iterations: the corners contradict each \
         other by about {} px, {} placements of the board do not fit the others",
        Short(*sigma_px), dropped.len()
    )]
    NotSettled {
        /// Iterations made.
        iterations: u32,
        /// Typical error of one coordinate of a corner where it ended, px.
        sigma_px: f64,
        /// Views that do not fit.
        dropped: Vec<usize>,
    },
    /// The result is no camera.
    #[error(transparent)]
    Camera(#[from] CameraError),
}

impl CalibrationError {
    /// The views that the error is about, from 0.
    pub fn views(&self) -> Vec<usize> {
        match self {
            Self::View { view, .. } | Self::SamePicture { view } => vec![*view],
            Self::Mispaired { views, .. } => views.to_vec(),
            Self::Inconsistent { dropped, .. } | Self::NotSettled { dropped, .. } => {
                dropped.clone()
            }
            _ => Vec::new(),
        }
    }
}

/// Least number of corners that make a view.
pub const MIN_CORNERS: usize = 8;
/// Least number of different placements of the board per camera.
pub const MIN_VIEWS: usize = 3;
const ITERATIONS: u32 = 100;
const ROUNDS: usize = 8;
/// Largest relative standard deviation of a focal length that counts as determined.
const MAX_FOCAL_SIGMA: f64 = 0.1;
/// Largest standard deviation of a turn between the cameras that counts as determined, radians.
const MAX_TURN_SIGMA_RAD: f64 = 0.1;

/// Calibrates one camera or a pair from what they saw of a board.
///
/// `sizes_px` has width and height of each camera's image; every view holds as many lists of
/// corners as there are cameras (one or two).
///
/// # Errors
/// [`CalibrationError`].
pub fn calibrate(
    sizes_px: &[[u32; 2]],
    views: &[BoardView],
    rules: &CalibrationRules,
) -> Result<Calibration, CalibrationError> {
    check(sizes_px, views)?;
    let start = start::rig(sizes_px, views, rules)?;
    let mut adjustment = Adjustment::new(views, rules);
    let mut rig = start;
    for round in 0..ROUNDS {
        let minimum = adjustment
            .run(rig.clone(), ITERATIONS)
            .ok_or_else(|| not_settled(&adjustment, 0))?;
        rig = minimum.state;
        if !minimum.settled && round + 1 == ROUNDS {
            return Err(not_settled(&adjustment, minimum.iterations));
        }
        // First robust with a scale from the bulk, then plain without the outliers.
        let changed = adjustment.reweigh(&rig, rules, round);
        enough_left(views, &adjustment)?;
        if !changed && round >= 2 {
            break;
        }
    }
    finish(sizes_px, rig, &adjustment)
}

fn check(sizes_px: &[[u32; 2]], views: &[BoardView]) -> Result<(), CalibrationError> {
    for (n, view) in views.iter().enumerate() {
        let bad = |reason: String| CalibrationError::View { view: n, reason };
        if view.len() != sizes_px.len() || !(1..=2).contains(&sizes_px.len()) {
            return Err(bad(format!(
                "{} lists of corners for {} cameras, expected one list each for one or two",
                view.len(),
                sizes_px.len()
            )));
        }
        for points in view {
            if !points.is_empty() && points.len() < MIN_CORNERS {
                return Err(bad(format!(
                    "{} corners, expected none or at least {MIN_CORNERS}",
                    points.len()
                )));
            }
            let finite = |p: &BoardPoint| {
                (p.board_m.x + p.board_m.y + p.pixel_px.x + p.pixel_px.y).is_finite()
            };
            if !points.iter().all(finite) {
                return Err(bad("a corner is not finite".into()));
            }
        }
    }
    check_pairs(views)?;
    enough(views, |camera, found| CalibrationError::TooFewViews {
        camera,
        found,
        expected: MIN_VIEWS,
    })
}

/// Whether views show enough different placements of the board to every camera, and one to all;
/// `too_few` names the camera and what it sees.
fn enough(
    views: &[BoardView],
    too_few: impl Fn(usize, usize) -> CalibrationError,
) -> Result<(), CalibrationError> {
    let repeats = repeats(views);
    for camera in 0..views.first().map_or(0, Vec::len) {
        let found = views
            .iter()
            .zip(&repeats)
            .filter(|(v, repeats)| !v[camera].is_empty() && repeats.is_none())
            .count();
        if found < MIN_VIEWS {
            return Err(too_few(camera, found));
        }
    }
    let common = |v: &BoardView| v.iter().all(|points| !points.is_empty());
    if views.iter().any(common) {
        Ok(())
    } else {
        Err(CalibrationError::NoCommonView)
    }
}

fn not_settled(adjustment: &Adjustment, iterations: u32) -> CalibrationError {
    CalibrationError::NotSettled {
        iterations,
        sigma_px: adjustment.sigma_px(),
        dropped: adjustment.dropped(),
    }
}

/// Whether the views that still count are as many as a calibration needs.
fn enough_left(views: &[BoardView], adjustment: &Adjustment) -> Result<(), CalibrationError> {
    let dropped = adjustment.dropped();
    let is_kept = |(n, _): &(usize, &BoardView)| !dropped.contains(n);
    let kept: Vec<BoardView> = views
        .iter()
        .enumerate()
        .filter(is_kept)
        .map(|(_, view)| view.clone())
        .collect();
    let too_few = |camera: usize, left: usize| CalibrationError::Inconsistent {
        camera,
        views: views.len(),
        left,
        expected: MIN_VIEWS,
        dropped: dropped.clone(),
    };
    if kept.is_empty() {
        return Err(too_few(0, 0));
    }
    enough(&kept, too_few)
}

/// The standard deviation of a parameter as a share of the largest that counts as determined;
/// infinite for one that is not a number.
fn looseness(parameter: &Parameter) -> f64 {
    let Parameter { name, value, sigma } = parameter;
    let limit = if name.contains(".f") {
        MAX_FOCAL_SIGMA * value
    } else if name.contains(".turn") {
        MAX_TURN_SIGMA_RAD
    } else {
        f64::MAX
    };
    let loose = sigma / limit;
    if loose.is_finite() {
        loose
    } else {
        f64::INFINITY
    }
}

fn finish(
    sizes_px: &[[u32; 2]],
    rig: Rig,
    adjustment: &Adjustment,
) -> Result<Calibration, CalibrationError> {
    let names = rig.names();
    let values = rig.values();
    let undetermined = |i: usize, sigma: f64| CalibrationError::Undetermined {
        parameter: names[i].clone(),
        value: values[i],
        sigma,
    };
    let covariance = adjustment
        .covariance(&rig)
        .ok_or_else(|| not_settled(adjustment, 0))?
        .map_err(|i| undetermined(i, f64::INFINITY))?;
    let parameters: Vec<Parameter> = names
        .iter()
        .zip(&values)
        .enumerate()
        .map(|(i, (name, value))| Parameter {
            name: name.clone(),
            value: *value,
            sigma: covariance[(i, i)].sqrt(),
        })
        .collect();
    let loose: Vec<f64> = parameters.iter().map(looseness).collect();
    let loosest = (0..loose.len()).max_by(|a, b| loose[*a].total_cmp(&loose[*b]));
    if let Some(i) = loosest.filter(|i| loose[*i] > 1.0) {
        return Err(undetermined(i, parameters[i].sigma));
    }
    let cameras = rig.cameras(sizes_px);
    for camera in &cameras {
        camera.validate()?;
    }
    let residuals = adjustment.residuals(&rig);
    let rms_px = (0..cameras.len())
        .map(|camera| {
            let used = residuals.iter().filter(|r| r.camera == camera && r.used);
            let (sum, n) = used.fold((0.0, 0), |(sum, n), r| {
                (sum + r.error_px.norm_squared(), n + 1)
            });
            (sum / f64::from(n.max(1))).sqrt()
        })
        .collect();
    Ok(Calibration {
        cameras,
        parameters,
        covariance,
        camera_from_board: rig.camera_from_board,
        rejected: residuals.iter().filter(|r| !r.used).count(),
        dropped: adjustment.dropped(),
        residuals,
        rms_px,
        sigma_px: adjustment.sigma_px(),
    })
}
