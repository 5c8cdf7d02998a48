//! Disparity of every pixel of a rectified pair, for the operator's view and for obstacles.
//!
//! Both images are reduced to their horizontal derivative (Sobel, clipped), which takes out light
//! and gain. The sum of absolute differences over a square window is carried along columns and rows
//! in whole numbers; the least sum wins if it is clearly less than any other two or more pixels away,
//! if the way back from the right image leads to the same pixel, and if there is texture. Two lines
//! of opposite slope through three sums give a start to a hundredth of a pixel; windows over slanted
//! ground blur it, so a plane through the agreeing neighbours replaces it where they lie on one.
//! All arithmetic is in whole numbers: the result does not depend on the vector unit.

use serde::{Deserialize, Serialize};

use super::dense_regions::drop_small;
use super::plane_smoothing::smooth;
use crate::image::{Image8, ImageError};

/// Settings of the dense matcher.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DenseRules {
    /// Disparities searched: 0 to this, exclusive; 16 to 256.
    pub disparities: u32,
    /// Half the side of the window less half a pixel: 3, 4 or 5 (7 x 7 to 11 x 11 px).
    pub half_window_px: u32,
    /// How much larger, in per cent, every sum two or more pixels away must be.
    pub uniqueness_percent: u32,
    /// Largest difference between the disparities of both directions, px.
    pub left_right_px: u32,
    /// Least mean clipped derivative in the window, DN/px (of 31).
    pub min_texture_dn: u32,
    /// Half the side of the window of the plane through neighbours, less half a pixel; 0 for none.
    pub half_plane_px: u32,
    /// Neighbours within this of a pixel's disparity agree with it, px.
    pub agreement_px: f32,
    /// Connected regions of fewer pixels are dropped.
    pub min_region_px: u32,
}

impl Default for DenseRules {
    fn default() -> Self {
        Self {
            disparities: 64,
            half_window_px: 4,
            uniqueness_percent: 8,
            left_right_px: 1,
            min_texture_dn: 2,
            half_plane_px: 3,
            agreement_px: 1.5,
            min_region_px: 80,
        }
    }
}

/// Why there is no disparity image.
#[derive(Debug, thiserror::Error)]
pub enum DenseError {
    /// A setting that cannot be worked with.
    #[error("dense rules: {name} is {found}, expected {expected}")]
    Rules {
        /// The field.
        name: &'static str,
        /// Its value.
        found: f64,
        /// What was expected.
        expected: &'static str,
    },
    /// Images of different sizes, or too small.
    #[error(
        "the images have {left:?} and {right:?} px, expected equal sizes of at least {least:?} px"
    )]
    Sizes {
        /// Left width and height, px.
        left: [u32; 2],
        /// Right width and height, px.
        right: [u32; 2],
        /// Least width and height, px.
        least: [u32; 2],
    },
    /// An image cannot be used.
    #[error(transparent)]
    Image(#[from] ImageError),
}

/// Steps of a held disparity per px.
pub(super) const STEPS: i32 = 64;
/// Mark of a pixel without disparity.
pub(super) const NONE: i16 = i16::MIN;

/// The disparity of every pixel of the left image: left column less right column, px.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Disparity {
    /// Width, px.
    pub width_px: u32,
    /// Height, px.
    pub height_px: u32,
    pub(super) held: Vec<i16>,
}

impl Disparity {
    /// Disparity at a pixel, px; `None` where there is none.
    #[must_use]
    pub fn at(&self, u: u32, v: u32) -> Option<f64> {
        if u >= self.width_px || v >= self.height_px {
            return None;
        }
        let held = self.held[v as usize * self.width_px as usize + u as usize];
        (held != NONE).then(|| f64::from(held) / f64::from(STEPS))
    }

    /// Pixels with a disparity.
    #[must_use]
    pub fn count(&self) -> usize {
        self.held.iter().filter(|&&d| d != NONE).count()
    }
}

impl DenseRules {
    fn validate(&self) -> Result<(), DenseError> {
        let check = |name, found: f64, low: f64, high: f64, expected| {
            if (low..=high).contains(&found) {
                Ok(())
            } else {
                Err(DenseError::Rules {
                    name,
                    found,
                    expected,
                })
            }
        };
        check(
            "disparities",
            self.disparities.into(),
            16.0,
            256.0,
            "16 to 256",
        )?;
        check(
            "half_window_px",
            self.half_window_px.into(),
            3.0,
            5.0,
            "3, 4 or 5",
        )?;
        check(
            "uniqueness_percent",
            self.uniqueness_percent.into(),
            0.0,
            100.0,
            "0 to 100",
        )?;
        check(
            "left_right_px",
            self.left_right_px.into(),
            0.0,
            16.0,
            "0 to 16",
        )?;
        check(
            "min_texture_dn",
            self.min_texture_dn.into(),
            0.0,
            31.0,
            "0 to 31",
        )?;
        check(
            "half_plane_px",
            self.half_plane_px.into(),
            0.0,
            7.0,
            "0 to 7",
        )?;
        check(
            "agreement_px",
            self.agreement_px.into(),
            0.1,
            16.0,
            "0.1 to 16",
        )?;
        check(
            "min_region_px",
            self.min_region_px.into(),
            0.0,
            1e9,
            "0 or more",
        )
    }
}

/// The derivative is clipped to this, DN, and held with it added.
const CAP: i16 = 31;

/// Horizontal Sobel derivative (an eighth of its weights' sum, halved), clipped and lifted.
fn derivative(image: &Image8) -> Vec<u8> {
    let (w, h) = (image.width_px as usize, image.height_px as usize);
    let mut out = vec![CAP as u8; w * h];
    for v in 1..h - 1 {
        let row = |v: usize| &image.pixels[v * w..(v + 1) * w];
        let (a, b, c) = (row(v - 1), row(v), row(v + 1));
        let n = w - 2;
        let (a0, a2, b0, b2, c0, c2) = (
            &a[..n],
            &a[2..2 + n],
            &b[..n],
            &b[2..2 + n],
            &c[..n],
            &c[2..2 + n],
        );
        let o = &mut out[v * w + 1..v * w + 1 + n];
        for i in 0..n {
            let d = i16::from(a2[i]) - i16::from(a0[i])
                + 2 * (i16::from(b2[i]) - i16::from(b0[i]))
                + i16::from(c2[i])
                - i16::from(c0[i]);
            o[i] = ((d >> 1).clamp(-CAP, CAP) + CAP) as u8;
        }
    }
    out
}

/// Working memory for the rows.
struct Rows {
    /// Column sums by disparity, `width` each.
    columns: Vec<u16>,
    /// Window sums by disparity, `width` each (the first and last half window unused).
    sums: Vec<u16>,
    best: Vec<u16>,
    best_at: Vec<u16>,
    right: Vec<u16>,
    right_at: Vec<u16>,
    second: Vec<u16>,
}

#[derive(Clone, Copy)]
struct Frame {
    width: usize,
    disparities: usize,
    half: usize,
}

/// Adds (or takes away) one row's absolute differences to the column sums.
#[inline(always)]
fn change<const ADD: bool>(frame: Frame, left: &[u8], right: &[u8], columns: &mut [u16]) {
    let w = frame.width;
    for d in 0..frame.disparities {
        let column = &mut columns[d * w..(d + 1) * w];
        // left of column d the right image has nothing to compare with
        let (beyond, column) = column.split_at_mut(d);
        for c in beyond {
            *c = if ADD {
                c.wrapping_add(2 * CAP as u16)
            } else {
                c.wrapping_sub(2 * CAP as u16)
            };
        }
        let n = w - d;
        let (l, r) = (&left[d..d + n], &right[..n]);
        for ((c, &a), &b) in column.iter_mut().zip(l).zip(r) {
            let difference = u16::from(a.abs_diff(b));
            *c = if ADD {
                c.wrapping_add(difference)
            } else {
                c.wrapping_sub(difference)
            };
        }
    }
}

/// Window sums of the current row, and the least of them in both directions.
#[inline(always)]
fn sum_up<const SIDE: usize>(frame: Frame, rows: &mut Rows) {
    let Frame { width: w, half, .. } = frame;
    let n = w + 1 - SIDE;
    rows.best.fill(u16::MAX);
    rows.right.fill(u16::MAX);
    for d in 0..frame.disparities {
        let column = &rows.columns[d * w..(d + 1) * w];
        let sums = &mut rows.sums[d * w + half..d * w + half + n];
        sums.copy_from_slice(&column[..n]);
        for k in 1..SIDE {
            for (s, &c) in sums.iter_mut().zip(&column[k..k + n]) {
                *s += c;
            }
        }
        let (best, at) = (
            &mut rows.best[half..half + n],
            &mut rows.best_at[half..half + n],
        );
        for ((&s, b), a) in sums.iter().zip(best).zip(at) {
            let less = s < *b;
            *a = if less { d as u16 } else { *a };
            *b = if less { s } else { *b };
        }
        // seen from the right image: its column is d further left
        let first = half.max(d);
        let sums = &rows.sums[d * w + first..d * w + half + n];
        let m = sums.len();
        let (best, at) = (
            &mut rows.right[first - d..first - d + m],
            &mut rows.right_at[first - d..first - d + m],
        );
        for ((&s, b), a) in sums.iter().zip(best).zip(at) {
            let less = s < *b;
            *a = if less { d as u16 } else { *a };
            *b = if less { s } else { *b };
        }
    }
    rows.second.fill(u16::MAX);
    for d in 0..frame.disparities {
        let sums = &rows.sums[d * w + half..d * w + half + n];
        let at = &rows.best_at[half..half + n];
        let second = &mut rows.second[half..half + n];
        for ((&s, &a), b) in sums.iter().zip(at).zip(second) {
            let apart = a.abs_diff(d as u16) > 1;
            let s = if apart { s } else { u16::MAX };
            *b = (*b).min(s);
        }
    }
}

/// One row: updates the column sums by the rows that enter and leave, and sums up.
#[inline(always)]
fn row_plain(frame: Frame, enter: (&[u8], &[u8]), leave: Option<(&[u8], &[u8])>, rows: &mut Rows) {
    change::<true>(frame, enter.0, enter.1, &mut rows.columns);
    if let Some((l, r)) = leave {
        change::<false>(frame, l, r, &mut rows.columns);
    }
    match frame.half {
        3 => sum_up::<7>(frame, rows),
        4 => sum_up::<9>(frame, rows),
        _ => sum_up::<11>(frame, rows),
    }
}

/// The same with wider vectors.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn row_avx2(frame: Frame, enter: (&[u8], &[u8]), leave: Option<(&[u8], &[u8])>, rows: &mut Rows) {
    row_plain(frame, enter, leave, rows);
}

fn row(frame: Frame, enter: (&[u8], &[u8]), leave: Option<(&[u8], &[u8])>, rows: &mut Rows) {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { row_avx2(frame, enter, leave, rows) };
    }
    row_plain(frame, enter, leave, rows);
}

/// Disparity of every pixel of a rectified pair (see [`super::Rectifier`]).
///
/// # Errors
/// [`DenseError`] for settings or images that cannot be used.
pub fn dense_disparity(
    left: &Image8,
    right: &Image8,
    rules: &DenseRules,
) -> Result<Disparity, DenseError> {
    rules.validate()?;
    left.validate()?;
    right.validate()?;
    let side = 2 * rules.half_window_px + 1;
    let least = [rules.disparities + side, side + 2];
    let sizes = [left, right].map(|i| [i.width_px, i.height_px]);
    if sizes[0] != sizes[1] || sizes[0][0] < least[0] || sizes[0][1] < least[1] {
        return Err(DenseError::Sizes {
            left: sizes[0],
            right: sizes[1],
            least,
        });
    }
    let (w, h) = (left.width_px as usize, left.height_px as usize);
    let frame = Frame {
        width: w,
        disparities: rules.disparities as usize,
        half: rules.half_window_px as usize,
    };
    let (a, b) = (derivative(left), derivative(right));
    let texture = textures(&a, w, h, frame.half);
    let need = (rules.min_texture_dn * side * side) as u16;
    let cells = w * frame.disparities;
    let mut rows = Rows {
        columns: vec![0; cells],
        sums: vec![u16::MAX; cells],
        best: vec![0; w],
        best_at: vec![0; w],
        right: vec![0; w],
        right_at: vec![0; w],
        second: vec![0; w],
    };
    let mut held = vec![NONE; w * h];
    let line = |v: usize| (&a[v * w..(v + 1) * w], &b[v * w..(v + 1) * w]);
    for v in 0..2 * frame.half {
        let (l, r) = line(v);
        change::<true>(frame, l, r, &mut rows.columns);
    }
    for v in frame.half..h - frame.half {
        let leave = (v > frame.half).then(|| line(v - frame.half - 1));
        row(frame, line(v + frame.half), leave, &mut rows);
        let out = &mut held[v * w..(v + 1) * w];
        let texture = &texture[v * w..(v + 1) * w];
        decide(frame, &rows, texture, need, rules, out);
    }
    let mut disparity = Disparity {
        width_px: left.width_px,
        height_px: left.height_px,
        held,
    };
    drop_small(&mut disparity, rules.min_region_px as usize);
    if rules.half_plane_px > 0 {
        let agreement = (rules.agreement_px * STEPS as f32) as i32;
        smooth(&mut disparity, rules.half_plane_px as usize, agreement);
    }
    Ok(disparity)
}

/// Checks and subpixel parts of one row.
fn decide(
    frame: Frame,
    rows: &Rows,
    texture: &[u16],
    need: u16,
    rules: &DenseRules,
    out: &mut [i16],
) {
    let w = frame.width;
    for u in frame.half..w - frame.half {
        let d = usize::from(rows.best_at[u]);
        if texture[u] < need || d == 0 || d + 1 >= frame.disparities || u < d + 1 + frame.half {
            continue;
        }
        let best = u32::from(rows.best[u]);
        if u32::from(rows.second[u]) * 100 < best * (100 + rules.uniqueness_percent) {
            continue;
        }
        let back = u32::from(rows.right_at[u - d]);
        if back.abs_diff(d as u32) > rules.left_right_px {
            continue;
        }
        let sum = |d: usize| i32::from(rows.sums[d * w + u]);
        let (before, here, after) = (sum(d - 1), sum(d), sum(d + 1));
        let steep = before.max(after) - here;
        if steep <= 0 {
            continue;
        }
        let part = (before - after) * STEPS / (2 * steep);
        out[u] = (d as i32 * STEPS + part) as i16;
    }
}

/// Sum of the clipped derivative's size over every window.
fn textures(derivative: &[u8], w: usize, h: usize, half: usize) -> Vec<u16> {
    let mut columns = vec![0u16; w];
    let mut out = vec![0u16; w * h];
    let size = |p: u8| u16::from(p.abs_diff(CAP as u8));
    for v in 0..h {
        for (c, &p) in columns.iter_mut().zip(&derivative[v * w..(v + 1) * w]) {
            *c += size(p);
        }
        if v > 2 * half {
            let gone = v - 2 * half - 1;
            for (c, &p) in columns
                .iter_mut()
                .zip(&derivative[gone * w..(gone + 1) * w])
            {
                *c -= size(p);
            }
        }
        if v >= 2 * half {
            let line = &mut out[(v - half) * w..(v - half + 1) * w];
            let mut sum: u16 = columns[..2 * half].iter().sum();
            for u in half..w - half {
                sum += columns[u + half];
                line[u] = sum;
                sum -= columns[u - half];
            }
        }
    }
    out
}
