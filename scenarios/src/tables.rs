//! Tables of numbers in and out: comma-separated values with a header line.
//!
//! A [`Table`] is read row by row, so its length is bounded by nothing and its memory by one line. The
//! header must name the expected columns in their order. Every cell is a finite decimal number. A
//! byte-order mark, CRLF line ends, blank lines, lines that begin with `#` and quoted cells are
//! understood; such a comment may be the header of a table that begins with numbers.
//!
//! A [`TableWriter`] writes the answers in the order of the rows, with a last column `status`: `ok`, or
//! the reason why this row has no answer, whose cells are then empty. A table that was written this way
//! can be the input of the next command: the reasons are handed on.
//!
//! Numbers are written with the fewest digits that read back as the same double.
//!
//! ```no_run
//! # fn project(p: [f64; 3]) -> Result<[f64; 2], String> { Ok([p[0] / p[2], p[1] / p[2]]) }
//! # fn main() -> Result<(), rover::tables::TableError> {
//! use rover::tables::{Table, TableWriter};
//!
//! let table = Table::open("points.csv".as_ref(), &["x_m", "y_m", "z_m"])?;
//! let mut out = TableWriter::create("-".as_ref(), false, &["u_px", "v_px"])?;
//! for row in table {
//!     let row = row?;
//!     out.answer(row.array().and_then(project))?;
//! }
//! out.finish()?;
//! # Ok(())
//! # }
//! ```

mod lines;
mod names;
mod reader;
mod writer;

pub(crate) use names::distance;
pub use names::nearest;
pub use reader::{Row, Table};
pub use writer::TableWriter;

use crate::output::OutputError;
use rover_files::FileError;

/// The last column of every table that is written.
pub const STATUS: &str = "status";

/// The status of a row that has an answer.
pub const OK: &str = "ok";

/// Why a table cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    /// The file cannot be opened.
    #[error("{file}: {source}")]
    Open {
        /// The file, or "standard input".
        file: String,
        /// What the system said.
        source: FileError,
    },
    /// The file cannot be read on.
    #[error("{file}:{line}: {what}")]
    Read {
        /// The file, or "standard input".
        file: String,
        /// Line, from 1.
        line: u64,
        /// What stopped the reading.
        what: String,
    },
    /// The header is not the expected one.
    #[error("{file}:{line}: {what}; the header must be `{expected}`")]
    Header {
        /// The file, or "standard input".
        file: String,
        /// Line, from 1.
        line: u64,
        /// What is wrong with it.
        what: String,
        /// The header that was expected.
        expected: String,
    },
    /// A row has the wrong number of cells.
    #[error("{file}:{line}: {found} cells, {expected} expected as in the header")]
    Width {
        /// The file, or "standard input".
        file: String,
        /// Line, from 1.
        line: u64,
        /// Cells found.
        found: usize,
        /// Columns of the header.
        expected: usize,
    },
    /// A cell is not a finite number.
    #[error("{file}:{line}:{column}: `{name}` is `{found}`, a finite decimal number is expected")]
    Cell {
        /// The file, or "standard input".
        file: String,
        /// Line, from 1.
        line: u64,
        /// Column, from 1.
        column: usize,
        /// Name of the column.
        name: String,
        /// Text of the cell, shortened.
        found: String,
    },
    /// The output must not be written, or cannot be.
    #[error(transparent)]
    Output(#[from] OutputError),
    /// A program asks for a row that does not fit the header it gave.
    #[error("{file}: an answer of {found} numbers for {expected} columns")]
    Answer {
        /// The file, or "standard output".
        file: String,
        /// Numbers of the answer.
        found: usize,
        /// Columns of the table.
        expected: usize,
    },
}

impl TableError {
    /// Whether the user's input is at fault, rather than the system or the program.
    pub fn is_bad_input(&self) -> bool {
        match self {
            Self::Output(error) => error.is_bad_input(),
            Self::Answer { .. } => false,
            _ => true,
        }
    }
}

#[cfg(test)]
mod tests;
