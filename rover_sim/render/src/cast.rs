//! Exact ray casts in double precision, for ground truth.

use crate::geometry::Geometry;
use nalgebra::{Isometry3, Point3, Vector3};

/// Where a ray meets the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// The point, world frame, metres.
    pub point: Vector3<f64>,
    /// Unit normal of the triangle, world frame, on the side that the ray comes from.
    pub normal: Vector3<f64>,
    /// Unit normal of the smooth surface that the mesh stands for, world frame, same side.
    pub smooth_normal: Vector3<f64>,
    /// Distance from the ray's origin, metres.
    pub distance_m: f64,
    /// Which mesh: static meshes in the scene's order, then parts, then plates.
    pub mesh_index: usize,
}

struct Node {
    low: Vector3<f64>,
    high: Vector3<f64>,
    /// First triangle, or left child (the right one follows).
    first: usize,
    count: usize,
}

struct Triangle {
    corners: [Vector3<f64>; 3],
    normals: [Vector3<f64>; 3],
}

/// The triangles of one body in its own frame.
struct BodyTree {
    nodes: Vec<Node>,
    triangles: Vec<Triangle>,
}

/// All bodies of a scene.
pub(crate) struct Caster {
    still: Vec<BodyTree>,
    moving: Vec<BodyTree>,
}

/// A hit on one triangle: distance, barycentric weights of the second and third corner.
struct Meeting {
    distance: f64,
    u: f64,
    v: f64,
    triangle: usize,
}

impl Caster {
    pub(crate) fn new(still: &Geometry, moving: &Geometry) -> Self {
        let trees = |g: &Geometry| {
            g.bodies
                .iter()
                .map(|b| BodyTree::new(g, b.triangles.clone()))
                .collect()
        };
        Self {
            still: trees(still),
            moving: trees(moving),
        }
    }

    /// `world_from_moving` may be empty: then nothing that moves is met.
    pub(crate) fn cast(
        &self,
        origin: &Vector3<f64>,
        direction: &Vector3<f64>,
        present: &[bool],
        world_from_moving: &[Isometry3<f64>],
    ) -> Option<Hit> {
        let direction = direction.try_normalize(1e-300)?;
        if !direction.iter().chain(origin.iter()).all(|x| x.is_finite()) {
            return None;
        }
        let still = (self.still.iter().enumerate())
            .filter(|(index, _)| present[*index])
            .map(|(index, tree)| (index, tree, None));
        let moving = (self.moving.iter().zip(world_from_moving).enumerate())
            .map(|(index, (tree, pose))| (self.still.len() + index, tree, Some(pose)));
        let mut nearest: Option<Hit> = None;
        for (mesh_index, tree, pose) in still.chain(moving) {
            let limit = nearest.map_or(f64::INFINITY, |h| h.distance_m);
            let (o, d) = match pose {
                None => (*origin, direction),
                Some(p) => (
                    p.inverse_transform_point(&Point3::from(*origin)).coords,
                    p.inverse_transform_vector(&direction),
                ),
            };
            let Some(meeting) = tree.meet(&o, &d, limit) else {
                continue;
            };
            let (mut normal, mut smooth_normal) = tree.normals(&meeting, &d);
            if let Some(p) = pose {
                normal = p.rotation * normal;
                smooth_normal = p.rotation * smooth_normal;
            }
            nearest = Some(Hit {
                point: origin + direction * meeting.distance,
                normal,
                smooth_normal,
                distance_m: meeting.distance,
                mesh_index,
            });
        }
        nearest
    }
}

impl BodyTree {
    fn new(geometry: &Geometry, range: std::ops::Range<usize>) -> Self {
        let mut triangles: Vec<Triangle> = range
            .map(|t| {
                let corner = geometry.triangles[t].map(|i| i as usize);
                Triangle {
                    corners: corner.map(|i| geometry.positions[i]),
                    normals: corner.map(|i| Vector3::from(geometry.normals[i].map(f64::from))),
                }
            })
            .collect();
        let mut nodes = Vec::new();
        if !triangles.is_empty() {
            nodes.push(Node {
                low: Vector3::zeros(),
                high: Vector3::zeros(),
                first: 0,
                count: 0,
            });
            split(&mut nodes, 0, &mut triangles, 0);
        }
        Self { nodes, triangles }
    }

    /// The nearest triangle within `limit`.
    fn meet(&self, o: &Vector3<f64>, d: &Vector3<f64>, limit: f64) -> Option<Meeting> {
        let inverse = d.map(|x| 1.0 / x);
        let mut best: Option<Meeting> = None;
        let mut stack = Vec::with_capacity(64);
        if !self.nodes.is_empty() {
            stack.push(0);
        }
        while let Some(index) = stack.pop() {
            let n: &Node = &self.nodes[index];
            let nearest = best.as_ref().map_or(limit, |b| b.distance);
            if !n.meets(o, &inverse, nearest) {
                continue;
            }
            if n.count == 0 {
                stack.extend([n.first + 1, n.first]);
                continue;
            }
            for t in n.first..n.first + n.count {
                let nearest = best.as_ref().map_or(limit, |b| b.distance);
                if let Some((distance, u, v)) = self.triangles[t].meet(o, d)
                    && distance < nearest
                {
                    best = Some(Meeting {
                        distance,
                        u,
                        v,
                        triangle: t,
                    });
                }
            }
        }
        best
    }

    /// Normals of triangle and smooth surface against the direction `d`.
    fn normals(&self, m: &Meeting, d: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
        let t = &self.triangles[m.triangle];
        let [a, b, c] = t.corners;
        let outward = (b - a).cross(&(c - a)).normalize();
        let side = if outward.dot(d) <= 0.0 { 1.0 } else { -1.0 };
        let smooth = t.normals[0] * (1.0 - m.u - m.v) + t.normals[1] * m.u + t.normals[2] * m.v;
        let smooth = smooth.try_normalize(1e-12).unwrap_or(outward);
        (outward * side, smooth * side)
    }
}

impl Node {
    fn meets(&self, o: &Vector3<f64>, inverse: &Vector3<f64>, limit: f64) -> bool {
        let (mut enter, mut leave) = (0.0_f64, limit);
        for k in 0..3 {
            let (a, b) = (
                (self.low[k] - o[k]) * inverse[k],
                (self.high[k] - o[k]) * inverse[k],
            );
            // a NaN (ray within a face) leaves the interval as it is
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        // a margin for the rounding of the slabs
        enter <= leave * (1.0 + 1e-12) + 1e-12
    }
}

impl Triangle {
    /// Moeller-Trumbore; distance and weights of the second and third corner.
    fn meet(&self, o: &Vector3<f64>, d: &Vector3<f64>) -> Option<(f64, f64, f64)> {
        let [a, b, c] = self.corners;
        let (e1, e2) = (b - a, c - a);
        let p = d.cross(&e2);
        let det = e1.dot(&p);
        if det == 0.0 {
            return None;
        }
        let s = o - a;
        let q = s.cross(&e1);
        let (u, v) = (s.dot(&p) / det, d.dot(&q) / det);
        // edges overlap a little so that no ray slips between neighbours
        const EDGE: f64 = 1e-10;
        if !(u >= -EDGE && v >= -EDGE && u + v <= 1.0 + EDGE) {
            return None;
        }
        let distance = e2.dot(&q) / det;
        (distance > 0.0 && distance.is_finite()).then_some((distance, u, v))
    }
}

/// Fills `node` with `triangles`, which begin at `offset` of the whole list.
fn split(nodes: &mut Vec<Node>, node: usize, triangles: &mut [Triangle], offset: usize) {
    let mut low = Vector3::repeat(f64::MAX);
    let mut high = Vector3::repeat(f64::MIN);
    for corner in triangles.iter().flat_map(|t| &t.corners) {
        low = low.inf(corner);
        high = high.sup(corner);
    }
    let mut this = Node {
        low,
        high,
        first: offset,
        count: triangles.len(),
    };
    if triangles.len() > 4 {
        let axis = (high - low).imax();
        let middle = triangles.len() / 2;
        let key = |t: &Triangle| t.corners.iter().map(|c| c[axis]).sum::<f64>();
        triangles.select_nth_unstable_by(middle, |a, b| key(a).total_cmp(&key(b)));
        let children = nodes.len();
        for _ in 0..2 {
            nodes.push(Node {
                low,
                high,
                first: 0,
                count: 0,
            });
        }
        let (left, right) = triangles.split_at_mut(middle);
        split(nodes, children, left, offset);
        split(nodes, children + 1, right, offset + middle);
        (this.first, this.count) = (children, 0);
    }
    nodes[node] = this;
}
