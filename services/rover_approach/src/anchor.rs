//! Where the target was anchored, and the rules of tracking it from there.

use crate::align::{AlignRules, Template};
use crate::error::TrackError;
use crate::fix::Attempt;
use crate::patch::HalfSize;
use crate::relief::ReliefRules;
use crate::surface::{PlaneRules, StereoPlane, SurfacePlane};
use crate::view::View;
use crate::warp::PlaneWarp;
use nalgebra::{Isometry3, Matrix2, Vector2};
use std::sync::Arc;

/// How the target is tracked.
#[derive(Clone, Debug, PartialEq)]
pub struct TrackRules {
    /// Half side of the template, px; flattened by the foreshortening, never below
    /// [`Self::min_half_px`].
    pub half_px: usize,
    /// Smallest half side, px.
    pub min_half_px: usize,
    /// Anchor anew when the anchor's range is so many times the present one.
    pub anchor_ratio: f64,
    /// Anchor anew when the target is seen from a direction that differs so much, rad.
    pub anchor_turn_rad: f64,
    /// What a match must fulfil.
    pub gate: Gate,
    /// What it must fulfil where the first attempt, with the newest anchor and an affine
    /// correction, has failed: what is left then to be found may as well be something else.
    pub strict_gate: Gate,
    /// Farthest that tracking back may end from the anchor pixel, anchor px.
    pub max_back_px: f64,
    /// Search reach in standard deviations of the prediction.
    pub search_sigma: f64,
    /// Least correlation of the template's own stereo match: less is no plane.
    pub min_plane_score: f64,
    /// Least correlation in the search.
    pub min_search_score: f64,
    /// Bounds of the alignment.
    pub align: AlignRules,
    /// How planes are measured.
    pub plane: PlaneRules,
    /// How the relief is measured; none: no relief correction.
    pub relief: Option<ReliefRules>,
}

impl Default for TrackRules {
    fn default() -> Self {
        Self {
            half_px: 12,
            min_half_px: 7,
            anchor_ratio: 1.4,
            anchor_turn_rad: 0.25,
            gate: Gate {
                min_score: 0.80,
                min_margin: 0.02,
                max_innovation_sigma: 5.0,
            },
            strict_gate: Gate {
                min_score: 0.80,
                min_margin: 0.10,
                max_innovation_sigma: 2.5,
            },
            max_back_px: 0.85,
            search_sigma: 3.5,
            min_plane_score: 0.5,
            min_search_score: 0.4,
            align: AlignRules::default(),
            plane: PlaneRules::default(),
            relief: Some(ReliefRules::default()),
        }
    }
}

/// What a match must fulfil to be taken for the target.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gate {
    /// Least weighted correlation after the alignment.
    pub min_score: f64,
    /// By how much the best correlation of the search must exceed the best one elsewhere.
    pub min_margin: f64,
    /// Farthest from the prediction, standard deviations.
    pub max_innovation_sigma: f64,
}

impl TrackRules {
    /// The gate of an attempt.
    #[must_use]
    pub fn gate(&self, attempt: Attempt) -> Gate {
        match attempt {
            Attempt::Affine => self.gate,
            _ => self.strict_gate,
        }
    }
}

/// A place in an image at which the target was anchored.
#[derive(Clone, Debug)]
pub struct Anchor {
    /// The view it was anchored in.
    pub view: Arc<View>,
    /// The target's pixel there.
    pub pixel_px: Vector2<f64>,
    /// Range then, m.
    pub range_m: f64,
    /// The template.
    pub template: Template,
    /// The template's warp, present rover frame.
    pub warp: PlaneWarp,
    /// Present rover frame to that of the view, as odometry and matches say.
    pub anchor_from_rover: Isometry3<f64>,
}

/// Search reach in template px for a covariance in image px^2.
pub(crate) fn reach(
    footprint: &Matrix2<f64>,
    prediction_px2: &Matrix2<f64>,
    sigmas: f64,
) -> Result<HalfSize, TrackError> {
    /// Farther than this no template is searched.
    const MAX_REACH: f64 = 160.0;
    let inverse = footprint.try_inverse().ok_or(TrackError::NotVisible)?;
    let spread = inverse * prediction_px2 * inverse.transpose();
    let side = |k: usize| {
        let sigma = spread[(k, k)].max(0.0).sqrt();
        (sigmas * sigma + 2.0).ceil()
    };
    let (u, v) = (side(0), side(1));
    if !(u.is_finite() && v.is_finite()) {
        return Err(TrackError::BadInput {
            what: "covariance of the prediction".into(),
            found: format!("{prediction_px2}"),
            expected: "finite numbers".into(),
        });
    }
    Ok(HalfSize {
        u: u.min(MAX_REACH) as usize,
        v: v.min(MAX_REACH) as usize,
    })
}

/// Anchors a target at a pixel of a view.
pub(crate) fn anchor(
    view: Arc<View>,
    pixel_px: Vector2<f64>,
    surface: &StereoPlane,
    rules: &TrackRules,
) -> Result<Anchor, TrackError> {
    let camera = &view.cameras.left;
    let half = window(camera.model.cahv()[0], &surface.plane, rules);
    let template = Template::cut(&view.left, &pixel_px, half)?;
    let warp = PlaneWarp::new(camera, &pixel_px, &surface.plane).ok_or(TrackError::NotVisible)?;
    Ok(Anchor {
        pixel_px,
        range_m: surface.range_m,
        template,
        warp,
        anchor_from_rover: Isometry3::identity(),
        view,
    })
}

/// The template's half sizes: flattened by the foreshortening.
fn window(eye: &nalgebra::Vector3<f64>, plane: &SurfacePlane, rules: &TrackRules) -> HalfSize {
    let sight = (eye - plane.point).normalize();
    let cosine = plane.normal.dot(&sight).clamp(0.0, 1.0);
    let v = (rules.half_px as f64 * cosine.sqrt()).round() as usize;
    HalfSize {
        u: rules.half_px,
        v: v.max(rules.min_half_px),
    }
}
