//! A rock-like texture by formula, for rendered tests and evaluations.

/// Value noise with a smooth (quintic) interpolation, -1 to 1.
fn value_noise(x: f64, y: f64, seed: u64) -> f64 {
    let corner = |i: i64, j: i64| {
        let mut h = (i as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
            ^ (j as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F)
            ^ seed.wrapping_mul(0x1656_67B1_9E37_79F9);
        h = (h ^ (h >> 32)).wrapping_mul(0xD6E8_FEB8_6659_FD93);
        h = (h ^ (h >> 32)).wrapping_mul(0xD6E8_FEB8_6659_FD93);
        (h >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    };
    let (i, j) = (x.floor(), y.floor());
    let (fx, fy) = (x - i, y - j);
    let ease = |t: f64| t * t * t * (t * (6.0 * t - 15.0) + 10.0);
    let (sx, sy) = (ease(fx), ease(fy));
    let (i, j) = (i as i64, j as i64);
    let top = corner(i, j) + (corner(i + 1, j) - corner(i, j)) * sx;
    let bottom = corner(i, j + 1) + (corner(i + 1, j + 1) - corner(i, j + 1)) * sx;
    top + (bottom - top) * sy
}

/// Sine and cosine of the octaves' turns, 0.7 rad each.
const TURNS: [(f64, f64); 8] = [
    (0.0, 1.0),
    (0.644217687237691, 0.7648421872844885),
    (0.9854497299884601, 0.16996714290024104),
    (0.8632093666488739, -0.5048461045998571),
    (0.3349881501559051, -0.9422223406686581),
    (-0.35078322768961984, -0.9364566872907963),
    (-0.8715757724135877, -0.4902608213407002),
    (-0.9824526126243326, 0.18651236942257488),
];

/// Rock-like texture around 110 DN: octaves of equal amplitude from `coarsest` down to `finest`
/// (wavelengths in the unit of x and y).
#[must_use]
pub fn texture(x: f64, y: f64, coarsest: f64, finest: f64, contrast_dn: f64, seed: u64) -> f64 {
    let mut sum = 0.0;
    let mut wavelength = coarsest;
    let mut octave = 0u64;
    while wavelength >= finest {
        let (s, c) = TURNS
            .get(octave as usize)
            .copied()
            .unwrap_or_else(|| (0.7 * octave as f64).sin_cos());
        let (a, b) = ((c * x - s * y) / wavelength, (s * x + c * y) / wavelength);
        sum += value_noise(
            a + 0.37 * octave as f64,
            b - 0.61 * octave as f64,
            seed + octave,
        );
        wavelength *= 0.5;
        octave += 1;
    }
    110.0 + contrast_dn * sum
}
