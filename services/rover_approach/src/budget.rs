//! The error of the target's position along its surface, by source.
//!
//! Errors are pixels of some image, and what a pixel covers of a surface is an ellipse: range over
//! focal length across the sight line, and along it longer by the cosine between the sight line and
//! the normal. Of ground seen from 8 m and 1.3 m up a pixel covers 6 mm by 37 mm. Covariances are
//! kept in the site frame, in which the rover moves.

use crate::first_ray::FirstRayFix;
use crate::fix::{Attempt, Fix};
use crate::handover::Handover;
use crate::surface::{StereoPlane, SurfacePlane};
use nalgebra::{Matrix3, Unit, UnitQuaternion, Vector3};
use rover_cameras::Camera;
use rover_messages::approach::ErrorShare;

/// Part of a relief correction that is taken to remain.
const RELIEF_REST: f64 = 0.5;
/// Smallest error of one match that is claimed, px.
const MATCH_FLOOR_PX: f64 = 0.05;
/// Less than this is never claimed for all of tracking, px of the image in which the target was
/// named, one sigma: matches from anchor to anchor share errors that none of them shows. Of 142
/// placements 95 % had lost no more than 0.33 px on the way. With 0.16 the servo's bound held in 76
/// of 82 others.
const TRACKING_FLOOR_PX: f64 = 0.18;
/// What shape, cameras and body do besides, one sigma along the surface, m.
const UNMODELLED_M: f64 = 0.5e-3;

/// What tracking loses in 95 % of approaches at most, px of the image in which the target was named.
const FORECAST_PX: f64 = 0.4;
/// 95 % of the errors of hand-over, servo and contact together, mm. With both, 97 % of the 142
/// placements that they were fitted to ended within the forecast, on rock and on ground alike.
const FORECAST_ARM_MM: f64 = 2.0;

/// Standard deviations of one axis that hold 95 %.
const SIGMAS_95: f64 = 1.96;

/// Flatter than this (cosine) no surface is taken to be seen.
const LEAST_COSINE: f64 = 0.05;

/// Where an image was taken, for what its pixels cover.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Standpoint<'a> {
    /// Believed model, rover frame of then, m.
    pub camera: &'a Camera,
    /// The rover then.
    pub site_from_rover: UnitQuaternion<f64>,
}

impl Standpoint<'_> {
    /// What the unit circle of pixels covers of a surface (rover frame of then): the covariance
    /// along the surface of an error of one pixel, site frame, m^2 per px^2.
    fn pixel_m2(&self, surface: &SurfacePlane) -> Matrix3<f64> {
        let [eye, _, horizontal, _] = self.camera.model.cahv();
        let normal = surface.normal;
        let sight = surface.point - eye;
        let across_m = sight.norm() / horizontal.norm();
        let cosine = normal.dot(&sight).abs() / sight.norm();
        let cosine = cosine.clamp(LEAST_COSINE, 1.0);
        let plane = Matrix3::identity() - normal * normal.transpose();
        let mut covers = plane * (across_m * across_m);
        if let Some(flat) = Unit::try_new(plane * sight, 1e-9) {
            let longer = across_m * across_m * (cosine.powi(-2) - 1.0);
            covers += flat.into_inner() * flat.transpose() * longer;
        }
        let turn = self.site_from_rover.to_rotation_matrix();
        turn * covers * turn.transpose()
    }
}

/// Covariances along the surface by source, site frame, m^2.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Budget {
    /// Of one pixel of the image in which the target was named.
    named_px: Matrix3<f64>,
    /// What an earlier approach has lost.
    lost: Matrix3<f64>,
    tracking: Matrix3<f64>,
    relief: Matrix3<f64>,
    handover: Matrix3<f64>,
    /// Of the body pair's range, in any direction.
    stereo: f64,
}

impl Budget {
    /// At the designation; `lost` is what an earlier approach has lost, site frame, m^2.
    pub fn designated(surface: &StereoPlane, from: &Standpoint<'_>, lost: &[[f64; 3]; 3]) -> Self {
        Self {
            named_px: from.pixel_m2(&surface.plane),
            lost: Matrix3::from_fn(|i, j| lost[i][j]),
            ..Self::default()
        }
    }

    /// Error along the surface that 95 % of placements stay below, mm, as it can be told from the
    /// image in which the target was named: what tracking loses over an approach is so many of
    /// that image's pixels, whatever the range, and a pixel of a surface seen flat covers much.
    pub fn forecast_mm(&self) -> f64 {
        let earlier_mm = SIGMAS_95 * longest(&self.lost) * 1e3;
        let tracking_mm = FORECAST_PX * longest(&self.named_px) * 1e3;
        tracking_mm.hypot(FORECAST_ARM_MM).hypot(earlier_mm)
    }

    /// All tracking, that of this approach not below its floor.
    fn tracking(&self) -> Matrix3<f64> {
        let floor = self.named_px * (TRACKING_FLOOR_PX * TRACKING_FLOOR_PX);
        let own = if self.tracking.trace() > floor.trace() {
            self.tracking
        } else {
            floor
        };
        own + self.lost
    }

    /// What this approach and those before it have lost of the place named first, site frame, m^2.
    pub fn lost_m2(&self) -> [[f64; 3]; 3] {
        let lost = self.tracking() + self.relief;
        [0, 1, 2].map(|i| [0, 1, 2].map(|j| lost[(i, j)]))
    }

    /// One more match against an anchor; only where a new anchor is made does its error stay.
    pub fn tracked(&mut self, fix: &Fix, from: &Standpoint<'_>) {
        if fix.anchored || fix.attempt == Attempt::LastStop {
            let pixel = from.pixel_m2(&fix.surface.plane);
            self.tracking += pixel * fix.sigma_px.max(MATCH_FLOOR_PX).powi(2);
            self.relief += pixel * (RELIEF_REST * fix.relief_px.norm()).powi(2);
        }
    }

    /// Tracking and relief together, one sigma along the longest axis, m.
    pub fn tracking_m(&self) -> f64 {
        longest(&(self.tracking + self.relief))
    }

    /// The first ray takes the place of all tracking.
    pub fn met(&mut self, met: &FirstRayFix) {
        self.tracking = Matrix3::identity() * met.sigma_m.powi(2);
        self.relief = Matrix3::zeros();
    }

    /// After the hand-over.
    pub fn handed(&mut self, found: &Handover, from: &Standpoint<'_>) {
        self.handover = from.pixel_m2(&found.surface.plane) * found.sigma_px.powi(2);
        self.stereo = found.surface.covariance_m2.trace() / 3.0;
    }

    /// Covariance of the error since the designation along a surface with this normal (unit
    /// vector, site frame), site frame, m^2; the body pair's stereo is in the target's own.
    pub fn along(&self, normal: &Vector3<f64>) -> Matrix3<f64> {
        let unmodelled = Matrix3::identity() * (UNMODELLED_M * UNMODELLED_M);
        let all = self.tracking() + self.relief + self.handover + unmodelled;
        let plane = Matrix3::identity() - normal * normal.transpose();
        plane * all * plane
    }

    /// The shares, one sigma along the longest axis each; that of the designation is the rounding
    /// to a pixel, the person's own.
    pub fn shares(&self) -> Vec<ErrorShare> {
        [
            ("designation", longest(&self.named_px) / 12.0_f64.sqrt()),
            ("tracking", longest(&self.tracking())),
            ("relief", longest(&self.relief)),
            ("handover", longest(&self.handover)),
            ("stereo", self.stereo.sqrt()),
            ("unmodelled", UNMODELLED_M),
        ]
        .map(|(source, sigma_m)| ErrorShare {
            source: source.into(),
            sigma_mm: sigma_m * 1e3,
        })
        .into()
    }
}

/// Standard deviation along the longest axis of a covariance.
fn longest(covariance: &Matrix3<f64>) -> f64 {
    covariance.symmetric_eigenvalues().max().max(0.0).sqrt()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use rover_cameras::{Cahv, CameraModel};

    /// Spread on the plane of where the rays of pixels about the target's meet it.
    #[test]
    fn a_pixel_covers_what_the_rays_through_its_circle_meet() {
        let camera = Camera {
            model: CameraModel::Cahv(Cahv {
                c: Vector3::new(0.3, 0.1, 1.3),
                a: Vector3::x(),
                h: Vector3::new(500.0, -1300.0, 0.0),
                v: Vector3::new(400.0, 0.0, -1300.0),
            }),
            width_px: 1001,
            height_px: 801,
        };
        let turned = UnitQuaternion::from_euler_angles(0.0, 0.0, 0.7);
        let normal = Vector3::new(-0.1, 0.05, 1.0).normalize();
        let point = Vector3::new(7.0, -1.0, 0.1);
        let plane = SurfacePlane { point, normal };
        let centre = camera.project(&point).unwrap();
        let mut brute = Matrix3::zeros();
        const N: u32 = 720;
        for k in 0..N {
            let angle = std::f64::consts::TAU * f64::from(k) / f64::from(N);
            // small, since what a pixel covers grows with the range
            let offset = nalgebra::Vector2::new(angle.cos(), angle.sin()) * 0.01;
            let ray = camera.ray(&(centre + offset)).unwrap();
            let way = normal.dot(&(point - ray.origin)) / normal.dot(&ray.direction);
            let apart = turned * (ray.at(way) - point) / 0.01;
            // the mean square over a circle is half the radius squared along each axis
            brute += apart * apart.transpose() * (2.0 / f64::from(N));
        }
        let from = Standpoint {
            camera: &camera,
            site_from_rover: turned,
        };
        let found = from.pixel_m2(&plane);
        // the image's plane does not stand square to the sight line: a few per cent
        let apart = (found - brute).norm() / brute.norm();
        assert!(apart < 0.06, "{apart}: {found} {brute}");
        assert!(longest(&found) > 3.0 * (point.norm() / 1300.0), "{found}");
    }

    #[test]
    fn the_error_along_a_surface_has_no_part_along_its_normal() {
        let budget = Budget {
            named_px: Matrix3::from_diagonal(&Vector3::new(1e-4, 1e-6, 1e-6)),
            ..Budget::default()
        };
        let normal = Vector3::new(0.6, 0.0, 0.8);
        let along = budget.along(&normal);
        assert!((along * normal).norm() < 1e-15);
        assert!(along[(1, 1)] > 0.0);
    }
}
