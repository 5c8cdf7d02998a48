//! Meshes of many bodies in one set of arrays.

use crate::scene::{Mesh, Plate};
use nalgebra::Vector3;
use std::ops::Range;

/// Where a body's vertices and triangles are.
pub(crate) struct Body {
    pub vertices: Range<usize>,
    pub triangles: Range<usize>,
    /// Drawn from both sides, casts shadows from both sides.
    pub two_sided: bool,
}

/// The meshes of several bodies, each in its own frame.
#[derive(Default)]
pub(crate) struct Geometry {
    pub positions: Vec<Vector3<f64>>,
    /// The same positions for shading.
    pub corners: Vec<[f32; 3]>,
    pub normals: Vec<[f32; 3]>,
    /// Indices into the arrays above.
    pub triangles: Vec<[u32; 3]>,
    pub bodies: Vec<Body>,
}

fn narrow(v: &Vector3<f64>) -> [f32; 3] {
    [v.x as f32, v.y as f32, v.z as f32]
}

impl Geometry {
    pub(crate) fn push(&mut self, mesh: &Mesh, two_sided: bool) {
        let (vertices, triangles) = (self.positions.len(), self.triangles.len());
        self.positions.extend_from_slice(&mesh.positions);
        self.corners.extend(mesh.positions.iter().map(narrow));
        self.normals.extend(mesh.normals.iter().map(narrow));
        self.triangles.extend(
            mesh.triangles
                .iter()
                .map(|t| t.map(|i| i + vertices as u32)),
        );
        self.bodies.push(Body {
            vertices: vertices..self.positions.len(),
            triangles: triangles..self.triangles.len(),
            two_sided,
        });
    }
}

/// The two triangles of a plate, in the plate's frame.
pub(crate) fn plate_mesh(plate: &Plate) -> Mesh {
    let (w, h) = (plate.half_width_m, plate.half_height_m);
    Mesh {
        positions: [(-w, -h), (w, -h), (w, h), (-w, h)]
            .map(|(x, y)| Vector3::new(x, y, 0.0))
            .to_vec(),
        normals: vec![Vector3::z(); 4],
        triangles: vec![[0, 1, 2], [0, 2, 3]],
    }
}
