//! A printed chessboard in a photograph: its inner corners to subpixel, in order, without a hint.
//!
//! 1. [`candidates`]: points where the smoothed image is a saddle between dark and bright, and two
//!    edges go straight through a ring around them.
//! 2. [`refine`]: each one to subpixel, as the point to which all gradients around it are
//!    perpendicular (Foerstner and Guelch 1987), in a window that fits its neighbours.
//! 3. [`grid`]: grown from pairs of neighbours of like contrast whose connecting edge has dark on
//!    one side and bright on the other, alternating from square to square, until the board is
//!    complete.
//!
//! The search starts on the full picture and goes on with halved ones, where blur and noise are
//! smaller; the corners are always refined on the full picture.

mod candidates;
mod grid;
mod refine;
#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests;

use crate::image::{Image8, ImageError, ImageF};
use crate::sample::SplineImage;
use nalgebra::Vector2;

/// The board: inner corners, as calibration programs count them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Chessboard {
    /// Inner corners along the board's x axis.
    pub columns: usize,
    /// Inner corners along its y axis.
    pub rows: usize,
}

/// A corner of the board.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoardCorner {
    /// Place in the grid: along x, along y.
    pub column: usize,
    /// Place in the grid along y.
    pub row: usize,
    /// Where it is, px.
    pub pixel_px: Vector2<f64>,
    /// Standard deviation per axis that the image around it promises, px.
    pub sigma_px: f64,
}

/// Why no board was found.
#[derive(Debug, thiserror::Error)]
pub enum BoardError {
    /// The board has too few corners to be told from chance, or too many to be one.
    #[error("a board of {columns} x {rows} inner corners, expected 3 to {MAX_SIDE} each")]
    Size {
        /// Corners along x.
        columns: usize,
        /// Corners along y.
        rows: usize,
    },
    /// The best grid is not the board.
    #[error(
        "the largest grid found has {found_columns} x {found_rows} places with {found} corners, \
         expected {columns} x {rows}; {candidates} saddle points were seen"
    )]
    Incomplete {
        /// Corners of the largest grid.
        found: usize,
        /// Its extent.
        found_columns: usize,
        /// Its extent.
        found_rows: usize,
        /// Expected.
        columns: usize,
        /// Expected.
        rows: usize,
        /// Saddle points seen at the level of that grid.
        candidates: usize,
    },
    /// The picture cannot be used.
    #[error(transparent)]
    Image(#[from] ImageError),
}

/// Largest number of corners on a side.
pub const MAX_SIDE: usize = 64;
/// Smoothing of the picture in which corners are refined, px.
const FINE_BLUR_PX: f64 = 1.0;
/// Halvings of the picture that are searched.
const LEVELS: usize = 4;

/// Finds the inner corners of a chessboard, row by row from the origin.
///
/// The board's x axis runs along its columns, y along its rows, and x turns towards y clockwise in
/// the picture, as for an unmirrored camera. If one of the two numbers is even and the other odd the
/// origin is the corner whose outermost square is dark, which a turn of the board does not change;
/// otherwise both ends look alike and the origin is the one nearer to the upper left of the picture.
///
/// # Errors
/// [`BoardError`]. A board that is partly hidden or cut off is not found.
pub fn find_chessboard(image: &Image8, board: Chessboard) -> Result<Vec<BoardCorner>, BoardError> {
    let side = 3..=MAX_SIDE;
    if !side.contains(&board.columns) || !side.contains(&board.rows) {
        return Err(BoardError::Size {
            columns: board.columns,
            rows: board.rows,
        });
    }
    let full = ImageF::from_image8(image)?;
    let mut best = BoardError::Incomplete {
        found: 0,
        found_columns: 0,
        found_rows: 0,
        columns: board.columns,
        rows: board.rows,
        candidates: 0,
    };
    let mut most = 0;
    // A little smoothing: edges sharper than the pixel grid shows would pull the corners about.
    let fine = SplineImage::new(&full.blurred(FINE_BLUR_PX));
    for (level, picture) in full.pyramid(LEVELS).into_iter().enumerate() {
        let smooth = picture.blurred(1.0);
        let points = candidates::saddles(&smooth, 8 * board.columns * board.rows + 400);
        let found = grid::grow(&smooth, &points, board);
        match found {
            Ok(cells) => {
                // Pixel i of level n has its centre at 2^n i + (2^n - 1) / 2 of the full picture.
                let scale = f64::from(1_u32 << level);
                let full_px = |p: &Vector2<f64>| (p.add_scalar(0.5) * scale).add_scalar(-0.5);
                let placed: Vec<_> = cells.iter().map(full_px).collect();
                if let Some(corners) = refine::all(&fine, &placed, board, scale) {
                    let ordered = grid::oriented(&smooth, &cells, &corners, board);
                    return Ok(ordered);
                }
            }
            Err((found, [found_columns, found_rows])) if found > most => {
                most = found;
                best = BoardError::Incomplete {
                    found,
                    found_columns,
                    found_rows,
                    columns: board.columns,
                    rows: board.rows,
                    candidates: points.len(),
                };
            }
            Err(_) => {}
        }
    }
    Err(best)
}
