//! Normalised cross-correlation of a masked template, in whole numbers.
//!
//! c = sum (I - mean I)(T - mean T) / sqrt(sum (I - mean I)^2 sum (T - mean T)^2) over the mask.
//! Image and template are held as `i16`, products are summed in `i32` and sums of squares come from
//! running sums, all without rounding: a score does not depend on the vector unit or the order of
//! work.

mod dots;
mod masked;
mod narrow;
mod pyramid;
mod score;
mod search_image;
mod small;
mod template;

pub use pyramid::{Peak, TemplatePyramid, Window, search, search_peaks};
pub use score::{ScoreMap, quadratic_peak, score_map};
pub use search_image::SearchImage;
pub use template::{Template, TemplateError};

/// Grey value times this, minus [`OFFSET`], is what a [`SearchImage`] holds.
const SCALE: i32 = 8;
/// Shift that brings the grey values 0..255 to about +-1024.
const OFFSET: i32 = 1024;
/// Largest size of a value of a [`SearchImage`].
const VALUE_LIMIT: i64 = 1024;
// 4096 squares of such values fit the u32 running sums
const _: () = assert!(VALUE_LIMIT * VALUE_LIMIT * 4096 <= u32::MAX as i64 + 1);
/// Vector length that rows are padded to.
const LANES: usize = 8;
/// Standard deviation (DN) below which an image window counts as flat: its score is 0.
const FLAT_DN: f64 = 0.5;

#[cfg(test)]
mod tests;
