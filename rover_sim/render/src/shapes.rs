//! Meshes of common shapes, with smooth normals within faces and hard edges between them.
//!
//! Built with arithmetic alone (sines by series), so that a shape is the same on every machine.

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

/// A number in -1..1 from a lattice point.
fn lattice(x: i64, y: i64, z: i64, seed: u64) -> f64 {
    let h = crate::sensor::mix(
        seed ^ (x as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15)
            ^ (y as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f)
            ^ (z as u64).wrapping_mul(0x1656_67b1_9e37_79f9),
    );
    (h >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
}

/// Smooth noise in space: values in -1..1, unit wavelength. The same everywhere and always for the
/// same `seed`; made for the shapes of terrain and stones.
pub fn noise(p: &Vector3<f64>, seed: u64) -> f64 {
    let base = p.map(f64::floor);
    let f = p - base;
    let s = f.map(|t| t * t * t * (t * (t * 6.0 - 15.0) + 10.0));
    let at = |i: i64, j: i64, k: i64| {
        lattice(
            base.x as i64 + i,
            base.y as i64 + j,
            base.z as i64 + k,
            seed,
        )
    };
    let mix = |a: f64, b: f64, t: f64| a + (b - a) * t;
    let row = |j, k| mix(at(0, j, k), at(1, j, k), s.x);
    mix(
        mix(row(0, 0), row(1, 0), s.y),
        mix(row(0, 1), row(1, 1), s.y),
        s.z,
    )
}

/// Noise summed over `octaves`, each of half the wavelength and `gain` times the amplitude of the
/// one before; `p` in units of the longest wavelength.
pub fn fractal_noise(p: &Vector3<f64>, seed: u64, octaves: u32, gain: f64) -> f64 {
    let (mut sum, mut amplitude, mut q) = (0.0, 1.0, *p);
    for octave in 0..octaves {
        sum += amplitude * noise(&q, seed.wrapping_add(u64::from(octave)));
        amplitude *= gain;
        q = q * 2.0 + Vector3::new(0.37, 0.71, 0.13);
    }
    sum
}

/// A stone centred on the origin, of mean radius `radius_m`: an icosphere cut by random planes
/// (facets) and displaced by noise. `roughness` is the relative depth of both, 0 for a sphere, 0.3
/// for an ordinary stone.
pub fn rock(seed: u64, radius_m: f64, subdivisions: u32, roughness: f64) -> Mesh {
    let mut mesh = icosphere(subdivisions);
    let unit = |k: u64| {
        let value = |c: i64| lattice(k as i64, c, 7, seed);
        Vector3::new(value(0), value(1), value(2))
            .try_normalize(1e-6)
            .unwrap_or_else(Vector3::z)
    };
    // cutting planes: direction and distance from the centre in radii
    let cuts: Vec<(Vector3<f64>, f64)> = (0..14)
        .map(|k| {
            (
                unit(k),
                1.0 - roughness * (0.5 + 0.45 * lattice(k as i64, 3, 9, seed)),
            )
        })
        .collect();
    let stretch = Vector3::new(
        1.0 + 0.6 * roughness * lattice(1, 5, 5, seed),
        1.0 + 0.6 * roughness * lattice(2, 5, 5, seed),
        1.0 - roughness * (0.6 + 0.3 * lattice(3, 5, 5, seed)),
    );
    for p in &mut mesh.positions {
        let direction = *p;
        let mut reach: f64 = 1.0;
        for (n, distance) in &cuts {
            let along = n.dot(&direction);
            if along > 0.1 {
                // a soft minimum rounds the edges between facets
                let limit = distance / along;
                let blunt = 0.04;
                let d = reach - limit;
                let h = (0.5 + 0.5 * d / blunt).clamp(0.0, 1.0);
                reach = reach * (1.0 - h) + limit * h - blunt * h * (1.0 - h);
            }
        }
        let wide = noise(&(direction * 1.3), seed ^ 0xa5);
        let fine = fractal_noise(&(direction * 4.0), seed ^ 0x5a, 5, 0.5);
        reach *= 1.0 + roughness * (0.25 * wide + 0.11 * fine);
        *p = direction.component_mul(&stretch) * (radius_m * reach);
    }
    mesh.smooth();
    mesh
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
            let (r, h) = if turn == 0.0 { (s, -c) } else { (s, -c) };
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
