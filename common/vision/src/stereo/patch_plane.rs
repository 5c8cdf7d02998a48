//! The plane of the surface under a pixel, from one stereo match over a window.
//!
//! A match carries an affine map between the two windows, and with it the slant of the surface.
//! Unlike the fit through many points of [`super::measure_surface`], it needs no range resolution
//! across the window, so it serves at ranges where single points are uncertain by centimetres.

use super::{
    MatchFailure, MatchRules, PreparedImage, StereoMatch, Surface, SurfaceFailure, match_point,
};
use nalgebra::{Isometry3, Matrix2, Matrix3, Point3, Unit, Vector2, Vector3};
use rover_cameras::StereoPair;

/// A plane, in the frame of the camera models that it was seen with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePlane {
    /// A point of it, m.
    pub point: Vector3<f64>,
    /// Unit normal, towards the camera.
    pub normal: Vector3<f64>,
}

impl SurfacePlane {
    /// The plane in another frame.
    #[must_use]
    pub fn moved(&self, to_from: &Isometry3<f64>) -> Self {
        Self {
            point: to_from * Point3::from(self.point) - Point3::origin(),
            normal: to_from.rotation * self.normal,
        }
    }
}

/// Why a pixel has no plane.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PlaneFailure {
    /// No match.
    #[error(transparent)]
    Match(#[from] MatchFailure),
    /// The window's map between the images is that of a surface seen edge on.
    #[error("its plane is seen edge on")]
    EdgeOn,
}

/// A plane through the surface point on a pixel's ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StereoPlane {
    /// The plane, rover frame; its point lies on the pixel's ray.
    pub plane: SurfacePlane,
    /// Range along the left ray, m.
    pub range_m: f64,
    /// Covariance of the point, frame of the camera models, m^2.
    pub covariance_m2: Matrix3<f64>,
    /// Correlation of the match over its window.
    pub score: f64,
}

/// How planes are measured.
#[derive(Clone, Debug, PartialEq)]
pub struct PlaneRules {
    /// Half side of the matching window, px.
    pub half_window_px: u32,
    /// The range searched, as fractions of the range expected.
    pub range_fraction: f64,
    /// Least correlation.
    pub min_score: f64,
    /// Standard deviation of the pixel itself across the ray (camera model, pointing), px.
    pub pixel_sigma_px: f64,
}

impl Default for PlaneRules {
    fn default() -> Self {
        Self {
            half_window_px: 10,
            range_fraction: 0.35,
            min_score: 0.5,
            pixel_sigma_px: 0.3,
        }
    }
}

impl PlaneRules {
    /// Matching rules for a surface between two ranges, m; `normals` are tried beside a surface
    /// that faces the camera.
    #[must_use]
    pub fn matching(&self, range_m: [f64; 2], normals: &[Vector3<f64>]) -> MatchRules {
        let mut slant_normals = vec![[0.0, 0.0, 1.0]];
        slant_normals.extend(normals.iter().map(|n| [n.x, n.y, n.z]));
        MatchRules {
            half_window_px: self.half_window_px,
            half_search_window_px: self.half_window_px.min(7),
            range_min_m: range_m[0],
            range_max_m: range_m[1],
            slant_normals,
            min_texture_dn: 1.0,
            min_search_score: 0.35,
            min_score: self.min_score,
            uniqueness_ratio: 0.98,
            left_right_tolerance_px: 2.5,
            max_slope: 1.5,
            max_epipolar_px: 2.5,
            max_correction_px: 4.0,
            max_sigma_px: 0.5,
            ..MatchRules::default()
        }
    }
}

/// Spacing and reach of the grid of single points by which a distant surface's roughness is told,
/// px.
const GRID_PX: [i32; 2] = [4, 8];
/// Fewest of those points.
const GRID_POINTS_N: usize = 4;

/// The surface around a left pixel that is seen from afar: position and normal from the one match
/// of the pixel's window, plane rms and roughness from single points around it. At such ranges both
/// are mostly the noise of stereo, so nothing is refused as too rough.
///
/// # Errors
/// [`SurfaceFailure`], but for `TooRough`.
pub fn measure_distant_surface(
    (left, right): (&PreparedImage, &PreparedImage),
    cameras: &StereoPair,
    pixel_px: &Vector2<f64>,
    range_m: [f64; 2],
    rules: &PlaneRules,
) -> Result<Surface, SurfaceFailure> {
    let matching = rules.matching(range_m, &[]);
    let refused = |failure| SurfaceFailure::of_match(failure, &matching);
    let (found, rules) = settled(rules, |rules| {
        let matching = rules.matching(range_m, &[]);
        Ok((
            match_point(left, right, cameras, pixel_px, &matching)?,
            rules.clone(),
        ))
    })
    .map_err(refused)?;
    let rules = &rules;
    let facing_away = SurfaceFailure::NormalFacingAway {
        cosine: 0.0,
        limit: 0.0,
    };
    let seen = plane_of(cameras, &found, rules).ok_or(facing_away)?;
    let normal = Unit::new_normalize(seen.plane.normal);
    let [step, reach] = GRID_PX;
    let mut heights_m = Vec::new();
    let near = rules.matching(
        [0.8 * seen.range_m, 1.25 * seen.range_m],
        &[seen.plane.normal],
    );
    for dv in (-reach..=reach).step_by(step as usize) {
        for du in (-reach..=reach).step_by(step as usize) {
            let at = pixel_px + Vector2::new(f64::from(du), f64::from(dv));
            let Ok(single) = match_point(left, right, cameras, &at, &near) else {
                continue;
            };
            if let Ok(point) = cameras.triangulate(&single.left_px, &single.right_px) {
                heights_m.push((point.point - seen.plane.point).dot(&normal));
            }
        }
    }
    if heights_m.len() < GRID_POINTS_N {
        return Err(SurfaceFailure::TooFewPoints {
            found: heights_m.len(),
            needed: GRID_POINTS_N,
        });
    }
    let mean_m = heights_m.iter().sum::<f64>() / heights_m.len() as f64;
    let square = heights_m.iter().map(|h| (h - mean_m).powi(2)).sum::<f64>();
    let (low, high) = heights_m
        .iter()
        .fold((f64::MAX, f64::MIN), |(low, high), &h| {
            (low.min(h), high.max(h))
        });
    Ok(Surface {
        position: seen.plane.point,
        normal,
        normal_sigma_rad: None,
        plane_rms_m: (square / heights_m.len() as f64).sqrt(),
        roughness_m: high - low,
        points_used: heights_m.len(),
        covariance: seen.covariance_m2,
        range_m: seen.range_m,
        sigma_px: found.sigma_px,
        score: found.score,
        epipolar_px: found.epipolar_px,
    })
}

/// Measures the plane at a left pixel; the range is searched between `range_m`, and `normal`
/// (frame of the camera models), if known, is one of the slants tried.
///
/// # Errors
/// [`PlaneFailure`].
pub fn measure_plane(
    (left, right): (&PreparedImage, &PreparedImage),
    cameras: &StereoPair,
    pixel_px: &Vector2<f64>,
    range_m: [f64; 2],
    normal: Option<&Vector3<f64>>,
    rules: &PlaneRules,
) -> Result<StereoPlane, PlaneFailure> {
    let normals: Vec<Vector3<f64>> = normal.copied().into_iter().collect();
    settled(rules, |rules| {
        let matching = rules.matching(range_m, &normals);
        let found = match_point(left, right, cameras, pixel_px, &matching)?;
        Ok(plane_of(cameras, &found, rules))
    })?
    .ok_or(PlaneFailure::EdgeOn)
}

/// Measures with the window of `rules`. A fit that wanders has too little in its window to hold on
/// to, or the edge of another surface: then a larger one is tried, and a smaller one.
fn settled<T>(
    rules: &PlaneRules,
    measured: impl Fn(&PlaneRules) -> Result<T, MatchFailure>,
) -> Result<T, MatchFailure> {
    let sized = |half_window_px| PlaneRules {
        half_window_px,
        ..rules.clone()
    };
    let half = rules.half_window_px;
    measured(rules).or_else(|failure| match failure {
        MatchFailure::Diverged { .. } => measured(&sized(half * 3 / 2))
            .or_else(|_| measured(&sized((half * 7 / 10).max(4))))
            .map_err(|_| failure),
        _ => Err(failure),
    })
}

fn plane_of(pair: &StereoPair, found: &StereoMatch, rules: &PlaneRules) -> Option<StereoPlane> {
    let point = pair.left.ray(&found.left_px).ok()?.at(found.range_m);
    let step = f64::from(rules.half_window_px) * 0.6;
    let at = |u: f64, v: f64| {
        let d = Vector2::new(u, v) * step;
        let right = found.right_px + found.affine * d;
        pair.triangulate(&(found.left_px + d), &right)
            .ok()
            .map(|t| t.point)
    };
    let across = at(1.0, 0.0)? - at(-1.0, 0.0)?;
    let down = at(0.0, 1.0)? - at(0.0, -1.0)?;
    let normal = down.cross(&across).try_normalize(1e-15)?;
    let to_camera = pair.left.model.cahv()[0] - point;
    let normal = if normal.dot(&to_camera) < 0.0 {
        -normal
    } else {
        normal
    };
    let lateral = rules.pixel_sigma_px.powi(2);
    let (_, [to_left, to_right]) = pair
        .triangulate_with_jacobian(&found.left_px, &found.right_px)
        .ok()?;
    // what moves both pixels alike is lateral, what moves one against the other is range
    let both = to_left + to_right;
    let covariance_m2 = both * (Matrix2::identity() * lateral) * both.transpose()
        + to_right
            * (Matrix2::identity() * found.sigma_px.max(0.03).powi(2))
            * to_right.transpose();
    Some(StereoPlane {
        plane: SurfacePlane { point, normal },
        range_m: found.range_m,
        covariance_m2,
        score: found.score,
    })
}
