//! One match with all its checks.

use nalgebra::{Matrix2, Vector2};
use rover_cameras::{Camera, CameraError, StereoPair};

use super::coarse::{self, CoarseMatch, Warp};
use super::link::Link;
use super::refine::{Displacement, Refined, refine};
use super::window::LeftWindow;
use super::{MatchRules, PreparedImage};

/// The same surface point in both images.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StereoMatch {
    /// The pixel in the left image, as asked for.
    pub left_px: Vector2<f64>,
    /// Its match in the right image.
    pub right_px: Vector2<f64>,
    /// NCC of the warped windows.
    pub score: f64,
    /// Standard deviation of `right_px` along the epipolar curve, px.
    pub sigma_px: f64,
    /// Distance of `right_px` from the epipolar curve, px; it tells of camera model error.
    pub epipolar_px: f64,
    /// Range along the left ray, m.
    pub range_m: f64,
    /// Affine map of offsets from the left to the right image.
    pub affine: Matrix2<f64>,
}

/// Why a pixel has no match.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MatchFailure {
    /// The pixel's window leaves the left image.
    #[error("the window around pixel ({u_px:.1}, {v_px:.1}) leaves the image")]
    OutsideImage {
        /// Pixel.
        u_px: f64,
        /// Pixel.
        v_px: f64,
    },
    /// The right image does not show the searched part of the pixel's ray.
    #[error("the pixel's epipolar curve between the range limits lies outside the other image")]
    CurveOutsideImage,
    /// Too little contrast to match.
    #[error("the grey values vary by {found_dn:.2} DN around the pixel, {needed_dn} DN are needed")]
    NoTexture {
        /// Standard deviation in the window, DN.
        found_dn: f64,
        /// Least standard deviation, DN.
        needed_dn: f64,
    },
    /// Nothing on the epipolar curve looks alike.
    #[error("the best correlation is {score:.3}, at least {limit} is needed")]
    LowScore {
        /// Best NCC.
        score: f64,
        /// Least NCC.
        limit: f64,
    },
    /// Two places look alike.
    #[error("another place scores {second:.3} beside the best with {best:.3}; ratio limit {limit}")]
    NotUnique {
        /// NCC of the best place.
        best: f64,
        /// NCC of the second best.
        second: f64,
        /// Largest accepted ratio.
        limit: f64,
    },
    /// The match leads back to another pixel: the point is hidden in one image.
    #[error("the match leads back to a pixel {distance_px:.1} px away, limit {limit_px} px")]
    NotMutual {
        /// Distance from the pixel, px.
        distance_px: f64,
        /// Largest accepted distance, px.
        limit_px: f64,
    },
    /// The fit did not settle near where it started.
    #[error("the fit moved {moved_px:.2} px without settling, limit {limit_px} px")]
    Diverged {
        /// Distance moved, px.
        moved_px: f64,
        /// Largest accepted distance, px.
        limit_px: f64,
    },
    /// The surface is seen at too flat an angle by one camera.
    #[error("the displacement changes by {slope:.2} px per px, limit {limit}")]
    TooSteep {
        /// Slope found.
        slope: f64,
        /// Largest accepted slope.
        limit: f64,
    },
    /// The match lies off the epipolar curve.
    #[error("the match lies {distance_px:.2} px off its epipolar curve, limit {limit_px} px")]
    OffEpipolar {
        /// Distance, px.
        distance_px: f64,
        /// Largest accepted distance, px.
        limit_px: f64,
    },
    /// The match is too uncertain.
    #[error("the match is uncertain by {sigma_px:.3} px, limit {limit_px} px")]
    Uncertain {
        /// Standard deviation, px.
        sigma_px: f64,
        /// Largest accepted standard deviation, px.
        limit_px: f64,
    },
    /// The match lies at or beyond the limits of the searched range.
    #[error("the match lies at {range_m:.3} m, outside the searched {min_m} to {max_m} m")]
    OutOfRange {
        /// Range along the left ray, m.
        range_m: f64,
        /// Nearest range searched, m.
        min_m: f64,
        /// Farthest range searched, m.
        max_m: f64,
    },
    /// A camera model has no answer for a pixel or point.
    #[error("camera model: {0}")]
    Camera(String),
    /// Images, cameras or rules cannot be used.
    #[error("{0}")]
    BadInput(String),
}

impl MatchFailure {
    pub(super) fn camera(e: CameraError) -> Self {
        Self::Camera(e.to_string())
    }
}

/// Candidates of the search that are fitted.
const FITTED_CANDIDATES: usize = 3;
/// Candidates that score this much less than the best in the search are not fitted.
const CANDIDATE_GAP: f64 = 0.2;
/// Two fits closer than this are the same place, px.
const SAME_PLACE_PX: f64 = 2.0;

/// Checks that images, cameras and rules belong together.
pub(super) fn check_input(
    left: &PreparedImage,
    right: &PreparedImage,
    pair: &StereoPair,
    left_px: &Vector2<f64>,
) -> Result<(), MatchFailure> {
    for (name, image, camera) in [("left", left, &pair.left), ("right", right, &pair.right)] {
        if (image.width_px, image.height_px) != (camera.width_px, camera.height_px) {
            return Err(MatchFailure::BadInput(format!(
                "the {name} image has {} x {} px, its camera model {} x {} px",
                image.width_px, image.height_px, camera.width_px, camera.height_px
            )));
        }
    }
    if !left_px.iter().all(|x| x.is_finite()) {
        return Err(MatchFailure::BadInput(format!(
            "the pixel is ({}, {}), expected finite numbers",
            left_px.x, left_px.y
        )));
    }
    Ok(())
}

/// Finds the match of a left pixel in the right image.
///
/// # Errors
/// [`MatchFailure`] with the reason and the numbers behind it.
pub fn match_point(
    left: &PreparedImage,
    right: &PreparedImage,
    pair: &StereoPair,
    left_px: &Vector2<f64>,
    rules: &MatchRules,
) -> Result<StereoMatch, MatchFailure> {
    rules.validate().map_err(MatchFailure::BadInput)?;
    check_input(left, right, pair, left_px)?;
    match_checked(left, right, pair, left_px, rules)
}

/// [`match_point`] for input that has been checked.
pub(super) fn match_checked(
    left: &PreparedImage,
    right: &PreparedImage,
    pair: &StereoPair,
    left_px: &Vector2<f64>,
    rules: &MatchRules,
) -> Result<StereoMatch, MatchFailure> {
    let outside = MatchFailure::OutsideImage {
        u_px: left_px.x,
        v_px: left_px.y,
    };
    let window = LeftWindow::new(left, left_px, rules.half_window_px as usize).ok_or(outside)?;
    if window.deviation_dn < rules.min_texture_dn {
        return Err(MatchFailure::NoTexture {
            found_dn: window.deviation_dn,
            needed_dn: rules.min_texture_dn,
        });
    }
    let cameras = (&pair.left, &pair.right);
    let candidates = coarse::search(
        cameras,
        (left, right),
        left_px,
        &Warp::Slants,
        rules,
        FITTED_CANDIDATES,
    )?;
    let top = candidates.first().map_or(-1.0, |c| c.score);
    if top < rules.min_search_score {
        return Err(MatchFailure::LowScore {
            score: top,
            limit: rules.min_search_score,
        });
    }
    let mut fits: Vec<(Link, Refined)> = Vec::new();
    let mut failure = None;
    for candidate in candidates.iter().filter(|c| c.score >= top - CANDIDATE_GAP) {
        match fit(cameras, (left, right), left_px, &window, candidate, rules) {
            Ok(found) => fits.push(found),
            Err(e) => {
                failure.get_or_insert(e);
            }
        }
    }
    fits.sort_by(|a, b| b.1.score.total_cmp(&a.1.score));
    let Some((link, best)) = fits.first() else {
        return Err(failure.unwrap_or(MatchFailure::LowScore {
            score: top,
            limit: rules.min_score,
        }));
    };
    let wide = widened(link, best, (left, right), left_px, rules);
    let found = accept(
        link,
        wide.as_ref().unwrap_or(best),
        (left, right),
        left_px,
        rules,
    )?;
    let elsewhere = fits[1..].iter().find(|(link, fit)| {
        let at = link.at + link.along * fit.displacement.along_px;
        (at - found.right_px).norm() > SAME_PLACE_PX
    });
    if let Some((_, second)) = elsewhere
        && second.score > rules.uniqueness_ratio * best.score
    {
        return Err(MatchFailure::NotUnique {
            best: best.score,
            second: second.score,
            limit: rules.uniqueness_ratio,
        });
    }
    check_mutual(left, right, pair, left_px, &found, rules)?;
    Ok(found)
}

/// Fits one candidate of the search.
fn fit(
    (a, b): (&Camera, &Camera),
    (left, right): (&PreparedImage, &PreparedImage),
    left_px: &Vector2<f64>,
    window: &LeftWindow,
    candidate: &CoarseMatch,
    rules: &MatchRules,
) -> Result<(Link, Refined), MatchFailure> {
    let link = Link::new(a, b, left_px, candidate.inverse_range).map_err(MatchFailure::camera)?;
    let slants = coarse::slants(&link, rules);
    let slopes = slants.get(candidate.hypothesis).or(slants.first()).copied();
    let offset = candidate.pixel - link.at;
    let start = Displacement {
        along_px: link.along.dot(&offset),
        slopes: slopes.unwrap_or_else(Vector2::zeros),
        across_px: 0.0,
    };
    let refined = settle((left, right), left_px, window, &link, start, rules)?;
    Ok((link, refined))
}

/// Fits a window from a start; where noise keeps it from settling, the widest one.
pub(super) fn settle(
    (left, right): (&PreparedImage, &PreparedImage),
    left_px: &Vector2<f64>,
    window: &LeftWindow,
    link: &Link,
    start: Displacement,
    rules: &MatchRules,
) -> Result<Refined, MatchFailure> {
    let unsettled = match refine(window, right, link, start, rules) {
        Err(e @ (MatchFailure::Diverged { .. } | MatchFailure::TooSteep { .. })) => e,
        done => return done,
    };
    let widest = rules.max_half_window_px as usize;
    if widest <= window.half || window.signal_part(left.noise_dn().powi(2)) > LITTLE_NOISE {
        return Err(unsettled);
    }
    let wide = LeftWindow::new(left, left_px, widest).ok_or(unsettled)?;
    refine(&wide, right, link, start, rules)
}

/// Windows are not held back by noise if this part of their variance is signal.
const LITTLE_NOISE: f64 = 0.97;
/// A wider window agrees within so many standard deviations of the difference, and px.
const AGREEMENT_SIGMAS: f64 = 3.0;
const AGREEMENT_PX: f64 = 0.02;
/// Residual of the wider window over the smaller one's, whose own is known to a twentieth.
const MAX_RESIDUAL_RATIO: f64 = 1.15;

/// The same fit over a window large enough for the aimed certainty, if the surface allows it. Where
/// the larger window fits as well but disagrees, the smaller one holds on to noise: it is as
/// uncertain as they differ.
pub(super) fn widened(
    link: &Link,
    narrow: &Refined,
    (left, right): (&PreparedImage, &PreparedImage),
    left_px: &Vector2<f64>,
    rules: &MatchRules,
) -> Option<Refined> {
    let (aim, most) = (rules.aim_sigma_px, f64::from(rules.max_half_window_px));
    if !(narrow.sigma_px > aim && rules.max_half_window_px > rules.half_window_px) {
        return None;
    }
    let side = 2.0 * f64::from(rules.half_window_px) + 1.0;
    // the deviation falls as the side grows
    let half = (0.5 * (side * narrow.sigma_px / aim - 1.0))
        .ceil()
        .min(most);
    let window = LeftWindow::new(left, left_px, half as usize)?;
    let wide = refine(&window, right, link, narrow.displacement, rules).ok()?;
    let off = wide.displacement.along_px - narrow.displacement.along_px;
    // the smaller window is part of the wider one: of the difference, the variances differ
    let variance = (narrow.sigma_px.powi(2) - wide.sigma_px.powi(2)).max(0.0);
    let agrees = off.abs() <= AGREEMENT_SIGMAS * variance.sqrt() + AGREEMENT_PX;
    if wide.residual_dn > MAX_RESIDUAL_RATIO * narrow.residual_dn {
        return None;
    }
    if agrees {
        return (wide.sigma_px < narrow.sigma_px).then_some(wide);
    }
    Some(Refined {
        sigma_px: narrow.sigma_px.hypot(off),
        ..*narrow
    })
}

/// Noise is never held responsible for more than this part of a window's variance.
const MOST_NOISE: f64 = 0.6;

/// The NCC that windows with these deviations must reach: the rules' for windows without noise, less
/// what the images' noise takes off it, but no less than in the search.
fn least_score(
    deviations_dn: [f64; 2],
    (left, right): (&PreparedImage, &PreparedImage),
    rules: &MatchRules,
) -> f64 {
    let part = |deviation: f64, noise: f64| {
        1.0 - (noise * noise / (deviation * deviation).max(1e-9)).min(MOST_NOISE)
    };
    let left = part(deviations_dn[0], left.noise_dn());
    let right = part(deviations_dn[1], right.noise_dn());
    (rules.min_score * (left * right).sqrt()).max(rules.min_search_score.min(rules.min_score))
}

/// Turns a fit into a match if it passes the checks on score, sigma, range and epipolar distance.
pub(super) fn accept(
    link: &Link,
    fit: &Refined,
    images: (&PreparedImage, &PreparedImage),
    left_px: &Vector2<f64>,
    rules: &MatchRules,
) -> Result<StereoMatch, MatchFailure> {
    // only what would be refused asks for the noise
    if !(fit.score >= rules.min_score) {
        let limit = least_score(fit.deviations_dn, images, rules);
        if !(fit.score >= limit) {
            return Err(MatchFailure::LowScore {
                score: fit.score,
                limit,
            });
        }
    }
    let d = &fit.displacement;
    if d.across_px.abs() > rules.max_epipolar_px {
        return Err(MatchFailure::OffEpipolar {
            distance_px: d.across_px.abs(),
            limit_px: rules.max_epipolar_px,
        });
    }
    if !(fit.sigma_px <= rules.max_sigma_px) {
        return Err(MatchFailure::Uncertain {
            sigma_px: fit.sigma_px,
            limit_px: rules.max_sigma_px,
        });
    }
    let inverse_range = link.inverse_range_at(d.along_px);
    let range_m = 1.0 / inverse_range;
    if !(inverse_range > 0.0 && range_m >= rules.range_min_m && range_m <= rules.range_max_m) {
        return Err(MatchFailure::OutOfRange {
            range_m,
            min_m: rules.range_min_m,
            max_m: rules.range_max_m,
        });
    }
    Ok(StereoMatch {
        left_px: *left_px,
        right_px: link.at + link.along * d.along_px + link.across * d.across_px,
        score: fit.score,
        sigma_px: fit.sigma_px,
        epipolar_px: d.across_px,
        range_m,
        affine: link.matrix(&d.slopes),
    })
}

/// Searches back from the right image.
fn check_mutual(
    left: &PreparedImage,
    right: &PreparedImage,
    pair: &StereoPair,
    left_px: &Vector2<f64>,
    found: &StereoMatch,
    rules: &MatchRules,
) -> Result<(), MatchFailure> {
    let Some(inverse) = found.affine.try_inverse() else {
        return Err(MatchFailure::TooSteep {
            slope: f64::INFINITY,
            limit: rules.max_slope,
        });
    };
    let back = coarse::search(
        (&pair.right, &pair.left),
        (right, left),
        &found.right_px,
        &Warp::Known(inverse),
        rules,
        1,
    )?;
    let distance_px = back
        .first()
        .map_or(f64::INFINITY, |c| (c.pixel - left_px).norm());
    // the search stops at whole pixels: up to half a pixel across the curve is its own
    if distance_px > rules.left_right_tolerance_px {
        return Err(MatchFailure::NotMutual {
            distance_px,
            limit_px: rules.left_right_tolerance_px,
        });
    }
    Ok(())
}
