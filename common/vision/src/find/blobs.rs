//! Dark or light patches: connected regions beyond a local threshold, with their moments.
//!
//! The threshold of an 8 x 8 px tile is the middle between the least and the largest grey value
//! around it, over the smallest surroundings (24, 48, 96 ... px) that have the asked contrast; so a
//! disc larger than a tile has no hole and uneven light does no harm.

use nalgebra::Vector2;

use crate::image::Image8;
use crate::ncc::Window;

/// A connected region.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Blob {
    /// Centroid in the image, px.
    pub centre: [f64; 2],
    /// Pixels.
    pub area: f64,
    /// Central second moments of the pixel centres, of u u, u v, v v, px^2.
    pub moments: [f64; 3],
    /// Whether it touches the border of the window.
    pub at_border: bool,
}

impl Blob {
    /// S = A A^T of the ellipse with the same moments, A taking the unit disc to the ellipse, px^2.
    pub fn shape(&self) -> [f64; 3] {
        self.moments.map(|m| 4.0 * m)
    }

    /// Semi-axes of that ellipse, shorter first, px; `None` without extent.
    pub fn semi_axes(&self) -> Option<(f64, f64)> {
        let [a, b, c] = self.shape();
        let (mean, half) = (0.5 * (a + c), 0.5 * (a - c));
        let spread = (half * half + b * b).sqrt();
        (mean > spread).then(|| ((mean - spread).sqrt(), (mean + spread).sqrt()))
    }

    /// Area over the area of the ellipse with the same moments: 1 for an ellipse.
    pub fn fill(&self) -> f64 {
        let [a, b, c] = self.shape();
        let det = a * c - b * b;
        if det > 0.0 {
            self.area / (std::f64::consts::PI * det.sqrt())
        } else {
            0.0
        }
    }
}

const TILE: usize = 8;

/// What makes a region.
#[derive(Clone, Copy, Debug)]
pub(super) struct BlobRules {
    /// Dark regions, or light ones.
    pub dark: bool,
    /// Least difference between dark and light around a tile, DN.
    pub min_contrast_dn: u8,
    /// Area limits, px.
    pub area: (f64, f64),
}

#[derive(Clone, Copy)]
struct Range {
    low: u8,
    high: u8,
}

/// One level of least and largest values.
struct Level {
    width: usize,
    height: usize,
    ranges: Vec<Range>,
}

impl Level {
    /// Least and largest value of a place and its eight neighbours.
    fn around(&self, i: usize, j: usize) -> Range {
        let mut all = Range { low: 255, high: 0 };
        for y in j.saturating_sub(1)..(j + 2).min(self.height) {
            for r in &self.ranges
                [y * self.width + i.saturating_sub(1)..y * self.width + (i + 2).min(self.width)]
            {
                all.low = all.low.min(r.low);
                all.high = all.high.max(r.high);
            }
        }
        all
    }

    fn reduced(&self) -> Self {
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let mut ranges = vec![Range { low: 255, high: 0 }; width * height];
        for j in 0..self.height {
            for i in 0..self.width {
                let (r, to) = (
                    self.ranges[j * self.width + i],
                    &mut ranges[j / 2 * width + i / 2],
                );
                to.low = to.low.min(r.low);
                to.high = to.high.max(r.high);
            }
        }
        Self {
            width,
            height,
            ranges,
        }
    }
}

/// Threshold of every tile; `None` where nothing around has the contrast.
fn thresholds(image: &Image8, window: Window, contrast: u8) -> (usize, Vec<Option<u8>>) {
    let (w, h) = (window.width as usize, window.height as usize);
    let (width, height) = (w.div_ceil(TILE), h.div_ceil(TILE));
    let mut ranges = vec![Range { low: 255, high: 0 }; width * height];
    // column by column over the rows of a tile, then over its columns
    let (mut lows, mut highs) = (vec![255u8; w], vec![0u8; w]);
    for (j, out) in ranges.chunks_exact_mut(width).enumerate() {
        lows.fill(255);
        highs.fill(0);
        for y in j * TILE..h.min((j + 1) * TILE) {
            let row = row_of(image, window, y);
            for ((low, high), &p) in lows.iter_mut().zip(&mut highs).zip(row) {
                *low = p.min(*low);
                *high = p.max(*high);
            }
        }
        let tiles = lows.chunks(TILE).zip(highs.chunks(TILE));
        for (r, (low, high)) in out.iter_mut().zip(tiles) {
            r.low = low.iter().fold(255, |m, &p| p.min(m));
            r.high = high.iter().fold(0, |m, &p| p.max(m));
        }
    }
    let mut levels = vec![Level {
        width,
        height,
        ranges,
    }];
    while let Some(last) = levels.last()
        && (last.width > 1 || last.height > 1)
    {
        levels.push(last.reduced());
    }
    let mut all = Vec::with_capacity(width * height);
    for j in 0..height {
        for i in 0..width {
            all.push(levels.iter().enumerate().find_map(|(k, level)| {
                let r = level.around(i >> k, j >> k);
                (r.high.saturating_sub(r.low) >= contrast)
                    .then(|| r.low + (r.high - r.low).div_ceil(2))
            }));
        }
    }
    (width, all)
}

/// A run of pixels beyond the threshold.
struct Run {
    row: u32,
    start: u32,
    end: u32,
    parent: u32,
}

fn root(runs: &mut [Run], mut i: u32) -> u32 {
    while runs[i as usize].parent != i {
        let up = runs[i as usize].parent;
        runs[i as usize].parent = runs[up as usize].parent;
        i = up;
    }
    i
}

/// Sums over a region, in whole numbers.
#[derive(Clone, Copy, Default)]
struct Sums {
    n: u64,
    u: u64,
    v: u64,
    uu: u64,
    uv: u64,
    vv: u64,
    at_border: bool,
}

/// The first bit from `from` on that is set, or clear.
#[inline]
fn next_bit<const SET: bool>(words: &[u64], from: usize) -> Option<usize> {
    let flipped = |word: u64| if SET { word } else { !word };
    let first = flipped(*words.get(from / 64)?) >> (from % 64) << (from % 64);
    let rest = words[from / 64 + 1..].iter().map(|&word| flipped(word));
    std::iter::once(first)
        .chain(rest)
        .position(|word| word != 0)
        .map(|k| {
            let word = if k == 0 {
                first
            } else {
                flipped(words[from / 64 + k])
            };
            (from / 64 + k) * 64 + word.trailing_zeros() as usize
        })
}

/// One row of a window's pixels.
fn row_of(image: &Image8, window: Window, y: usize) -> &[u8] {
    let start = (window.top as usize + y) * image.width_px as usize + window.left as usize;
    &image.pixels[start..start + window.width as usize]
}

/// One bit for each pixel of a tile's row: below the limit if `dark`, else at or above it.
#[inline]
fn beyond_limit(pixels: &[u8], limit: u8, dark: bool) -> u8 {
    let mut ones = [0u8; TILE];
    if let Some(whole) = pixels.first_chunk::<TILE>() {
        for k in 0..TILE {
            ones[k] = u8::from((whole[k] < limit) == dark);
        }
    } else {
        for (one, &p) in ones.iter_mut().zip(pixels) {
            *one = u8::from((p < limit) == dark);
        }
    }
    // every product puts one of the eight ones into the highest byte
    (u64::from_le_bytes(ones).wrapping_mul(0x0102_0408_1020_4080) >> 56) as u8
}

/// Runs of a clipped window's pixels beyond the threshold, joined where they touch.
fn label(image: &Image8, window: Window, rules: &BlobRules) -> Vec<Run> {
    let (w, h) = (window.width as usize, window.height as usize);
    if w == 0 || h == 0 {
        return Vec::new();
    }
    let (tiles, thresholds) = thresholds(image, window, rules.min_contrast_dn.max(1));
    let mut runs: Vec<Run> = Vec::new();
    // one bit per pixel, and clear ones behind the last
    let mut beyond = vec![0u64; w / 64 + 1];
    let (mut above, mut above_end) = (0usize, 0usize);
    for y in 0..h {
        let limits = &thresholds[y / TILE * tiles..][..tiles];
        beyond.fill(0);
        let row = row_of(image, window, y).chunks(TILE);
        for (t, (pixels, limit)) in row.zip(limits).enumerate() {
            let Some(limit) = limit else { continue };
            let bits = u64::from(beyond_limit(pixels, *limit, rules.dark));
            beyond[t * TILE / 64] |= bits << (t * TILE % 64);
        }
        let first = runs.len();
        let mut x = 0;
        while let Some(start) = next_bit::<true>(&beyond, x) {
            x = next_bit::<false>(&beyond, start).unwrap_or(w);
            let me = runs.len() as u32;
            runs.push(Run {
                row: y as u32,
                start: start as u32,
                end: x as u32,
                parent: me,
            });
            // four-connected runs of the row above
            while above < above_end && (runs[above].end as usize) <= start {
                above += 1;
            }
            let mut k = above;
            while k < above_end && (runs[k].start as usize) < x {
                let (a, b) = (root(&mut runs, me), root(&mut runs, k as u32));
                let (low, high) = (a.min(b), a.max(b));
                runs[high as usize].parent = low;
                k += 1;
            }
        }
        (above, above_end) = (first, runs.len());
    }
    runs
}

/// All regions of a window, from the top.
pub(super) fn blobs(image: &Image8, window: Window, rules: &BlobRules) -> Vec<Blob> {
    let window = window.clipped(image);
    let (w, h) = (window.width as usize, window.height as usize);
    let mut runs = label(image, window, rules);
    let mut sums: Vec<Sums> = vec![Sums::default(); runs.len()];
    for i in 0..runs.len() {
        let r = root(&mut runs, i as u32) as usize;
        let Run {
            row, start, end, ..
        } = runs[i];
        let (a, b, v) = (u64::from(start), u64::from(end), u64::from(row));
        let n = b - a;
        // sums of u and u^2 over a..b
        let u = (b * (b - 1) - a * a.saturating_sub(1)) / 2;
        let squares = |m: u64| m * m.saturating_sub(1) * (2 * m).saturating_sub(1) / 6;
        let s = &mut sums[r];
        s.n += n;
        s.u += u;
        s.v += n * v;
        s.uu += squares(b) - squares(a);
        s.uv += u * v;
        s.vv += n * v * v;
        s.at_border |= a == 0 || end as usize == w || v == 0 || row as usize + 1 == h;
    }
    sums.iter()
        .filter(|s| s.n > 0 && (s.n as f64) >= rules.area.0 && (s.n as f64) <= rules.area.1)
        .map(|s| {
            let n = s.n as f64;
            let (mu, mv) = (s.u as f64 / n, s.v as f64 / n);
            Blob {
                centre: [mu + f64::from(window.left), mv + f64::from(window.top)],
                area: n,

                moments: [
                    s.uu as f64 / n - mu * mu,
                    s.uv as f64 / n - mu * mv,
                    s.vv as f64 / n - mv * mv,
                ],
                at_border: s.at_border,
            }
        })
        .collect()
}

/// The outlines of all regions: first and last pixel of every row that a region has, by row.
/// Regions that touch the window's border are left out.
pub(super) fn outlines(
    image: &Image8,
    window: Window,
    rules: &BlobRules,
) -> Vec<Vec<Vector2<f64>>> {
    let window = window.clipped(image);
    let mut runs = label(image, window, rules);
    let mut sizes = vec![0u32; runs.len()];
    for i in 0..runs.len() {
        let r = root(&mut runs, i as u32) as usize;
        let Run {
            row, start, end, ..
        } = runs[i];
        let at_border = start == 0 || row == 0 || end == window.width || row + 1 == window.height;
        sizes[r] = if at_border {
            u32::MAX
        } else {
            sizes[r].saturating_add(end - start)
        };
    }
    let fits = |size: u32| {
        size < u32::MAX && f64::from(size) >= rules.area.0 && f64::from(size) <= rules.area.1
    };
    let mut places = vec![usize::MAX; runs.len()];
    let mut all: Vec<Vec<(u32, u32, u32)>> = Vec::new();
    for i in 0..runs.len() {
        let r = root(&mut runs, i as u32) as usize;
        if !fits(sizes[r]) {
            continue;
        }
        if places[r] == usize::MAX {
            places[r] = all.len();
            all.push(Vec::new());
        }
        let Run {
            row, start, end, ..
        } = runs[i];
        let rows = &mut all[places[r]];
        match rows.last_mut() {
            Some(last) if last.0 == row => last.2 = end - 1,
            _ => rows.push((row, start, end - 1)),
        }
    }
    let at = |u: u32, v: u32| Vector2::new(f64::from(u + window.left), f64::from(v + window.top));
    let outline = |rows: Vec<(u32, u32, u32)>| {
        let mut points = Vec::with_capacity(2 * rows.len());
        for (v, first, last) in rows {
            points.push(at(first, v));
            if last > first {
                points.push(at(last, v));
            }
        }
        points
    };
    all.into_iter().map(outline).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bit_tells_which_pixels_of_a_tile_are_beyond_the_limit() {
        let pixels = [10u8, 200, 99, 100, 101, 0, 255, 100];
        for length in [8, 5, 1] {
            for dark in [true, false] {
                let bits = beyond_limit(&pixels[..length], 100, dark);
                for k in 0..8 {
                    let expected = k < length && (pixels[k] < 100) == dark;
                    assert_eq!(bits >> k & 1 == 1, expected, "{length} {dark} {k}");
                }
            }
        }
    }
}
