//! Value noise in space, summed over the octaves that a pixel can resolve.

use crate::scene::Texture;
use crate::simd::{Simd, V3, add3, dot, scale3, splat3};

/// One octave of a texture.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Octave {
    /// From mesh coordinates (metres) to the octave's lattice of unit cells.
    to_lattice: [[f32; 3]; 3],
    /// From the gradient on the lattice to the slope of the relief in mesh coordinates.
    to_slope: [[f32; 3]; 3],
    half_wavelength_m: f32,
    amplitude: f32,
    seed: u32,
}

/// A rotation by rational numbers, so that no trigonometric function is needed; applied once per
/// octave it keeps the lattices of neighbouring octaves from lining up.
const TURN: [[f64; 3]; 3] = [[0.0, 0.8, 0.6], [-0.8, 0.36, -0.48], [-0.6, -0.48, 0.64]];

fn product(a: &[[f64; 3]; 3], b: &[[f64; 3]; 3]) -> [[f64; 3]; 3] {
    let cell = |r: usize, c: usize| (0..3).map(|k| a[r][k] * b[k][c]).sum();
    [0, 1, 2].map(|r| [0, 1, 2].map(|c| cell(r, c)))
}

/// The octaves of a texture, coarsest first; none if it has neither contrast nor relief.
pub(crate) fn octaves(texture: &Texture) -> Vec<Octave> {
    let mut out = Vec::new();
    if texture.amplitude == 0.0 && texture.relief == 0.0 {
        return out;
    }
    let mut turn = [[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]];
    let mut wavelength = texture.coarsest_wavelength_m;
    let mut amplitude = texture.amplitude;
    while wavelength >= texture.finest_wavelength_m * 0.999 && out.len() < 24 {
        let lattice = |r: usize, c: usize| (turn[r][c] * texture.squeeze[c] / wavelength) as f32;
        let slope = |r: usize, c: usize| (turn[c][r] * texture.relief) as f32;
        out.push(Octave {
            to_lattice: [0, 1, 2].map(|r| [0, 1, 2].map(|c| lattice(r, c))),
            to_slope: [0, 1, 2].map(|r| [0, 1, 2].map(|c| slope(r, c))),
            half_wavelength_m: (wavelength / 2.0) as f32,
            amplitude: amplitude as f32,
            seed: texture.seed.wrapping_mul(0x9e37_79b9) ^ (out.len() as u32) << 24,
        });
        turn = product(&TURN, &turn);
        wavelength /= 2.0;
        amplitude *= texture.octave_gain;
    }
    out
}

/// The pattern (zero mean) and the slope of the relief at `p` (mesh coordinates, metres).
/// An octave fades out as its wavelength falls from four to two footprints.
#[inline(always)]
pub(crate) fn sample<S: Simd>(
    octaves: &[Octave],
    p: V3<S>,
    inverse_footprint: S::F,
) -> (S::F, V3<S>) {
    let zero = S::splat(0.0);
    let mut pattern = zero;
    let mut slope = [zero; 3];
    for o in octaves {
        let fade = S::splat(o.half_wavelength_m) * inverse_footprint - S::splat(1.0);
        let weight = S::max(S::min(fade, S::splat(1.0)), zero);
        if S::bits(S::gt(weight, zero)) == 0 {
            break; // all that follow are finer
        }
        let m = &o.to_lattice;
        let q = [
            dot::<S>(splat3::<S>(m[0]), p),
            dot::<S>(splat3::<S>(m[1]), p),
            dot::<S>(splat3::<S>(m[2]), p),
        ];
        let (value, gradient) = value_noise::<S>(q, o.seed);
        pattern = pattern + value * (weight * S::splat(o.amplitude));
        let m = &o.to_slope;
        let g = [
            dot::<S>(splat3::<S>(m[0]), gradient),
            dot::<S>(splat3::<S>(m[1]), gradient),
            dot::<S>(splat3::<S>(m[2]), gradient),
        ];
        slope = add3::<S>(slope, scale3::<S>(g, weight));
    }
    (pattern, slope)
}

/// A number in -1..1 from a lattice point's mixed coordinates.
#[inline(always)]
fn lattice_value<S: Simd>(h: S::I) -> S::F {
    let h = S::mul_i(S::xor_i(h, S::shr_i::<15>(h)), S::splat_i(0x2c1b_3c6d));
    let h = S::mul_i(S::xor_i(h, S::shr_i::<12>(h)), S::splat_i(0x297a_2d39));
    S::to_f(S::shr_i::<8>(h)) * S::splat(1.0 / 8_388_608.0) - S::splat(1.0)
}

#[inline(always)]
fn lerp<S: Simd>(a: S::F, b: S::F, t: S::F) -> S::F {
    a + (b - a) * t
}

/// Values in -1..1 at the points of the integer lattice, joined by quintic steps; with gradient.
#[inline(always)]
fn value_noise<S: Simd>(q: V3<S>, seed: u32) -> (S::F, V3<S>) {
    const MIX: [u32; 3] = [0x8da6_b343, 0xd816_3841, 0xcb1a_b31f];
    let one = S::splat(1.0);
    let mut low = [S::splat_i(0); 3];
    let mut high = low;
    let mut step = [one; 3];
    let mut rate = [one; 3];
    for k in 0..3 {
        let t = S::to_f(S::trunc(q[k]));
        let floor = S::select(S::gt(t, q[k]), t - one, t);
        let f = q[k] - floor;
        low[k] = S::mul_i(S::trunc(floor), S::splat_i(MIX[k]));
        high[k] = S::add_i(low[k], S::splat_i(MIX[k]));
        let six = S::splat(6.0);
        step[k] = f * f * f * (f * (f * six - S::splat(15.0)) + S::splat(10.0));
        let g = f * (f - one);
        rate[k] = S::splat(30.0) * g * g;
    }
    low[2] = S::xor_i(low[2], S::splat_i(seed));
    high[2] = S::xor_i(high[2], S::splat_i(seed));
    let xy = [
        S::xor_i(low[0], low[1]),
        S::xor_i(high[0], low[1]),
        S::xor_i(low[0], high[1]),
        S::xor_i(high[0], high[1]),
    ];
    let mut near = [one; 4];
    let mut far = [one; 4];
    for k in 0..4 {
        near[k] = lattice_value::<S>(S::xor_i(xy[k], low[2]));
        far[k] = lattice_value::<S>(S::xor_i(xy[k], high[2]));
    }
    // along x
    let (n0, n1) = (
        lerp::<S>(near[0], near[1], step[0]),
        lerp::<S>(near[2], near[3], step[0]),
    );
    let (f0, f1) = (
        lerp::<S>(far[0], far[1], step[0]),
        lerp::<S>(far[2], far[3], step[0]),
    );
    let (dn0, dn1) = (near[1] - near[0], near[3] - near[2]);
    let (df0, df1) = (far[1] - far[0], far[3] - far[2]);
    // along y, then z
    let (n, f) = (lerp::<S>(n0, n1, step[1]), lerp::<S>(f0, f1, step[1]));
    let dx = lerp::<S>(
        lerp::<S>(dn0, dn1, step[1]),
        lerp::<S>(df0, df1, step[1]),
        step[2],
    );
    let dy = lerp::<S>(n1 - n0, f1 - f0, step[2]);
    (
        lerp::<S>(n, f, step[2]),
        [dx * rate[0], dy * rate[1], (f - n) * rate[2]],
    )
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use crate::simd::Portable;

    fn noise(p: [f32; 3], seed: u32) -> (f32, [f32; 3]) {
        let (value, gradient) = value_noise::<Portable>(splat3::<Portable>(p), seed);
        let first = |x| {
            let mut lanes = [0.0; 8];
            Portable::store(x, &mut lanes);
            lanes[0]
        };
        (first(value), gradient.map(first))
    }

    #[test]
    fn the_gradient_of_the_noise_is_its_derivative() {
        for i in 0..300 {
            let t = i as f32 * 0.37 - 40.0;
            let p = [t, 1.7 * t + 0.3, 5.0 - 0.9 * t];
            let (_, gradient) = noise(p, 7);
            for k in 0..3 {
                let h = 2e-3;
                let (mut a, mut b) = (p, p);
                a[k] -= h;
                b[k] += h;
                let slope = (noise(b, 7).0 - noise(a, 7).0) / (b[k] - a[k]);
                assert!(
                    (slope - gradient[k]).abs() < 0.03,
                    "{slope} {}",
                    gradient[k]
                );
            }
        }
    }

    #[test]
    fn noise_is_centred_and_differs_from_seed_to_seed() {
        let at = |i: usize, seed| {
            noise(
                [i as f32 * 0.71, i as f32 * -0.39, (i % 17) as f32 * 1.3],
                seed,
            )
            .0
        };
        let n = 20_000;
        let mean = (0..n).map(|i| f64::from(at(i, 1))).sum::<f64>() / n as f64;
        let both = (0..n).map(|i| f64::from(at(i, 1) * at(i, 2))).sum::<f64>() / n as f64;
        let square = (0..n).map(|i| f64::from(at(i, 1)).powi(2)).sum::<f64>() / n as f64;
        assert!(mean.abs() < 0.02 && both.abs() < 0.01, "{mean} {both}");
        assert!((0.05..0.25).contains(&square), "{square}");
    }
}
