//! From the predicted pose to a measured one: correlation of the warped appearance at reduced
//! resolution, then what the caller measures at the best places.

use nalgebra::{Matrix2, Vector2};

use super::align::refine;
use super::local_map::{Candidate, LocalMap};
use super::model::{self, Part, Picture, level_sigma};
use super::{NotFound, PlateSearch};
use crate::image::Image8;
use crate::ncc::{ScoreMap, SearchImage, Template, score_map};

/// Least side of a part's image at the coarse level, px of that level.
const MIN_COARSE_SIDE: f64 = 12.0;
/// Least radius of a mark at the coarse level, px of that level.
const MIN_COARSE_MARK: f64 = 0.9;
/// Coarsest level: quarter resolution.
const MAX_LEVEL: u32 = 2;

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
    image: &'a Image8,
    search: &'a PlateSearch<'a>,
    part: Part,
    /// First pixel of the window in the image.
    corner_px: [u32; 2],
    /// Width and height of the window, px of the image.
    size_px: [u32; 2],
    level: u32,
    /// Shorter side of the part's image, px.
    side: f64,
}

impl<'a> Field<'a> {
    fn new(
        image: &'a Image8,
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
            image,
            search,
            part,
            corner_px: [left, top],
            size_px: [right - left, bottom - top],
            level,
            side,
        })
    }

    /// Side of the window's pixels, px of the image.
    fn step(&self) -> u32 {
        1 << self.level
    }

    /// Width and height of the window in its own pixels.
    fn size(&self) -> [usize; 2] {
        self.size_px.map(|x| (x >> self.level) as usize)
    }

    /// The window.
    fn window(&self) -> SearchImage {
        let ([left, top], [width, height]) = (self.corner_px, self.size_px);
        SearchImage::new(self.image, left, top, width, height, self.level)
    }

    /// The part of the window over which a template of the given size moves when its first pixel is
    /// at the given positions, reduced `more` times.
    fn part_of_window(&self, at: [Positions; 2], size: [usize; 2], more: u32) -> SearchImage {
        let step = self.step() << more;
        let first = |k: usize| self.corner_px[k] + at[k].first as u32 * step;
        let length = |k: usize| (at[k].count + size[k] - 1) as u32 * step;
        SearchImage::new(
            self.image,
            first(0),
            first(1),
            length(0),
            length(1),
            self.level + more,
        )
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
    // a single crossing needs no more than its place when it looks as predicted
    if part == Part::Saddle {
        for place in glance(&field, map) {
            if place.score >= rules.min_saddle_score
                && let Ok(found) = measure(&place)
            {
                return Ok(found);
            }
        }
    }
    let window = field.window();
    let at_once = correlate(&field, &window, map);
    let mut placed = at_once.is_some();
    let mut places = field.distinct(at_once.unwrap_or_default());
    let enough = |c: &&Candidate| c.score >= rules.min_coarse_score;

    for place in places.iter().filter(enough).take(FIRST_PLACES) {
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
        if let Some(more) = correlate(&field, &window, &variant) {
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

/// Template positions along one axis.
#[derive(Clone, Copy, Debug)]
struct Positions {
    first: usize,
    count: usize,
}

/// The part's appearance under a map, to be found in a field's window.
struct Pattern {
    map: LocalMap,
    picture: Picture,
    /// Position in the window if the map is right.
    offset: Vector2<f64>,
    /// Positions that the search radius allows.
    searched: [Positions; 2],
}

impl Pattern {
    /// `None` if it does not fit in the window.
    fn new(field: &Field, map: &LocalMap) -> Option<Self> {
        let search = field.search;
        let step = f64::from(field.step());
        let (low, high) = model::bounds(search.layout, field.part, map);
        let size = |a: f64, b: f64| ((b - a) / step).ceil() as usize + 1;
        let (width, height) = (size(low.x, high.x), size(low.y, high.y));
        let [window_width, window_height] = field.size();
        if width > window_width || height > window_height {
            return None;
        }
        // its first pixel is drawn at the corner of the bounds
        let sigma_px = level_sigma(search.rules.blur_sigma_px, field.level);
        let layout = search.layout;
        let size = (width, height);
        let picture = model::draw(layout, field.part, map, sigma_px, low, step, size, false)?;
        // position i of the window has its first pixel's centre at corner + i step + (step - 1) / 2
        let corner = Vector2::from(field.corner_px.map(f64::from));
        let offset = (low - corner) / step - Vector2::repeat((step - 1.0) / (2.0 * step));
        let radius = search.search_radius_px / step;
        let range = |x: f64| {
            let first = (x - radius).floor().max(0.0);
            let last = (x + radius).ceil();
            Positions {
                first: first as usize,
                count: (last - first + 1.0).max(0.0) as usize,
            }
        };
        Some(Self {
            map: *map,
            picture,
            offset,
            searched: [range(offset.x), range(offset.y)],
        })
    }

    fn size(&self) -> [usize; 2] {
        [self.picture.width, self.picture.height]
    }

    fn template(&self) -> Option<Template> {
        let values: Vec<f32> = self.picture.values.iter().map(|x| -x).collect();
        let [width, height] = self.size();
        Template::new(width, height, &values, Some(&self.picture.mask)).ok()
    }

    /// The template at half the resolution.
    fn half_template(&self) -> Option<Template> {
        let [width, height] = self.size();
        let (half_width, half_height) = (width / 2, height / 2);
        let (mut values, mut mask) = (Vec::new(), Vec::new());
        for j in 0..half_height {
            for i in 0..half_width {
                let at = 2 * j * width + 2 * i;
                let four = [at, at + 1, at + width, at + width + 1];
                values.push(-0.25 * four.iter().map(|&k| self.picture.values[k]).sum::<f32>());
                mask.push(four.iter().all(|&k| self.picture.mask[k]));
            }
        }
        Template::new(half_width, half_height, &values, Some(&mask)).ok()
    }

    /// The candidate at a peak of the scores; `before` positions come before the map's.
    fn candidate(
        &self,
        field: &Field,
        scores: &ScoreMap,
        (i, j, score): (usize, usize, f32),
        before: [usize; 2],
    ) -> Option<Candidate> {
        let (du, dv) = scores.refine(i, j);
        let (x, y) = (before[0] + scores.left + i, before[1] + scores.top + j);
        let found = Vector2::new(x as f64 + du, y as f64 + dv);
        let map = &self.map;
        let pixel_px = map.pixel_px + (found - self.offset) * f64::from(field.step());
        LocalMap::from_parts(map.centre_m, pixel_px, map.m, map.g).map(|map| Candidate {
            map,
            score: f64::from(score),
        })
    }
}

/// Correlates one appearance over the window. `None` if it does not fit in.
fn correlate(field: &Field, window: &SearchImage, map: &LocalMap) -> Option<Vec<Candidate>> {
    let pattern = Pattern::new(field, map)?;
    let [x, y] = pattern.searched;
    let template = pattern.template()?;
    let scores = score_map(window, &template, x.first, y.first, x.count, y.count)?;
    let peaks = scores.peaks(field.search.rules.max_candidates).into_iter();
    Some(
        peaks
            .filter_map(|peak| pattern.candidate(field, &scores, peak, [0, 0]))
            .collect(),
    )
}

/// Least side of a part's image for a glance, px at its resolution.
const MIN_GLANCE_SIDE: f64 = 5.0;
/// Peaks that are looked at: those that score at least this fraction of the best.
const GLANCE_SCORE: f64 = 0.8;
/// Positions on either side of a peak that are correlated at the field's own resolution.
const GLANCE_ROUND: usize = 2;

/// The best places at half the field's resolution, each correlated anew in its surroundings at the
/// field's own, where it scores exactly as in [`correlate`]. Empty if this tells nothing.
fn glance(field: &Field, map: &LocalMap) -> Vec<Candidate> {
    if field.side < MIN_GLANCE_SIDE * f64::from(2 * field.step()) {
        return Vec::new();
    }
    let Some((pattern, places)) = half_places(field, map) else {
        return Vec::new();
    };
    let Some(template) = pattern.template() else {
        return Vec::new();
    };
    let mut found: Vec<Candidate> = places
        .iter()
        .filter_map(|&place| climb(field, &pattern, &template, place))
        .collect();
    found.sort_by(|a, b| b.score.total_cmp(&a.score));
    found
}

/// The peak of the scores close to a position in the window.
fn climb(
    field: &Field,
    pattern: &Pattern,
    template: &Template,
    place: [usize; 2],
) -> Option<Candidate> {
    let at = [0, 1].map(|k| pattern.around(field, k, place[k]));
    let window = field.part_of_window(at, pattern.size(), 0);
    let mut middle = [0, 1].map(|k| place[k].saturating_sub(at[k].first));
    for _ in 0..GLANCE_ROUND {
        // at the border a neighbour may be higher
        if (0..2).any(|k| middle[k] == 0 || middle[k] + 1 >= at[k].count) {
            return None;
        }
        let scores = score_map(&window, template, middle[0] - 1, middle[1] - 1, 3, 3)?;
        let (i, j, score) = scores.best()?;
        if (i, j) == (1, 1) {
            return pattern.candidate(field, &scores, (i, j, score), at.map(|p| p.first));
        }
        middle = [middle[0] + i - 1, middle[1] + j - 1];
    }
    None
}

/// The pattern, and the positions in the window of its best places at half the resolution.
fn half_places(field: &Field, map: &LocalMap) -> Option<(Pattern, Vec<[usize; 2]>)> {
    let pattern = Pattern::new(field, map)?;
    let half = pattern.half_template()?;
    let size = [half.width(), half.height()];
    let at = [0, 1].map(|k| {
        let Positions { first, count } = pattern.searched[k];
        let room = (field.size()[k] / 2 + 1).saturating_sub(size[k]);
        let end = ((first + count) / 2 + 1).min(room);
        Positions {
            first: first / 2,
            count: end.saturating_sub(first / 2),
        }
    });
    if at.iter().any(|p| p.count == 0) {
        return None;
    }
    let window = field.part_of_window(at, size, 1);
    let scores = score_map(&window, &half, 0, 0, at[0].count, at[1].count)?;
    let peaks = scores.peaks(2);
    let best = f64::from(peaks.first()?.2);
    let places = peaks
        .iter()
        .filter(|peak| f64::from(peak.2) >= GLANCE_SCORE * best)
        .map(|&(i, j, _)| {
            let (du, dv) = scores.refine(i, j);
            let place = |first: usize, x: f64| (2.0 * (first as f64 + x)).round().max(0.0);
            [
                place(at[0].first, i as f64 + du) as usize,
                place(at[1].first, j as f64 + dv) as usize,
            ]
        })
        .collect();
    Some((pattern, places))
}

impl Pattern {
    /// Positions close to one that are searched and inside the window.
    fn around(&self, field: &Field, axis: usize, position: usize) -> Positions {
        let Positions { first, count } = self.searched[axis];
        let room = (field.size()[axis] + 1).saturating_sub(self.size()[axis]);
        let end = (position + GLANCE_ROUND + 1).min(first + count).min(room);
        let first = first.max(position.saturating_sub(GLANCE_ROUND));
        Positions {
            first,
            count: end.saturating_sub(first),
        }
    }
}

/// What a glance and the full search say about a saddle.
#[cfg(test)]
pub(super) fn both_ways(
    image: &Image8,
    search: &PlateSearch,
    map: &LocalMap,
) -> Option<(Vec<Candidate>, Vec<Candidate>)> {
    let field = Field::new(image, search, map, Part::Saddle).ok()?;
    Some((
        glance(&field, map),
        correlate(&field, &field.window(), map)?,
    ))
}
