//! From scattered crossings to the board's grid.

use super::candidates::Crossing;
use super::refine::Refined;
use super::{BoardCorner, Chessboard};
use crate::image::ImageF;
use crate::sample::bilinear;
use nalgebra::Vector2;
use std::collections::BTreeMap;

/// Seeds tried, spread over the candidates from the strongest.
const SEEDS: usize = 60;
/// Nearest candidates looked at for a seed's neighbours.
const AROUND: usize = 10;
/// A corner may lie this far from its predicted place, in steps of the grid.
const REACH: f64 = 0.3;
/// Least contrast across an edge, DN.
const MIN_EDGE: f64 = 6.0;
/// Least ratio of the swings of two neighbouring corners: light changes slowly over a board.
const ALIKE: f64 = 0.5;

type Cell = (i32, i32);

/// A grid that grows; places are in the level's pixels.
struct Growing<'a> {
    smooth: &'a ImageF,
    points: &'a [Crossing],
    cells: BTreeMap<Cell, usize>,
    taken: Vec<bool>,
    /// Bright on the left of the edge from cell (0, 0) to (1, 0).
    bright_left: bool,
}

/// The board's corners row by row; or how many corners of which extent the largest grid had.
pub(super) fn grow(
    smooth: &ImageF,
    points: &[Crossing],
    board: Chessboard,
) -> Result<Vec<Vector2<f64>>, (usize, [usize; 2])> {
    let mut largest = (0, [0, 0]);
    let mut tried = 0;
    let mut spent = vec![false; points.len()];
    for seed in 0..points.len() {
        // A seed that was part of a grid that failed would grow the same one again.
        if spent[seed] || tried == SEEDS {
            continue;
        }
        tried += 1;
        for (right, down, bright_left) in neighbours(smooth, points, seed) {
            let mut grid = Growing {
                smooth,
                points,
                cells: BTreeMap::from([((0, 0), seed), ((1, 0), right), ((0, 1), down)]),
                taken: vec![false; points.len()],
                bright_left,
            };
            for at in [seed, right, down] {
                grid.taken[at] = true;
            }
            grid.spread(2 * board.columns.max(board.rows));
            if let Some(corners) = grid.board(board) {
                return Ok(corners);
            }
            if grid.cells.len() > largest.0 {
                largest = (grid.cells.len(), grid.extent());
            }
            if grid.cells.len() > 8 {
                for at in grid.cells.values() {
                    spent[*at] = true;
                }
            }
        }
    }
    Err(largest)
}

/// Pairs of candidates that may be the right and the lower neighbour of a seed, and whether the
/// edge to the first is bright on its left.
fn neighbours(smooth: &ImageF, points: &[Crossing], seed: usize) -> Vec<(usize, usize, bool)> {
    let here = points[seed].at;
    let mut near: Vec<(f64, usize)> = points
        .iter()
        .enumerate()
        .filter(|(i, _)| *i != seed)
        .map(|(i, p)| ((p.at - here).norm(), i))
        .collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    near.truncate(AROUND);
    let along: Vec<(usize, bool)> = near
        .iter()
        .filter(|(_, i)| alike(&points[seed], &points[*i]))
        .filter_map(|(_, i)| Some((*i, edge(smooth, &here, &points[*i].at)?)))
        .collect();
    let mut pairs = Vec::new();
    for &(a, first) in &along {
        for &(b, second) in &along {
            let (p, q) = (points[a].at - here, points[b].at - here);
            let turn = p.perp(&q) / (p.norm() * q.norm());
            // Clockwise in the picture, and of opposite contrast: a crossing's two edges.
            if turn > 0.3 && first != second {
                pairs.push((a, b, first));
            }
        }
    }
    pairs.truncate(4);
    pairs
}

/// Whether two neighbours have contrasts that one board can have.
fn alike(a: &Crossing, b: &Crossing) -> bool {
    a.swing.min(b.swing) >= ALIKE * a.swing.max(b.swing)
}

/// Whether the line between two crossings is an edge: the sign of bright minus dark from its
/// left to its right, the same all along.
fn edge(smooth: &ImageF, from: &Vector2<f64>, to: &Vector2<f64>) -> Option<bool> {
    let along = to - from;
    let length = along.norm();
    if !(length > 3.0) {
        return None;
    }
    let across = Vector2::new(along.y, -along.x) / length * (0.18 * length).clamp(1.5, 6.0);
    let mut sign = None;
    for t in [0.3, 0.5, 0.7] {
        let middle = from + along * t;
        let (left, right) = (middle + across, middle - across);
        let step = f64::from(
            bilinear(smooth, left.x, left.y)?.value - bilinear(smooth, right.x, right.y)?.value,
        );
        if step.abs() < MIN_EDGE || sign.is_some_and(|s| s != (step > 0.0)) {
            return None;
        }
        sign = Some(step > 0.0);
    }
    sign
}

impl Growing<'_> {
    fn at(&self, cell: Cell) -> Option<Vector2<f64>> {
        self.cells.get(&cell).map(|i| self.points[*i].at)
    }

    /// Where a free cell's corner must be, and how long a step is there.
    fn predicted(&self, (i, j): Cell) -> Option<(Vector2<f64>, f64, Cell)> {
        let mut best: Option<(u8, Vector2<f64>, f64, Cell)> = None;
        for (di, dj) in [(1, 0), (-1, 0), (0, 1), (0, -1)] {
            let behind = (i - di, j - dj);
            let Some(b) = self.at(behind) else {
                continue;
            };
            // From the same line, with its change of step; or from the line beside it.
            let second = self.at((i - 2 * di, j - 2 * dj));
            let third = self.at((i - 3 * di, j - 3 * dj));
            let guess = match (second, third) {
                (Some(s), Some(t)) => Some((3, (b - s) * 2.0 - (s - t))),
                (Some(s), None) => Some((1, b - s)),
                _ => None,
            };
            let guess = guess.or_else(|| {
                [(dj, di), (-dj, -di)].iter().find_map(|(oi, oj)| {
                    let p = self.at((behind.0 + oi, behind.1 + oj))?;
                    let q = self.at((i + oi, j + oj))?;
                    Some((2, q - p))
                })
            });
            if let Some((rank, step)) = guess
                && best.as_ref().is_none_or(|(r, ..)| rank > *r)
            {
                best = Some((rank, b + step, step.norm(), behind));
            }
        }
        best.map(|(_, place, step, behind)| (place, step, behind))
    }

    fn spread(&mut self, reach: usize) {
        let reach = reach as i32;
        loop {
            let frontier: Vec<Cell> = self
                .cells
                .keys()
                .flat_map(|(i, j)| [(i + 1, *j), (i - 1, *j), (*i, j + 1), (*i, j - 1)])
                .filter(|cell| !self.cells.contains_key(cell))
                .filter(|(i, j)| i.abs() <= reach && j.abs() <= reach)
                .collect();
            let mut grown = false;
            for cell in frontier {
                if self.cells.contains_key(&cell) {
                    continue;
                }
                let Some((place, step, behind)) = self.predicted(cell) else {
                    continue;
                };
                let Some(found) = self.nearest(&place, REACH * step) else {
                    continue;
                };
                if self.belongs(behind, cell, found) {
                    self.cells.insert(cell, found);
                    self.taken[found] = true;
                    grown = true;
                }
            }
            if !grown {
                return;
            }
        }
    }

    /// Whether a candidate beside a corner of the grid is the board's next corner: as strong, and
    /// behind an edge whose sides are dark and bright as the board's squares alternate.
    fn belongs(&self, behind: Cell, cell: Cell, candidate: usize) -> bool {
        let (last, next) = (&self.points[self.cells[&behind]], &self.points[candidate]);
        let even = (behind.0 + behind.1) % 2 == 0;
        let along_x = cell.1 == behind.1;
        let bright_left = self.bright_left == (even == along_x);
        alike(last, next) && edge(self.smooth, &last.at, &next.at) == Some(bright_left)
    }

    fn nearest(&self, place: &Vector2<f64>, within: f64) -> Option<usize> {
        self.points
            .iter()
            .enumerate()
            .filter(|(i, _)| !self.taken[*i])
            .map(|(i, p)| ((p.at - place).norm(), i))
            .filter(|(distance, _)| *distance <= within)
            .min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)))
            .map(|(_, i)| i)
    }

    fn bounds(&self) -> [i32; 4] {
        let mut b = [i32::MAX, i32::MIN, i32::MAX, i32::MIN];
        for (i, j) in self.cells.keys() {
            b = [b[0].min(*i), b[1].max(*i), b[2].min(*j), b[3].max(*j)];
        }
        b
    }

    fn extent(&self) -> [usize; 2] {
        let [a, b, c, d] = self.bounds();
        [(b - a + 1) as usize, (d - c + 1) as usize]
    }

    /// The corners row by row if the grid is the whole board, in either orientation.
    fn board(&self, board: Chessboard) -> Option<Vec<Vector2<f64>>> {
        let [i0, i1, j0, j1] = self.bounds();
        let extent = self.extent();
        let upright = extent == [board.columns, board.rows];
        if !upright && extent != [board.rows, board.columns]
            || self.cells.len() != board.columns * board.rows
        {
            return None;
        }
        let mut corners = Vec::with_capacity(self.cells.len());
        for row in 0..board.rows as i32 {
            for column in 0..board.columns as i32 {
                // A quarter turn keeps x turning clockwise towards y.
                let cell = if upright {
                    (i0 + column, j0 + row)
                } else {
                    (i1 - row, j0 + column)
                };
                corners.push(self.at(cell)?);
            }
        }
        debug_assert!(j1 >= j0);
        Some(corners)
    }
}

/// The corners with the board's origin where the rules of [`super::find_chessboard`] put it.
pub(super) fn oriented(
    smooth: &ImageF,
    cells: &[Vector2<f64>],
    corners: &[Refined],
    board: Chessboard,
) -> Vec<BoardCorner> {
    let (columns, rows) = (board.columns, board.rows);
    let place = |i: usize, j: usize| cells[j * columns + i];
    let value =
        |p: Vector2<f64>| bilinear(smooth, p.x, p.y).map_or(f64::NAN, |s| f64::from(s.value));
    // Brightness of the square inside the corner at one end: it has the shade of the outermost
    // square diagonally opposite across the crossing.
    let inside = |i: [usize; 2], j: [usize; 2]| {
        let sum = place(i[0], j[0]) + place(i[1], j[0]) + place(i[0], j[1]) + place(i[1], j[1]);
        value(sum * 0.25)
    };
    let first = inside([0, 1], [0, 1]);
    let last = inside([columns - 1, columns - 2], [rows - 1, rows - 2]);
    let turned = if (columns + rows) % 2 == 1 {
        last < first
    } else {
        let height = |p: Vector2<f64>| p.x + p.y;
        height(place(columns - 1, rows - 1)) < height(place(0, 0))
    };
    let mut ordered: Vec<BoardCorner> = Vec::with_capacity(corners.len());
    for row in 0..rows {
        for column in 0..columns {
            let at = row * columns + column;
            let at = if turned { corners.len() - 1 - at } else { at };
            ordered.push(BoardCorner {
                column,
                row,
                pixel_px: corners[at].pixel_px,
                sigma_px: corners[at].sigma_px,
            });
        }
    }
    ordered
}
