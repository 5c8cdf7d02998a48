//! The exact rays of a camera, tile by tile.
//!
//! Rays are kept in the *axis frame*: origin at the centre of projection, z along the ray of the
//! image centre, scaled to `z = 1`. In that plane straight edges are straight and triangles are
//! convex, however much the lens bends them in the image. A tile knows where its pixels lie in it.

use crate::error::RenderError;
use crate::simd::Lanes;
use nalgebra::{Matrix3, Rotation3, Unit, Vector3};
use rayon::prelude::*;

/// Pixels across a tile.
pub(crate) const TILE_WIDTH: usize = 32;
/// Pixels down a tile.
pub(crate) const TILE_HEIGHT: usize = 16;
/// Pixels in a tile.
pub(crate) const TILE_PIXELS: usize = TILE_WIDTH * TILE_HEIGHT;
/// Runs of eight pixels in a row of a tile.
pub(crate) const RUNS: usize = TILE_WIDTH / 8;

/// Offsets of the sixteen samples from the pixel's centre, pixels: a regular 4x4 grid.
pub(crate) const SAMPLE_U: [Lanes; 2] = [
    [-0.375, -0.125, 0.125, 0.375, -0.375, -0.125, 0.125, 0.375],
    [-0.375, -0.125, 0.125, 0.375, -0.375, -0.125, 0.125, 0.375],
];
/// See [`SAMPLE_U`].
pub(crate) const SAMPLE_V: [Lanes; 2] = [
    [
        -0.375, -0.375, -0.375, -0.375, -0.125, -0.125, -0.125, -0.125,
    ],
    [0.125, 0.125, 0.125, 0.125, 0.375, 0.375, 0.375, 0.375],
];

/// A rectangle in the plane `z = 1` of the axis frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Bounds {
    pub x: [f32; 2],
    pub y: [f32; 2],
}

/// The rays of one tile. Pixel `(i, j)` of the tile is lane `i % 8` of run `j * RUNS + i / 8`.
pub(crate) struct TileRays {
    /// Ray x at pixel centres.
    pub x: [Lanes; TILE_PIXELS / 8],
    /// Ray y at pixel centres.
    pub y: [Lanes; TILE_PIXELS / 8],
    /// Change of the ray (x, y) from one column to the next, mean over the tile.
    pub du: [f32; 2],
    /// Change of the ray (x, y) from one row to the next, mean over the tile.
    pub dv: [f32; 2],
    /// Mean distance between neighbouring rays: the size of a pixel at `z = 1`.
    pub pixel: f32,
    /// Lowest and highest y of each row, borders of its pixels included.
    pub row_low: [Lanes; 2],
    pub row_high: [Lanes; 2],
    /// Lowest and highest x of each run (four of them; the others empty).
    pub run_low: Lanes,
    pub run_high: Lanes,
    /// The whole tile.
    pub bounds: Bounds,
    /// Columns and rows that lie inside the image.
    pub columns: usize,
    pub rows: usize,
}

impl TileRays {
    /// The ray through the centre of pixel `index` (row by row) of the tile.
    pub(crate) fn ray(&self, index: usize) -> [f32; 2] {
        [self.x[index / 8][index % 8], self.y[index / 8][index % 8]]
    }
}

/// The rays of a camera.
pub(crate) struct Optics {
    pub width: usize,
    pub height: usize,
    /// Tiles across and down.
    pub across: usize,
    pub down: usize,
    /// Centre of projection in the frame that the camera's vectors are given in.
    pub centre: Vector3<f64>,
    /// Rotation from the axis frame to that frame.
    pub camera_from_axis: Rotation3<f64>,
    pub tiles: Vec<TileRays>,
    columns: Lookup,
    rows: Lookup,
}

/// Which tiles may hold a coordinate: first and last tile for each cell of a fine division.
struct Lookup {
    low: f32,
    cells_per_unit: f32,
    first: Vec<u16>,
    last: Vec<u16>,
}

impl Lookup {
    /// `ranges`: the extent of each column (or row) of tiles.
    fn new(ranges: &[[f32; 2]]) -> Self {
        const CELLS: usize = 1024;
        let low = ranges.iter().fold(f32::MAX, |m, r| m.min(r[0]));
        let high = ranges.iter().fold(f32::MIN, |m, r| m.max(r[1]));
        let step = (high - low) / CELLS as f32;
        let touching = |cell: usize| {
            // one cell more on either side covers any rounding in `cell_of`
            let (a, b) = (
                low + step * (cell as f32 - 1.0),
                low + step * (cell as f32 + 2.0),
            );
            (0..ranges.len()).filter(move |&i| ranges[i][1] >= a && ranges[i][0] <= b)
        };
        let first = (0..CELLS)
            .map(|c| touching(c).min().unwrap_or(0) as u16)
            .collect();
        let last = (0..CELLS)
            .map(|c| touching(c).max().unwrap_or(0) as u16)
            .collect();
        Self {
            low,
            cells_per_unit: 1.0 / step,
            first,
            last,
        }
    }

    fn range(&self, low: f32, high: f32) -> (usize, usize) {
        let most = (self.first.len() - 1) as f32;
        let cell = |x: f32| ((x - self.low) * self.cells_per_unit).clamp(0.0, most) as usize;
        (
            usize::from(self.first[cell(low)]),
            usize::from(self.last[cell(high)]),
        )
    }
}

/// The start and direction of a ray, or why there is none.
pub(crate) type RayResult = Result<(Vector3<f64>, Unit<Vector3<f64>>), String>;

impl Optics {
    /// Tabulates the rays of a camera: `ray(u_px, v_px)` with (0, 0) at the centre of the first
    /// pixel.
    pub(crate) fn new(
        width: usize,
        height: usize,
        ray: impl Fn(f64, f64) -> RayResult + Sync,
    ) -> Result<Self, RenderError> {
        if !(2..=8192).contains(&width) || !(2..=8192).contains(&height) {
            return Err(RenderError::ImageSize { width, height });
        }
        let checked = |u_px: f64, v_px: f64| {
            ray(u_px, v_px).map_err(|reason| RenderError::NoRay { u_px, v_px, reason })
        };
        let middle = ((width as f64 - 1.0) / 2.0, (height as f64 - 1.0) / 2.0);
        let (centre, axis) = checked(middle.0, middle.1)?;
        let along_u = checked(middle.0 + 0.5, middle.1)?.1.into_inner() - axis.into_inner();
        let y = axis.cross(&along_u).normalize();
        let frame = Matrix3::from_columns(&[y.cross(&axis), y, axis.into_inner()]);
        let camera_from_axis = Rotation3::from_matrix_unchecked(frame);
        let axis_from_camera = camera_from_axis.inverse();

        let across = width.div_ceil(TILE_WIDTH);
        let down = height.div_ceil(TILE_HEIGHT);
        let plane = |u: usize, v: usize| -> Result<[f64; 2], RenderError> {
            let (u_px, v_px) = (u as f64, v as f64);
            let (start, direction) = checked(u_px, v_px)?;
            let distance_m = (start - centre).norm();
            let one_pupil = distance_m <= 1e-7;
            if !one_pupil {
                return Err(RenderError::MovingPupil {
                    u_px,
                    v_px,
                    distance_m,
                });
            }
            let d = axis_from_camera * direction.into_inner();
            let narrow = d.z > 0.174;
            if !narrow {
                let angle_deg = d.z.acos().to_degrees();
                return Err(RenderError::TooWide {
                    u_px,
                    v_px,
                    angle_deg,
                });
            }
            Ok([d.x / d.z, d.y / d.z])
        };
        let table: Vec<[f64; 2]> = (0..width * height)
            .into_par_iter()
            .map(|i| plane(i % width, i / width))
            .collect::<Result<_, _>>()?;
        // beyond the right and lower borders the table goes on in a straight line
        let at = |u: usize, v: usize| -> [f64; 2] {
            let (ui, vi) = (u.min(width - 1), v.min(height - 1));
            let (du, dv) = ((u - ui) as f64, (v - vi) as f64);
            let here = table[vi * width + ui];
            let left = table[vi * width + ui.max(1) - 1];
            let up = table[(vi.max(1) - 1) * width + ui];
            [0, 1].map(|k| here[k] + du * (here[k] - left[k]) + dv * (here[k] - up[k]))
        };
        let tiles: Vec<TileRays> = (0..across * down)
            .into_par_iter()
            .map(|t| {
                let (u, v) = (t % across * TILE_WIDTH, t / across * TILE_HEIGHT);
                let mut tile = tile_rays(u, v, &at);
                tile.columns = TILE_WIDTH.min(width - u);
                tile.rows = TILE_HEIGHT.min(height - v);
                tile
            })
            .collect();
        let hull = |pick: &dyn Fn(&TileRays) -> [f32; 2], members: &[usize]| {
            members
                .iter()
                .map(|&i| pick(&tiles[i]))
                .fold([f32::MAX, f32::MIN], |m, r| {
                    [m[0].min(r[0]), m[1].max(r[1])]
                })
        };
        let column_ranges: Vec<_> = (0..across)
            .map(|c| {
                hull(
                    &|t| t.bounds.x,
                    &(0..down).map(|r| r * across + c).collect::<Vec<_>>(),
                )
            })
            .collect();
        let row_ranges: Vec<_> = (0..down)
            .map(|r| {
                hull(
                    &|t| t.bounds.y,
                    &(0..across).map(|c| r * across + c).collect::<Vec<_>>(),
                )
            })
            .collect();
        let (columns, rows) = (Lookup::new(&column_ranges), Lookup::new(&row_ranges));
        Ok(Self {
            width,
            height,
            across,
            down,
            centre,
            camera_from_axis,
            tiles,
            columns,
            rows,
        })
    }

    /// Calls `f` with every tile whose rectangle meets `b`.
    #[inline]
    pub(crate) fn tiles_touching(&self, b: &Bounds, mut f: impl FnMut(usize)) {
        let (c0, c1) = self.columns.range(b.x[0], b.x[1]);
        let (r0, r1) = self.rows.range(b.y[0], b.y[1]);
        for r in r0..=r1 {
            for c in c0..=c1 {
                let t = &self.tiles[r * self.across + c].bounds;
                if t.x[0] <= b.x[1] && t.x[1] >= b.x[0] && t.y[0] <= b.y[1] && t.y[1] >= b.y[0] {
                    f(r * self.across + c);
                }
            }
        }
    }
}

/// The tile whose first pixel is `(u, v)`.
fn tile_rays(u: usize, v: usize, at: &impl Fn(usize, usize) -> [f64; 2]) -> TileRays {
    let last = (u + TILE_WIDTH - 1, v + TILE_HEIGHT - 1);
    let corners = [at(u, v), at(last.0, v), at(u, last.1), at(last.0, last.1)];
    let (columns, rows) = ((TILE_WIDTH - 1) as f64, (TILE_HEIGHT - 1) as f64);
    let mean_slope = |a: usize, b: usize, c: usize, d: usize, steps: f64| {
        [0, 1].map(|k| {
            let (p, q) = (corners[b][k] - corners[a][k], corners[d][k] - corners[c][k]);
            ((p + q) / (2.0 * steps)) as f32
        })
    };
    let du = mean_slope(0, 1, 2, 3, columns);
    let dv = mean_slope(0, 2, 1, 3, rows);
    // half a pixel and a little, however the image axes lie in the axis frame
    let margin = [0, 1].map(|k| 0.52 * (du[k].abs() + dv[k].abs()));
    let length = |g: [f32; 2]| (g[0] * g[0] + g[1] * g[1]).sqrt();
    let empty = [[f32::MAX; 8], [f32::MAX; 8]];
    let full = [[f32::MIN; 8], [f32::MIN; 8]];
    let mut tile = TileRays {
        x: [[0.0; 8]; TILE_PIXELS / 8],
        y: [[0.0; 8]; TILE_PIXELS / 8],
        du,
        dv,
        pixel: 0.5 * (length(du) + length(dv)),
        row_low: empty,
        row_high: full,
        run_low: empty[0],
        run_high: full[0],
        bounds: Bounds {
            x: [f32::MAX, f32::MIN],
            y: [f32::MAX, f32::MIN],
        },
        columns: TILE_WIDTH,
        rows: TILE_HEIGHT,
    };
    for j in 0..TILE_HEIGHT {
        for i in 0..TILE_WIDTH {
            let [x, y] = at(u + i, v + j).map(|c| c as f32);
            let run = i / 8;
            tile.x[j * RUNS + run][i % 8] = x;
            tile.y[j * RUNS + run][i % 8] = y;
            let row = (j / 8, j % 8);
            tile.row_low[row.0][row.1] = tile.row_low[row.0][row.1].min(y - margin[1]);
            tile.row_high[row.0][row.1] = tile.row_high[row.0][row.1].max(y + margin[1]);
            tile.run_low[run] = tile.run_low[run].min(x - margin[0]);
            tile.run_high[run] = tile.run_high[run].max(x + margin[0]);
        }
    }
    let fold = |low: &[f32], high: &[f32]| {
        [
            low.iter().copied().fold(f32::MAX, f32::min),
            high.iter().copied().fold(f32::MIN, f32::max),
        ]
    };
    tile.bounds.x = fold(&tile.run_low, &tile.run_high);
    tile.bounds.y = fold(tile.row_low.as_flattened(), tile.row_high.as_flattened());
    tile
}
