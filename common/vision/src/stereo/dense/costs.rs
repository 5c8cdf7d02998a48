//! The matching itself: sums of absolute differences of every pixel's window at every disparity,
//! and the least of them in both directions.
//!
//! Disparities lie side by side in memory, sixteen to a block, so that one vector instruction works
//! on as many of them. The right image is held mirrored for that: what a left column is compared
//! with then grows with the disparity. A column's sum over the window's height is carried from row
//! to row, a window's sum from column to column; nothing is summed anew.

#[cfg(target_arch = "x86_64")]
use super::lanes::avx2::Avx2;
use super::lanes::{Block, LANES, Lanes, Plain, least};
use super::{DenseRules, NONE, STEPS};
use crate::image::Image8;

/// Blocks of the most disparities that rules allow.
const MOST_BLOCKS: usize = 256 / LANES;
/// The derivative is clipped to this, DN, and held with it added.
const CAP: i16 = 31;
/// Where the mirrored right image has ended: far from every derivative.
const BEYOND: u8 = u8::MAX;

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

/// The derivative of the right image, rows mirrored and lengthened by the disparities.
fn mirrored(image: &Image8, more: usize) -> Vec<u8> {
    let w = image.width_px as usize;
    let mut out = Vec::with_capacity((w + more) * image.height_px as usize);
    for row in derivative(image).chunks_exact(w) {
        out.extend(row.iter().rev());
        out.resize(out.len() + more, BEYOND);
    }
    out
}

/// The best match of a left pixel in its row, before it is looked at from the right.
#[derive(Clone, Copy, Default)]
struct Candidate {
    /// Whether its own rules hold.
    stands: bool,
    disparity: u16,
    /// Disparity with its subpixel part, steps.
    steps: i16,
}

/// What is carried from row to row, and the results of one row.
struct Rows {
    /// Blocks of disparities.
    blocks: usize,
    half: usize,
    /// Column sums by column and disparity, after one window's width of zeros.
    columns: Vec<Block>,
    /// All ones for disparities beyond those searched.
    beyond: Vec<Block>,
    /// All ones at the disparities next to one, which is at the middle.
    near: Vec<u16>,
    /// Disparity of the least sum of every right column.
    right_at: Vec<u16>,
    found: Vec<Candidate>,
    /// Window sums of the current pixel, all ones beyond the disparities searched.
    sums: Vec<Block>,
}

/// One image row's derivatives: left, and right mirrored.
type Line<'a> = (&'a [u8], &'a [u8]);

/// Disparities of all rows, steps.
pub(super) fn matched(left: &Image8, right: &Image8, rules: &DenseRules) -> Vec<i16> {
    let (w, h) = (left.width_px as usize, left.height_px as usize);
    let half = rules.half_window_px as usize;
    let side = 2 * half + 1;
    let disparities = rules.disparities as usize;
    let blocks = disparities.div_ceil(LANES);
    let more = blocks * LANES;
    let (a, b) = (derivative(left), mirrored(right, more));
    let texture = textures(&a, w, h, half);
    let lane = |i: usize| if i < disparities { 0 } else { u16::MAX };
    let mut rows = Rows {
        blocks,
        half,
        columns: vec![[0; LANES]; (w + side) * blocks],
        beyond: (0..blocks)
            .map(|k| std::array::from_fn(|i| lane(k * LANES + i)))
            .collect(),
        right_at: vec![0; w],
        near: (0..2 * more)
            .map(|i| if i.abs_diff(more) <= 1 { u16::MAX } else { 0 })
            .collect(),
        found: vec![Candidate::default(); w],
        sums: vec![[0; LANES]; blocks],
    };
    let line = |v: usize| {
        (
            &a[v * w..(v + 1) * w],
            &b[v * (w + more)..(v + 1) * (w + more)],
        )
    };
    let mut held = vec![NONE; w * h];
    for v in 0..h {
        if v + 1 < side {
            enter(line(v), &mut rows);
            continue;
        }
        let leave = v.checked_sub(side).map(line);
        let middle = v - half;
        let texture = &texture[middle * w..(middle + 1) * w];
        row(line(v), leave, texture, rules, &mut rows);
        let out = &mut held[middle * w..(middle + 1) * w];
        for (u, (o, found)) in out.iter_mut().zip(&rows.found).enumerate() {
            let d = found.disparity;
            if found.stands {
                let back = rows.right_at[u - usize::from(d)];
                if u32::from(back.abs_diff(d)) <= rules.left_right_px {
                    *o = found.steps;
                }
            }
        }
    }
    held
}

/// The first blocks of a row of bytes.
#[inline(always)]
fn blocks_of(row: &[u8], blocks: usize) -> &[[u8; LANES]] {
    &row.as_chunks().0[..blocks]
}

/// The first rows: column sums only.
fn enter((left, right): Line<'_>, rows: &mut Rows) {
    let (w, blocks, side) = (left.len(), rows.blocks, 2 * rows.half + 1);
    for (u, &l) in left.iter().enumerate() {
        let with = blocks_of(&right[w - 1 - u..], blocks);
        let columns = &mut rows.columns[(u + side) * blocks..(u + side + 1) * blocks];
        for (column, with) in columns.iter_mut().zip(with) {
            for (c, &r) in column.iter_mut().zip(with) {
                *c += u16::from(l.abs_diff(r));
            }
        }
    }
}

/// One row: column sums by the rows that enter and leave, window sums, and the least of them.
#[inline(always)]
fn row_of<L: Lanes, const BLOCKS: usize>(
    entering: Line<'_>,
    leaving: Option<Line<'_>>,
    texture: &[u16],
    rules: &DenseRules,
    rows: &mut Rows,
) {
    let Rows {
        blocks,
        half,
        columns,
        beyond,
        near,
        right_at,
        found,
        sums,
    } = rows;
    let blocks = if BLOCKS > 0 { BLOCKS } else { *blocks };
    let (half, side) = (*half, 2 * *half + 1);
    let (w, more) = (entering.0.len(), blocks * LANES);
    let last = rules.disparities as u16 - 1;
    let need = rules.min_texture_dn * (side * side) as u32;
    found.fill(Candidate::default());
    let (none, step) = (L::splat(u16::MAX), L::splat(LANES as u16));
    let lanes = L::load(&std::array::from_fn(|i| i as u16));
    // sums of the window that ends at the current column
    let mut window = [L::splat(0); MOST_BLOCKS];
    // the least sum yet of each right column that can match the current left one, and its disparity
    let (mut right, mut at) = ([none; MOST_BLOCKS], [none; MOST_BLOCKS]);
    for end in 0..w {
        let with = blocks_of(&entering.1[w - 1 - end..], blocks);
        let (before, now) = columns[end * blocks..].split_at_mut(side * blocks);
        for k in 0..blocks {
            let mut column = L::load(&now[k]).plus(L::differences(entering.0[end], &with[k]));
            if let Some((left, right)) = leaving {
                let without = blocks_of(&right[w - 1 - end..], blocks);
                column = column.minus(L::differences(left[end], &without[k]));
            }
            column.store(&mut now[k]);
            window[k] = window[k].plus(column).minus(L::load(&before[k]));
        }
        if end + 1 < side {
            continue;
        }
        let u = end - half;
        // from the last pixel to this one a right column's disparity grows by one
        for k in (0..blocks).rev() {
            let before = if k > 0 {
                [right[k - 1], at[k - 1]]
            } else {
                [none; 2]
            };
            right[k] = right[k].shifted(before[0]);
            at[k] = at[k].shifted(before[1]);
        }
        // the least sum of each lane and its disparity
        let (mut lowest, mut lowest_at) = (none, lanes);
        let mut place = lanes;
        for k in 0..blocks {
            let sum = window[k].or(L::load(&beyond[k]));
            sum.store(&mut sums[k]);
            // the old one of equal ones stays
            let lower = right[k].lesser(sum);
            at[k] = place.replaced(right[k].equal(lower), at[k]);
            right[k] = lower;
            let lower = lowest.lesser(sum);
            lowest_at = place.replaced(lowest.equal(lower), lowest_at);
            lowest = lower;
            place = place.plus(step);
        }
        // the last lane's column has been compared with all; at the end of the row all have
        if let Some(column) = (u + 1).checked_sub(more) {
            right_at[column] = at[blocks - 1].last();
        }
        if end + 1 == w {
            for d in 0..more.min(u + 1) {
                right_at[u - d] = at[d / LANES].lane(d % LANES);
            }
        }
        if u32::from(texture[u]) < need {
            continue;
        }
        let best = least(lowest);
        let here = L::splat(best).equal(lowest);
        let best_at = least(none.replaced(here, lowest_at));
        let d = usize::from(best_at);
        if d == 0 || best_at >= last || u < d + 1 + half {
            continue;
        }
        let near = near[more - d..2 * more - d].as_chunks().0;
        let mut second = none;
        for (sum, near) in sums.iter().zip(near) {
            second = second.lesser(L::load(sum).or(L::load(near)));
        }
        let (second, margin) = (least(second), 100 + rules.uniqueness_percent);
        // what fits as well elsewhere is not unique, however well it fits
        if second == best || u32::from(second) * 100 < u32::from(best) * margin {
            continue;
        }
        let sum = |d: usize| i32::from(sums[d / LANES][d % LANES]);
        let (before, here, after) = (sum(d - 1), i32::from(best), sum(d + 1));
        let steep = before.max(after) - here;
        if steep > 0 {
            let part = (before - after) * STEPS / (2 * steep);
            found[u] = Candidate {
                stands: true,
                disparity: best_at,
                steps: (i32::from(best_at) * STEPS + part) as i16,
            };
        }
    }
}

/// The usual number of blocks as a constant, so that its loops are laid out in full.
#[inline(always)]
fn row_with<L: Lanes>(
    entering: Line<'_>,
    leaving: Option<Line<'_>>,
    texture: &[u16],
    rules: &DenseRules,
    rows: &mut Rows,
) {
    match rows.blocks {
        4 => row_of::<L, 4>(entering, leaving, texture, rules, rows),
        _ => row_of::<L, 0>(entering, leaving, texture, rules, rows),
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn row_avx2(
    entering: Line<'_>,
    leaving: Option<Line<'_>>,
    texture: &[u16],
    rules: &DenseRules,
    rows: &mut Rows,
) {
    row_with::<Avx2>(entering, leaving, texture, rules, rows);
}

fn row(
    entering: Line<'_>,
    leaving: Option<Line<'_>>,
    texture: &[u16],
    rules: &DenseRules,
    rows: &mut Rows,
) {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { row_avx2(entering, leaving, texture, rules, rows) };
    }
    row_with::<Plain>(entering, leaving, texture, rules, rows);
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
