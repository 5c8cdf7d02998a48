//! Noise in space, and the stones and terrain made of it.

use super::icosphere;
use crate::scene::Mesh;
use nalgebra::Vector3;

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
