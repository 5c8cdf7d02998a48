//! The unknowns: intrinsics of each camera, pose of the second, poses of the board.

use super::ModelKind;
use crate::{Cahv, Cahvor, Cahvore, Camera, CameraModel};
use nalgebra::{DVector, Isometry3, Translation3, UnitQuaternion, Vector3};

/// The unknowns at one point of the iteration.
#[derive(Clone, Debug)]
pub(super) struct Rig {
    pub(super) kind: ModelKind,
    /// Per camera: fx, fy, cx, cy, then tilt of O (2), r1, r2, then e0, e1, e2.
    pub(super) inner: Vec<Vec<f64>>,
    /// Takes the first camera's axes to the second's.
    pub(super) second_from_first: Option<Isometry3<f64>>,
    /// Takes the board's coordinates to the first camera's axes.
    pub(super) camera_from_board: Vec<Isometry3<f64>>,
}

const INNER: [&str; 11] = [
    "fx_px", "fy_px", "cx_px", "cy_px", "tilt_x", "tilt_y", "r1", "r2", "e0_m", "e1_m", "e2_m",
];
const POSE: [&str; 6] = [
    "turn_x_rad",
    "turn_y_rad",
    "turn_z_rad",
    "shift_x_m",
    "shift_y_m",
    "shift_z_m",
];
const SIDES: [&str; 2] = ["left", "right"];

/// Number of intrinsic parameters of a model.
pub(super) fn inner_n(kind: ModelKind) -> usize {
    match kind {
        ModelKind::Cahv => 4,
        ModelKind::Cahvor => 8,
        ModelKind::Cahvore { .. } => 11,
    }
}

/// Step of the central difference for intrinsic parameter `i`.
pub(super) fn difference_step(i: usize) -> f64 {
    if i < 4 { 1e-3 } else { 1e-6 }
}

/// The camera in its own axes; its image size is not needed here.
pub(super) fn own_camera(kind: ModelKind, inner: &[f64]) -> CameraModel {
    let at = |i: usize| inner.get(i).copied().unwrap_or(0.0);
    let (c, a) = (Vector3::zeros(), Vector3::z());
    let h = Vector3::new(at(0), 0.0, at(2));
    let v = Vector3::new(0.0, at(1), at(3));
    let o = Vector3::new(at(4), at(5), 1.0).normalize();
    let r = Vector3::new(0.0, at(6), at(7));
    match kind {
        ModelKind::Cahv => CameraModel::Cahv(Cahv { c, a, h, v }),
        ModelKind::Cahvor => CameraModel::Cahvor(Cahvor { c, a, h, v, o, r }),
        ModelKind::Cahvore { linearity } => CameraModel::Cahvore(Cahvore {
            c,
            a,
            h,
            v,
            o,
            r,
            e: Vector3::new(at(8), at(9), at(10)),
            linearity,
        }),
    }
}

/// A pose turned and shifted on its left side: angles (radians), then metres.
pub(super) fn nudged(pose: &Isometry3<f64>, by: &[f64]) -> Isometry3<f64> {
    let turn = UnitQuaternion::from_scaled_axis(Vector3::new(by[0], by[1], by[2]));
    let shift = Vector3::new(by[3], by[4], by[5]);
    Isometry3::from_parts(
        Translation3::from(pose.translation.vector + shift),
        turn * pose.rotation,
    )
}

impl Rig {
    /// Number of parameters of the cameras, which come first.
    pub(super) fn camera_n(&self) -> usize {
        self.inner.iter().map(Vec::len).sum::<usize>() + 6 * (self.inner.len() - 1)
    }

    /// Where the intrinsics of a camera start; the second's pose stands before its own.
    pub(super) fn inner_at(&self, camera: usize) -> usize {
        camera * (self.inner[0].len() + 6)
    }

    /// Where the pose of the second camera starts.
    pub(super) fn second_at(&self) -> usize {
        self.inner[0].len()
    }

    /// Where the pose of the board in a view starts.
    pub(super) fn board_at(&self, view: usize) -> usize {
        self.camera_n() + 6 * view
    }

    pub(super) fn moved(&self, step: &DVector<f64>) -> Rig {
        let step = step.as_slice();
        let mut rig = self.clone();
        for camera in 0..rig.inner.len() {
            let at = self.inner_at(camera);
            for (x, dx) in rig.inner[camera].iter_mut().zip(&step[at..]) {
                *x += dx;
            }
        }
        if let Some(pose) = &mut rig.second_from_first {
            let at = self.second_at();
            *pose = nudged(pose, &step[at..at + 6]);
        }
        for (view, pose) in rig.camera_from_board.iter_mut().enumerate() {
            let at = self.board_at(view);
            *pose = nudged(pose, &step[at..at + 6]);
        }
        rig
    }

    pub(super) fn names(&self) -> Vec<String> {
        let mut names = Vec::new();
        for (camera, inner) in self.inner.iter().enumerate() {
            let side = SIDES[camera];
            if camera > 0 {
                names.extend(POSE.map(|name| format!("{side}.{name}")));
            }
            names.extend(
                INNER[..inner.len()]
                    .iter()
                    .map(|name| format!("{side}.{name}")),
            );
        }
        names
    }

    /// The parameters of the cameras; the second's turn as a rotation vector.
    pub(super) fn values(&self) -> Vec<f64> {
        let mut values = Vec::new();
        for (camera, inner) in self.inner.iter().enumerate() {
            if let (1, Some(pose)) = (camera, &self.second_from_first) {
                values.extend(pose.rotation.scaled_axis().iter());
                values.extend(pose.translation.vector.iter());
            }
            values.extend(inner);
        }
        values
    }

    /// The cameras in the axes of the first.
    pub(super) fn cameras(&self, sizes_px: &[[u32; 2]]) -> Vec<Camera> {
        let of = |(n, (inner, size)): (usize, (&Vec<f64>, &[u32; 2]))| {
            let camera = Camera {
                model: own_camera(self.kind, inner),
                width_px: size[0],
                height_px: size[1],
            };
            match (&self.second_from_first, n) {
                (Some(pose), 1) => camera.transformed(&pose.inverse()),
                _ => camera,
            }
        };
        self.inner
            .iter()
            .zip(sizes_px)
            .enumerate()
            .map(of)
            .collect()
    }
}
