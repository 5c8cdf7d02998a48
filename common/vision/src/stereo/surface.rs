//! The surface under a pixel: position on exactly that pixel's ray, normal, roughness, uncertainty,
//! or the reason why nothing can be placed there.

use nalgebra::{Matrix3, Unit, Vector2, Vector3};
use rover_cameras::StereoPair;

use super::link::Link;
use super::matching::{accept, check_input, match_checked, settle, widened};
use super::refine::Displacement;
use super::surface_fit::{Sample, fit_centre, fit_patch};
use super::window::LeftWindow;
use super::{MatchFailure, MatchRules, PreparedImage, StereoMatch, SurfaceRules};

/// A measured surface patch, in the frame of the camera models.
#[derive(Clone, Debug, PartialEq)]
pub struct Surface {
    /// The surface point on the ray of the designated left pixel, m.
    pub position: Vector3<f64>,
    /// Unit normal, towards the left camera.
    pub normal: Unit<Vector3<f64>>,
    /// Standard deviation of the normal in the direction in which it is known least, rad; `None`
    /// where it was not measured (distant surfaces).
    pub normal_sigma_rad: Option<f64>,
    /// Root mean square distance of the points used from their plane, m.
    pub plane_rms_m: f64,
    /// Extent of the surrounding surface along the normal, m.
    pub roughness_m: f64,
    /// Points that the plane was fitted to.
    pub points_used: usize,
    /// Covariance of `position`, m^2.
    pub covariance: Matrix3<f64>,
    /// Range along the left ray, m.
    pub range_m: f64,
    /// Standard deviation of the fused match along the epipolar curve, px.
    pub sigma_px: f64,
    /// Mean NCC of the matches.
    pub score: f64,
    /// Median distance of the matches from their epipolar curves, px: camera model error.
    pub epipolar_px: f64,
}

/// Why a surface was not measured or must not be placed on.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SurfaceFailure {
    /// Too little contrast around the pixel.
    #[error("no texture: grey values vary by {found_dn:.2} DN, {needed_dn} DN are needed")]
    NoTexture {
        /// Standard deviation in the window, DN.
        found_dn: f64,
        /// Least standard deviation, DN.
        needed_dn: f64,
    },
    /// The pixel matches several places.
    #[error("ambiguous: another place scores {second:.3} beside the best with {best:.3}")]
    NotUnique {
        /// NCC of the best place.
        best: f64,
        /// NCC of the second best.
        second: f64,
    },
    /// The point is hidden from one camera, or lies at the edge of something.
    #[error("occluded or at an edge: {0}")]
    Occluded(String),
    /// Nothing within the range limits matches: sky, or a surface too near or too far.
    #[error("nothing at {min_m} to {max_m} m matches the pixel: {reason}")]
    NothingInRange {
        /// Nearest range searched, m.
        min_m: f64,
        /// Farthest range searched, m.
        max_m: f64,
        /// What the match at the pixel said.
        reason: String,
    },
    /// The pixel or its surroundings leave an image.
    #[error("too close to the image border: {0}")]
    OutsideImage(String),
    /// Too few of the surrounding points could be matched.
    #[error("{found} points around the pixel could be measured, {needed} are needed")]
    TooFewPoints {
        /// Points found.
        found: usize,
        /// Points needed.
        needed: usize,
    },
    /// The surface is too rough.
    #[error(
        "too rough: plane rms {rms_mm:.2} mm (limit {rms_limit_mm} mm), extent along the normal \
         {roughness_mm:.2} mm (limit {roughness_limit_mm} mm)"
    )]
    TooRough {
        /// Root mean square distance from the plane, mm.
        rms_mm: f64,
        /// Its limit, mm.
        rms_limit_mm: f64,
        /// Extent along the normal, mm.
        roughness_mm: f64,
        /// Its limit, mm.
        roughness_limit_mm: f64,
    },
    /// The points lie too close to a line, or scatter too much, for a normal.
    #[error("the normal is uncertain by {sigma_deg:.1} deg, limit {limit_deg} deg")]
    NormalUncertain {
        /// Standard deviation in the worst direction, deg.
        sigma_deg: f64,
        /// Its limit, deg.
        limit_deg: f64,
    },
    /// The surface is seen at too flat an angle.
    #[error("the cosine between normal and direction to the camera is {cosine:.3}, limit {limit}")]
    NormalFacingAway {
        /// Cosine found.
        cosine: f64,
        /// Least cosine.
        limit: f64,
    },
    /// Images, cameras or rules cannot be used.
    #[error("{0}")]
    BadInput(String),
}

impl SurfaceFailure {
    /// What a pixel without a match means for its surface.
    pub(super) fn of_match(failure: MatchFailure, rules: &MatchRules) -> Self {
        let reason = failure.to_string();
        match failure {
            MatchFailure::NoTexture {
                found_dn,
                needed_dn,
            } => SurfaceFailure::NoTexture {
                found_dn,
                needed_dn,
            },
            MatchFailure::NotUnique { best, second, .. } => {
                SurfaceFailure::NotUnique { best, second }
            }
            MatchFailure::NotMutual { .. } | MatchFailure::OffEpipolar { .. } => {
                SurfaceFailure::Occluded(reason)
            }
            MatchFailure::OutsideImage { .. } | MatchFailure::CurveOutsideImage => {
                SurfaceFailure::OutsideImage(reason)
            }
            MatchFailure::BadInput(_) | MatchFailure::Camera(_) => SurfaceFailure::BadInput(reason),
            _ => SurfaceFailure::NothingInRange {
                min_m: rules.range_min_m,
                max_m: rules.range_max_m,
                reason,
            },
        }
    }
}

/// Offsets (px) of the places at which a start is looked for if the pixel itself has no match.
const OTHER_STARTS: [(f64, f64); 8] = [
    (5.0, 0.0),
    (-5.0, 0.0),
    (0.0, 5.0),
    (0.0, -5.0),
    (8.0, 8.0),
    (-8.0, 8.0),
    (8.0, -8.0),
    (-8.0, -8.0),
];

/// Measures the surface around a left pixel.
///
/// The pixel is matched with all checks; from there the match is carried outwards over a grid, each
/// place starting from its neighbour's local plane. The position comes from a robust quadratic fit
/// of the inverse range over all matches, the normal and the roughness from the flight rules for
/// surface normals.
///
/// # Errors
/// [`SurfaceFailure`] with the reason and the numbers behind it.
pub fn measure_surface(
    left: &PreparedImage,
    right: &PreparedImage,
    pair: &StereoPair,
    left_px: &Vector2<f64>,
    rules: &SurfaceRules,
) -> Result<Surface, SurfaceFailure> {
    rules.validate().map_err(SurfaceFailure::BadInput)?;
    check_input(left, right, pair, left_px).map_err(|e| SurfaceFailure::BadInput(e.to_string()))?;
    let start = find_start(left, right, pair, left_px, &rules.matching)?;
    let grid = Grid::grow(left, right, pair, left_px, &start, rules)?;

    let ray = pair
        .left
        .ray(left_px)
        .map_err(|e| SurfaceFailure::BadInput(e.to_string()))?;
    let first_guess = grid.samples_near(&ray.at(start.range_m), rules.separation_m);
    let needed = rules.min_points;
    if first_guess.len() < needed {
        return Err(SurfaceFailure::TooFewPoints {
            found: first_guess.len(),
            needed,
        });
    }
    check_quadrants(&first_guess, rules)?;
    // windows that noise has widened count with their own size
    let sides: f64 = first_guess.iter().map(|s| s.side_px).sum();
    let side = sides / first_guess.len() as f64;
    let window_variance = (side * side - 1.0) / 12.0;
    let reach = f64::from(rules.half_grid) * rules.grid_step_px;
    let centre = fit_centre(&first_guess, reach, window_variance)
        .ok_or(SurfaceFailure::TooFewPoints { found: 0, needed })?;
    let range_m = 1.0 / centre.inverse_range;
    let position = ray.at(range_m);

    let back = -ray.direction.into_inner();
    let samples = grid.samples_near(&position, rules.separation_m);
    // windows overlap: the samples hold only this many independent looks
    let spacing = (rules.grid_step_px / side).powi(2).min(1.0);
    let patch = fit_patch(&samples, spacing, &back, rules)?;
    if patch.rms_m > rules.max_plane_rms_m || patch.roughness_m > rules.max_roughness_m {
        return Err(SurfaceFailure::TooRough {
            rms_mm: patch.rms_m * 1e3,
            rms_limit_mm: rules.max_plane_rms_m * 1e3,
            roughness_mm: patch.roughness_m * 1e3,
            roughness_limit_mm: rules.max_roughness_m * 1e3,
        });
    }
    let (sigma_deg, limit_deg) = (
        patch.normal_sigma_rad.to_degrees(),
        rules.max_normal_sigma_deg,
    );
    if !(sigma_deg <= limit_deg) {
        return Err(SurfaceFailure::NormalUncertain {
            sigma_deg,
            limit_deg,
        });
    }
    let cosine = patch.normal.dot(&back);
    if cosine < rules.min_facing_cosine {
        return Err(SurfaceFailure::NormalFacingAway {
            cosine,
            limit: rules.min_facing_cosine,
        });
    }

    let px = grid.px_per_inverse_range;
    let scatter = (centre.scatter * px).max(rules.matching.sigma_floor_px);
    let independent = (samples.len() as f64 * spacing).max(1.0);
    let fused = (centre.sigma * px / spacing.sqrt()).max(scatter / independent.sqrt());
    let sigma_px = fused.hypot(rules.common_sigma_px);
    let sigma_range = sigma_px / px * range_m * range_m;
    let lateral = rules.pixel_sigma_px * range_m * ray_angle_per_px(pair, left_px);
    let along = back * back.transpose();
    let covariance = along * sigma_range.powi(2) + (Matrix3::identity() - along) * lateral.powi(2);
    Ok(Surface {
        position,
        normal: patch.normal,
        normal_sigma_rad: Some(patch.normal_sigma_rad),
        plane_rms_m: patch.rms_m,
        roughness_m: patch.roughness_m,
        points_used: patch.used,
        covariance,
        range_m,
        sigma_px,
        score: grid.mean_score(),
        epipolar_px: grid.epipolar_px,
    })
}

/// Angle between the rays of neighbouring pixels, rad/px.
fn ray_angle_per_px(pair: &StereoPair, pixel: &Vector2<f64>) -> f64 {
    pair.left
        .ray_with_jacobian(pixel)
        .map_or(0.0, |(_, turn)| turn.norm() / 2f64.sqrt())
}

/// A match at the pixel or close by.
fn find_start(
    left: &PreparedImage,
    right: &PreparedImage,
    pair: &StereoPair,
    left_px: &Vector2<f64>,
    rules: &MatchRules,
) -> Result<StereoMatch, SurfaceFailure> {
    let failure = match match_checked(left, right, pair, left_px, rules) {
        Ok(found) => return Ok(found),
        Err(e) => e,
    };
    let fatal = matches!(
        failure,
        MatchFailure::NoTexture { .. }
            | MatchFailure::OutsideImage { .. }
            | MatchFailure::NotUnique { .. }
            | MatchFailure::BadInput(_)
            | MatchFailure::Camera(_)
    );
    if !fatal {
        for (du, dv) in OTHER_STARTS {
            let near = left_px + Vector2::new(du, dv);
            if let Ok(found) = match_checked(left, right, pair, &near, rules) {
                return Ok(found);
            }
        }
    }
    Err(SurfaceFailure::of_match(failure, rules))
}

/// Points in each quadrant around the pixel: an edge shows as an empty one.
fn check_quadrants(samples: &[Sample], rules: &SurfaceRules) -> Result<(), SurfaceFailure> {
    let side = f64::from(2 * rules.half_grid + 1);
    let per_quadrant = side * side / 4.0;
    for (name, su, sv) in [
        ("left above", -1.0, -1.0),
        ("right above", 1.0, -1.0),
        ("left below", -1.0, 1.0),
        ("right below", 1.0, 1.0),
    ] {
        let found = samples
            .iter()
            .filter(|s| s.offset.x * su >= 0.0 && s.offset.y * sv >= 0.0)
            .count();
        let fraction = found as f64 / per_quadrant;
        if fraction < rules.min_quadrant_fraction {
            return Err(SurfaceFailure::Occluded(format!(
                "{:.0} % of the surroundings {name} of the pixel lie on its surface, {:.0} % are \
                 needed",
                fraction * 100.0,
                rules.min_quadrant_fraction * 100.0
            )));
        }
    }
    Ok(())
}

/// What a grid place knows after its match.
#[derive(Clone, Copy)]
struct Node {
    inverse_range: f64,
    /// Change of the inverse range per pixel.
    slopes: Vector2<f64>,
    score: f64,
    sample: Sample,
}

/// Matches on a grid around the pixel.
struct Grid {
    nodes: Vec<Option<Node>>,
    px_per_inverse_range: f64,
    epipolar_px: f64,
}

impl Grid {
    fn grow(
        left: &PreparedImage,
        right: &PreparedImage,
        pair: &StereoPair,
        left_px: &Vector2<f64>,
        start: &StereoMatch,
        rules: &SurfaceRules,
    ) -> Result<Self, SurfaceFailure> {
        let bad = |e: &dyn std::fmt::Display| SurfaceFailure::BadInput(e.to_string());
        let link = Link::new(&pair.left, &pair.right, &start.left_px, 1.0 / start.range_m)
            .map_err(|e| bad(&e))?;
        let steepness = link.along.transpose() * (start.affine - link.base);
        let slopes = Vector2::new(steepness[0], steepness[1]) / link.px_per_inverse_range;
        let seed = (start.left_px, 1.0 / start.range_m, slopes);

        let n = rules.half_grid as isize;
        let side = (2 * n + 1) as usize;
        let index = |i: isize, j: isize| ((j + n) as usize) * side + (i + n) as usize;
        // outwards by distance, ties by place
        let mut order: Vec<(isize, isize)> = (-n..=n)
            .flat_map(|j| (-n..=n).map(move |i| (i, j)))
            .collect();
        order.sort_by_key(|&(i, j)| (i * i + j * j, j, i));
        let matching = MatchRules {
            half_window_px: rules.half_window_px,
            aim_sigma_px: AIMED_PART * rules.matching.max_sigma_px,
            ..rules.matching.clone()
        };
        let mut nodes: Vec<Option<Node>> = vec![None; side * side];
        let mut across = Vec::new();
        // a second round reaches places whose neighbours came later
        for _ in 0..2 {
            for &(i, j) in &order {
                if nodes[index(i, j)].is_some() {
                    continue;
                }
                let offset = Vector2::new(i as f64, j as f64) * rules.grid_step_px;
                let pixel = left_px + offset;
                let neighbours = (0..9)
                    .filter(|&k| k != 4)
                    .map(|k| (i + k % 3 - 1, j + k / 3 - 1))
                    .filter(|(a, b)| a.abs() <= n && b.abs() <= n)
                    .filter_map(|(a, b)| nodes[index(a, b)]);
                let best = neighbours.max_by(|a, b| a.score.total_cmp(&b.score));
                let (from, inverse_range, slopes) = match best {
                    Some(node) => (
                        left_px + node.sample.offset,
                        node.inverse_range,
                        node.slopes,
                    ),
                    None if i.abs() <= 3 && j.abs() <= 3 => seed,
                    None => continue,
                };
                let predicted = inverse_range + slopes.dot(&(pixel - from));
                let start = (predicted, slopes);
                if let Some((node, distance)) =
                    measure_node(left, right, pair, &pixel, &offset, start, &matching, rules)
                {
                    nodes[index(i, j)] = Some(node);
                    across.push(distance);
                }
            }
        }
        across.sort_by(f64::total_cmp);
        let epipolar_px = across.get(across.len() / 2).copied().unwrap_or(0.0);
        Ok(Self {
            nodes,
            px_per_inverse_range: link.px_per_inverse_range,
            epipolar_px,
        })
    }

    fn samples_near(&self, point: &Vector3<f64>, separation_m: f64) -> Vec<Sample> {
        self.nodes
            .iter()
            .flatten()
            .filter(|n| (n.sample.point - point).norm() <= separation_m)
            .map(|n| n.sample)
            .collect()
    }

    fn mean_score(&self) -> f64 {
        let count = self.nodes.iter().flatten().count().max(1);
        self.nodes.iter().flatten().map(|n| n.score).sum::<f64>() / count as f64
    }
}

/// Windows that noise leaves too uncertain are widened to this part of the accepted deviation.
const AIMED_PART: f64 = 0.6;

/// Matches one grid place from a predicted inverse range and slopes; also its distance from the
/// epipolar curve, px.
#[allow(clippy::too_many_arguments)] // one inner step, called from one place
fn measure_node(
    left: &PreparedImage,
    right: &PreparedImage,
    pair: &StereoPair,
    pixel: &Vector2<f64>,
    offset: &Vector2<f64>,
    (inverse_range, slopes): (f64, Vector2<f64>),
    matching: &MatchRules,
    rules: &SurfaceRules,
) -> Option<(Node, f64)> {
    let window = LeftWindow::new(left, pixel, rules.half_window_px as usize)?;
    if window.deviation_dn < matching.min_texture_dn || !(inverse_range > 0.0) {
        return None;
    }
    let link = Link::new(&pair.left, &pair.right, pixel, inverse_range).ok()?;
    let start = Displacement {
        along_px: 0.0,
        slopes: slopes * link.px_per_inverse_range,
        across_px: 0.0,
    };
    let mut found = settle((left, right), pixel, &window, &link, start, matching).ok()?;
    if found.sigma_px > matching.max_sigma_px
        && let Some(wide) = widened(&link, &found, (left, right), pixel, matching)
    {
        found = wide;
    }
    if found.displacement.along_px.abs() > rules.max_jump_px {
        return None;
    }
    let checked = accept(&link, &found, (left, right), pixel, matching).ok()?;
    let ray_point = link.origin + link.direction * checked.range_m;
    let inverse_range = 1.0 / checked.range_m;
    let slopes = found.displacement.slopes / link.px_per_inverse_range;
    let sample = Sample {
        offset: *offset,
        inverse_range,
        sigma: found.sigma_px / link.px_per_inverse_range,
        point: ray_point,
        side_px: found.side_px as f64,
    };
    Some((
        Node {
            inverse_range,
            slopes,
            score: found.score,
            sample,
        },
        found.displacement.across_px.abs(),
    ))
}
