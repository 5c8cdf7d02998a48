//! Triangles as one camera sees them: edge and depth planes through the centre of projection, and
//! for each tile the list of triangles that may touch it.

use crate::geometry::Geometry;
use crate::optics::{Bounds, Optics};
use nalgebra::Isometry3;

/// A triangle ready for rasterisation. With `d` the ray of a pixel (axis frame, `z = 1`), `d` hits
/// it where all `edge[i] . d >= 0`, at inverse depth `inverse_depth . d`; the three `edge[i] . d`
/// are in the ratio of the barycentric weights of the vertices.
#[derive(Clone, Copy)]
pub(crate) struct Facet {
    pub edge: [[f32; 3]; 3],
    pub inverse_depth: [f32; 3],
    pub bounds: Bounds,
}

/// All triangles that face a camera, and which tiles they may touch.
#[derive(Default)]
pub(crate) struct View {
    pub facets: Vec<Facet>,
    /// Index in [`Geometry`] of the triangle of each facet.
    pub triangle: Vec<u32>,
    /// Body of each facet.
    pub body: Vec<u16>,
    /// For each tile, where its list in `refs` begins; more entries at the end.
    starts: Vec<u32>,
    refs: Vec<u32>,
    /// Room for the making: vertices in the axis frame, pairs (tile, facet).
    vertices: Vec<[f32; 3]>,
    touches: Vec<(u32, u32)>,
}

/// Nothing nearer than this (along the axis) has bounds of its own, metres.
const NEAR_M: f32 = 1e-4;

impl View {
    /// Sees `geometry` through `optics`; `axis_from_body(b)` is `None` for a body not to be drawn.
    /// The memory of the last view is used again.
    pub(crate) fn see(
        &mut self,
        optics: &Optics,
        geometry: &Geometry,
        axis_from_body: impl Fn(usize) -> Option<Isometry3<f64>>,
    ) {
        self.facets.clear();
        self.triangle.clear();
        self.body.clear();
        self.touches.clear();
        self.vertices.resize(geometry.positions.len(), [0.0; 3]);
        for (index, body) in geometry.bodies.iter().enumerate() {
            let Some(pose) = axis_from_body(index) else {
                continue;
            };
            let (rotation, shift) = (
                *pose.rotation.to_rotation_matrix().matrix(),
                pose.translation.vector,
            );
            for v in body.vertices.clone() {
                let p = rotation * geometry.positions[v] + shift;
                self.vertices[v] = [p.x as f32, p.y as f32, p.z as f32];
            }
            for t in body.triangles.clone() {
                let [a, b, c] = geometry.triangles[t].map(|i| self.vertices[i as usize]);
                let Some(facet) = facet(a, b, c, body.two_sided) else {
                    continue;
                };
                let id = self.facets.len() as u32;
                let before = self.touches.len();
                optics.tiles_touching(&facet.bounds, |tile| self.touches.push((tile as u32, id)));
                if self.touches.len() > before {
                    self.facets.push(facet);
                    self.triangle.push(t as u32);
                    self.body.push(index as u16);
                }
            }
        }
        self.sort(optics.tiles.len());
    }

    /// Makes one list per tile from the pairs (tile, facet), facets in ascending order.
    fn sort(&mut self, tiles: usize) {
        self.starts.clear();
        self.starts.resize(tiles + 2, 0);
        for &(tile, _) in &self.touches {
            self.starts[tile as usize + 2] += 1;
        }
        for tile in 2..tiles + 2 {
            self.starts[tile] += self.starts[tile - 1];
        }
        // one place ahead: filling a list moves its entry to where the next list begins
        self.refs.resize(self.touches.len(), 0);
        for &(tile, facet) in &self.touches {
            let slot = &mut self.starts[tile as usize + 1];
            self.refs[*slot as usize] = facet;
            *slot += 1;
        }
    }

    /// The facets that may touch a tile.
    pub(crate) fn touching(&self, tile: usize) -> &[u32] {
        match (self.starts.get(tile), self.starts.get(tile + 1)) {
            (Some(&a), Some(&b)) => &self.refs[a as usize..b as usize],
            _ => &[],
        }
    }
}

fn sub(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

fn cross(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

/// The plane through the centre of projection and the edge from `a` to `b`. Swapping the two ends
/// negates it exactly, so triangles that share an edge leave neither gap nor overlap.
fn edge(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    cross([a[0] + b[0], a[1] + b[1], a[2] + b[2]], sub(a, b))
}

fn facet(a: [f32; 3], b: [f32; 3], c: [f32; 3], two_sided: bool) -> Option<Facet> {
    let normal = cross(sub(b, a), sub(c, a));
    let height = normal[0] * a[0] + normal[1] * a[1] + normal[2] * a[2];
    // negative: the camera is on the outer side
    let faces = height < 0.0;
    if !(faces || (two_sided && height > 0.0)) {
        return None;
    }
    let bounds = bounds(a, b, c)?;
    let mut edges = [edge(b, c), edge(c, a), edge(a, b)];
    if !faces {
        edges = edges.map(|e| e.map(|x| -x));
    }
    let inverse_depth = normal.map(|x| x / height);
    if !inverse_depth.iter().all(|x| x.is_finite()) {
        return None; // seen exactly edge-on
    }
    Some(Facet {
        edge: edges,
        inverse_depth,
        bounds,
    })
}

/// The rectangle of a triangle in the plane `z = 1`, cut at the near plane; `None` if it lies
/// wholly behind it.
fn bounds(a: [f32; 3], b: [f32; 3], c: [f32; 3]) -> Option<Bounds> {
    let mut out = Bounds {
        x: [f32::MAX, f32::MIN],
        y: [f32::MAX, f32::MIN],
    };
    let mut add = |p: [f32; 3]| {
        let (x, y) = (p[0] / p[2], p[1] / p[2]);
        out.x = [out.x[0].min(x), out.x[1].max(x)];
        out.y = [out.y[0].min(y), out.y[1].max(y)];
    };
    if a[2] >= NEAR_M && b[2] >= NEAR_M && c[2] >= NEAR_M {
        add(a);
        add(b);
        add(c);
        return Some(out);
    }
    let mut any = false;
    for (p, q) in [(a, b), (b, c), (c, a)] {
        if p[2] >= NEAR_M {
            add(p);
            any = true;
        }
        if (p[2] >= NEAR_M) != (q[2] >= NEAR_M) {
            let s = (NEAR_M - p[2]) / (q[2] - p[2]);
            add([p[0] + s * (q[0] - p[0]), p[1] + s * (q[1] - p[1]), NEAR_M]);
        }
    }
    any.then_some(out)
}
