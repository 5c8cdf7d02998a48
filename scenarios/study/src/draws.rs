//! Random numbers of the studies: every draw is a hash of what it belongs to, so neither the order
//! of the work nor the number of threads can change it.

use std::f32::consts::FRAC_PI_2;

const GOLDEN: u64 = 0x9e37_79b9_7f4a_7c15;

/// The splitmix64 finaliser: a bijection whose output bits each depend on every input bit.
fn mixed(x: u64) -> u64 {
    let x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// The key of a stream of draws: a seed and the places in the study that the stream belongs to.
pub fn key(seed: u64, places: &[u64]) -> u64 {
    places
        .iter()
        .fold(mixed(seed.wrapping_add(GOLDEN)), |k, p| {
            mixed(k.wrapping_add(GOLDEN) ^ mixed(p.wrapping_mul(GOLDEN)))
        })
}

/// A uniform number in `(0, 1)` of 24 bits from the key and a counter.
#[inline(always)]
fn uniform(low: u32, high: u32, counter: u32) -> f32 {
    // Two rounds of a 32-bit hash with a half of the key before each: streams of different keys
    // are different permutations of the counter, not pieces of a common one.
    let x = counter.wrapping_mul(0x9e37_79b9) ^ low;
    let x = (x ^ (x >> 16)).wrapping_mul(0x7feb_352d);
    let x = (x ^ (x >> 15)).wrapping_mul(0x846c_a68b);
    let x = (x ^ (x >> 16)).wrapping_add(high);
    let x = (x ^ (x >> 15)).wrapping_mul(0xd35a_2d97);
    let x = x ^ (x >> 16);
    ((x >> 8) as i32 as f32 + 0.5) * (1.0 / 16_777_216.0)
}

/// Natural logarithm of `x` in `(0, 1)`, relative error below 1e-6 away from 1.
#[inline(always)]
fn ln(x: f32) -> f32 {
    // x = m 2^e with m in [sqrt(1/2), sqrt(2)); ln m = 2 atanh((m - 1)/(m + 1)).
    let bits = x.to_bits();
    let offset = bits.wrapping_sub(0x3f35_04f3);
    let exponent = (offset as i32) >> 23;
    let m = f32::from_bits((offset & 0x007f_ffff) + 0x3f35_04f3);
    let t = (m - 1.0) / (m + 1.0);
    let z = t * t;
    let series = t * (2.0 + z * (0.666_666_7 + z * (0.4 + z * (0.285_714_3 + z * 0.222_222_2))));
    exponent as f32 * std::f32::consts::LN_2 + series
}

/// Sine and cosine of `2 pi u`, `u` in `(0, 1)`.
#[inline(always)]
fn circle(u: f32) -> (f32, f32) {
    let shifted = u * 4.0 + 0.5;
    let quadrant = shifted as i32;
    let r = (u * 4.0 - quadrant as f32) * FRAC_PI_2;
    let z = r * r;
    let s = r * (1.0 + z * (-1.0 / 6.0 + z * (1.0 / 120.0 - z * (1.0 / 5040.0))));
    let c = 1.0 + z * (-0.5 + z * (1.0 / 24.0 + z * (-1.0 / 720.0 + z * (1.0 / 40_320.0))));
    let (a, b) = if quadrant & 1 == 0 { (s, c) } else { (c, s) };
    let a = if quadrant & 2 == 0 { a } else { -a };
    let b = if (quadrant + 1) & 2 == 0 { b } else { -b };
    (a, b)
}

/// Fills `first` and `second`, of equal length, with standard normal numbers (Box and Muller):
/// the draws `counter..` of the stream `key`. Single precision is enough for a draw: what is
/// drawn counts as exact. The largest magnitude possible is 5.9.
#[inline(always)]
pub fn fill_normals(key: u64, counter: u32, first: &mut [f32], second: &mut [f32]) {
    let (low, high) = (key as u32, (key >> 32) as u32);
    let n = first.len().min(second.len());
    let (first, second) = (&mut first[..n], &mut second[..n]);
    for i in 0..n {
        let c = counter.wrapping_add(2 * i as u32);
        let radius = (-2.0 * ln(uniform(low, high, c))).sqrt();
        let (s, c) = circle(uniform(low, high, c.wrapping_add(1)));
        first[i] = radius * c;
        second[i] = radius * s;
    }
}

/// A stream of standard normal and uniform numbers for work that is not batched.
#[derive(Clone, Debug)]
pub struct Draws {
    key: u64,
    counter: u64,
}

impl Draws {
    /// The stream that belongs to these places of the study.
    pub fn new(seed: u64, places: &[u64]) -> Self {
        Self {
            key: key(seed, places),
            counter: 0,
        }
    }

    /// Uniform in `(0, 1)`, 53 bits.
    pub fn unit(&mut self) -> f64 {
        self.counter = self.counter.wrapping_add(1);
        let bits = mixed(self.key.wrapping_add(self.counter.wrapping_mul(GOLDEN))) >> 11;
        (bits as f64 + 0.5) / 9_007_199_254_740_992.0
    }

    /// Uniform between two bounds.
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// Standard normal.
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * self.unit().ln()).sqrt();
        radius * (std::f64::consts::TAU * self.unit()).cos()
    }

    /// Three independent normal numbers of standard deviation `sigma`.
    pub fn vector(&mut self, sigma: f64) -> nalgebra::Vector3<f64> {
        nalgebra::Vector3::from_fn(|_, _| sigma * self.normal())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn batched_draws_are_standard_normal_and_independent() {
        const N: usize = 200_000;
        let (mut a, mut b) = (vec![0.0; N], vec![0.0; N]);
        fill_normals(key(1, &[2, 3]), 0, &mut a, &mut b);
        for x in [&a, &b] {
            let moment = |p: i32| x.iter().map(|v| f64::from(*v).powi(p)).sum::<f64>() / N as f64;
            assert!(moment(1).abs() < 0.01, "mean {}", moment(1));
            assert!((moment(2) - 1.0).abs() < 0.015, "variance {}", moment(2));
            assert!(moment(3).abs() < 0.03, "skewness {}", moment(3));
            assert!((moment(4) - 3.0).abs() < 0.1, "kurtosis {}", moment(4));
            let beyond = x.iter().filter(|v| v.abs() > 1.959_964).count() as f64 / N as f64;
            assert!((beyond - 0.05).abs() < 0.003, "tail {beyond}");
        }
        let cross = |lag: usize| {
            let pairs = a[lag..].iter().zip(&b);
            pairs.map(|(x, y)| f64::from(x * y)).sum::<f64>() / N as f64
        };
        for lag in [0, 1, 2, 7] {
            assert!(cross(lag).abs() < 0.01, "lag {lag}: {}", cross(lag));
        }
    }

    #[test]
    fn batched_draws_follow_the_exact_transform() {
        let (mut a, mut b) = ([0.0; 64], [0.0; 64]);
        let k = key(7, &[1]);
        fill_normals(k, 10, &mut a, &mut b);
        for i in 0..64_u32 {
            let u = |c| f64::from(uniform(k as u32, (k >> 32) as u32, c));
            let radius = (-2.0 * u(10 + 2 * i).ln()).sqrt();
            let angle = std::f64::consts::TAU * u(11 + 2 * i);
            let i = i as usize;
            assert!((f64::from(a[i]) - radius * angle.cos()).abs() < 3e-6);
            assert!((f64::from(b[i]) - radius * angle.sin()).abs() < 3e-6);
        }
    }

    #[test]
    fn streams_of_different_places_differ() {
        let first = |seed, places: &[u64]| Draws::new(seed, places).unit();
        assert_ne!(first(1, &[0, 1]), first(1, &[1, 0]));
        assert_ne!(first(1, &[0]), first(2, &[0]));
        assert_eq!(first(3, &[4, 5]), first(3, &[4, 5]));
    }
}
