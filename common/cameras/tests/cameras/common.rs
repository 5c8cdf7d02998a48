//! The reference models and vectors, shared by the tests of this crate.

use nalgebra::{Matrix2x3, Matrix3x2, Vector2, Vector3};
use rover_cameras::{Cahv, Cahvor, Cahvore, Camera, CameraModel};
use serde_json::Value;

/// One model of the reference file with the projections that the JPL library computed for it.
pub struct Reference {
    pub name: String,
    pub camera: Camera,
    /// `hs`, `vs`, `hc`, `vc` by the JPL formulas, which take A to be a unit vector.
    pub derived: [f64; 4],
    pub rays: Vec<RayVector>,
    pub projections: Vec<ProjectionVector>,
}

pub struct RayVector {
    pub pixel_px: Vector2<f64>,
    pub origin: Vector3<f64>,
    pub direction: Vector3<f64>,
    pub jacobian: Matrix3x2<f64>,
}

pub struct ProjectionVector {
    pub point: Vector3<f64>,
    pub pixel_px: Vector2<f64>,
    pub range_m: f64,
    pub jacobian: Matrix2x3<f64>,
}

pub fn references() -> Vec<Reference> {
    let text = include_str!("../data/jpl_cmod_vectors.json");
    let root: Value = serde_json::from_str(text).unwrap();
    list(&root["models"]).iter().map(reference).collect()
}

fn reference(model: &Value) -> Reference {
    let vector = |name: &str| Vector3::from_row_slice(&numbers(&model[name]));
    let (c, a, h, v) = (vector("C"), vector("A"), vector("H"), vector("V"));
    let camera_model = match model["type"].as_str().unwrap() {
        "CAHV" => CameraModel::Cahv(Cahv { c, a, h, v }),
        "CAHVOR" => CameraModel::Cahvor(Cahvor {
            c,
            a,
            h,
            v,
            o: vector("O"),
            r: vector("R"),
        }),
        "CAHVORE" => CameraModel::Cahvore(Cahvore {
            c,
            a,
            h,
            v,
            o: vector("O"),
            r: vector("R"),
            e: vector("E"),
            linearity: match model["mtype"].as_i64().unwrap() {
                1 => 1.0,
                2 => 0.0,
                _ => model["mparm"].as_f64().unwrap(),
            },
        }),
        other => panic!("unexpected type {other}"),
    };
    let size = numbers(&model["size_wh"]);
    let vectors = &model["test_vectors_jpl_cmod"];
    Reference {
        name: model["name"].as_str().unwrap().to_owned(),
        camera: Camera {
            model: camera_model,
            width_px: size[0] as u32,
            height_px: size[1] as u32,
        },
        derived: ["hs", "vs", "hc", "vc"].map(|k| model["derived"][k].as_f64().unwrap()),
        rays: list(&vectors["pixel_to_ray"])
            .iter()
            .map(|v| RayVector {
                pixel_px: Vector2::from_row_slice(&numbers(&v["px"])),
                origin: Vector3::from_row_slice(&numbers(&v["origin"])),
                direction: Vector3::from_row_slice(&numbers(&v["ray"])),
                jacobian: Matrix3x2::from_row_slice(&rows(&v["d_ray_d_px"])),
            })
            .collect(),
        projections: list(&vectors["point_to_pixel"])
            .iter()
            .map(|v| ProjectionVector {
                point: Vector3::from_row_slice(&numbers(&v["P"])),
                pixel_px: Vector2::from_row_slice(&numbers(&v["px"])),
                range_m: v["range_along_A"].as_f64().unwrap(),
                jacobian: Matrix2x3::from_row_slice(&rows(&v["d_px_d_P"])),
            })
            .collect(),
    }
}

fn list(value: &Value) -> &[Value] {
    value.as_array().unwrap()
}

fn numbers(value: &Value) -> Vec<f64> {
    list(value).iter().map(|x| x.as_f64().unwrap()).collect()
}

fn rows(value: &Value) -> Vec<f64> {
    list(value).iter().flat_map(numbers).collect()
}
