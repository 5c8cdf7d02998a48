//! Start values from the views alone.
//!
//! Each view's homography from board to image (normalised direct linear transform) constrains the
//! focal length: its first two columns are images of orthogonal vectors of one length (Zhang 2000,
//! with the principal point at the middle of the image). That focal length and a spread of
//! others are tried; for each, the poses follow from the homographies between the board and the
//! rays, a short adjustment is run, and the one that explains the views best is kept.

use super::adjust::Adjustment;
use super::rig::{Rig, inner_n, own_camera};
use super::{BoardPoint, BoardView, CalibrationError, CalibrationRules};
use crate::CameraModel;
use nalgebra::{
    DMatrix, Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector2, Vector3,
};

/// Focal lengths tried, in widths of the image.
const SPREAD: [f64; 7] = [0.3, 0.45, 0.65, 0.95, 1.4, 2.2, 4.0];
const SHORT: u32 = 12;
const LONG: u32 = 40;
/// Rays closer to the image plane than this (z of the unit direction) are left out of a pose.
const MIN_FORWARD: f64 = 0.2;

/// Start values for one camera or a pair.
pub(super) fn rig(
    sizes_px: &[[u32; 2]],
    views: &[BoardView],
    rules: &CalibrationRules,
) -> Result<Rig, CalibrationError> {
    let alone: Vec<(Rig, Vec<usize>)> = sizes_px
        .iter()
        .enumerate()
        .map(|(camera, size)| single(camera, *size, views, rules))
        .collect::<Result<_, _>>()?;
    let pose_in = |camera: usize, view: usize| {
        let (rig, seen) = &alone[camera];
        let at = seen.iter().position(|v| *v == view)?;
        Some(rig.camera_from_board[at])
    };
    let second_from_first = if sizes_px.len() == 2 {
        let steps: Vec<Isometry3<f64>> = (0..views.len())
            .filter_map(|view| Some(pose_in(1, view)? * pose_in(0, view)?.inverse()))
            .collect();
        Some(medoid(&steps).ok_or(CalibrationError::NoCommonView)?)
    } else {
        None
    };
    let camera_from_board = (0..views.len())
        .map(|view| {
            pose_in(0, view)
                .or_else(|| Some(second_from_first?.inverse() * pose_in(1, view)?))
                .ok_or(CalibrationError::View {
                    view,
                    reason: "no camera found the board".into(),
                })
        })
        .collect::<Result<_, _>>()?;
    Ok(Rig {
        kind: rules.model,
        inner: alone
            .into_iter()
            .map(|(rig, _)| rig.inner[0].clone())
            .collect(),
        second_from_first,
        camera_from_board,
    })
}

/// The pose that is nearest to all others.
fn medoid(poses: &[Isometry3<f64>]) -> Option<Isometry3<f64>> {
    let apart = |a: &Isometry3<f64>, b: &Isometry3<f64>| {
        let off = a.inverse() * b;
        off.rotation.angle() + off.translation.vector.norm()
    };
    let total = |a: &Isometry3<f64>| poses.iter().map(|b| apart(a, b)).sum::<f64>();
    poses
        .iter()
        .min_by(|a, b| total(a).total_cmp(&total(b)))
        .copied()
}

/// One camera by itself; also which views it saw.
fn single(
    camera: usize,
    size: [u32; 2],
    views: &[BoardView],
    rules: &CalibrationRules,
) -> Result<(Rig, Vec<usize>), CalibrationError> {
    let seen: Vec<usize> = (0..views.len())
        .filter(|view| !views[*view][camera].is_empty())
        .collect();
    let own: Vec<BoardView> = seen
        .iter()
        .map(|view| vec![views[*view][camera].clone()])
        .collect();
    let centre = Vector2::new(f64::from(size[0]) - 1.0, f64::from(size[1]) - 1.0) * 0.5;
    let width = f64::from(size[0].max(size[1]));
    let adjustment = Adjustment::new(&own, rules);
    let mut candidates: Vec<f64> = SPREAD.map(|s| s * width).into();
    candidates.extend(focal_px(&own, &centre));
    let mut best: Option<(f64, Rig)> = None;
    for focal in candidates {
        let mut inner = vec![0.0; inner_n(rules.model)];
        inner[..4].copy_from_slice(&[focal, focal, centre.x, centre.y]);
        let model = own_camera(rules.model, &inner);
        let poses: Option<Vec<_>> = own.iter().map(|view| pose(&model, &view[0])).collect();
        let Some(camera_from_board) = poses else {
            continue;
        };
        let start = Rig {
            kind: rules.model,
            inner: vec![inner],
            second_from_first: None,
            camera_from_board,
        };
        if let Some(found) = adjustment.run(start, SHORT)
            && best.as_ref().is_none_or(|(cost, _)| found.cost < *cost)
        {
            best = Some((found.cost, found.state));
        }
    }
    let (_, start) = best.ok_or(CalibrationError::NoStart { camera })?;
    let found = adjustment
        .run(start, LONG)
        .ok_or(CalibrationError::NoStart { camera })?;
    Ok((found.state, seen))
}

/// The focal length that the homographies ask for, if they do.
fn focal_px(views: &[BoardView], centre: &Vector2<f64>) -> Option<f64> {
    let (mut above, mut below) = (0.0, 0.0);
    for view in views {
        let pairs: Vec<_> = view[0]
            .iter()
            .map(|p| (p.board_m, p.pixel_px - centre))
            .collect();
        let Some(h) = homography(&pairs) else {
            continue;
        };
        let (p, q) = (h.column(0), h.column(1));
        let size = p.norm() * q.norm();
        // w = 1 / f^2 in both a w + b = 0.
        for (a, b) in [
            (p[0] * q[0] + p[1] * q[1], p[2] * q[2]),
            (
                p[0] * p[0] + p[1] * p[1] - q[0] * q[0] - q[1] * q[1],
                p[2] * p[2] - q[2] * q[2],
            ),
        ] {
            above -= a * b / (size * size);
            below += a * a / (size * size);
        }
    }
    let w = above / below;
    (w > 0.0 && w.is_finite()).then(|| 1.0 / w.sqrt())
}

/// The pose of the board under a camera model.
fn pose(model: &CameraModel, points: &[BoardPoint]) -> Option<Isometry3<f64>> {
    let pairs: Vec<_> = points
        .iter()
        .filter_map(|p| {
            let d = model.ray(&p.pixel_px).ok()?.direction;
            (d.z > MIN_FORWARD).then(|| (p.board_m, d.xy() / d.z))
        })
        .collect();
    let mut h = homography(&pairs)?;
    let scale = 2.0 / (h.column(0).norm() + h.column(1).norm());
    h *= if h[(2, 2)] < 0.0 { -scale } else { scale };
    let (x, y): (Vector3<f64>, Vector3<f64>) = (h.column(0).into_owned(), h.column(1).into_owned());
    let raw = Matrix3::from_columns(&[x, y, x.cross(&y)]);
    let svd = raw.svd(true, true);
    let rotation = svd.u? * svd.v_t?;
    if !rotation.iter().all(|x| x.is_finite()) || rotation.determinant() < 0.0 {
        return None;
    }
    Some(Isometry3::from_parts(
        Translation3::from(h.column(2).into_owned()),
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation)),
    ))
}

/// The homography from the first to the second of each pair, by the normalised direct linear
/// transform.
fn homography(pairs: &[(Vector2<f64>, Vector2<f64>)]) -> Option<Matrix3<f64>> {
    if pairs.len() < 4 {
        return None;
    }
    let normal = |of: &dyn Fn(usize) -> Vector2<f64>| {
        let n = pairs.len() as f64;
        let mean = (0..pairs.len()).map(of).sum::<Vector2<f64>>() / n;
        let spread = (0..pairs.len()).map(|i| (of(i) - mean).norm()).sum::<f64>() / n;
        let s = std::f64::consts::SQRT_2 / spread;
        Matrix3::new(s, 0.0, -s * mean.x, 0.0, s, -s * mean.y, 0.0, 0.0, 1.0)
    };
    let (from, to) = (normal(&|i| pairs[i].0), normal(&|i| pairs[i].1));
    let mut gram = DMatrix::<f64>::zeros(9, 9);
    for (p, q) in pairs {
        let p = from * Vector3::new(p.x, p.y, 1.0);
        let q = to * Vector3::new(q.x, q.y, 1.0);
        let rows = [
            [p.x, p.y, 1.0, 0.0, 0.0, 0.0, -q.x * p.x, -q.x * p.y, -q.x],
            [0.0, 0.0, 0.0, p.x, p.y, 1.0, -q.y * p.x, -q.y * p.y, -q.y],
        ];
        for row in rows {
            for i in 0..9 {
                for j in 0..9 {
                    gram[(i, j)] += row[i] * row[j];
                }
            }
        }
    }
    let eigen = gram.symmetric_eigen();
    let least = eigen.eigenvalues.imin();
    let h = eigen.eigenvectors.column(least);
    let h = Matrix3::from_row_slice(h.as_slice());
    let h = to.try_inverse()? * h * from;
    h.iter().all(|x| x.is_finite()).then_some(h)
}
