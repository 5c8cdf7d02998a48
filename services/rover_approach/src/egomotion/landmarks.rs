//! Which places of the last picture are looked for in the new one, and how they slant.

use super::EgomotionRules;
use crate::align::Template;
use crate::filter::Motion;
use crate::patch::HalfSize;
use crate::surface::SurfacePlane;
use crate::view::View;
use nalgebra::{Matrix3, Point3, Vector2, Vector3};
use rover_cameras::Camera;
use std::collections::BTreeMap;

/// A place of the ground seen in a picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Landmark {
    /// Where the left camera saw it, px.
    pub pixel_px: Vector2<f64>,
    /// Where stereo puts it, rover frame of that stop, m.
    pub point_m: Vector3<f64>,
}

/// The landmark with the most texture of each cell of the new picture, of those that both pictures
/// should show.
pub(super) fn chosen(
    [last, now]: [&View; 2],
    landmarks: &[Landmark],
    odometry: &Motion,
    usable: impl Fn(&View, &Vector3<f64>) -> bool,
    rules: &EgomotionRules,
) -> Vec<Landmark> {
    let inside = |camera: &Camera, pixel: &Vector2<f64>| {
        let size = [camera.width_px, camera.height_px].map(f64::from);
        (0..2).all(|k| pixel[k] >= rules.border_px && pixel[k] <= size[k] - 1.0 - rules.border_px)
    };
    let half = HalfSize {
        u: rules.half_px,
        v: rules.half_px,
    };
    let camera = &now.cameras.left;
    let size = [camera.width_px, camera.height_px].map(f64::from);
    let mut best: BTreeMap<[usize; 2], (f64, Landmark)> = BTreeMap::new();
    for mark in landmarks {
        let there = (odometry.now_from_last * Point3::from(mark.point_m)).coords;
        let Ok(pixel) = camera.project(&there) else {
            continue;
        };
        let shown = inside(&last.cameras.left, &mark.pixel_px) && inside(camera, &pixel);
        if !(shown && usable(last, &mark.point_m) && usable(now, &there)) {
            continue;
        }
        let Ok(template) = Template::cut(&last.left, &mark.pixel_px, half) else {
            continue;
        };
        let cell = [0, 1].map(|k| (pixel[k] / size[k] * rules.cells[k] as f64) as usize);
        let texture = template.deviation_dn();
        if best.get(&cell).is_none_or(|(most, _)| texture > *most) {
            best.insert(cell, (texture, *mark));
        }
    }
    best.into_values().map(|(_, mark)| mark).collect()
}

/// The plane through a landmark as its neighbours tell it. Over a plane the inverse of the range
/// along the camera's axis is linear in the pixel. Facing the camera where they do not tell one.
pub(super) fn slant(
    mark: &Landmark,
    landmarks: &[Landmark],
    view: &View,
    neighbour_px: f64,
) -> SurfacePlane {
    /// Planes seen flatter than this (cosine) are taken to be wrong.
    const LEAST_COSINE: f64 = 0.1;
    let camera = &view.cameras.left;
    let eye = camera.model.cahv()[0];
    let sight = (eye - mark.point_m).normalize();
    let normal = fitted(mark, landmarks, camera, neighbour_px)
        .filter(|normal| normal.dot(&sight) > LEAST_COSINE);
    SurfacePlane {
        point: mark.point_m,
        normal: normal.unwrap_or(sight),
    }
}

/// Unit normal towards the camera; none from fewer than five neighbours.
fn fitted(
    mark: &Landmark,
    landmarks: &[Landmark],
    camera: &Camera,
    neighbour_px: f64,
) -> Option<Vector3<f64>> {
    const LEAST_N: usize = 5;
    let [eye, axis, ..] = camera.model.cahv();
    let inverse_range = |p: &Vector3<f64>| 1.0 / (p - eye).dot(axis);
    let (mut normal, mut right, mut n) = (Matrix3::zeros(), Vector3::zeros(), 0);
    for other in landmarks {
        let away = other.pixel_px - mark.pixel_px;
        if away.amax() > neighbour_px {
            continue;
        }
        let row = Vector3::new(1.0, away.x, away.y);
        normal += row * row.transpose();
        right += row * inverse_range(&other.point_m);
        n += 1;
    }
    if n < LEAST_N {
        return None;
    }
    let plane = normal.try_inverse()? * right;
    let place = |du: f64, dv: f64| -> Option<Vector3<f64>> {
        let inverse = plane.dot(&Vector3::new(1.0, du, dv));
        let ray = camera.ray(&(mark.pixel_px + Vector2::new(du, dv))).ok()?;
        let along = ray.direction.dot(axis) * inverse;
        (along > 0.0).then(|| eye + ray.direction.into_inner() / along)
    };
    let origin = place(0.0, 0.0)?;
    let across = place(neighbour_px, 0.0)? - origin;
    let down = place(0.0, neighbour_px)? - origin;
    let unit = down.cross(&across).try_normalize(1e-12)?;
    Some(if unit.dot(&(eye - origin)) < 0.0 {
        -unit
    } else {
        unit
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use rover_cameras::{Cahv, CameraModel};

    #[test]
    fn neighbours_on_a_plane_tell_its_normal() {
        let camera = Camera {
            model: CameraModel::Cahv(Cahv {
                c: Vector3::new(0.1, 0.0, 1.2),
                a: Vector3::x(),
                h: Vector3::new(200.0, -500.0, 0.0),
                v: Vector3::new(150.0, 0.0, -500.0),
            }),
            width_px: 400,
            height_px: 300,
        };
        let normal = Vector3::new(-0.3, 0.2, 1.0).normalize();
        let through = Vector3::new(4.0, 0.3, 0.1);
        let landmarks: Vec<Landmark> = (0..25)
            .map(|k| {
                let pixel_px = Vector2::new(
                    170.0 + f64::from(k % 5) * 15.0,
                    240.0 + f64::from(k / 5) * 12.0,
                );
                let ray = camera.ray(&pixel_px).unwrap();
                let range = normal.dot(&(through - ray.origin)) / normal.dot(&ray.direction);
                Landmark {
                    pixel_px,
                    point_m: ray.at(range),
                }
            })
            .collect();
        let found = fitted(&landmarks[12], &landmarks, &camera, 45.0).unwrap();
        assert!((found - normal).norm() < 1e-9, "{found}");
        assert!(fitted(&landmarks[12], &landmarks[10..14], &camera, 45.0).is_none());
    }
}
