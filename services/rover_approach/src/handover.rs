//! Hand-over from the mast pair to the body pair: the mast's window, warped by the plane of the
//! surface, is matched in the body image, so that the calibration between the pairs cancels.

use crate::align::{AlignRules, Freedom, Template, refine, search};
use crate::error::TrackError;
use crate::patch::HalfSize;
use crate::relief::{AnchorGeometry, ReliefRules, corrected_pixel};
use crate::surface::{PlaneRules, StereoPlane, measure_plane};
use crate::view::View;
use crate::warp::PlaneWarp;
use nalgebra::{Isometry3, Vector2};
use rover_cameras::Camera;
use rover_vision::PreparedImage;

/// How the hand-over is made.
#[derive(Clone, Debug, PartialEq)]
pub struct HandoverRules {
    /// Half side of the template, mast px.
    pub half_px: usize,
    /// Search about the pixel that geometry predicts, body px.
    pub search_px: f64,
    /// Farthest that the match may lie from that pixel, body px.
    pub gate_px: f64,
    /// Largest difference of the matches from the left and the right mast camera, body px.
    pub sides_px: f64,
    /// Least weighted correlation.
    pub min_score: f64,
    /// Bounds of the alignment.
    pub align: AlignRules,
    /// How planes are measured.
    pub plane: PlaneRules,
    /// How the relief is measured; none: no relief correction.
    pub relief: Option<ReliefRules>,
}

impl Default for HandoverRules {
    fn default() -> Self {
        Self {
            half_px: 12,
            search_px: 12.0,
            gate_px: 10.0,
            sides_px: 2.0,
            min_score: 0.80,
            align: AlignRules::default(),
            plane: PlaneRules::default(),
            relief: Some(ReliefRules {
                half_grid: 4,
                range_fraction: 0.06,
                ..ReliefRules::default()
            }),
        }
    }
}

impl HandoverRules {
    /// The rules for a robot whose two pairs are mounted with an uncertainty of `mount_rad`
    /// each (one sigma per axis), seen by a camera of `focal_px`: geometry alone is off by that,
    /// so the search must reach so far and the gate may not be closer.
    #[must_use]
    pub fn for_mounts(mount_rad: f64, focal_px: f64) -> Self {
        /// Three sigma of two mounts.
        const SIGMAS: f64 = 3.0 * std::f64::consts::SQRT_2;
        let rules = Self::default();
        let reach_px = SIGMAS * mount_rad * focal_px;
        Self {
            search_px: rules.search_px.hypot(reach_px),
            gate_px: rules.gate_px.hypot(reach_px),
            ..rules
        }
    }
}

/// The target in the body pair.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Handover {
    /// Pixel in the body's left image.
    pub pixel_px: Vector2<f64>,
    /// Pixel that geometry alone predicts.
    pub geometric_px: Vector2<f64>,
    /// Surface there, from the body pair, rover frame.
    pub surface: StereoPlane,
    /// Weighted correlation.
    pub score: f64,
    /// Difference of the match from the right mast camera, px, if it could be made.
    pub sides_px: Option<f64>,
    /// Move by the relief correction, px.
    pub relief_px: Vector2<f64>,
    /// Standard deviation of the pixel, px: alignment and disagreement of the sides.
    pub sigma_px: f64,
}

struct Found {
    warp: PlaneWarp,
    pixel_px: Vector2<f64>,
    score: f64,
    sigma_px: f64,
}

/// Finds the target, seen at `mast_px` of the mast's left image with `surface` measured there, in
/// the body pair of the same stop.
///
/// # Errors
/// [`TrackError`]; `NotVisible` or `OutsideImage` when the target is outside the body image.
pub fn hand_over(
    mast: &View,
    mast_px: &Vector2<f64>,
    surface: &StereoPlane,
    body: &View,
    rules: &HandoverRules,
) -> Result<Handover, TrackError> {
    let camera = &body.cameras.left;
    let geometric_px = camera
        .project(&surface.plane.point)
        .map_err(|_| TrackError::NotVisible)?;
    let from_left = find(
        &mast.left,
        &mast.cameras.left,
        mast_px,
        surface,
        body,
        rules,
    )?;
    let distance_px = (from_left.pixel_px - geometric_px).norm();
    if !(distance_px <= rules.gate_px) {
        return Err(TrackError::OffGeometry {
            distance_px,
            limit_px: rules.gate_px,
        });
    }
    let centre = camera.model.cahv()[0];
    let range = (surface.plane.point - centre).norm();
    let fraction = rules.plane.range_fraction;
    let limits = [range * (1.0 - fraction), range * (1.0 + fraction)];
    let normal = Some(&surface.plane.normal);
    let measured = |pixel: &Vector2<f64>| measure_plane(body, pixel, limits, normal, &rules.plane);
    let mut plane = measured(&from_left.pixel_px)?;
    // the right mast camera sees another side of the relief: an independent match of one point
    let mast_right = mast.cameras.right.project(&surface.plane.point).ok();
    let sides_px = mast_right
        .and_then(|pixel| {
            find(
                &mast.right,
                &mast.cameras.right,
                &pixel,
                surface,
                body,
                rules,
            )
            .ok()
        })
        .map(|right| (right.pixel_px - from_left.pixel_px).norm());
    if let Some(distance_px) = sides_px
        && !(distance_px <= rules.sides_px)
    {
        return Err(TrackError::SidesDisagree {
            distance_px,
            limit_px: rules.sides_px,
        });
    }
    let mut pixel_px = from_left.pixel_px;
    if let Some(relief) = &rules.relief
        && let Some(warp) = from_left.warp.onto(camera, &plane.plane)
    {
        let geometry = AnchorGeometry {
            camera: &mast.cameras.left,
            anchor_from_rover: &Isometry3::identity(),
            warp: &warp,
        };
        if let Some(moved) = corrected_pixel(body, &pixel_px, &plane.plane, &geometry, relief)
            && let Ok(better) = measured(&moved)
        {
            pixel_px = moved;
            plane = better;
        }
    }
    let spread = sides_px.map_or(0.3, |d| d / 2.0);
    Ok(Handover {
        relief_px: pixel_px - from_left.pixel_px,
        pixel_px,
        geometric_px,
        surface: plane,
        score: from_left.score,
        sides_px,
        sigma_px: from_left.sigma_px.hypot(spread),
    })
}

/// Matches a window of one mast image in the body's left image.
fn find(
    image: &PreparedImage,
    mast_camera: &Camera,
    mast_px: &Vector2<f64>,
    surface: &StereoPlane,
    body: &View,
    rules: &HandoverRules,
) -> Result<Found, TrackError> {
    let camera = &body.cameras.left;
    let half = HalfSize {
        u: rules.half_px,
        v: rules.half_px,
    };
    let template = Template::cut(image, mast_px, half)?;
    let warp =
        PlaneWarp::new(mast_camera, mast_px, &surface.plane).ok_or(TrackError::NotVisible)?;
    let footprint = warp.jacobian(camera).ok_or(TrackError::NotVisible)?;
    let inverse = footprint.try_inverse().ok_or(TrackError::NotVisible)?;
    let side = |k: usize| (inverse.row(k).norm() * rules.search_px).ceil().min(60.0) as usize;
    let reach = HalfSize {
        u: side(0),
        v: side(1),
    };
    let (found_px, score, _) = search(&template, &body.left, camera, &warp, reach)?;
    let low = |score| TrackError::LowScore {
        score,
        limit: rules.min_score,
        columns: 2 * reach.u + 1,
        rows: 2 * reach.v + 1,
    };
    if !(score >= 0.5 * rules.min_score) {
        return Err(low(score));
    }
    let (warp, _) = warp
        .turned_to(camera, &found_px)
        .ok_or(TrackError::NotVisible)?;
    let step = |warp: &PlaneWarp, freedom| {
        refine(&template, &body.left, camera, warp, freedom, &rules.align)
    };
    let (shifted, by_shift) = step(&warp, Freedom::Translation)?;
    let (warp, aligned) = step(&shifted, Freedom::Affine).unwrap_or((shifted, by_shift));
    if !(aligned.score >= rules.min_score) {
        return Err(low(aligned.score));
    }
    let pixel_px = warp
        .pixel(camera, &Vector2::zeros())
        .ok_or(TrackError::NotVisible)?;
    let spread = footprint * aligned.covariance_px2 * footprint.transpose();
    Ok(Found {
        warp,
        pixel_px,
        score: aligned.score,
        sigma_px: spread.diagonal().max().sqrt(),
    })
}
