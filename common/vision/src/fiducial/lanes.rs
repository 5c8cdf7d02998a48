//! The blurred images of discs and saddle, eight pixels of a row at a time in single precision.
//!
//! Every step is a short loop over arrays of fixed length, which the compiler turns into vectors;
//! the functions that call these are compiled twice, for any processor and for AVX2, with the same
//! operations in the same order and so the same results to the last bit.

use std::sync::OnceLock;

use super::local_map::LocalMap;
use crate::plate::{Disc, Saddle};

/// Pixels that are worked out together.
pub(super) const LANES: usize = 8;
/// One number for each of them.
pub(super) type Lane = [f32; LANES];

/// A function of the lane's index for every lane.
#[inline(always)]
pub(super) fn each(f: impl Fn(usize) -> f32) -> Lane {
    let mut out = [0.0; LANES];
    for (k, x) in out.iter_mut().enumerate() {
        *x = f(k);
    }
    out
}

/// `first`, `first + step`, ...
#[inline(always)]
pub(super) fn ramp(first: f32, step: f32) -> Lane {
    const COUNT: Lane = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0];
    each(|k| first + step * COUNT[k])
}

/// The larger of two numbers, the second one beside a NaN: a single instruction.
#[inline(always)]
pub(super) fn larger(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// The smaller of two numbers, the second one beside a NaN: a single instruction.
#[inline(always)]
pub(super) fn smaller(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

/// Adds the products of column `P` of a design matrix and the columns before it to row `P` of the
/// lower triangle of the normal equations.
#[inline(always)]
pub(super) fn add_products<const P: usize>(sums: &mut [Lane], columns: &[Lane], weighted: &Lane) {
    let first = P * (P + 1) / 2;
    for (sum, column) in sums[first..=first + P].iter_mut().zip(&columns[..=P]) {
        *sum = each(|k| sum[k] + weighted[k] * column[k]);
    }
}

/// The sum over the lanes.
#[inline(always)]
pub(super) fn total(x: &Lane) -> f32 {
    ((x[0] + x[4]) + (x[2] + x[6])) + ((x[1] + x[5]) + (x[3] + x[7]))
}

const NORMAL_REACH: f32 = 5.0;
const NORMAL_STEPS: f32 = 128.0;
const NORMAL_ENTRIES: usize = 2 * (NORMAL_REACH * NORMAL_STEPS) as usize + 2;

/// Standard normal distribution function and density from a table: error below 3e-6. Beyond
/// +-[`NORMAL_REACH`] they are 0 or 1 and 0.
#[derive(Debug)]
struct Normal {
    table: [[f32; 2]; NORMAL_ENTRIES],
}

fn normal() -> &'static Normal {
    static TABLE: OnceLock<Normal> = OnceLock::new();
    TABLE.get_or_init(|| {
        // Integrate the density by Simpson's rule from the middle outwards.
        let density = |x: f64| (-0.5 * x * x).exp() / (2.0 * std::f64::consts::PI).sqrt();
        let half = (NORMAL_REACH * NORMAL_STEPS) as usize;
        let h = 1.0 / f64::from(NORMAL_STEPS);
        let mut above = vec![0.5f64];
        for i in 0..half + 1 {
            let x = i as f64 * h;
            let area = h / 6.0 * (density(x) + 4.0 * density(x + h / 2.0) + density(x + h));
            above.push(above[i] + area);
        }
        let mut table = [[1.0, 0.0]; NORMAL_ENTRIES];
        table[0] = [0.0, 0.0];
        for (i, entry) in table.iter_mut().enumerate().take(2 * half).skip(1) {
            let p = if i >= half {
                above[i - half]
            } else {
                1.0 - above[half - i]
            };
            *entry = [p as f32, density((i as f64 - half as f64) * h) as f32];
        }
        Normal { table }
    })
}

/// Index of the table's entry at or before `x`, and the rest in steps of the table.
#[inline(always)]
fn place(x: f32) -> (i32, f32) {
    // a NaN becomes the lower bound
    let t = (smaller(larger(x, -NORMAL_REACH), NORMAL_REACH) + NORMAL_REACH) * NORMAL_STEPS;
    // SAFETY: t is 0 to 2 * NORMAL_REACH * NORMAL_STEPS.
    let i = unsafe { t.to_int_unchecked::<i32>() };
    (i, t - i as f32)
}

impl Normal {
    /// (distribution function, density) at `x`.
    #[inline]
    fn at(&self, x: f32) -> (f32, f32) {
        let (i, f) = place(x);
        let (a, b) = (self.table[i as usize], self.table[i as usize + 1]);
        (a[0] + (b[0] - a[0]) * f, a[1] + (b[1] - a[1]) * f)
    }

    /// The same for every lane.
    #[inline(always)]
    fn lanes(&self, x: &Lane) -> (Lane, Lane) {
        let (mut index, mut rest) = ([0i32; LANES], [0.0f32; LANES]);
        for k in 0..LANES {
            (index[k], rest[k]) = place(x[k]);
        }
        // value and density at the entry and at the next one
        let mut parts = [[0.0f32; LANES]; 4];
        for first in (0..LANES).step_by(4) {
            // SAFETY: `place` gives 0 to NORMAL_ENTRIES - 2, so that two entries follow.
            unsafe { self.corners(&index, first, &mut parts) };
        }
        let [a, b, c, d] = &parts;
        (
            each(|k| a[k] + (c[k] - a[k]) * rest[k]),
            each(|k| b[k] + (d[k] - b[k]) * rest[k]),
        )
    }

    /// Two entries from each of four indices, sorted by part.
    ///
    /// # Safety
    /// The indices are 0 to [`NORMAL_ENTRIES`] - 2, and `first + 4` is at most [`LANES`].
    #[inline(always)]
    unsafe fn corners(&self, index: &[i32; LANES], first: usize, parts: &mut [Lane; 4]) {
        #[cfg(target_arch = "x86_64")]
        {
            use std::arch::x86_64::{_MM_TRANSPOSE4_PS, _mm_loadu_ps, _mm_storeu_ps};
            // SAFETY: SSE belongs to every x86-64; the caller guarantees that the reads are inside.
            unsafe {
                let entry = |k: usize| {
                    let at = self.table.as_ptr().add(index[first + k] as usize);
                    _mm_loadu_ps(at.cast::<f32>())
                };
                let (mut a, mut b, mut c, mut d) = (entry(0), entry(1), entry(2), entry(3));
                _MM_TRANSPOSE4_PS(&mut a, &mut b, &mut c, &mut d);
                for (part, x) in parts.iter_mut().zip([a, b, c, d]) {
                    _mm_storeu_ps(part.as_mut_ptr().add(first), x);
                }
            }
        }
        #[cfg(not(target_arch = "x86_64"))]
        for k in first..first + 4 {
            let i = index[k] as usize;
            [parts[0][k], parts[1][k]] = self.table[i];
            [parts[2][k], parts[3][k]] = self.table[i + 1];
        }
    }
}

/// Standard normal distribution function and density at `x`, from the table.
#[inline]
pub(crate) fn normal_at(x: f32) -> (f32, f32) {
    normal().at(x)
}

/// Blurred darkness (0 white, 1 black) at eight pixels, its derivatives with respect to the pixel
/// and to the blur, and the distance from the mark's edge (negative inside).
#[derive(Clone, Copy, Debug)]
pub(super) struct Darkness {
    pub value: Lane,
    pub du: Lane,
    pub dv: Lane,
    pub dsigma: Lane,
    pub edge_px: Lane,
}

/// The inverse of a [`LocalMap`] about its centre: from an offset d (px) to q = M^-1 d and
/// D = 1 - g.q; the place on the plate is q / D.
#[derive(Clone, Copy, Debug)]
pub(super) struct Inverse {
    pub rows: [[f32; 2]; 2],
    /// Lengths of the rows, m/px.
    pub slopes: [f32; 2],
    g: [f32; 2],
}

impl Inverse {
    pub fn new(map: &LocalMap) -> Self {
        let i = map.inverse.map(|x| x as f32);
        let rows = [[i.m11, i.m12], [i.m21, i.m22]];
        Self {
            rows,
            slopes: rows.map(|r| (r[0] * r[0] + r[1] * r[1]).sqrt()),
            g: [map.g.x as f32, map.g.y as f32],
        }
    }

    /// q (x and y, m) and D.
    #[inline(always)]
    pub fn at(&self, du: &Lane, dv: f32) -> [Lane; 3] {
        let i = &self.rows;
        let x = each(|k| i[0][0] * du[k] + i[0][1] * dv);
        let y = each(|k| i[1][0] * du[k] + i[1][1] * dv);
        let d = each(|k| 1.0 - self.g[0] * x[k] - self.g[1] * y[k]);
        [x, y, d]
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum MarkKind {
    Disc,
    Saddle,
}

/// Evaluates a mark's image around its centre.
#[derive(Clone, Copy, Debug)]
pub(super) struct MarkModel {
    inverse: Inverse,
    sigma: f32,
    size_m: f32,
    kind: MarkKind,
    normal: &'static Normal,
}

/// Distances, in blurs, at which the table has 0 or 1.
const SURE: f32 = -NORMAL_REACH;

impl MarkModel {
    /// `map` must be centred on the disc.
    pub fn disc(map: &LocalMap, disc: &Disc, sigma_px: f64) -> Self {
        Self::new(map, disc.radius_m, sigma_px, MarkKind::Disc)
    }

    /// `map` must be centred on the saddle.
    pub fn saddle(map: &LocalMap, saddle: &Saddle, sigma_px: f64) -> Self {
        Self::new(map, saddle.half_size_m, sigma_px, MarkKind::Saddle)
    }

    fn new(map: &LocalMap, size_m: f64, sigma_px: f64, kind: MarkKind) -> Self {
        Self {
            inverse: Inverse::new(map),
            sigma: sigma_px as f32,
            size_m: size_m as f32,
            kind,
            normal: normal(),
        }
    }

    /// At offsets (px) from the mark's centre.
    #[inline(always)]
    pub fn at(&self, du: &Lane, dv: f32) -> Darkness {
        match self.kind {
            MarkKind::Disc => self.disc_at(du, dv),
            MarkKind::Saddle => self.saddle_at(du, dv),
        }
    }

    /// With q and D as in [`Inverse`], the place on the plate is q / D, the gradient of its distance
    /// from the centre is M^-T q / (|q| D), and so the distance from the edge over that gradient's
    /// length is (|q| - radius D) |q| / |M^-T q|.
    #[inline(always)]
    fn disc_at(&self, du: &Lane, dv: f32) -> Darkness {
        let [x, y, d] = self.inverse.at(du, dv);
        let i = &self.inverse.rows;
        let inverse_sigma = 1.0 / self.sigma;
        let radius = each(|k| (x[k] * x[k] + y[k] * y[k]).sqrt());
        let gu = each(|k| x[k] * i[0][0] + y[k] * i[1][0]);
        let gv = each(|k| x[k] * i[0][1] + y[k] * i[1][1]);
        // at the very centre there is no direction outwards; it is deep inside
        let over = each(|k| 1.0 / larger(gu[k] * gu[k] + gv[k] * gv[k], 1e-30).sqrt());
        let edge_px = each(|k| {
            let size = self.size_m * d[k];
            let edge = (radius[k] - size) * radius[k] * over[k];
            if radius[k] < 1e-3 * size { -1e3 } else { edge }
        });
        let inside = each(|k| -edge_px[k] * inverse_sigma);
        let (value, density) = self.normal.lanes(&inside);
        let rate = each(|k| density[k] * inverse_sigma);
        Darkness {
            value,
            du: each(|k| -rate[k] * (gu[k] * over[k])),
            dv: each(|k| -rate[k] * (gv[k] * over[k])),
            dsigma: each(|k| -rate[k] * inside[k]),
            edge_px,
        }
    }

    /// The gradients of both edges' distances are the rows of M^-1 over D, so that D leaves the
    /// distance in px.
    #[inline(always)]
    fn saddle_at(&self, du: &Lane, dv: f32) -> Darkness {
        let [x, y, d] = self.inverse.at(du, dv);
        let inverse = &self.inverse;
        let inverse_sigma = 1.0 / self.sigma;
        let over = inverse.slopes.map(|s| 1.0 / s);
        let unit = [0, 1].map(|r| inverse.rows[r].map(|c| c * over[r]));
        let zx = each(|k| x[k] * over[0] * inverse_sigma);
        let zy = each(|k| y[k] * over[1] * inverse_sigma);
        let ((px, dx), (py, dy)) = (self.normal.lanes(&zx), self.normal.lanes(&zy));
        let (ex, ey) = (each(|k| 2.0 * px[k] - 1.0), each(|k| 2.0 * py[k] - 1.0));
        // half the products' derivatives by the distances, 1/px
        let rate_x = each(|k| dx[k] * inverse_sigma * ey[k]);
        let rate_y = each(|k| dy[k] * inverse_sigma * ex[k]);
        let inner = each(|k| 0.5 + 0.5 * ex[k] * ey[k]);
        let edge = |q: &Lane, r: usize| each(|k| (q[k].abs() - self.size_m * d[k]) * over[r]);
        let (edge_x, edge_y) = (edge(&x, 0), edge(&y, 1));
        let edge_px = each(|k| larger(edge_x[k], edge_y[k]));
        let mut dark = Darkness {
            value: inner,
            du: each(|k| rate_x[k] * unit[0][0] + rate_y[k] * unit[1][0]),
            dv: each(|k| rate_x[k] * unit[0][1] + rate_y[k] * unit[1][1]),
            dsigma: each(|k| -(rate_x[k] * zx[k] + rate_y[k] * zy[k])),
            edge_px,
        };
        // the checker ends at the square's border, blurred like any edge
        if edge_px.iter().all(|&e| e <= SURE * self.sigma) {
            return dark;
        }
        let z = each(|k| edge_px[k] * inverse_sigma);
        let (inside, density) = self.normal.lanes(&each(|k| -z[k]));
        let fade = each(|k| inner[k] * density[k] * inverse_sigma);
        let outward = |c: usize| {
            each(|k| {
                if edge_x[k] >= edge_y[k] {
                    unit[0][c].copysign_by(x[k])
                } else {
                    unit[1][c].copysign_by(y[k])
                }
            })
        };
        let (out_u, out_v) = (outward(0), outward(1));
        dark.value = each(|k| inner[k] * inside[k]);
        dark.du = each(|k| dark.du[k] * inside[k] - fade[k] * out_u[k]);
        dark.dv = each(|k| dark.dv[k] * inside[k] - fade[k] * out_v[k]);
        dark.dsigma = each(|k| dark.dsigma[k] * inside[k] + fade[k] * z[k]);
        dark
    }
}

/// Turning a sign around.
trait CopySign {
    /// The number, negated if `by` is negative.
    fn copysign_by(self, by: f32) -> f32;
}

impl CopySign for f32 {
    #[inline(always)]
    fn copysign_by(self, by: f32) -> f32 {
        self * 1.0f32.copysign(by)
    }
}
