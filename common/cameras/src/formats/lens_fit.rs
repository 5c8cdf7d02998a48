//! The parameters of a pinhole camera with a lens, for fitting it to a camera of the CAHV family:
//! where to begin, and the camera that they make.

use super::fit::{Fitting, nudged};
use super::lens::{Lens, LensCamera};
use crate::{Camera, CameraModel};
use nalgebra::{DVector, Isometry3, Translation3, UnitQuaternion, Vector3};

/// The lens models that other tools read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Family {
    /// k1, k2, p1, p2 (Kalibr `radtan`).
    RadialTangential,
    /// k1, k2, p1, p2, k3 (ROS `plumb_bob`).
    PlumbBob,
    /// k1, k2, p1, p2, k3, k4, k5, k6 (ROS `rational_polynomial`).
    Rational,
    /// k1, k2, k3, k4 of the angle (ROS `equidistant`, OpenCV fisheye, Kalibr `equidistant`).
    Equidistant,
}

impl Family {
    /// What the families are called in messages.
    pub(super) fn names(families: &[Self]) -> String {
        let name = |family: &Self| match family {
            Self::RadialTangential => "radtan",
            Self::PlumbBob => "plumb_bob",
            Self::Rational => "rational_polynomial",
            Self::Equidistant => "equidistant",
        };
        let all: Vec<_> = families.iter().map(name).collect();
        format!("a pinhole camera with a lens {}", all.join(" or "))
    }
}

/// The pinhole camera that the formulas give for a model with unit axes.
pub(super) fn start_of(camera: &Camera, family: Family) -> LensCamera {
    let terms = camera.intrinsics();
    let rotation = UnitQuaternion::from_rotation_matrix(&terms.camera_from_model.inverse());
    let r = camera.model.lens().map_or(Vector3::zeros(), |[_, r]| *r);
    let stretch = 1.0 + r.x;
    let (r1, r2) = (r.y / stretch, r.z / stretch);
    // tan(L t) / L = t (1 + L^2 t^2 / 3 + 2 L^4 t^4 / 15 + ...), sin(L t) / L = t (1 - ...).
    let l = match &camera.model {
        CameraModel::Cahvore(m) => m.linearity,
        _ => 1.0,
    };
    let l2 = l * l;
    let lens = if family == Family::Equidistant {
        let k = if l == 0.0 {
            [r1, r2, 0.0, 0.0]
        } else if l > 0.0 {
            [l2 / 3.0 + r1, 2.0 * l2 * l2 / 15.0 + r1 + r2, 0.0, 0.0]
        } else {
            [-l2 / 6.0 + r1, r2, 0.0, 0.0]
        };
        Lens::Equidistant { k }
    } else if matches!(camera.model, CameraModel::Cahvore(_)) && l < 1.0 {
        // An angle narrower than its tangent, by (1 + t^2 / 3)^-1 and its like.
        let bend = (1.0 - l2) / 3.0;
        let k = if family == Family::Rational {
            [0.0, 0.0, 0.0, bend, 0.0, 0.0]
        } else {
            [0.0; 6]
        };
        Lens::Polynomial { k, p: [0.0; 2] }
    } else {
        Lens::Polynomial {
            k: [r1, r2, 0.0, 0.0, 0.0, 0.0],
            p: [0.0; 2],
        }
    };
    LensCamera {
        frame_from_camera: Isometry3::from_parts(Translation3::from(terms.position), rotation),
        focal_px: [terms.hs * stretch, terms.vs * stretch],
        centre_px: [terms.hc, terms.vc],
        size_px: [camera.width_px, camera.height_px],
        lens,
    }
}

/// Parameters: turn and shift (6; a shift only for a moving pupil), fx, fy, cx, cy, coefficients.
pub(super) fn lens_start(start: &LensCamera, family: Family, moving: bool) -> DVector<f64> {
    let mut x0 = vec![0.0; pose_n(moving)];
    x0.extend(start.focal_px);
    x0.extend(start.centre_px);
    match (&start.lens, family) {
        (Lens::Equidistant { k }, _) => x0.extend(k),
        (Lens::Polynomial { k, .. }, Family::Rational) => {
            x0.extend([k[0], k[1], 0.0, 0.0]);
            x0.extend(&k[2..]);
        }
        (Lens::Polynomial { k, .. }, Family::PlumbBob) => {
            x0.extend([k[0], k[1], 0.0, 0.0, 0.0]);
        }
        (Lens::Polynomial { k, .. }, _) => x0.extend([k[0], k[1], 0.0, 0.0]),
    }
    DVector::from_vec(x0)
}

fn pose_n(moving: bool) -> usize {
    if moving { 6 } else { 3 }
}

pub(super) fn lens_fitting(
    start: &LensCamera,
    family: Family,
    moving: bool,
) -> Fitting<'_, LensCamera> {
    let pose_n = pose_n(moving);
    let mut steps = DVector::repeat(lens_start(start, family, moving).len(), 1e-6);
    steps.rows_mut(pose_n, 4).fill(1e-3);
    let build = move |x: &DVector<f64>| {
        let (pose, rest) = x.as_slice().split_at(pose_n);
        let mut by = [0.0; 6];
        by[..pose_n].copy_from_slice(pose);
        let c = &rest[4..];
        let at = |i: usize| c.get(i).copied().unwrap_or(0.0);
        let lens = match start.lens {
            Lens::Equidistant { .. } => Lens::Equidistant {
                k: [at(0), at(1), at(2), at(3)],
            },
            Lens::Polynomial { .. } => Lens::Polynomial {
                k: [at(0), at(1), at(4), at(5), at(6), at(7)],
                p: [at(2), at(3)],
            },
        };
        let camera = LensCamera {
            frame_from_camera: nudged(&start.frame_from_camera, &by),
            focal_px: [rest[0], rest[1]],
            centre_px: [rest[2], rest[3]],
            size_px: start.size_px,
            lens,
        };
        camera.validate().is_ok().then_some(camera)
    };
    Fitting {
        steps,
        build: Box::new(build),
        project: LensCamera::project,
    }
}
