//! Least-squares alignment of the whole plate's appearance with the image.

use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

use super::PlateSearch;
use super::lanes::{LANES, Lane, add_products, each, ramp, total};
use super::local_map::{Candidate, LocalMap};
use super::model::{self, Part, Picture, level_sigma};
use crate::image::Image8;
use crate::ncc::SearchImage;

const MAX_STEPS: usize = 8;
/// Alignment stops when a step moves the part's corners by less, px of the level; the fits of the
/// marks do the rest.
const SETTLED_PX: f64 = 0.05;

/// Aligns position, rotation, size and shear level by level; `None` if it runs away.
pub(super) fn refine(
    image: &Image8,
    search: &PlateSearch,
    start: &Candidate,
    part: Part,
    level: u32,
) -> Option<Candidate> {
    let mut map = start.map;
    let mut score = 0.0;
    // half resolution is enough: the fit of the points does the rest
    for level in (level.min(1)..=level).rev() {
        let step = f64::from(1u32 << level);
        let sigma = level_sigma(search.rules.blur_sigma_px, level);
        for _ in 0..MAX_STEPS {
            let (next, moved, ncc) = align_step(image, search, &map, part, level, sigma)?;
            map = next;
            score = ncc;
            if moved < SETTLED_PX * step {
                break;
            }
        }
    }
    let away = (map.pixel_px - start.map.pixel_px).norm();
    let (low, high) = model::bounds(search.layout, part, &start.map);
    (away <= 0.25 * (high - low).norm()).then_some(Candidate { map, score })
}

/// One Gauss-Newton step for the six affine parameters, gain and offset. Returns the new map, how
/// far the farthest corner moved (px), and the NCC *before* the step.
fn align_step(
    image: &Image8,
    search: &PlateSearch,
    map: &LocalMap,
    part: Part,
    level: u32,
    sigma_px: f64,
) -> Option<(LocalMap, f64, f64)> {
    let step = f64::from(1u32 << level);
    let (low, high) = model::bounds(search.layout, part, map);
    // grid of reduced pixels that are blocks of the full image, aligned to multiples of step
    let first = |x: f64, size: u32| (x / step).floor().clamp(0.0, f64::from(size >> level)) as u32;
    let last =
        |x: f64, size: u32| ((x / step).ceil() + 1.0).clamp(0.0, f64::from(size >> level)) as u32;
    let (i0, j0) = (first(low.x, image.width_px), first(low.y, image.height_px));
    let (i1, j1) = (last(high.x, image.width_px), last(high.y, image.height_px));
    if i1 <= i0 + 2 || j1 <= j0 + 2 {
        return None;
    }
    let (width, height) = ((i1 - i0) as usize, (j1 - j0) as usize);
    let middle = (step - 1.0) / 2.0;
    let origin = Vector2::new(f64::from(i0) * step + middle, f64::from(j0) * step + middle);
    let picture = model::draw(
        search.layout,
        part,
        map,
        sigma_px,
        origin,
        step,
        (width, height),
        true,
    )?;
    let seen = SearchImage::new(
        image,
        i0 << level,
        j0 << level,
        (i1 - i0) << level,
        (j1 - j0) << level,
        level,
    );
    let (parameters, ncc) = solve(&picture, &seen, map)?;
    let change =
        Matrix2::new(parameters[2], parameters[3], parameters[4], parameters[5]) / NORMALISE_PX;
    let shift = Vector2::new(parameters[0], parameters[1]);
    let moved = shift.norm() + change.norm() * 0.5 * (high - low).norm();
    // a step larger than the marks is not believed
    let limit = 0.08 * (high - low).norm() + step;
    let damping = if moved > limit { limit / moved } else { 1.0 };
    let next = LocalMap::from_parts(
        map.centre_m,
        map.pixel_px + shift * damping,
        (Matrix2::identity() + change * damping) * map.m,
        map.g,
    )?;
    Some((next, moved, ncc))
}

/// Offsets are divided by this in the normal equations, to keep them well scaled.
const NORMALISE_PX: f64 = 32.0;

/// Least squares of image = gain * darkness(moved) + offset for the motion (du, dv, and the 2 x 2
/// change per [`NORMALISE_PX`]); also the NCC of image and picture as they are.
fn solve(picture: &Picture, seen: &SearchImage, map: &LocalMap) -> Option<([f64; 6], f64)> {
    let sums = accumulate(picture, seen, map);
    let mut normal = SMatrix::<f64, 8, 8>::zeros();
    let mut right = SVector::<f64, 8>::zeros();
    let mut sii = 0.0;
    let mut at = 0;
    for p in 0..9 {
        for q in 0..=p {
            match (p < 8, q < 8) {
                (true, true) => {
                    normal[(p, q)] = sums[at];
                    normal[(q, p)] = sums[at];
                }
                (false, true) => right[q] = sums[at],
                _ => sii = sums[at],
            }
            at += 1;
        }
    }
    let (n, si) = (normal[(7, 7)], right[7]);
    if n < 20.0 {
        return None;
    }
    // gain and offset with the motion at rest
    let (st, stt, sti) = (normal[(6, 7)], normal[(6, 6)], right[6]);
    let (vt, vi) = (stt - st * st / n, sii - si * si / n);
    let cross = sti - st * si / n;
    if !(vt > 0.0 && vi > 0.0) {
        return None;
    }
    let ncc = -cross / (vt * vi).sqrt(); // dark marks: darkness rises where grey falls
    let gain = cross / vt;
    let mut damped = normal;
    for p in 0..6 {
        damped[(p, p)] *= 1.0 + 1e-4;
        damped[(p, p)] += 1e-9;
    }
    let solution = damped.cholesky()?.solve(&right);
    // gain times motion was solved for
    let mut parameters = [0.0; 6];
    let gain = if solution[6].abs() > 0.3 * gain.abs() {
        solution[6]
    } else {
        gain
    };
    for (p, x) in parameters.iter_mut().zip(solution.iter()) {
        *p = x / gain;
    }
    parameters
        .iter()
        .all(|x| x.is_finite())
        .then_some((parameters, ncc))
}

/// Lower triangle of the normal equations of [`solve`], row by row: six motions, darkness, one,
/// grey value.
type Sums = [f64; 45];

/// Rows whose sums are held in single precision.
const ROWS_AT_ONCE: usize = 4;

fn accumulate(picture: &Picture, seen: &SearchImage, map: &LocalMap) -> Sums {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { accumulate_avx2(picture, seen, map) };
    }
    accumulate_plain(picture, seen, map)
}

/// The same with wider vectors.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn accumulate_avx2(picture: &Picture, seen: &SearchImage, map: &LocalMap) -> Sums {
    accumulate_plain(picture, seen, map)
}

#[inline(always)]
fn accumulate_plain(picture: &Picture, seen: &SearchImage, map: &LocalMap) -> Sums {
    let mut sums = [0.0f64; 45];
    let place = |k: usize, n: usize| {
        let at_px = picture.origin_px[k] + n as f64 * picture.step_px - map.pixel_px[k];
        (at_px / NORMALISE_PX) as f32
    };
    let step = (picture.step_px / NORMALISE_PX) as f32;
    for first_row in (0..picture.height).step_by(ROWS_AT_ONCE) {
        let mut rows = [[0.0f32; LANES]; 45];
        for j in first_row..picture.height.min(first_row + ROWS_AT_ONCE) {
            let v = place(1, j);
            let line = seen.values(j);
            let width = picture.width.min(line.len());
            for i in (0..width).step_by(LANES) {
                let cells = j * picture.width + i..j * picture.width + (i + LANES).min(width);
                let on = lane(&picture.mask[cells.clone()], |m| f32::from(u8::from(m)));
                if on.iter().all(|&on| on == 0.0) {
                    continue;
                }
                let values = lane(&picture.values[cells.clone()], |x| x);
                let du = lane(&picture.du[cells.clone()], |x| x);
                let dv = lane(&picture.dv[cells.clone()], |x| x);
                let grey = lane(&line[i..i + cells.len()], SearchImage::grey);
                let u = ramp(place(0, i), step);
                let (gu, gv) = (each(|k| -du[k] * on[k]), each(|k| -dv[k] * on[k]));
                let a = [
                    gu,
                    gv,
                    each(|k| gu[k] * u[k]),
                    each(|k| gu[k] * v),
                    each(|k| gv[k] * u[k]),
                    each(|k| gv[k] * v),
                    each(|k| values[k] * on[k]),
                    on,
                    each(|k| grey[k] * on[k]),
                ];
                add_products::<0>(&mut rows, &a, &a[0]);
                add_products::<1>(&mut rows, &a, &a[1]);
                add_products::<2>(&mut rows, &a, &a[2]);
                add_products::<3>(&mut rows, &a, &a[3]);
                add_products::<4>(&mut rows, &a, &a[4]);
                add_products::<5>(&mut rows, &a, &a[5]);
                add_products::<6>(&mut rows, &a, &a[6]);
                add_products::<7>(&mut rows, &a, &a[7]);
                add_products::<8>(&mut rows, &a, &a[8]);
            }
        }
        for (s, r) in sums.iter_mut().zip(&rows) {
            *s += f64::from(total(r));
        }
    }
    sums
}

/// Up to [`LANES`] values, zeros after them.
#[inline(always)]
fn lane<T: Copy>(values: &[T], f: impl Fn(T) -> f32) -> Lane {
    let mut out = [0.0; LANES];
    if let Some(whole) = values.first_chunk::<LANES>() {
        return each(|k| f(whole[k]));
    }
    for (o, &x) in out.iter_mut().zip(values) {
        *o = f(x);
    }
    out
}
