//! Ground and rocks. The meshes made here are both drawn and touched.

use crate::description::{RockDescription, TerrainDescription};
use crate::facets::Facets;
use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rover_render::{Mesh, StaticMesh, Surface, shapes};
use std::sync::OnceLock;

/// Finest undulation that the ground's cells can carry, cells.
const FINEST_CELLS: f64 = 4.0;
/// No scattered rock nearer to the origin along x, m: the mount stands there.
const CLEAR_M: f64 = 0.25;

/// The ground's mesh and that of every rock, world frame. The first is the ground, then come the
/// described rocks in their order, then the scattered ones.
#[derive(Clone, Debug)]
pub struct Terrain {
    /// Shapes and surfaces.
    pub bodies: Vec<StaticMesh>,
    /// How many of the bodies are rocks.
    pub rocks_n: usize,
    /// Lines of the ground's grid along x and y, m; its vertices run along x first.
    pub grid_m: [Vec<f64>; 2],
    /// The facets of each body by place, sorted when first asked for.
    facets: Vec<OnceLock<Facets>>,
}

impl Terrain {
    /// Name of a body for messages.
    pub fn name(index: usize) -> String {
        if index == 0 {
            "ground".into()
        } else {
            format!("rock {}", index - 1)
        }
    }

    /// Index of the body that is rock `rock_n`.
    pub fn rock(&self, rock_n: u32) -> Option<usize> {
        let index = rock_n as usize;
        (index < self.rocks_n).then_some(index + 1)
    }

    /// Makes the terrain; the description has been checked.
    pub(crate) fn new(d: &TerrainDescription) -> Self {
        let height = |x: f64, y: f64| ground_height_m(d, x, y);
        let axis = |i: usize| {
            let cells = (d.size_m[i] / d.cell_m).round().max(1.0) as usize;
            let (low, step) = (
                d.centre_m[i] - d.size_m[i] / 2.0,
                d.size_m[i] / cells as f64,
            );
            (0..=cells)
                .map(|k| low + step * k as f64)
                .collect::<Vec<_>>()
        };
        let grid_m = [axis(0), axis(1)];
        let ground = StaticMesh {
            mesh: shapes::heightfield_mesh(&grid_m[0], &grid_m[1], height),
            surface: Surface::ground(texture_seed(d.seed)),
        };
        let mut bodies = vec![ground];
        bodies.extend(d.rocks.iter().map(rock));
        bodies.extend(scattered(d).iter().map(rock));
        bodies.extend(rock_field(d).iter().map(rock));
        Self {
            rocks_n: bodies.len() - 1,
            facets: vec![OnceLock::new(); bodies.len()],
            bodies,
            grid_m,
        }
    }

    /// Height of the ground's grid line crossing nearest to a place, m.
    pub(crate) fn height_near_m(&self, x: f64, y: f64) -> f64 {
        let nearest = |lines: &[f64], at: f64| {
            let step = (lines[lines.len() - 1] - lines[0]) / (lines.len() - 1) as f64;
            (((at - lines[0]) / step).round().max(0.0) as usize).min(lines.len() - 1)
        };
        let [xs, ys] = &self.grid_m;
        let (i, j) = (nearest(xs, x), nearest(ys, y));
        self.bodies[0].mesh.positions[j * xs.len() + i].z
    }

    /// Whether there is ground for `about_m` on all sides of a place.
    pub(crate) fn has_about(&self, x: f64, y: f64, about_m: f64) -> bool {
        let [xs, ys] = &self.grid_m;
        let inside = |lines: &[f64], at: f64| {
            lines[0] + about_m <= at && at <= lines[lines.len() - 1] - about_m
        };
        inside(xs, x) && inside(ys, y)
    }

    /// Outward normal of a body within `radius_m` of a point, by area, not of unit length; `None` if
    /// there is no such body.
    pub(crate) fn mean_normal(
        &self,
        body: usize,
        centre: &Vector3<f64>,
        radius_m: f64,
    ) -> Option<Vector3<f64>> {
        let mesh = &self.bodies.get(body)?.mesh;
        let facets = self.facets[body].get_or_init(|| Facets::of(mesh));
        Some(facets.mean_normal(mesh, centre, radius_m))
    }

    /// Largest extent of a body along an axis, m.
    pub(crate) fn size_m(&self, body: usize) -> f64 {
        let positions = &self.bodies[body].mesh.positions;
        let Some(first) = positions.first() else {
            return 0.0;
        };
        let (low, high) = positions
            .iter()
            .fold((*first, *first), |(l, h), p| (l.inf(p), h.sup(p)));
        (high - low).max()
    }

    /// The part of a body within a square of half width `half_m` about a place, as vertices and
    /// triangles; empty if there is none.
    pub(crate) fn part(
        &self,
        body: usize,
        centre: [f64; 2],
        half_m: f64,
    ) -> (Vec<Vector3<f64>>, Vec<[u32; 3]>) {
        let mesh = &self.bodies[body].mesh;
        let near = |i: u32| {
            let p = &mesh.positions[i as usize];
            (p.x - centre[0]).abs() <= half_m && (p.y - centre[1]).abs() <= half_m
        };
        let mut place = vec![u32::MAX; mesh.positions.len()];
        let (mut positions, mut triangles) = (Vec::new(), Vec::new());
        // Of a rock all triangles are kept if one is near.
        let whole = body > 0 && mesh.triangles.iter().any(|t| t.iter().any(|&i| near(i)));
        for t in &mesh.triangles {
            if whole || t.iter().all(|&i| near(i)) {
                triangles.push(t.map(|i| {
                    let at = &mut place[i as usize];
                    if *at == u32::MAX {
                        *at = positions.len() as u32;
                        positions.push(mesh.positions[i as usize]);
                    }
                    *at
                }));
            }
        }
        (positions, triangles)
    }
}

/// Height of the ground, world frame, m.
fn ground_height_m(d: &TerrainDescription, x: f64, y: f64) -> f64 {
    let span = d.relief_wavelength_m / (FINEST_CELLS * d.cell_m);
    let octaves = if span > 1.0 {
        span.log2().floor() as u32 + 1
    } else {
        1
    };
    let p = Vector3::new(x, y, 0.0) / d.relief_wavelength_m;
    // Two standard deviations of one octave of this noise are about 1.
    let noise = shapes::fractal_noise(&p, d.seed, octaves, d.relief_gain);
    d.height_m + 2.0 * d.relief_m * noise
}

fn texture_seed(seed: u64) -> u32 {
    (seed ^ (seed >> 32)) as u32
}

fn rock(d: &RockDescription) -> StaticMesh {
    let mesh = shapes::rock(d.seed, d.radius_m, d.subdivisions_n, d.roughness);
    let position = Vector3::from(d.position_m);
    let place = Isometry3::from_parts(position.into(), UnitQuaternion::identity());
    StaticMesh {
        mesh: Mesh::transformed(&mesh, &place),
        surface: Surface::rock(texture_seed(d.seed)),
    }
}

fn scattered(d: &TerrainDescription) -> Vec<RockDescription> {
    let mut random = ChaCha8Rng::seed_from_u64(d.seed);
    let s = &d.scattered;
    (0..s.count_n)
        .map(|i| {
            let [u, v, w]: [f64; 3] = std::array::from_fn(|_| random.random());
            let low = (d.centre_m[0] - d.size_m[0] / 2.0).max(CLEAR_M);
            let high = d.centre_m[0] + d.size_m[0] / 2.0;
            let x = low + u * (high - low);
            let y = d.centre_m[1] + (v - 0.5) * d.size_m[1];
            // Many small ones, few large ones.
            let radius_m = s.radius_m[0] * (s.radius_m[1] / s.radius_m[0]).powf(w * w);
            RockDescription {
                position_m: [x, y, ground_height_m(d, x, y) + 0.2 * radius_m],
                radius_m,
                roughness: 0.3,
                subdivisions_n: s.subdivisions_n,
                seed: d
                    .seed
                    .wrapping_mul(0x9e37_79b9_7f4a_7c15)
                    .wrapping_add(u64::from(i)),
            }
        })
        .collect()
}

/// Large rocks that keep their distance from the start and from each other. A rock that finds no
/// place in many tries is left out.
fn rock_field(d: &TerrainDescription) -> Vec<RockDescription> {
    const TRIES: u32 = 300;
    let Some(f) = &d.field else {
        return Vec::new();
    };
    let mut random = ChaCha8Rng::seed_from_u64(d.seed);
    random.set_stream(1);
    let mut placed: Vec<RockDescription> = Vec::new();
    for i in 0..f.count_n {
        let radius_m = f.radius_m[0] + random.random::<f64>() * (f.radius_m[1] - f.radius_m[0]);
        for _ in 0..TRIES {
            let [u, v]: [f64; 2] = std::array::from_fn(|_| random.random::<f64>() - 0.5);
            let x = d.centre_m[0] + u * (d.size_m[0] - 2.0 * radius_m);
            let y = d.centre_m[1] + v * (d.size_m[1] - 2.0 * radius_m);
            let clear = x.hypot(y) > f.clear_m + radius_m
                && placed.iter().chain(&d.rocks).all(|r| {
                    let apart = (x - r.position_m[0]).hypot(y - r.position_m[1]);
                    apart > radius_m + r.radius_m + f.gap_m
                });
            if !clear {
                continue;
            }
            placed.push(RockDescription {
                position_m: [x, y, ground_height_m(d, x, y) - f.buried * radius_m],
                radius_m,
                roughness: f.roughness,
                subdivisions_n: f.subdivisions_n,
                seed: d
                    .seed
                    .wrapping_mul(0x9e37_79b9_7f4a_7c15)
                    .wrapping_add(0x1_0000 + u64::from(i)),
            });
            break;
        }
    }
    placed
}
