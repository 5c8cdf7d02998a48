//! The obstacle map: a grid of heights over the rover frame's x-y plane, made from stereo points.
//!
//! Each cell holds the greatest height that was seen in it; what lies below counts as solid. Cells
//! that nothing was seen in are unknown and obstruct nothing, but gaps no wider than the spacing
//! of the points are closed. A point without others near it is a false match and is left out.

use crate::segment::{Closest, Column, Segment};
use nalgebra::Vector3;
use std::collections::BTreeMap;

/// How a map is made.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapRules {
    /// Edge of a cell, m.
    pub cell_m: f64,
    /// A point counts only if [`Self::support_n`] others lie within this distance, m.
    pub support_radius_m: f64,
    /// How many others.
    pub support_n: usize,
    /// Unknown cells between two known ones of a row or column are closed up to this width, m;
    /// they take the greater height.
    pub gap_m: f64,
}

impl Default for MapRules {
    fn default() -> Self {
        Self {
            cell_m: 0.01,
            support_radius_m: 0.04,
            support_n: 2,
            gap_m: 0.03,
        }
    }
}

/// Most cells of a map: 100 m^2 at 1 cm.
pub const MAX_CELLS: usize = 1_000_000;

/// Why no map could be made.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MapError {
    /// No point has enough others near it.
    #[error(
        "none of {found_n} points has {support_n} others within {radius_m} m: nothing to make a \
         map of"
    )]
    NoPoints {
        /// Points given.
        found_n: usize,
        /// Others needed near each.
        support_n: usize,
        /// How near, m.
        radius_m: f64,
    },
    /// A coordinate is NaN or infinite.
    #[error("point {index} is not finite")]
    NotFinite {
        /// Which point, from 0.
        index: usize,
    },
    /// The points are spread too far.
    #[error("the points span {width_m:.1} x {depth_m:.1} m, too much for cells of {cell_m} m")]
    TooLarge {
        /// Extent along x, m.
        width_m: f64,
        /// Extent along y, m.
        depth_m: f64,
        /// Edge of a cell, m.
        cell_m: f64,
    },
}

/// Heights of the terrain, rover frame.
#[derive(Clone, Debug, PartialEq)]
pub struct TerrainMap {
    cell_m: f64,
    /// Corner of the first cell, whole cells from the frame's origin.
    corner: [i64; 2],
    points_n: usize,
    /// From single cells up to one cell over everything; each holds the greatest height below it.
    levels: Vec<Level>,
}

/// Heights of cells that are `2^level` cells wide; minus infinity where nothing is known.
#[derive(Clone, Debug, PartialEq)]
struct Level {
    size: [usize; 2],
    tops_m: Vec<f64>,
}

impl Level {
    fn unknown(size: [usize; 2]) -> Self {
        Self {
            size,
            tops_m: vec![f64::NEG_INFINITY; size[0] * size[1]],
        }
    }

    fn index(&self, cell: [usize; 2]) -> Option<usize> {
        (cell[0] < self.size[0] && cell[1] < self.size[1]).then(|| cell[1] * self.size[0] + cell[0])
    }

    fn raise(&mut self, cell: [usize; 2], height_m: f64) {
        if let Some(i) = self.index(cell) {
            self.tops_m[i] = self.tops_m[i].max(height_m);
        }
    }

    /// The height of a known cell.
    fn top(&self, cell: [usize; 2]) -> Option<f64> {
        self.index(cell)
            .map(|i| self.tops_m[i])
            .filter(|top| top.is_finite())
    }

    fn halved(&self) -> Self {
        let mut level = Self::unknown(self.size.map(|n| n.div_ceil(2)));
        for y in 0..self.size[1] {
            for x in 0..self.size[0] {
                level.raise([x / 2, y / 2], self.tops_m[y * self.size[0] + x]);
            }
        }
        level
    }
}

impl TerrainMap {
    /// A map of `points` (rover frame, m).
    ///
    /// # Errors
    /// [`MapError`] when nothing is left to make a map of, a point is not finite, or the points
    /// span more than [`MAX_CELLS`].
    pub fn from_points(points: &[Vector3<f64>], rules: &MapRules) -> Result<Self, MapError> {
        if let Some(index) = points.iter().position(|p| !p.iter().all(|x| x.is_finite())) {
            return Err(MapError::NotFinite { index });
        }
        let kept = supported(points, rules);
        let Some(first) = kept.first() else {
            return Err(MapError::NoPoints {
                found_n: points.len(),
                support_n: rules.support_n,
                radius_m: rules.support_radius_m,
            });
        };
        let (low, high) = kept
            .iter()
            .fold((*first, *first), |(low, high), p| (low.inf(p), high.sup(p)));
        let cell_of = |x: f64| (x / rules.cell_m).floor();
        let extent = [0, 1].map(|i| cell_of(high[i]) - cell_of(low[i]) + 1.0);
        if extent[0] * extent[1] > MAX_CELLS as f64 {
            return Err(MapError::TooLarge {
                width_m: high.x - low.x,
                depth_m: high.y - low.y,
                cell_m: rules.cell_m,
            });
        }
        let corner = [cell_of(low.x), cell_of(low.y)];
        let mut base = Level::unknown(extent.map(|n| n as usize));
        for p in &kept {
            let cell = [0, 1].map(|i| (cell_of(p[i]) - corner[i]) as usize);
            base.raise(cell, p.z);
        }
        let gap_cells = (rules.gap_m / rules.cell_m).round() as usize;
        let base = closed(&base, gap_cells);
        Ok(Self::new(
            rules.cell_m,
            corner.map(|c| c as i64),
            kept.len(),
            base,
        ))
    }

    fn new(cell_m: f64, corner: [i64; 2], points_n: usize, base: Level) -> Self {
        let mut levels = vec![base];
        while let Some(last) = levels.last().filter(|l| l.size != [1, 1]) {
            levels.push(last.halved());
        }
        Self {
            cell_m,
            corner,
            points_n,
            levels,
        }
    }

    /// Edge of a cell, m.
    pub fn cell_m(&self) -> f64 {
        self.cell_m
    }

    /// Points that the heights come from.
    pub fn points_n(&self) -> usize {
        self.points_n
    }

    /// Cells with a height.
    pub fn cells_n(&self) -> usize {
        self.levels[0]
            .tops_m
            .iter()
            .filter(|top| top.is_finite())
            .count()
    }

    /// The height of the cell at x, y (rover frame, m), if it is known.
    pub fn height_m(&self, x_m: f64, y_m: f64) -> Option<f64> {
        let at = |v: f64, corner: i64| (v / self.cell_m).floor() - corner as f64;
        let (x, y) = (at(x_m, self.corner[0]), at(y_m, self.corner[1]));
        if !(x >= 0.0 && y >= 0.0) {
            return None;
        }
        self.levels[0].top([x as usize, y as usize])
    }

    /// The terrain nearest to a segment (first point: on the segment, second: on the terrain), if
    /// it is nearer than `within_m`.
    pub fn closest(&self, segment: &Segment, within_m: f64) -> Option<Closest> {
        let mut best = None;
        let top_level = self.levels.len() - 1;
        self.search(segment, top_level, [0, 0], within_m, &mut best);
        best
    }

    fn column(&self, level: usize, cell: [usize; 2]) -> Option<Column> {
        let top_m = self.levels[level].top(cell)?;
        let base = self.levels[0].size;
        let edge = |i: usize, n: usize| {
            ((n << level).min(base[i]) as i64 + self.corner[i]) as f64 * self.cell_m
        };
        Some(Column {
            low_m: [edge(0, cell[0]), edge(1, cell[1])],
            high_m: [edge(0, cell[0] + 1), edge(1, cell[1] + 1)],
            top_m,
        })
    }

    /// Looks into the four cells below a cell, nearest first, and leaves out those that cannot
    /// hold anything nearer than what is known.
    fn search(
        &self,
        segment: &Segment,
        level: usize,
        cell: [usize; 2],
        within_m: f64,
        best: &mut Option<Closest>,
    ) {
        let Some(column) = self.column(level, cell) else {
            return;
        };
        let closest = segment.closest_to_column(&column);
        if closest.distance_m >= best.map_or(within_m, |b| b.distance_m) {
            return;
        }
        if level == 0 {
            *best = Some(closest);
            return;
        }
        let below =
            [[0, 0], [1, 0], [0, 1], [1, 1]].map(|d| [cell[0] * 2 + d[0], cell[1] * 2 + d[1]]);
        let bounds = below.map(|c| {
            self.column(level - 1, c).map_or(f64::INFINITY, |column| {
                segment.closest_to_column(&column).distance_m
            })
        });
        let mut order = [0, 1, 2, 3];
        order.sort_by(|&a, &b| bounds[a].total_cmp(&bounds[b]));
        for i in order {
            if bounds[i] < best.map_or(within_m, |b| b.distance_m) {
                self.search(segment, level - 1, below[i], within_m, best);
            }
        }
    }
}

/// The points with enough others near them, in their order.
fn supported(points: &[Vector3<f64>], rules: &MapRules) -> Vec<Vector3<f64>> {
    let radius = rules.support_radius_m;
    let bin = |p: &Vector3<f64>| [0, 1, 2].map(|i| (p[i] / radius).floor() as i64);
    let mut bins: BTreeMap<[i64; 3], Vec<usize>> = BTreeMap::new();
    for (i, p) in points.iter().enumerate() {
        bins.entry(bin(p)).or_default().push(i);
    }
    let near = |i: usize| {
        let centre = bin(&points[i]);
        let around = (0..27).map(move |n| {
            [
                centre[0] + n % 3 - 1,
                centre[1] + n / 3 % 3 - 1,
                centre[2] + n / 9 - 1,
            ]
        });
        around
            .filter_map(|b| bins.get(&b))
            .flatten()
            .filter(move |&&j| j != i && (points[i] - points[j]).norm() <= radius)
            .take(rules.support_n)
            .count()
    };
    (0..points.len())
        .filter(|&i| near(i) >= rules.support_n)
        .map(|i| points[i])
        .collect()
}

/// The level with gaps of up to `width` cells closed along rows and columns.
fn closed(level: &Level, width: usize) -> Level {
    let mut result = level.clone();
    for axis in 0..2 {
        for line in 0..level.size[1 - axis] {
            let cell = |n: usize| if axis == 0 { [n, line] } else { [line, n] };
            let mut last: Option<(usize, f64)> = None;
            for n in 0..level.size[axis] {
                let Some(top) = level.top(cell(n)) else {
                    continue;
                };
                if let Some((from, height)) = last
                    && n - from - 1 <= width
                {
                    (from + 1..n).for_each(|gap| result.raise(cell(gap), height.max(top)));
                }
                last = Some((n, top));
            }
        }
    }
    result
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use proptest::prelude::*;

    /// Points every 8 mm over 0.4 m x 0.4 m.
    fn ground(height: impl Fn(f64, f64) -> f64) -> Vec<Vector3<f64>> {
        let at = |i: i32| 0.3 + f64::from(i) * 8e-3;
        (0..50)
            .flat_map(|i| (0..50).map(move |j| (at(i), at(j) - 0.5)))
            .map(|(x, y)| Vector3::new(x, y, height(x, y)))
            .collect()
    }

    #[test]
    fn a_map_holds_the_greatest_height_of_each_cell() {
        let map = TerrainMap::from_points(&ground(|x, _| 0.1 * x), &MapRules::default()).unwrap();
        assert_eq!(map.points_n(), 2500);
        for (x, y) in [(0.4051, -0.1), (0.5, 0.0), (0.3001, -0.2)] {
            let height = map.height_m(x, y).unwrap();
            let cell_end = ((x / 0.01).floor() + 1.0) * 0.01;
            assert!((0.1 * (cell_end - 0.01) - 1e-9..=0.1 * cell_end + 1e-9).contains(&height));
        }
        assert_eq!(map.height_m(0.9, 0.0), None);
        assert_eq!(map.height_m(-0.9, 0.0), None);
    }

    #[test]
    fn single_outliers_leave_no_mark() {
        let mut points = ground(|_, _| 0.0);
        let clean = TerrainMap::from_points(&points, &MapRules::default()).unwrap();
        points.push(Vector3::new(0.5, 0.0, 0.3));
        points.push(Vector3::new(0.4, -0.1, 0.7));
        points.push(Vector3::new(0.4, 0.9, 0.0));
        assert_eq!(
            TerrainMap::from_points(&points, &MapRules::default()).unwrap(),
            clean
        );
    }

    #[test]
    fn a_small_rock_stays() {
        let rock = |x: f64, y: f64| f64::hypot(x - 0.5, y + 0.2) < 0.015;
        let points = ground(|x, y| if rock(x, y) { 0.05 } else { 0.0 });
        let map = TerrainMap::from_points(&points, &MapRules::default()).unwrap();
        assert_eq!(map.height_m(0.5, -0.2), Some(0.05));
    }

    #[test]
    fn what_was_not_seen_stays_unknown_but_narrow_gaps_close() {
        let mut points = ground(|_, _| 0.0);
        points.retain(|p| !(0.45..0.55).contains(&p.x) && !(0.35..0.37).contains(&p.x));
        let map = TerrainMap::from_points(&points, &MapRules::default()).unwrap();
        assert_eq!(map.height_m(0.505, -0.2), None);
        assert_eq!(map.height_m(0.361, -0.2), Some(0.0));
    }

    #[test]
    fn nothing_to_map_is_refused() {
        let lone = [Vector3::zeros(), Vector3::x()];
        let error = TerrainMap::from_points(&lone, &MapRules::default()).unwrap_err();
        assert!(matches!(error, MapError::NoPoints { found_n: 2, .. }));
        let mut points = ground(|_, _| 0.0);
        points[7].y = f64::NAN;
        let error = TerrainMap::from_points(&points, &MapRules::default()).unwrap_err();
        assert_eq!(error, MapError::NotFinite { index: 7 });
        let far = (0..3).flat_map(|i| [1e-3 * f64::from(i), 1e3].map(|x| Vector3::new(x, x, x)));
        let error = TerrainMap::from_points(&far.collect::<Vec<_>>(), &MapRules::default());
        assert!(matches!(error.unwrap_err(), MapError::TooLarge { .. }));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]
        #[test]
        fn the_nearest_terrain_is_that_of_all_cells(
            from in prop::array::uniform3(-0.4..0.8f64), d in prop::array::uniform3(-0.5..0.5f64),
            within_m in 0.01..0.6f64, bumps in prop::array::uniform2(2.0..30.0f64),
        ) {
            let points = ground(|x, y| 0.1 * (bumps[0] * x).sin() * (bumps[1] * y).cos());
            let map = TerrainMap::from_points(&points, &MapRules::default()).unwrap();
            let segment = Segment { from: from.into(), to: Vector3::from(from) + Vector3::from(d) };
            let size = map.levels[0].size;
            let brute = (0..size[0])
                .flat_map(|x| (0..size[1]).map(move |y| [x, y]))
                .filter_map(|cell| map.column(0, cell))
                .map(|column| segment.closest_to_column(&column).distance_m)
                .fold(f64::INFINITY, f64::min);
            match map.closest(&segment, within_m) {
                Some(closest) => prop_assert_eq!(closest.distance_m, brute),
                None => prop_assert!(brute >= within_m),
            }
        }
    }
}
