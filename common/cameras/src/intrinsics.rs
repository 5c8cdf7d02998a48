//! Between CAHV vectors and the pinhole terms: focal lengths, principal point, orientation.

use crate::{Cahv, Cahvor, Camera, CameraModel};
use nalgebra::{Isometry3, Matrix3, Rotation3, Unit, Vector2, Vector3};

/// What the vectors of a model say in pinhole terms.
///
/// Computed from A, H, V as the projection uses them, so that a common scale of the three (which
/// changes no pixel) changes nothing here; for a unit A they are the classical
/// `hc = A.H`, `vc = A.V`, `hs = |A x H|`, `vs = |A x V|`. A distorted model has these values
/// before its distortion: near the optical axis its scale is larger by `1 + r0`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Horizontal focal length, px.
    pub hs: f64,
    /// Vertical focal length, px.
    pub vs: f64,
    /// Horizontal pixel coordinate of the boresight A, px.
    pub hc: f64,
    /// Vertical pixel coordinate of the boresight A, px.
    pub vc: f64,
    /// Angle from V' to H' about A, radians: -pi/2 for a rectangular pixel grid (the JPL sign),
    /// +pi/2 for a mirrored image.
    pub theta_rad: f64,
    /// Projection centre C in the model's frame, metres.
    pub position: Vector3<f64>,
    /// Rotation from the model's frame to the camera's axes: x along H' (right), z along A
    /// (forward), y completing the right hand (down). Its rows are those axes.
    pub camera_from_model: Rotation3<f64>,
    /// The pixel of the optical axis O, the centre of distortion; `None` for a linear model.
    pub distortion_centre_px: Option<Vector2<f64>>,
}

impl Camera {
    /// The model in pinhole terms. Meaningful for a model that passes [`Self::validate`].
    pub fn intrinsics(&self) -> Intrinsics {
        let [c, a, h, v] = self.model.cahv();
        let a2 = a.norm_squared();
        let z = a / a2.sqrt();
        let (hc, vc) = (a.dot(h) / a2, a.dot(v) / a2);
        let (across_h, across_v) = (h - a * hc, v - a * vc);
        let (length_h, length_v) = (across_h.norm(), across_v.norm());
        let (x, v_unit) = (across_h / length_h, across_v / length_v);
        let axes = Matrix3::from_rows(&[x.transpose(), z.cross(&x).transpose(), z.transpose()]);
        Intrinsics {
            hs: length_h / a2.sqrt(),
            vs: length_v / a2.sqrt(),
            hc,
            vc,
            theta_rad: v_unit.cross(&x).dot(&z).atan2(v_unit.dot(&x)),
            position: *c,
            camera_from_model: Rotation3::from_matrix_unchecked(axes),
            distortion_centre_px: self
                .model
                .lens()
                .map(|[o, _]| Vector2::new(o.dot(h), o.dot(v)) / o.dot(a)),
        }
    }

    /// A CAHV camera from its pose and pinhole terms.
    ///
    /// `model_from_camera` takes coordinates in the camera's axes (x right, y down, z forward) to
    /// the model's frame; its translation is the projection centre, metres. `focal_px` is
    /// `[fx, fy]`, `centre_px` the principal point `[cx, cy]`, `size_px` `[width, height]`.
    /// Check the result with [`Self::validate`] if the numbers come from outside.
    pub fn pinhole(
        model_from_camera: &Isometry3<f64>,
        focal_px: [f64; 2],
        centre_px: [f64; 2],
        size_px: [u32; 2],
    ) -> Camera {
        let [x, y, a] = [Vector3::x(), Vector3::y(), Vector3::z()]
            .map(|axis| model_from_camera.rotation * axis);
        let model = CameraModel::Cahv(Cahv {
            c: model_from_camera.translation.vector,
            a,
            h: x * focal_px[0] + a * centre_px[0],
            v: y * focal_px[1] + a * centre_px[1],
        });
        Camera {
            model,
            width_px: size_px[0],
            height_px: size_px[1],
        }
    }

    /// A CAHVOR camera from its pose, pinhole terms and distortion.
    ///
    /// As [`Self::pinhole`]; `axis_in_camera` is the optical axis O in the camera's axes (+z for
    /// a lens mounted true) and `r` the distortion coefficients `[r0, r1, r2]`. With O along +z
    /// the model equals the OpenCV radial one with `f = (1 + r0) focal_px`,
    /// `k1 = r1 / (1 + r0)`, `k2 = r2 / (1 + r0)`.
    pub fn pinhole_distorted(
        model_from_camera: &Isometry3<f64>,
        focal_px: [f64; 2],
        centre_px: [f64; 2],
        size_px: [u32; 2],
        axis_in_camera: &Unit<Vector3<f64>>,
        r: [f64; 3],
    ) -> Camera {
        let camera = Self::pinhole(model_from_camera, focal_px, centre_px, size_px);
        let [c, a, h, v] = camera.model.cahv().map(Clone::clone);
        let o = model_from_camera.rotation * axis_in_camera.as_ref();
        Camera {
            model: CameraModel::Cahvor(Cahvor {
                c,
                a,
                h,
                v,
                o,
                r: r.into(),
            }),
            ..camera
        }
    }
}
