//! Fiducials in anybody's images, with one uniform result.
//!
//! | detector | what it finds | needs |
//! |---|---|---|
//! | [`harris`] | interest points | nothing |
//! | [`template()`] | a picture, anywhere or near a place | the picture |
//! | [`warped_template`] | a flat picture as a predicted pose shows it | picture, camera, pose |
//! | [`disc`] | a dark or light disc; its true centre with a camera and the disc's normal | nothing |
//! | [`saddle`] | the crossing of two edges, as in a checker | nothing |
//! | [`plate`] | the plate of discs and a saddle, and its pose | layout and camera |
//! | [`tags`] | AprilTag families, and their poses | nothing; camera and size for poses |
//!
//! Every detector refuses by stated rules ([`NoFinding`] names them); none returns its best guess
//! when nothing is there.

mod blobs;
mod disc;
mod disc_centre;
mod edges;
mod homography;
mod pixels;
mod plate;
mod saddle;
mod sums;
mod tag_code;
mod tags;
mod template;
#[cfg(test)]
mod tests;
mod warp;

pub use disc::{DiscRules, Polarity, disc};
pub use disc_centre::DiscTruth;
pub use plate::plate;
pub use saddle::{SaddleRules, saddle};
pub use tag_code::TAG_FAMILIES;
pub use tags::{TagRules, tags};
pub use template::{TemplateRules, template, warped_template};
pub use warp::Appearance;

use nalgebra::{Isometry3, Matrix6};
use serde::Serialize;

use crate::fiducial::NotFound;
use crate::harris::{HarrisRules, harris_corners};
use crate::image::{Image8, ImageError};
use crate::ncc::Window;
pub(crate) use pixels::noise_dn;

/// One fiducial seen in an image.
#[derive(Clone, Debug, PartialEq)]
pub struct Finding {
    /// Column, px.
    pub u_px: f64,
    /// Row, px.
    pub v_px: f64,
    /// How much the image looks like the fiducial: the NCC of model and image, -1 to 1; for a tag
    /// the fraction of bits read without error; for Harris the response as a fraction of the
    /// image's largest.
    pub score: f64,
    /// Standard deviation of `u_px` and of `v_px`, px.
    pub sigma_px: f64,
    /// Identity, for fiducials that carry one.
    pub id: Option<u32>,
    /// Pose, for fiducials that have one.
    pub pose: Option<FoundPose>,
}

impl Finding {
    fn at(u_px: f64, v_px: f64, score: f64, sigma_px: f64) -> Self {
        Self {
            u_px,
            v_px,
            score,
            sigma_px,
            id: None,
            pose: None,
        }
    }
}

/// The pose of a fiducial.
#[derive(Clone, Debug, PartialEq)]
pub struct FoundPose {
    /// Takes the fiducial's coordinates to the frame of the camera model's vectors.
    pub camera_frame_from_fiducial: Isometry3<f64>,
    /// Covariance of (origin, m; rotation vector about the frame's axes, rad).
    pub covariance: Matrix6<f64>,
    /// Root mean square reprojection error per coordinate, px.
    pub rms_px: f64,
}

/// Why nothing was found. The rule that refused is the variant's name.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum NoFinding {
    /// Nothing in the searched part of the image has the fiducial's shape.
    #[error("nothing of the fiducial's shape is in the searched window: {0}")]
    NothingThere(String),
    /// The best place looks too little like the fiducial.
    #[error("the best score is {score:.3}, at least {limit} is needed")]
    LowScore {
        /// Best score.
        score: f64,
        /// Least score.
        limit: f64,
    },
    /// Two places look alike.
    #[error("another place scores {second:.3} beside the best with {best:.3}; ratio limit {limit}")]
    NotUnique {
        /// Best score.
        best: f64,
        /// Second best.
        second: f64,
        /// Largest accepted ratio.
        limit: f64,
    },
    /// Too little contrast.
    #[error("the contrast is {found_dn:.1} DN, {needed_dn} DN are needed")]
    LowContrast {
        /// Contrast found, DN.
        found_dn: f64,
        /// Least contrast, DN.
        needed_dn: f64,
    },
    /// The image is clipped there.
    #[error("{fraction:.3} of the pixels are saturated, limit {limit}")]
    Saturated {
        /// Fraction of saturated pixels.
        fraction: f64,
        /// Largest accepted fraction.
        limit: f64,
    },
    /// The image does not follow the fiducial's model.
    #[error("the image differs from the model by {rms_dn:.1} DN rms, limit {limit_dn:.1} DN")]
    Misfit {
        /// Root mean square difference, DN.
        rms_dn: f64,
        /// Largest accepted difference, DN.
        limit_dn: f64,
    },
    /// The shape is too slender, too skew or too blurred.
    #[error("the {what} is {found:.3}, expected {expected}")]
    Shape {
        /// What is off.
        what: &'static str,
        /// Its value.
        found: f64,
        /// What was expected.
        expected: String,
    },
    /// The fit ran away or did not settle.
    #[error("the fit moved {moved_px:.2} px from its start, limit {limit_px} px")]
    Diverged {
        /// Distance moved, px.
        moved_px: f64,
        /// Largest accepted distance, px.
        limit_px: f64,
    },
    /// The position is too uncertain.
    #[error("the position is uncertain by {sigma_px:.3} px, limit {limit_px} px")]
    Uncertain {
        /// Standard deviation, px.
        sigma_px: f64,
        /// Largest accepted standard deviation, px.
        limit_px: f64,
    },
    /// It is, or would be, too small in the image.
    #[error("its size in the image is {found_px:.2} px, {needed_px} px are needed")]
    TooSmall {
        /// Size found, px.
        found_px: f64,
        /// Least size, px.
        needed_px: f64,
    },
    /// The window that it takes leaves the image or the searched window.
    #[error("its window around ({u_px:.1}, {v_px:.1}) leaves the image")]
    OutsideImage {
        /// Column, px.
        u_px: f64,
        /// Row, px.
        v_px: f64,
    },
    /// The plate search's own reason.
    #[error(transparent)]
    Plate(#[from] NotFound),
    /// Image, rules, camera or prediction cannot be used.
    #[error("{0}")]
    BadInput(String),
}

impl From<ImageError> for NoFinding {
    fn from(error: ImageError) -> Self {
        Self::BadInput(error.to_string())
    }
}

impl NoFinding {
    /// The rule's name, for tables: the variant in lower case with underscores.
    #[must_use]
    pub fn rule(&self) -> &'static str {
        match self {
            Self::NothingThere(_) => "nothing_there",
            Self::LowScore { .. } => "low_score",
            Self::NotUnique { .. } => "not_unique",
            Self::LowContrast { .. } => "low_contrast",
            Self::Saturated { .. } => "saturated",
            Self::Misfit { .. } => "misfit",
            Self::Shape { .. } => "shape",
            Self::Diverged { .. } => "diverged",
            Self::Uncertain { .. } => "uncertain",
            Self::TooSmall { .. } => "too_small",
            Self::OutsideImage { .. } => "outside_image",
            Self::Plate(NotFound::BadInput(_)) | Self::BadInput(_) => "bad_input",
            Self::Plate(_) => "plate",
        }
    }

    /// Whether the caller's input is at fault, not the image's content.
    #[must_use]
    pub fn is_bad_input(&self) -> bool {
        self.rule() == "bad_input"
    }
}

/// The part of an image within `radius_px` of a place in u and in v, cut at the border.
///
/// # Errors
/// [`NoFinding::BadInput`] if nothing of the image is left, or the numbers are not finite.
pub fn near(image: &Image8, place_px: [f64; 2], radius_px: f64) -> Result<Window, NoFinding> {
    let [u, v] = place_px;
    if !(u.is_finite() && v.is_finite() && radius_px.is_finite() && radius_px >= 0.0) {
        return Err(NoFinding::BadInput(format!(
            "the search is around ({u}, {v}) with radius {radius_px} px, expected finite numbers \
             and a radius of 0 or more"
        )));
    }
    let range = |x: f64, size: u32| {
        let limit = f64::from(size);
        let first = (x - radius_px).floor().clamp(0.0, limit) as u32;
        let end = ((x + radius_px).ceil() + 1.0).clamp(0.0, limit) as u32;
        (first, end)
    };
    let ((left, right), (top, bottom)) = (range(u, image.width_px), range(v, image.height_px));
    if left >= right || top >= bottom {
        return Err(NoFinding::BadInput(format!(
            "the search around ({u}, {v}) with radius {radius_px} px lies outside the image of {} \
             x {} px",
            image.width_px, image.height_px
        )));
    }
    Ok(Window {
        left,
        top,
        width: right - left,
        height: bottom - top,
    })
}

/// Harris corners in a window, strongest first, refined to subpixel.
///
/// `sigma_px` is [`HARRIS_SIGMA_PX`] for all: the response has no model whose residuals would tell.
///
/// # Errors
/// [`NoFinding::NothingThere`] if the window has no corner, [`NoFinding::BadInput`].
pub fn harris(
    image: &Image8,
    window: Window,
    rules: &HarrisRules,
) -> Result<Vec<Finding>, NoFinding> {
    image.validate()?;
    for (name, x) in [
        ("gradient_sigma_px", rules.gradient_sigma_px),
        ("window_sigma_px", rules.window_sigma_px),
        ("k", rules.k),
        ("min_relative_response", rules.min_relative_response),
        ("min_distance_px", rules.min_distance_px),
    ] {
        positive("harris rules", name, x)?;
    }
    // a margin lets the smoothing see what surrounds the window
    let margin = (4.0 * (rules.gradient_sigma_px + rules.window_sigma_px)).ceil() as u32 + 2;
    let wide = Window {
        left: window.left.saturating_sub(margin),
        top: window.top.saturating_sub(margin),
        width: window.width.saturating_add(2 * margin),
        height: window.height.saturating_add(2 * margin),
    }
    .clipped(image);
    let part = cut(image, wide)?;
    let corners = harris_corners(&part, rules)?;
    let largest = corners.first().map_or(1.0, |c| c.response);
    let inside = |x: f64, first: u32, length: u32| {
        x >= f64::from(first) - 0.5 && x <= f64::from(first) + f64::from(length) - 0.5
    };
    let found: Vec<Finding> = corners
        .iter()
        .map(|c| {
            Finding::at(
                c.u_px + f64::from(wide.left),
                c.v_px + f64::from(wide.top),
                c.response / largest,
                HARRIS_SIGMA_PX,
            )
        })
        .filter(|f| {
            inside(f.u_px, window.left, window.width) && inside(f.v_px, window.top, window.height)
        })
        .collect();
    if found.is_empty() {
        return Err(NoFinding::NothingThere("no corner".into()));
    }
    Ok(found)
}

/// Standard deviation stated for Harris corners, px: that of a corner's place between two exposures
/// of one textured surface with grey noise of 3 DN, for which `rover vision evaluate --only harris
/// --noise 3 --patches 600 --seed 2` measures 0.18 px. How far a corner lies from the surface mark that a person
/// would call the corner is another matter: the response pulls it inwards.
pub const HARRIS_SIGMA_PX: f64 = 0.2;

/// A part of an image as an image.
fn cut(image: &Image8, window: Window) -> Result<Image8, NoFinding> {
    let window = window.clipped(image);
    let mut pixels = Vec::with_capacity(window.width as usize * window.height as usize);
    for v in window.top..window.top + window.height {
        let start = v as usize * image.width_px as usize + window.left as usize;
        pixels.extend_from_slice(&image.pixels[start..start + window.width as usize]);
    }
    Ok(Image8::from_raw(window.width, window.height, pixels)?)
}

/// Refuses a rule that is not a positive number.
fn positive(whose: &str, name: &str, x: f64) -> Result<(), NoFinding> {
    if x.is_finite() && x > 0.0 {
        Ok(())
    } else {
        Err(NoFinding::BadInput(format!(
            "{whose}: {name} is {x}, expected a positive number"
        )))
    }
}

/// A finding as it is written to JSON: without a pose or an identity that are not there.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FindingRecord {
    /// Column, px.
    pub u_px: f64,
    /// Row, px.
    pub v_px: f64,
    /// See [`Finding::score`].
    pub score: f64,
    /// Standard deviation, px.
    pub sigma_px: f64,
    /// Identity.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub id: Option<u32>,
    /// Pose.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pose: Option<PoseRecord>,
}

/// A pose as it is written to JSON.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PoseRecord {
    /// Origin of the fiducial in the frame of the camera model's vectors, m.
    pub position_m: [f64; 3],
    /// Rotation from the fiducial to that frame, w x y z.
    pub quaternion_wxyz: [f64; 4],
    /// Standard deviations of the origin, m.
    pub position_sigma_m: [f64; 3],
    /// Standard deviations of the rotation about the frame's axes, rad.
    pub rotation_sigma_rad: [f64; 3],
    /// Root mean square reprojection error per coordinate, px.
    pub rms_px: f64,
}

impl From<&Finding> for FindingRecord {
    fn from(f: &Finding) -> Self {
        Self {
            u_px: f.u_px,
            v_px: f.v_px,
            score: f.score,
            sigma_px: f.sigma_px,
            id: f.id,
            pose: f.pose.as_ref().map(PoseRecord::from),
        }
    }
}

impl From<&FoundPose> for PoseRecord {
    fn from(p: &FoundPose) -> Self {
        let pose = &p.camera_frame_from_fiducial;
        let q = pose.rotation.quaternion();
        let t = pose.translation.vector;
        let sigma = |i: usize| p.covariance[(i, i)].max(0.0).sqrt();
        Self {
            position_m: [t.x, t.y, t.z],
            quaternion_wxyz: [q.w, q.i, q.j, q.k],
            position_sigma_m: [sigma(0), sigma(1), sigma(2)],
            rotation_sigma_rad: [sigma(3), sigma(4), sigma(5)],
            rms_px: p.rms_px,
        }
    }
}

/// Drops findings within `apart_px` of a better one; the list is sorted, the best first.
fn distinct(found: Vec<Finding>, apart_px: f64) -> Vec<Finding> {
    let mut kept: Vec<Finding> = Vec::with_capacity(found.len());
    for one in found {
        let close = |k: &Finding| {
            let (du, dv) = (k.u_px - one.u_px, k.v_px - one.v_px);
            du * du + dv * dv < apart_px * apart_px
        };
        if !kept.iter().any(close) {
            kept.push(one);
        }
    }
    kept
}
