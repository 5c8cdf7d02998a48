//! The rover's motion between two stops as the mast's pictures tell it.
//!
//! Odometry knows a heading to a degree after a metre, which is twenty pixels and more; a target
//! that must be searched for that far away can be taken for another. The ground and the rocks about
//! it tell the motion to a fraction of a pixel: landmarks of the last picture, whose places stereo
//! knows, are found again in the new one, first coarsely over the odometry's whole uncertainty,
//! then finely, and the rigid motion that agrees with most of them, and with odometry, is taken
//! (stereo visual odometry: L. Matthies 1989; D. Nister et al. 2004). What the mast's pointing is
//! off goes into it as well, which is what a prediction of pixels wants.

mod fit;
mod landmarks;

use crate::align::{AlignRules, Freedom, Template, refine, search};
use crate::anchor::reach;
use crate::filter::{Motion, TargetEstimate};
use crate::patch::HalfSize;
use crate::surface::SurfacePlane;
use crate::view::View;
use crate::warp::PlaneWarp;
use fit::{Correction, Fit, Found};
pub use landmarks::Landmark;
use nalgebra::{Matrix3, Point3, Vector2, Vector3};
use rayon::prelude::*;

/// How the motion is found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EgomotionRules {
    /// Columns and rows of the cells of the new picture; each has one landmark at most.
    pub cells: [usize; 2],
    /// Distance of a landmark from the border of either picture, px.
    pub border_px: f64,
    /// Half side of the templates, template px.
    pub half_px: usize,
    /// Neighbours within this distance give a landmark's slant, px.
    pub neighbour_px: f64,
    /// The coarse and the fine search.
    pub stages: [Stage; 2],
    /// Factor on odometry's covariance where it is weighed against landmarks.
    pub prior_inflation: f64,
    /// Least landmarks that must agree.
    pub min_agreeing_n: usize,
    /// Least part of those found that must agree.
    pub min_agreeing: f64,
}

/// One search for the landmarks.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stage {
    /// Whether in pictures a quarter as wide and high.
    pub quarter: bool,
    /// Least correlation.
    pub min_score: f64,
    /// By how much the best correlation of a search must exceed the best one elsewhere.
    pub min_margin: f64,
    /// Landmarks farther than this from where a motion puts them speak against it, px.
    pub agree_px: f64,
}

impl Default for EgomotionRules {
    fn default() -> Self {
        Self {
            cells: [8, 6],
            border_px: 24.0,
            half_px: 7,
            neighbour_px: 45.0,
            stages: [
                Stage {
                    quarter: true,
                    min_score: 0.6,
                    min_margin: 0.05,
                    agree_px: 6.0,
                },
                Stage {
                    quarter: false,
                    min_score: 0.75,
                    min_margin: 0.0,
                    agree_px: 2.0,
                },
            ],
            prior_inflation: 25.0,
            min_agreeing_n: 8,
            min_agreeing: 0.5,
        }
    }
}

/// A motion that the pictures agree on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Egomotion {
    /// The motion and its covariance.
    pub motion: Motion,
    /// Landmarks that agree.
    pub agreeing_n: usize,
    /// Landmarks found.
    pub found_n: usize,
    /// Root mean square distance of the agreeing ones from where the motion puts them, px.
    pub rms_px: f64,
}

/// The pictures do not tell the motion.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "of {shown_n} landmarks that both pictures should show {found_n} were found, and {agreeing_n} \
     agree on a motion, need {least_n}"
)]
pub struct NoMotion {
    /// Landmarks that both pictures should show.
    pub shown_n: usize,
    /// Landmarks found.
    pub found_n: usize,
    /// Landmarks that agree.
    pub agreeing_n: usize,
    /// Least that must agree.
    pub least_n: usize,
}

/// Finds the motion between the stops of two views, the last and the present one. `landmarks` are
/// places that the last one shows; `odometry` is the motion as wheels and attitude sensor tell it,
/// with what the cameras add to its covariance; `usable` says whether a place (rover frame) is
/// itself what a view shows there, neither hidden by the rover nor on the edge of its shadow.
///
/// # Errors
/// [`NoMotion`] if too few landmarks agree; then odometry is all that is known.
pub fn egomotion(
    [last, now]: [&View; 2],
    landmarks: &[Landmark],
    odometry: &Motion,
    usable: impl Fn(&View, &Vector3<f64>) -> bool,
    rules: &EgomotionRules,
) -> Result<Egomotion, NoMotion> {
    let camera = &now.cameras.left;
    let chosen = landmarks::chosen([last, now], landmarks, odometry, usable, rules);
    let marks: Vec<(Landmark, SurfacePlane)> = chosen
        .into_iter()
        .map(|mark| {
            let plane = landmarks::slant(&mark, landmarks, last, rules.neighbour_px);
            (mark, plane)
        })
        .collect();
    // Many landmarks know better than odometry, whose errors are not all in its covariance; it only
    // decides what they leave open.
    let prior = odometry.covariance * rules.prior_inflation;
    let mut correction = Correction::identity();
    let mut known = odometry.covariance;
    let mut refusal = NoMotion {
        shown_n: marks.len(),
        found_n: 0,
        agreeing_n: 0,
        least_n: rules.min_agreeing_n,
    };
    let mut outcome = Err(refusal);
    for (n, stage) in rules.stages.iter().enumerate() {
        let sought = Motion {
            now_from_last: correction.isometry() * odometry.now_from_last,
            covariance: known,
        };
        let found: Vec<Found> = marks
            .par_iter()
            .filter_map(|(mark, plane)| {
                let pixel_px = find([last, now], mark, plane, &sought, rules, stage)?;
                let by_odometry = odometry.now_from_last * Point3::from(mark.point_m);
                Some(Found {
                    point_m: by_odometry.coords,
                    pixel_px,
                })
            })
            .collect();
        refusal.found_n = found.len();
        let start = (n > 0).then_some(correction);
        let fit = Fit::of(&found, camera, &prior, start, stage.agree_px).ok_or(refusal)?;
        refusal.agreeing_n = fit.agreeing_n;
        let least = rules.min_agreeing * found.len() as f64;
        if fit.agreeing_n < rules.min_agreeing_n || (fit.agreeing_n as f64) < least {
            return Err(refusal);
        }
        (correction, known) = (fit.correction, fit.covariance);
        outcome = Ok(Egomotion {
            motion: Motion {
                now_from_last: correction.isometry() * odometry.now_from_last,
                covariance: known,
            },
            agreeing_n: fit.agreeing_n,
            found_n: found.len(),
            rms_px: fit.rms_px,
        });
    }
    outcome
}

/// Where the present view's left image shows a landmark, px; none if it does not stand out.
fn find(
    [last, now]: [&View; 2],
    mark: &Landmark,
    plane: &SurfacePlane,
    sought: &Motion,
    rules: &EgomotionRules,
    stage: &Stage,
) -> Option<Vector2<f64>> {
    /// Search reach in standard deviations.
    const SIGMAS: f64 = 3.0;
    /// What slant and range may put the pixel off besides, px.
    const RANGE_PX: f64 = 1.0;
    let half = HalfSize {
        u: rules.half_px,
        v: rules.half_px,
    };
    let (pictures, scale) = if stage.quarter {
        ([last.quarter()?, now.quarter()?], 4.0)
    } else {
        (
            [last, now].map(|view| (&view.left, &view.cameras.left)),
            1.0,
        )
    };
    let [(before, from), (after, camera)] = pictures;
    let middle = Vector2::repeat(0.5);
    let pixel_px = (mark.pixel_px + middle) / scale - middle;
    let align = AlignRules::default();
    let template = Template::cut(before, &pixel_px, half).ok()?;
    if template.deviation_dn() < align.min_texture_dn {
        return None;
    }
    let warp = PlaneWarp::new(from, &pixel_px, plane)?.moved(&sought.now_from_last);
    let known = TargetEstimate {
        position_m: mark.point_m,
        covariance_m2: Matrix3::zeros(),
    };
    let spread = known
        .predicted(sought)
        .pixel_covariance(camera, RANGE_PX / scale)?;
    let reach = reach(&warp.jacobian(camera)?, &spread, SIGMAS).ok()?;
    let (pixel, score, second) = search(&template, after, camera, &warp, reach).ok()?;
    if !(score >= stage.min_score && score - second >= stage.min_margin) {
        return None;
    }
    let (warp, _) = warp.turned_to(camera, &pixel)?;
    let freedom = Freedom::Translation;
    let (warp, aligned) = refine(&template, after, camera, &warp, freedom, &align).ok()?;
    if aligned.score < stage.min_score {
        return None;
    }
    let found = warp.pixel(camera, &Vector2::zeros())?;
    Some((found + middle) * scale - middle)
}
