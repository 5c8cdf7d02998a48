//! A small testbed: rough ground, stones, a jointed arm with a marked plate, a pair of cameras.
#![allow(dead_code, clippy::unwrap_used, clippy::expect_used)]

use nalgebra::{Isometry3, Rotation3, Translation3, Unit, UnitQuaternion, Vector3};
use rover_cameras::{Cahvor, Camera, CameraModel};
use rover_render::{
    CameraId, DynamicPart, FrameState, ImagingParameters, Mesh, Plate, Renderer, Scene, Sky,
    StaticMesh, Sun, Surface, shapes,
};
use std::sync::Arc;

pub fn camera(eye: Vector3<f64>, target: Vector3<f64>, size: [u32; 2], focal_px: f64) -> Camera {
    let a = (target - eye).normalize();
    let right = a.cross(&Vector3::z()).normalize();
    let h = right * focal_px + a * (f64::from(size[0]) - 1.0) * 0.5;
    let v = a.cross(&right) * focal_px + a * (f64::from(size[1]) - 1.0) * 0.5;
    let r = Vector3::new(0.001, -0.06, 0.02);
    let model = CameraModel::Cahvor(Cahvor {
        c: eye,
        a,
        h,
        v,
        o: a,
        r,
    });
    Camera {
        model,
        width_px: size[0],
        height_px: size[1],
    }
}

pub fn sun() -> Sun {
    Sun {
        direction_to_sun: Unit::new_normalize(Vector3::new(-0.35, 0.85, 0.72)),
        intensity: 1.0,
        ambient: 0.16,
    }
}

pub fn height(x: f64, y: f64) -> f64 {
    0.03 * shapes::fractal_noise(&Vector3::new(x / 0.6, y / 0.6, 0.0), 11, 5, 0.45)
}

pub fn ground(cells: usize) -> Mesh {
    let lines: Vec<f64> = (0..=cells)
        .map(|i| 4.0 * i as f64 / cells as f64 - 2.0)
        .collect();
    shapes::heightfield_mesh(&lines, &lines, height)
}

pub fn statics() -> Vec<StaticMesh> {
    let mut out = vec![StaticMesh {
        mesh: ground(160),
        surface: Surface::ground(1),
    }];
    for (seed, x, y, radius) in [
        (5, 0.8, -0.1, 0.15),
        (6, 0.6, 0.25, 0.07),
        (7, 1.2, 0.3, 0.1),
    ] {
        let lift = Translation3::new(x, y, height(x, y) + 0.2 * radius);
        let mesh = shapes::rock(seed, radius, 4, 0.3).transformed(&lift.into());
        out.push(StaticMesh {
            mesh,
            surface: Surface::rock(seed as u32),
        });
    }
    out
}

pub fn marks(x: f64, y: f64) -> Option<f64> {
    Some(if (x.abs() - 0.02).hypot(y.abs() - 0.02) < 0.008 {
        0.04
    } else {
        0.5
    })
}

pub fn arm() -> (Vec<DynamicPart>, Vec<Plate>) {
    let link = DynamicPart {
        mesh: shapes::capsule(0.03, 0.5, 32),
        surface: Surface::paint(0.4, 2),
    };
    let mut tool = shapes::cylinder(0.03, 0.06, 32);
    tool.append(&shapes::cone(0.02, 0.004, 0.12, 32));
    let tool = DynamicPart {
        mesh: tool,
        surface: Surface::metal(3),
    };
    let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), -std::f64::consts::FRAC_PI_2);
    let plate = Plate {
        part: 1,
        part_from_plate: Isometry3::from_parts(Translation3::new(-0.033, 0.0, 0.0), turn.into()),
        half_width_m: 0.04,
        half_height_m: 0.04,
        albedo: Arc::new(marks),
        blank_albedo: 0.5,
        back_albedo: 0.3,
    };
    (vec![link, tool], vec![plate])
}

pub fn state(step: f64) -> FrameState {
    let elbow = Vector3::new(0.3, -0.3, 0.5);
    let wrist = Vector3::new(0.6 + 0.02 * step, -0.1 + 0.03 * step, 0.35);
    let z = wrist - elbow;
    let turn = UnitQuaternion::rotation_between(&Vector3::z(), &z).unwrap();
    let tool = UnitQuaternion::from_euler_angles(std::f64::consts::PI, -0.3, 0.1 * step);
    FrameState {
        part_poses: vec![
            Isometry3::from_parts(elbow.into(), turn),
            Isometry3::from_parts((wrist - Vector3::z() * 0.07).into(), tool),
        ],
        pattern_visible: true,
    }
}

pub fn pair() -> [Camera; 2] {
    [0.04, -0.04].map(|y| {
        let eye = Vector3::new(0.05, y, 0.8);
        camera(eye, eye + Vector3::new(0.7, 0.0, -0.7), [320, 240], 301.0)
    })
}

pub fn renderer() -> (Renderer, CameraId, CameraId) {
    let (parts, plates) = arm();
    let scene = Scene::new(statics(), parts, plates, sun(), Sky::default()).unwrap();
    let mut renderer = Renderer::new(scene);
    let [l, r] = pair();
    let left = renderer
        .add_camera(&l, ImagingParameters::default())
        .unwrap();
    let right = renderer
        .add_camera(&r, ImagingParameters::default())
        .unwrap();
    (renderer, left, right)
}
