//! Meshes of common shapes, with smooth normals within faces and hard edges between them.
//!
//! Built with arithmetic alone (sines by series), so that a shape is the same on every machine.

mod stone;

pub use stone::{fractal_noise, noise, rock};

use crate::scene::Mesh;
use nalgebra::{Isometry3, Point3, Vector3};
use std::collections::BTreeMap;

impl Mesh {
    /// The mesh moved by `to_from`.
    #[must_use]
    pub fn transformed(&self, to_from: &Isometry3<f64>) -> Self {
        Self {
            positions: self
                .positions
                .iter()
                .map(|p| to_from.transform_point(&Point3::from(*p)).coords)
                .collect(),
            normals: self.normals.iter().map(|n| to_from.rotation * n).collect(),
            triangles: self.triangles.clone(),
        }
    }

    /// Adds the triangles of another mesh given in the same frame.
    pub fn append(&mut self, other: &Self) {
        let shift = self.positions.len() as u32;
        self.positions.extend_from_slice(&other.positions);
        self.normals.extend_from_slice(&other.normals);
        self.triangles
            .extend(other.triangles.iter().map(|t| t.map(|i| i + shift)));
    }

    /// Replaces the normals by the area-weighted mean of the adjoining triangles' normals.
    pub fn smooth(&mut self) {
        let mut sums = vec![Vector3::zeros(); self.positions.len()];
        for t in &self.triangles {
            let [a, b, c] = t.map(|i| self.positions[i as usize]);
            let area = (b - a).cross(&(c - a));
            for &i in t {
                sums[i as usize] += area;
            }
        }
        self.normals = sums
            .iter()
            .map(|s| s.try_normalize(1e-300).unwrap_or_else(Vector3::z))
            .collect();
    }
}

/// Sine and cosine of a fraction of a full turn, by arithmetic alone.
fn sin_cos_turns(turns: f64) -> (f64, f64) {
    let t = (turns - turns.floor()) * 8.0;
    let octant = t as u32;
    let x = (t - f64::from(octant)) * std::f64::consts::FRAC_PI_4;
    let x = if octant % 2 == 1 {
        std::f64::consts::FRAC_PI_4 - x
    } else {
        x
    };
    let y = x * x;
    let s = x
        * (1.0
            - y / 6.0
                * (1.0
                    - y / 20.0
                        * (1.0
                            - y / 42.0
                                * (1.0 - y / 72.0 * (1.0 - y / 110.0 * (1.0 - y / 156.0))))));
    let c = 1.0
        - y / 2.0
            * (1.0
                - y / 12.0
                    * (1.0 - y / 30.0 * (1.0 - y / 56.0 * (1.0 - y / 90.0 * (1.0 - y / 132.0)))));
    match octant {
        0 => (s, c),
        1 => (c, s),
        2 => (c, -s),
        3 => (s, -c),
        4 => (-s, -c),
        5 => (-c, -s),
        6 => (-c, s),
        _ => (-s, c),
    }
}

/// A height field `z = height(x, y)` over the grid of `xs` by `ys` (ascending, metres). The grid
/// may be finer in the middle than outside. Normals are those of the function (central
/// differences over a thousandth of the local grid step).
pub fn heightfield_mesh(xs: &[f64], ys: &[f64], height: impl Fn(f64, f64) -> f64) -> Mesh {
    let mut mesh = Mesh::default();
    let step = |v: &[f64], i: usize| {
        let (a, b) = (v[i.saturating_sub(1)], v[(i + 1).min(v.len() - 1)]);
        1e-3 * (b - a).max(1e-6)
    };
    for (j, &y) in ys.iter().enumerate() {
        for (i, &x) in xs.iter().enumerate() {
            mesh.positions.push(Vector3::new(x, y, height(x, y)));
            let (hx, hy) = (step(xs, i), step(ys, j));
            let dx = (height(x + hx, y) - height(x - hx, y)) / (2.0 * hx);
            let dy = (height(x, y + hy) - height(x, y - hy)) / (2.0 * hy);
            mesh.normals.push(Vector3::new(-dx, -dy, 1.0).normalize());
        }
    }
    let width = xs.len();
    for j in 1..ys.len() {
        for i in 1..width {
            let [a, b] = [(j - 1) * width + i - 1, (j - 1) * width + i].map(|k| k as u32);
            let [c, d] = [j * width + i - 1, j * width + i].map(|k| k as u32);
            // diagonals alternate, so that slopes have no preferred direction
            if (i + j) % 2 == 0 {
                mesh.triangles.extend([[a, b, d], [a, d, c]]);
            } else {
                mesh.triangles.extend([[a, b, c], [b, d, c]]);
            }
        }
    }
    mesh
}

/// A sphere of unit radius from an icosahedron whose faces are quartered `subdivisions` times
/// (`20 * 4^subdivisions` triangles).
pub fn icosphere(subdivisions: u32) -> Mesh {
    let g = (1.0 + 5.0_f64.sqrt()) / 2.0;
    let mut positions: Vec<Vector3<f64>> = [
        [-1.0, g, 0.0],
        [1.0, g, 0.0],
        [-1.0, -g, 0.0],
        [1.0, -g, 0.0],
        [0.0, -1.0, g],
        [0.0, 1.0, g],
        [0.0, -1.0, -g],
        [0.0, 1.0, -g],
        [g, 0.0, -1.0],
        [g, 0.0, 1.0],
        [-g, 0.0, -1.0],
        [-g, 0.0, 1.0],
    ]
    .into_iter()
    .map(|p| Vector3::from(p).normalize())
    .collect();
    let mut triangles: Vec<[u32; 3]> = vec![
        [0, 11, 5],
        [0, 5, 1],
        [0, 1, 7],
        [0, 7, 10],
        [0, 10, 11],
        [1, 5, 9],
        [5, 11, 4],
        [11, 10, 2],
        [10, 7, 6],
        [7, 1, 8],
        [3, 9, 4],
        [3, 4, 2],
        [3, 2, 6],
        [3, 6, 8],
        [3, 8, 9],
        [4, 9, 5],
        [2, 4, 11],
        [6, 2, 10],
        [8, 6, 7],
        [9, 8, 1],
    ];
    for _ in 0..subdivisions {
        let mut middles: BTreeMap<(u32, u32), u32> = BTreeMap::new();
        let mut middle = |a: u32, b: u32| {
            *middles.entry((a.min(b), a.max(b))).or_insert_with(|| {
                positions.push((positions[a as usize] + positions[b as usize]).normalize());
                positions.len() as u32 - 1
            })
        };
        let mut finer = Vec::with_capacity(triangles.len() * 4);
        for [a, b, c] in triangles {
            let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
            finer.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
        }
        triangles = finer;
    }
    Mesh {
        normals: positions.clone(),
        positions,
        triangles,
    }
}

/// A body of revolution about z: `profile` lists `(radius_m, z_m)` with the outside on the right
/// of the path (from bottom to top for a solid). Corners sharper than 35 deg become hard edges.
pub fn lathe(profile: &[[f64; 2]], segments: usize) -> Mesh {
    const SOFT_COSINE: f64 = 0.819;
    let mut mesh = Mesh::default();
    let outward = |i: usize| -> Option<[f64; 2]> {
        let (a, b) = (profile.get(i)?, profile.get(i + 1)?);
        let (r, z) = (b[0] - a[0], b[1] - a[1]);
        let length = (r * r + z * z).sqrt();
        (length > 0.0).then(|| [z / length, -r / length])
    };
    for i in 0..profile.len().saturating_sub(1) {
        let Some(own) = outward(i) else { continue };
        let blend = |other: Option<[f64; 2]>| match other {
            Some(o) if o[0] * own[0] + o[1] * own[1] > SOFT_COSINE => {
                let (r, z) = (o[0] + own[0], o[1] + own[1]);
                let length = (r * r + z * z).sqrt();
                [r / length, z / length]
            }
            _ => own,
        };
        let before = if i > 0 { outward(i - 1) } else { None };
        let ends = [
            (profile[i], blend(before)),
            (profile[i + 1], blend(outward(i + 1))),
        ];
        let first = mesh.positions.len() as u32;
        for k in 0..=segments {
            let (s, c) = sin_cos_turns((k % segments) as f64 / segments as f64);
            for ([r, z], [nr, nz]) in ends {
                mesh.positions.push(Vector3::new(r * c, r * s, z));
                mesh.normals.push(Vector3::new(nr * c, nr * s, nz));
            }
        }
        for k in 0..segments as u32 {
            let [a, b, c, d] = [0, 1, 2, 3].map(|j| first + 2 * k + j);
            // a, b: this meridian from bottom to top; c, d: the next one
            if profile[i][0] > 0.0 {
                mesh.triangles.push([a, c, b]);
            }
            if profile[i + 1][0] > 0.0 {
                mesh.triangles.push([b, c, d]);
            }
        }
    }
    mesh
}

/// A closed cylinder about z from `z = 0` to `z = length_m`, its edges broken by a small bevel.
pub fn cylinder(radius_m: f64, length_m: f64, segments: usize) -> Mesh {
    let b = 0.08 * radius_m.min(length_m / 2.0);
    let (r, l) = (radius_m, length_m);
    lathe(
        &[
            [0.0, 0.0],
            [r - b, 0.0],
            [r, b],
            [r, l - b],
            [r - b, l],
            [0.0, l],
        ],
        segments,
    )
}

/// A closed cone about z from a base of `base_radius_m` at `z = 0` to `top_radius_m` (zero for a
/// point) at `z = length_m`.
pub fn cone(base_radius_m: f64, top_radius_m: f64, length_m: f64, segments: usize) -> Mesh {
    lathe(
        &[
            [0.0, 0.0],
            [base_radius_m, 0.0],
            [top_radius_m, length_m],
            [0.0, length_m],
        ],
        segments,
    )
}

/// A capsule about z: a cylinder from `z = 0` to `z = length_m` with half spheres at both ends.
pub fn capsule(radius_m: f64, length_m: f64, segments: usize) -> Mesh {
    let rings = (segments / 4).max(2);
    let mut profile = Vec::new();
    for (turn, z) in [(0.0, 0.0), (0.25, length_m)] {
        for i in 0..=rings {
            let (s, c) = sin_cos_turns(0.25 * i as f64 / rings as f64 + turn);
            // from the lowest point outwards, then from the side to the top
            let (r, h) = (s, -c);
            let r = if r.abs() < 1e-12 { 0.0 } else { r };
            profile.push([r * radius_m, z + h * radius_m]);
        }
    }
    lathe(&profile, segments)
}

/// A closed box centred on the origin, its edges bevelled by a twentieth of the smallest half
/// extent.
pub fn cuboid(half_extents_m: &Vector3<f64>) -> Mesh {
    let h = half_extents_m;
    let b = 0.05 * h.min();
    let mut mesh = Mesh::default();
    let mut quad = |corners: [Vector3<f64>; 4]| {
        let normal = (corners[1] - corners[0])
            .cross(&(corners[2] - corners[0]))
            .normalize();
        let n = mesh.positions.len() as u32;
        mesh.positions.extend(corners);
        mesh.normals.extend([normal; 4]);
        mesh.triangles
            .extend([[n, n + 1, n + 2], [n, n + 2, n + 3]]);
    };
    let axis = |k: usize| Vector3::ith(k, 1.0);
    for k in 0..3 {
        let (x, y, z) = (axis((k + 1) % 3), axis((k + 2) % 3), axis(k));
        let (hx, hy, hz) = (h[(k + 1) % 3], h[(k + 2) % 3], h[k]);
        for side in [1.0, -1.0] {
            let x = x * side;
            let at = |i: f64, j: f64| x * (i * (hx - b)) + y * (j * (hy - b)) + z * (side * hz);
            quad([at(-1.0, -1.0), at(1.0, -1.0), at(1.0, 1.0), at(-1.0, 1.0)]);
        }
        // the four bevels along the axis z
        for (sx, sy) in [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)] {
            let p = x * (sx * hx) + y * (sy * (hy - b));
            let q = x * (sx * (hx - b)) + y * (sy * hy);
            let (p, q) = if sx * sy > 0.0 { (p, q) } else { (q, p) };
            let up = z * (hz - b);
            quad([p - up, q - up, q + up, p + up]);
        }
    }
    // the eight corners
    for i in 0..8 {
        let s = [0, 1, 2].map(|k| if i >> k & 1 == 1 { 1.0 } else { -1.0 });
        let corner =
            |k: usize| Vector3::from_fn(|c, _| s[c] * if c == k { h[c] } else { h[c] - b });
        let mut c = [corner(0), corner(1), corner(2)];
        if s[0] * s[1] * s[2] < 0.0 {
            c.swap(1, 2);
        }
        let normal = (c[1] - c[0]).cross(&(c[2] - c[0])).normalize();
        let n = mesh.positions.len() as u32;
        mesh.positions.extend(c);
        mesh.normals.extend([normal; 3]);
        mesh.triangles.push([n, n + 1, n + 2]);
    }
    mesh
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    /// Volume by the divergence theorem: positive only if triangles face outwards.
    fn volume(mesh: &Mesh) -> f64 {
        let corner = |i: u32| mesh.positions[i as usize];
        mesh.triangles
            .iter()
            .map(|t| corner(t[0]).dot(&corner(t[1]).cross(&corner(t[2]))) / 6.0)
            .sum()
    }

    fn check(name: &str, mesh: &Mesh, expected: f64, tolerance: f64) {
        let v = volume(mesh);
        assert!(
            (v / expected - 1.0).abs() < tolerance,
            "{name}: volume {v}, expected {expected}"
        );
        // closed: the area vectors sum to zero
        let mut sum = Vector3::zeros();
        for t in &mesh.triangles {
            let [a, b, c] = t.map(|i| mesh.positions[i as usize]);
            let area = (b - a).cross(&(c - a));
            sum += area;
            for &i in t {
                let along = mesh.normals[i as usize].dot(&area);
                assert!(
                    area.norm() < 1e-15 || along > 0.3 * area.norm(),
                    "{name}: normal"
                );
            }
        }
        assert!(sum.norm() < 1e-12, "{name} is open: {sum}");
        assert!(
            mesh.normals.iter().all(|n| (n.norm() - 1.0).abs() < 1e-9),
            "{name}: lengths"
        );
    }

    #[test]
    fn shapes_are_closed_and_have_their_volume() {
        let pi = std::f64::consts::PI;
        check("sphere", &icosphere(4), 4.0 / 3.0 * pi, 0.01);
        check("cylinder", &cylinder(0.1, 0.5, 96), pi * 0.01 * 0.5, 0.01);
        check("cone", &cone(0.1, 0.0, 0.3, 96), pi * 0.01 * 0.1, 0.01);
        check(
            "stump",
            &cone(0.1, 0.05, 0.3, 96),
            pi * 0.1 * (0.01 + 0.005 + 0.0025),
            0.01,
        );
        let round = pi * 0.01 * 0.5 + 4.0 / 3.0 * pi * 0.001;
        check("capsule", &capsule(0.1, 0.5, 96), round, 0.01);
        check(
            "box",
            &cuboid(&Vector3::new(0.1, 0.2, 0.3)),
            8.0 * 0.006,
            0.01,
        );
    }

    #[test]
    fn stones_are_closed_and_about_as_large_as_asked() {
        for seed in 0..20 {
            let stone = rock(seed, 0.1, 4, 0.3);
            let v = volume(&stone) / (4.0 / 3.0 * std::f64::consts::PI * 0.001);
            assert!((0.2..1.3).contains(&v), "seed {seed}: {v} of a sphere");
            assert!(
                stone
                    .positions
                    .iter()
                    .all(|p| (0.03..0.15).contains(&p.norm()))
            );
        }
    }

    #[test]
    fn own_sines_agree_with_the_library() {
        for i in -400..400 {
            let turns = f64::from(i) / 171.0;
            let (s, c) = sin_cos_turns(turns);
            let (es, ec) = (turns * std::f64::consts::TAU).sin_cos();
            assert!((s - es).abs() < 1e-10 && (c - ec).abs() < 1e-10, "{turns}");
        }
    }

    #[test]
    fn a_height_field_passes_through_its_function() {
        let lines: Vec<f64> = (0..10).map(|i| f64::from(i) * 0.1).collect();
        let mesh = heightfield_mesh(&lines, &lines, |x, y| 0.2 * x - 0.1 * y);
        assert_eq!((mesh.positions.len(), mesh.triangles.len()), (100, 162));
        for n in &mesh.normals {
            assert!((n - Vector3::new(-0.2, 0.1, 1.0).normalize()).norm() < 1e-9);
        }
    }
}
