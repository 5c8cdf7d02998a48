//! Scores over a range of positions, and their peaks.

use super::dots::dots;
use super::masked;
use super::small::{self, Extent, Scale};
use super::{FLAT_DN, SCALE, SearchImage, Template};

/// Scores for template positions: the template's first pixel at column `left + i`, row `top + j`
/// of the [`SearchImage`].
#[derive(Clone, Debug)]
pub struct ScoreMap {
    /// Leftmost position, px of the search image.
    pub left: usize,
    /// Topmost position, px of the search image.
    pub top: usize,
    /// Number of positions across.
    pub width: usize,
    /// Number of positions down.
    pub height: usize,
    /// NCC of every position, row by row, -1 to 1; 0 where the image is flat.
    pub scores: Vec<f32>,
}

impl ScoreMap {
    /// Score at a position counted from `left`, `top`.
    #[must_use]
    pub fn at(&self, i: usize, j: usize) -> f32 {
        self.scores[j * self.width + i]
    }

    /// The best position and its score; the first of equals. `None` for an empty map.
    #[must_use]
    pub fn best(&self) -> Option<(usize, usize, f32)> {
        let mut best: Option<(usize, f32)> = None;
        for (i, &s) in self.scores.iter().enumerate() {
            if best.is_none_or(|(_, b)| s > b) {
                best = Some((i, s));
            }
        }
        best.map(|(i, s)| (i % self.width, i / self.width, s))
    }

    /// The best `count` local maxima (of their 3 x 3 neighbourhoods), best first.
    #[must_use]
    pub fn peaks(&self, count: usize) -> Vec<(usize, usize, f32)> {
        // sorted; most places fall short of the last one kept and need no look at their neighbours
        let mut all: Vec<(usize, usize, f32)> = Vec::with_capacity(count + 1);
        for j in 0..self.height {
            for i in 0..self.width {
                let s = self.at(i, j);
                if all.len() == count && all.last().is_none_or(|last| s <= last.2) {
                    continue;
                }
                let rows = j.saturating_sub(1)..=(j + 1).min(self.height - 1);
                let is_peak = rows.into_iter().all(|y| {
                    (i.saturating_sub(1)..=(i + 1).min(self.width - 1)).all(|x| {
                        let other = self.at(x, y);
                        other < s || (other == s && (y, x) >= (j, i))
                    })
                });
                if is_peak {
                    let at = all.partition_point(|kept| kept.2 >= s);
                    all.insert(at, (i, j, s));
                    all.truncate(count);
                }
            }
        }
        all
    }

    /// Shift of the peak from (`i`, `j`) by the least-squares quadratic over 3 x 3 scores, px; each
    /// part within +-1. Zero at the border of the map.
    #[must_use]
    pub fn refine(&self, i: usize, j: usize) -> (f64, f64) {
        if i == 0 || j == 0 || i + 1 >= self.width || j + 1 >= self.height {
            return (0.0, 0.0);
        }
        let mut block = [[0.0f64; 3]; 3];
        for (y, row) in block.iter_mut().enumerate() {
            for (x, cell) in row.iter_mut().enumerate() {
                *cell = f64::from(self.at(i + x - 1, j + y - 1));
            }
        }
        quadratic_peak(&block).unwrap_or((0.0, 0.0))
    }
}

/// Position of the maximum of the least-squares quadratic through 3 x 3 values (rows are v), px
/// from the middle. `None` if it has no maximum or lies further than 1 px away.
#[must_use]
pub fn quadratic_peak(block: &[[f64; 3]; 3]) -> Option<(f64, f64)> {
    let column = |x: usize| block[0][x] + block[1][x] + block[2][x];
    let row = |y: usize| block[y].iter().sum::<f64>();
    let du = (column(2) - column(0)) / 6.0;
    let dv = (row(2) - row(0)) / 6.0;
    let duu = (column(0) - 2.0 * column(1) + column(2)) / 3.0;
    let dvv = (row(0) - 2.0 * row(1) + row(2)) / 3.0;
    let duv = (block[2][2] - block[2][0] - block[0][2] + block[0][0]) / 4.0;
    let det = duu * dvv - duv * duv;
    if !(det > 0.0 && duu < 0.0) {
        return None;
    }
    let shift = ((duv * dv - dvv * du) / det, (duv * du - duu * dv) / det);
    (shift.0.abs() <= 1.0 && shift.1.abs() <= 1.0).then_some(shift)
}

/// Sums that the score's denominator needs, for one row of positions.
struct WindowSums {
    sums: Vec<i64>,
    squares: Vec<i64>,
}

/// Column sums of a rectangular template's window, moved down row by row.
struct ColumnSums {
    sums: Vec<i32>,
    squares: Vec<u32>,
}

impl ColumnSums {
    fn new(image: &SearchImage, left: usize, columns: usize, top: usize, rows: usize) -> Self {
        let mut this = Self {
            sums: vec![0; columns],
            squares: vec![0; columns],
        };
        for y in top..top + rows {
            this.change::<1>(&image.row(y)[left..left + columns]);
        }
        this
    }

    fn change<const SIGN: i32>(&mut self, row: &[i16]) {
        for ((sum, square), &x) in self.sums.iter_mut().zip(&mut self.squares).zip(row) {
            let x = i32::from(x);
            *sum += SIGN * x;
            *square = square.wrapping_add_signed(SIGN * x * x);
        }
    }

    fn windows(&self, width: usize, out: &mut WindowSums) {
        let mut sum: i64 = self.sums[..width].iter().map(|&x| i64::from(x)).sum();
        let mut square: i64 = self.squares[..width].iter().map(|&x| i64::from(x)).sum();
        out.sums[0] = sum;
        out.squares[0] = square;
        for i in 1..out.sums.len() {
            sum += i64::from(self.sums[i + width - 1]) - i64::from(self.sums[i - 1]);
            square += i64::from(self.squares[i + width - 1]) - i64::from(self.squares[i - 1]);
            out.sums[i] = sum;
            out.squares[i] = square;
        }
    }
}

/// Row-wise running sums (first `left` columns left out) for templates with a mask.
struct RowPrefix {
    stride: usize,
    top: usize,
    sums: Vec<i32>,
    squares: Vec<u32>,
}

impl RowPrefix {
    fn new(image: &SearchImage, left: usize, columns: usize, top: usize, rows: usize) -> Self {
        let stride = columns + 1;
        let mut this = Self {
            stride,
            top,
            sums: vec![0; stride * rows],
            squares: vec![0; stride * rows],
        };
        for y in 0..rows {
            let (mut sum, mut square) = (0i32, 0u32);
            let row = &image.row(top + y)[left..left + columns];
            let start = y * stride + 1;
            let out = this.sums[start..]
                .iter_mut()
                .zip(&mut this.squares[start..]);
            for ((s, q), &x) in out.zip(row) {
                sum += i32::from(x);
                square = square.wrapping_add((i32::from(x) * i32::from(x)) as u32);
                *s = sum;
                *q = square;
            }
        }
        this
    }

    fn windows(&self, template: &Template, y: usize, out: &mut WindowSums) {
        out.sums.fill(0);
        out.squares.fill(0);
        let n = out.sums.len();
        for span in &template.spans {
            let start = (y + span.row - self.top) * self.stride;
            let (from, to) = (start + span.start, start + span.end);
            let ends = self.sums[to..to + n].iter().zip(&self.sums[from..from + n]);
            for (o, (b, a)) in out.sums.iter_mut().zip(ends) {
                *o += i64::from(b - a);
            }
            let ends = self.squares[to..to + n]
                .iter()
                .zip(&self.squares[from..from + n]);
            for (o, (b, a)) in out.squares.iter_mut().zip(ends) {
                *o += i64::from(b.wrapping_sub(*a));
            }
        }
    }
}

/// NCC of `template` with its first pixel at every position `left..left + columns`,
/// `top..top + rows` of `image`. Positions at which the template would leave the image are cut off
/// (the map tells its true extent); `None` if none is left.
#[must_use]
pub fn score_map(
    image: &SearchImage,
    template: &Template,
    left: usize,
    top: usize,
    columns: usize,
    rows: usize,
) -> Option<ScoreMap> {
    let last_x = (image.width + 1).checked_sub(template.width)?;
    let last_y = (image.height + 1).checked_sub(template.height)?;
    let width = last_x.min(left.checked_add(columns)?).checked_sub(left)?;
    let height = last_y.min(top.checked_add(rows)?).checked_sub(top)?;
    if width == 0 || height == 0 {
        return None;
    }
    let covered_columns = width + template.width - 1;
    let covered_rows = height + template.height - 1;
    let mut scores = Vec::with_capacity(width * height);
    let n = template.count as f64;
    let scale = Scale {
        n,
        mean: template.mean,
        inverse_norm: 1.0 / template.norm,
        flat: (n * (FLAT_DN * f64::from(SCALE)).powi(2)) as f32,
    };
    let extent = Extent {
        left,
        top,
        width,
        height,
    };
    if masked::is_for(template, &extent) {
        masked::scores(image, template, extent, &scale, &mut scores);
        return Some(ScoreMap {
            left,
            top,
            width,
            height,
            scores,
        });
    }
    if small::is_small(template) {
        small::scores(image, template, extent, &scale, &mut scores);
        return Some(ScoreMap {
            left,
            top,
            width,
            height,
            scores,
        });
    }
    let mut windows = WindowSums {
        sums: vec![0; width],
        squares: vec![0; width],
    };
    let mut columns_state = (template.rectangular && template.height <= 4000)
        .then(|| ColumnSums::new(image, left, covered_columns, top, template.height));
    let prefix = columns_state
        .is_none()
        .then(|| RowPrefix::new(image, left, covered_columns, top, covered_rows));
    let mut products = vec![0i32; width];
    for y in top..top + height {
        if let Some(state) = &mut columns_state {
            if y > top {
                state.change::<-1>(&image.row(y - 1)[left..left + covered_columns]);
                let next = &image.row(y + template.height - 1)[left..left + covered_columns];
                state.change::<1>(next);
            }
            state.windows(template.width, &mut windows);
        }
        if let Some(prefix) = &prefix {
            prefix.windows(template, y, &mut windows);
        }
        dots(template, image, left, y, &mut products);
        let sums = windows.sums.iter().zip(&windows.squares);
        scores.extend(
            products
                .iter()
                .zip(sums)
                .map(|(&product, (&sum, &square))| scale.score(product, sum as f64, square as f64)),
        );
    }
    Some(ScoreMap {
        left,
        top,
        width,
        height,
        scores,
    })
}
