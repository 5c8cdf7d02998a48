//! From the predicted pose to an aligned one: correlation of the warped appearance at reduced
//! resolution, then a least-squares alignment of the whole plate.

use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

use super::lanes::{LANES, Lane, each, ramp, total};
use super::model::{self, LocalMap, Part, Picture};
use super::{NotFound, PlateSearch};
use crate::image::Image8;
use crate::ncc::{SearchImage, Template, score_map};

/// A place where the plate may be: the map around the centre of the searched part, and the NCC of
/// its appearance there.
#[derive(Clone, Copy, Debug)]
pub(super) struct Candidate {
    pub map: LocalMap,
    pub score: f64,
}

/// Least side of a part's image at the coarse level, px of that level.
const MIN_COARSE_SIDE: f64 = 12.0;
/// Least radius of a mark at the coarse level, px of that level.
const MIN_COARSE_MARK: f64 = 0.9;
/// Coarsest level: quarter resolution.
const MAX_LEVEL: u32 = 2;
/// Variance of the box that makes one pixel of unit side, px^2.
const BOX_VARIANCE: f64 = 1.0 / 12.0;

/// Smallest half size of the searched part's marks, m.
fn smallest_mark_m(search: &PlateSearch, part: Part) -> f64 {
    let discs = search.layout.discs.iter().map(|d| d.radius_m);
    let saddle = search.layout.saddle.iter().map(|s| s.half_size_m);
    match part {
        Part::Plate => discs.chain(saddle).fold(f64::INFINITY, f64::min),
        Part::Saddle => saddle.fold(f64::INFINITY, f64::min),
    }
}

/// The part of the image to search, and at which resolution.
struct Field<'a> {
    search: &'a PlateSearch<'a>,
    part: Part,
    window: SearchImage,
    /// First pixel of the window in the image.
    corner: Vector2<f64>,
    level: u32,
    /// Shorter side of the part's image, px.
    side: f64,
}

impl<'a> Field<'a> {
    fn new(
        image: &Image8,
        search: &'a PlateSearch,
        map: &LocalMap,
        part: Part,
    ) -> Result<Self, NotFound> {
        let needed_px = search.rules.min_mark_radius_px;
        let mark_px = smallest_mark_m(search, part) * map.scales().0;
        if !(mark_px >= needed_px) {
            return Err(NotFound::TooSmall {
                found_px: mark_px,
                needed_px,
            });
        }
        let (low, high) = model::bounds(search.layout, part, map);
        let side = (high.x - low.x).min(high.y - low.y);
        let mut level = 0;
        while level < MAX_LEVEL
            && side / f64::from(2u32 << level) >= MIN_COARSE_SIDE
            && mark_px / f64::from(2u32 << level) >= MIN_COARSE_MARK
        {
            level += 1;
        }
        // the widest hypothesis must fit
        let step = f64::from(1u32 << level);
        let room = search.search_radius_px + 0.15 * (high - low).max() + 2.0 * step;
        let clamp = |x: f64, size: u32| x.clamp(0.0, f64::from(size)) as u32;
        let left = clamp((low.x - room).floor(), image.width_px);
        let top = clamp((low.y - room).floor(), image.height_px);
        let right = clamp((high.x + room).ceil() + 1.0, image.width_px);
        let bottom = clamp((high.y + room).ceil() + 1.0, image.height_px);
        if right <= left || bottom <= top {
            return Err(outside(search, map));
        }
        Ok(Self {
            search,
            part,
            window: SearchImage::new(image, left, top, right - left, bottom - top, level),
            corner: Vector2::new(f64::from(left), f64::from(top)),
            level,
            side,
        })
    }

    /// Drops places close to better ones.
    fn distinct(&self, mut places: Vec<Candidate>) -> Vec<Candidate> {
        places.sort_by(|a, b| b.score.total_cmp(&a.score));
        let mut kept: Vec<Candidate> = Vec::new();
        for place in places {
            let close = |c: &Candidate| {
                (c.map.pixel_px - place.map.pixel_px).norm() < SAME_PLACE * self.side
            };
            if !kept.iter().any(close) {
                kept.push(place);
            }
        }
        kept
    }
}

/// Places closer than this fraction of the part's side are one.
const SAME_PLACE: f64 = 0.15;
/// Places that are followed up before other rotations and sizes are tried.
const FIRST_PLACES: usize = 2;

fn outside(search: &PlateSearch, map: &LocalMap) -> NotFound {
    NotFound::OutsideImage {
        u_px: map.pixel_px.x,
        v_px: map.pixel_px.y,
        search_radius_px: search.search_radius_px,
    }
}

/// Looks for the searched part and measures it with `measure`, which is given candidates in the
/// order of their likeness until it accepts one.
pub(super) fn locate<T>(
    image: &Image8,
    search: &PlateSearch,
    map: &LocalMap,
    part: Part,
    measure: &dyn Fn(&Candidate) -> Result<T, NotFound>,
) -> Result<T, NotFound> {
    let rules = search.rules;
    let field = Field::new(image, search, map, part)?;
    let at_once = correlate(&field, map);
    let mut placed = at_once.is_some();
    let mut places = field.distinct(at_once.unwrap_or_default());
    let enough = |c: &&Candidate| c.score >= rules.min_coarse_score;

    for place in places.iter().filter(enough).take(FIRST_PLACES) {
        // a single crossing needs no more than its place when it looks as predicted
        if part == Part::Saddle
            && place.score >= rules.min_saddle_score
            && let Ok(found) = measure(place)
        {
            return Ok(found);
        }
        if let Some(aligned) = refine(image, search, place, part, field.level)
            && aligned.score >= rules.good_coarse_score
            && let Ok(found) = measure(&aligned)
        {
            return Ok(found);
        }
    }
    for variant in variants(search, map) {
        if let Some(more) = correlate(&field, &variant) {
            placed = true;
            places.extend(more);
        }
    }
    if !placed {
        return Err(outside(search, map));
    }
    places = field.distinct(places);
    let score = places.first().map_or(0.0, |c| c.score);
    let mut aligned: Vec<Candidate> = places
        .iter()
        .filter(enough)
        .take(rules.max_candidates)
        .filter_map(|place| refine(image, search, place, part, field.level))
        .collect();
    aligned.sort_by(|a, b| b.score.total_cmp(&a.score));
    let mut failure = None;
    for candidate in &aligned {
        match measure(candidate) {
            Ok(found) => return Ok(found),
            Err(e) => {
                failure.get_or_insert(e);
            }
        }
    }
    Err(failure.unwrap_or(NotFound::LowScore {
        score,
        limit: rules.min_coarse_score,
    }))
}

/// The predicted map turned, scaled and foreshortened as the rules say.
fn variants(search: &PlateSearch, map: &LocalMap) -> Vec<LocalMap> {
    let rules = search.rules;
    let mut all = Vec::new();
    let mut push = |change: Matrix2<f64>| {
        all.extend(LocalMap::from_parts(
            map.centre_m,
            map.pixel_px,
            change * map.m,
            map.g,
        ));
    };
    let turn = |degrees: f64| nalgebra::Rotation2::new(degrees.to_radians()).into_inner();
    for &angle in &rules.rotations_deg {
        push(turn(angle));
    }
    let angles: Vec<f64> = std::iter::once(0.0)
        .chain(rules.rotations_deg.iter().copied())
        .collect();
    for &scale in &rules.scales {
        for &angle in &angles {
            push(turn(angle) * scale);
        }
    }
    // squeeze along the direction in which the plate is already foreshortened
    let svd = map.m.svd(true, false);
    if let Some(u) = svd.u {
        let shortest = usize::from(svd.singular_values[1] < svd.singular_values[0]);
        let axis: Vector2<f64> = u.column(shortest).into_owned();
        for &factor in &rules.foreshortenings {
            push(Matrix2::identity() + (factor - 1.0) * axis * axis.transpose());
        }
    }
    all
}

/// Correlates one appearance over the window. `None` if it does not fit in.
fn correlate(field: &Field, map: &LocalMap) -> Option<Vec<Candidate>> {
    let Field {
        search,
        part,
        window,
        corner,
        level,
        ..
    } = field;
    let (part, level) = (*part, *level);
    let step = f64::from(1u32 << level);
    let (low, high) = model::bounds(search.layout, part, map);
    let size = |a: f64, b: f64| ((b - a) / step).ceil() as usize + 1;
    let (width, height) = (size(low.x, high.x), size(low.y, high.y));
    if width > window.width() || height > window.height() {
        return None;
    }
    // image position of the template's first pixel when drawn
    let origin = low;
    let picture = model::draw(
        search.layout,
        part,
        map,
        level_sigma(search.rules.blur_sigma_px, level),
        origin,
        step,
        (width, height),
    )?;
    let values: Vec<f32> = picture.values.iter().map(|x| -x).collect();
    let template = Template::new(width, height, &values, Some(&picture.mask)).ok()?;
    // position i of the window has its first pixel's centre at corner + i step + (step - 1) / 2
    let offset = (origin - corner) / step - Vector2::repeat((step - 1.0) / (2.0 * step));
    let radius = search.search_radius_px / step;
    let range = |x: f64| {
        let first = (x - radius).floor().max(0.0);
        let last = (x + radius).ceil();
        (first as usize, (last - first + 1.0).max(0.0) as usize)
    };
    let ((x, columns), (y, rows)) = (range(offset.x), range(offset.y));
    let scores = score_map(window, &template, x, y, columns, rows)?;
    let list = scores
        .peaks(search.rules.max_candidates)
        .into_iter()
        .filter_map(|(i, j, score)| {
            let (du, dv) = scores.refine(i, j);
            let found = Vector2::new((scores.left + i) as f64 + du, (scores.top + j) as f64 + dv);
            let pixel_px = map.pixel_px + (found - offset) * step;
            LocalMap::from_parts(map.centre_m, pixel_px, map.m, map.g).map(|map| Candidate {
                map,
                score: f64::from(score),
            })
        });
    Some(list.collect())
}

/// Blur of an image reduced `level` times, in full-resolution px.
fn level_sigma(sigma_px: f64, level: u32) -> f64 {
    let step = f64::from(1u32 << level);
    // the full-resolution blur already holds one pixel's box
    (sigma_px * sigma_px + (step * step - 1.0) * BOX_VARIANCE).sqrt()
}

const MAX_STEPS: usize = 8;
/// Alignment stops when a step moves the part's corners by less, px of the level.
const SETTLED_PX: f64 = 0.02;

/// Aligns position, rotation, size and shear level by level; `None` if it runs away.
fn refine(
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
        for q in p..9 {
            match (p < 8, q < 8) {
                (true, true) => normal[(p, q)] = sums[at],
                (true, false) => right[p] = sums[at],
                _ => sii = sums[at],
            }
            at += 1;
        }
    }
    let (n, si) = (normal[(7, 7)], right[7]);
    for p in 0..8 {
        for q in 0..p {
            normal[(p, q)] = normal[(q, p)];
        }
    }
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

/// Upper triangle of the normal equations of [`solve`], row by row: six motions, darkness, one,
/// grey value.
type Sums = [f64; 45];

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
    for j in 0..picture.height {
        let v = place(1, j);
        let line = seen.values(j);
        let width = picture.width.min(line.len());
        let mut rows = [[0.0f32; LANES]; 45];
        for i in (0..width).step_by(LANES) {
            let cells = j * picture.width + i..j * picture.width + (i + LANES).min(width);
            let on = lane(&picture.mask[cells.clone()], |m| f32::from(u8::from(m)));
            if on.iter().all(|&on| on == 0.0) {
                continue;
            }
            let part = |of: &[f32]| {
                let x = lane(&of[cells.clone()], |x| x);
                each(|k| x[k] * on[k])
            };
            let (du, dv) = (part(&picture.du), part(&picture.dv));
            let (gu, gv) = (each(|k| -du[k]), each(|k| -dv[k]));
            let grey = lane(&line[i..i + cells.len()], SearchImage::grey);
            let u = ramp(place(0, i), step);
            let a = [
                gu,
                gv,
                each(|k| gu[k] * u[k]),
                each(|k| gu[k] * v),
                each(|k| gv[k] * u[k]),
                each(|k| gv[k] * v),
                part(&picture.values),
                on,
                each(|k| grey[k] * on[k]),
            ];
            let mut at = 0;
            for p in 0..9 {
                for q in p..9 {
                    for k in 0..LANES {
                        rows[at][k] += a[p][k] * a[q][k];
                    }
                    at += 1;
                }
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
