//! The map from a template to another image that a plane through the target induces.
//!
//! A template is a window of pixels about the anchor pixel; `d` (px) is the offset from it. The
//! ray of `d` meets the plane of the surface in one point, which is a projective function of `d`:
//! with the camera's centre `c`, the ray's direction `b(d) = b0 + bu du + bv dv` and the plane
//! `n . x = k`, in homogeneous coordinates
//!
//! ```text
//! x(d) ~ [ c (n . b(d)) + b(d) (k - n . c) ;  n . b(d) ]          a 4 x 3 matrix times [du dv 1]
//! ```
//!
//! Motion of the rover multiplies the matrix from the left, what the images say (an affine
//! correction of `d`) from the right; a better plane slides the points along the rays on which they
//! are seen. So the matrix is the chain of all accepted warps, without loss. With a distorting lens
//! `b(d)` is its tangent at the anchor pixel; projection into the other image uses the full model.

use crate::surface::SurfacePlane;
use nalgebra::{Isometry3, Matrix2, Matrix3, Matrix4x3, UnitQuaternion, Vector2, Vector3};
use rover_cameras::Camera;

/// Where the pixels of a template lie in space; see the module's text.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlaneWarp {
    space_from_template: Matrix4x3<f64>,
}

/// Planes seen flatter than this (cosine) carry no template.
const MIN_COSINE: f64 = 0.02;

impl PlaneWarp {
    /// The warp of a template about `pixel_px` of `camera` on `plane` (camera's frame); `None` if
    /// the plane is seen edge on or from behind, or the pixel has no ray.
    #[must_use]
    pub fn new(camera: &Camera, pixel_px: &Vector2<f64>, plane: &SurfacePlane) -> Option<Self> {
        let (ray, turn) = camera.ray_with_jacobian(pixel_px).ok()?;
        let axis = camera.model.cahv()[1];
        // direction / (direction . axis) is linear in the pixel for a perspective camera
        let b0 = ray.direction.into_inner();
        let depth = b0.dot(axis);
        if !(depth > 0.0) {
            return None;
        }
        let slope = |k: usize| {
            let column = turn.column(k).into_owned();
            (column - b0 * (column.dot(axis) / depth)) / depth
        };
        let directions = Matrix3::from_columns(&[slope(0), slope(1), b0 / depth]);
        Self::from_rays(&ray.origin, &directions, plane)
    }

    fn from_rays(
        origin: &Vector3<f64>,
        directions: &Matrix3<f64>,
        plane: &SurfacePlane,
    ) -> Option<Self> {
        let n = &plane.normal;
        let distance = n.dot(&(plane.point - origin));
        let along = n.transpose() * directions;
        let centre = directions.column(2).norm();
        if !(along[2].abs() > MIN_COSINE * centre && along[2] * distance > 0.0) {
            return None;
        }
        let mut m = Matrix4x3::zeros();
        m.fixed_view_mut::<3, 3>(0, 0)
            .copy_from(&(origin * along + directions * distance));
        m.fixed_view_mut::<1, 3>(3, 0).copy_from(&along);
        let scale = 1.0 / m[(3, 2)];
        let m = m * scale;
        m.iter().all(|x| x.is_finite()).then_some(Self {
            space_from_template: m,
        })
    }

    /// The point of space that template offset `d` (px) lies on; `None` beyond the horizon.
    #[must_use]
    pub fn point(&self, d: &Vector2<f64>) -> Option<Vector3<f64>> {
        let x = self.space_from_template * Vector3::new(d.x, d.y, 1.0);
        (x.w > 1e-9).then(|| x.xyz() / x.w)
    }

    /// Where `camera` sees template offset `d` (px).
    #[must_use]
    pub fn pixel(&self, camera: &Camera, d: &Vector2<f64>) -> Option<Vector2<f64>> {
        camera.project(&self.point(d)?).ok()
    }

    /// The warp in another frame (the rover has moved).
    #[must_use]
    pub fn moved(&self, to_from: &Isometry3<f64>) -> Self {
        Self {
            space_from_template: to_from.to_homogeneous() * self.space_from_template,
        }
    }

    /// The warp after an affine correction: offset `d` now lies where `shift + turn d` lay.
    #[must_use]
    pub fn adjusted(&self, shift: &Vector2<f64>, turn: &Matrix2<f64>) -> Option<Self> {
        let a = Matrix3::new(
            turn[(0, 0)],
            turn[(0, 1)],
            shift.x,
            turn[(1, 0)],
            turn[(1, 1)],
            shift.y,
            0.0,
            0.0,
            1.0,
        );
        let m = self.space_from_template * a;
        let w = m[(3, 2)];
        (w > 1e-9 && w.is_finite()).then(|| Self {
            space_from_template: m / w,
        })
    }

    /// The same pixels of `camera`, but on `plane`: every point slides along the ray on which the
    /// camera sees it.
    #[must_use]
    pub fn onto(&self, camera: &Camera, plane: &SurfacePlane) -> Option<Self> {
        let origin = camera.model.cahv()[0];
        let m = &self.space_from_template;
        let w = m.fixed_view::<1, 3>(3, 0).into_owned();
        let directions = m.fixed_view::<3, 3>(0, 0).into_owned() - origin * w;
        Self::from_rays(origin, &directions, plane)
    }

    /// The template offset (px) whose ray `pixel_px` of `camera` sees, whatever its range.
    #[must_use]
    pub fn offset(&self, camera: &Camera, pixel_px: &Vector2<f64>) -> Option<Vector2<f64>> {
        let origin = camera.model.cahv()[0];
        let m = &self.space_from_template;
        let w = m.fixed_view::<1, 3>(3, 0).into_owned();
        let directions = m.fixed_view::<3, 3>(0, 0).into_owned() - origin * w;
        let ray = camera.ray(pixel_px).ok()?.direction.into_inner();
        let d = directions.try_inverse()? * ray;
        (d.z > 1e-12).then(|| d.xy() / d.z)
    }

    /// Turns the points about the camera's centre so that the template's middle is seen at
    /// `pixel_px`: what an error of heading or pointing does. Also returns the turn as a transform
    /// of the rover frame.
    #[must_use]
    pub fn turned_to(
        &self,
        camera: &Camera,
        pixel_px: &Vector2<f64>,
    ) -> Option<(Self, Isometry3<f64>)> {
        let origin = *camera.model.cahv()[0];
        let from = self.point(&Vector2::zeros())? - origin;
        let to = camera.ray(pixel_px).ok()?.direction.into_inner();
        let rotation = UnitQuaternion::rotation_between(&from, &to)?;
        let turn = Isometry3::from_parts((origin - rotation * origin).into(), rotation);
        Some((self.moved(&turn), turn))
    }

    /// Derivative of the pixel in `camera` with respect to `d` at the template's middle.
    #[must_use]
    pub fn jacobian(&self, camera: &Camera) -> Option<Matrix2<f64>> {
        let x0 = self.space_from_template.column(2);
        let point = x0.xyz() / x0.w;
        let seen = camera.project_with_jacobian(&point).ok()?;
        let slope = |k: usize| {
            let column = self.space_from_template.column(k);
            (column.xyz() - point * column.w) / x0.w
        };
        Some(Matrix2::from_columns(&[
            seen.jacobian * slope(0),
            seen.jacobian * slope(1),
        ]))
    }
}
