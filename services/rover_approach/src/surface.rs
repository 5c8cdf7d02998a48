//! The plane of the surface under a pixel, from one stereo match over a window.

use crate::error::TrackError;
use crate::view::View;
use crate::warp::SurfacePlane;
use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};
use rover_vision::{MatchRules, StereoMatch, match_point};

/// A plane through the surface point on a pixel's ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StereoPlane {
    /// The plane, rover frame; its point lies on the pixel's ray.
    pub plane: SurfacePlane,
    /// Range along the left ray, m.
    pub range_m: f64,
    /// Covariance of the point, rover frame, m^2.
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
    pub(crate) fn matching(&self, range_m: [f64; 2], normals: &[Vector3<f64>]) -> MatchRules {
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
            max_sigma_px: 0.5,
            ..MatchRules::default()
        }
    }
}

/// Measures the plane at a left pixel; the range is searched between `range_m`, and `normal` (rover
/// frame), if known, is one of the slants tried.
///
/// # Errors
/// [`TrackError::NoPlane`] with the match's own reason.
pub fn measure_plane(
    view: &View,
    pixel_px: &Vector2<f64>,
    range_m: [f64; 2],
    normal: Option<&Vector3<f64>>,
    rules: &PlaneRules,
) -> Result<StereoPlane, TrackError> {
    let none = |reason: String| TrackError::NoPlane {
        u_px: pixel_px.x,
        v_px: pixel_px.y,
        reason,
    };
    let normals: Vec<Vector3<f64>> = normal.copied().into_iter().collect();
    let matching = rules.matching(range_m, &normals);
    let found = match_point(&view.left, &view.right, &view.cameras, pixel_px, &matching)
        .map_err(|e| none(e.to_string()))?;
    plane_of(view, &found, rules).ok_or_else(|| none("its plane is seen edge on".into()))
}

fn plane_of(view: &View, found: &StereoMatch, rules: &PlaneRules) -> Option<StereoPlane> {
    let pair = &view.cameras;
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
