//! Files of camera models, and the models of other tools.
//!
//! | module | format |
//! |---|---|
//! | [`text`] | the plain text form of CAHV models |
//! | [`toml`] | [`ModelFile`] as TOML |
//! | [`ros`] | ROS `CameraInfo` YAML |
//! | [`opencv`] | OpenCV `FileStorage` YAML |
//! | [`kalibr`] | Kalibr camera chains |
//!
//! The latter three hold pinhole cameras with the distortions of OpenCV ([`Lens`]);
//! [`conversion`] takes them to the CAHV family and back, exactly where the formulas are the same
//! and by a fit with its worst error where they are not.

pub mod conversion;
mod fit;
pub mod kalibr;
mod lens;
mod lens_fit;
pub mod opencv;
mod pose;
pub mod ros;
pub mod text;
pub mod toml;
mod yaml;

pub use conversion::{Conversion, ConversionError, ConversionRules};
pub use lens::{Lens, LensCamera};
pub use lens_fit::Family;
pub use text::{read_text, write_text};
pub use toml::{read_toml, write_toml};

use crate::{Camera, CameraError, CameraModel};
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Longest text that is read, bytes. A model takes less than one thousand, a chain of cameras a
/// few.
pub const MAX_BYTES: usize = 65_536;
/// Longest frame name, characters.
pub const MAX_FRAME_CHARS: usize = 64;
const MAX_SHOWN_CHARS: usize = 40;
const KNOWN: &str = "C, A, H, V, O, R, E, T, P, Model, Dimensions or Frame";

/// A camera model with what its file says about it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelFile {
    /// The frame that the model's vectors are given in, if the file names it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frame: Option<String>,
    /// Width and height of the image, px, if the file gives them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub size_px: Option<[u32; 2]>,
    /// The model.
    pub model: CameraModel,
}

/// Why a text is not a camera model. Lines count from 1.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum FormatError {
    /// The text is longer than [`MAX_BYTES`].
    #[error("the text has {found} bytes, expected at most {MAX_BYTES}")]
    TooLong {
        /// Its length, bytes.
        found: usize,
    },
    /// A line that is not `NAME = values` with a known name.
    #[error("line {line}: unknown line {found:?}, expected NAME = values with NAME {KNOWN}")]
    UnknownLine {
        /// Line number.
        line: usize,
        /// The start of the line.
        found: String,
    },
    /// A name given twice.
    #[error("line {line}: {name} is given again, first in line {first}")]
    Repeated {
        /// Line number.
        line: usize,
        /// The name.
        name: &'static str,
        /// Line number of the first one.
        first: usize,
    },
    /// A value that cannot be read.
    #[error("line {line}: {name} is {found:?}, expected {expected}")]
    Value {
        /// Line number.
        line: usize,
        /// The name.
        name: &'static str,
        /// The start of what was found.
        found: String,
        /// What was expected.
        expected: &'static str,
    },
    /// A line is missing that the others call for.
    #[error("{name} is missing, expected a line {name} = ...")]
    Missing {
        /// The name of the line.
        name: &'static str,
    },
    /// `Model` names another model than the vectors make.
    #[error("line {line}: Model is {found:?}, but the vectors given make a {expected} model")]
    OtherModel {
        /// Line number.
        line: usize,
        /// The model named.
        found: String,
        /// The model made by the vectors.
        expected: &'static str,
    },
    /// A camera needs an image size and the file has none.
    #[error(
        "the image size is missing: Dimensions in CAHV text, size_px in TOML, or `rover camera \
         convert --size WIDTHxHEIGHT`"
    )]
    NoSize,
    /// The text is not YAML, or not of the structure that the format has.
    #[error("{message}")]
    Structure {
        /// What the reader says, with line and column where it knows them.
        message: String,
    },
    /// A field of a YAML format holds what cannot be used.
    #[error("{field}: found {found}, expected {expected}")]
    Field {
        /// The field, with the names above it.
        field: String,
        /// The start of what was found.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// The model cannot be expressed in the other format.
    #[error(transparent)]
    Conversion(#[from] ConversionError),
    /// The numbers do not make a camera.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// A frame name that the format cannot hold.
    #[error(
        "the frame name is {found:?}, expected 1 to {MAX_FRAME_CHARS} printable ASCII characters \
         without # and without spaces at its ends"
    )]
    FrameName {
        /// The start of the name.
        found: String,
    },
}

impl ModelFile {
    /// The model with its image size.
    ///
    /// # Errors
    /// [`FormatError::NoSize`] if the file gave none.
    pub fn camera(&self) -> Result<Camera, FormatError> {
        let [width_px, height_px] = self.size_px.ok_or(FormatError::NoSize)?;
        Ok(Camera {
            model: self.model.clone(),
            width_px,
            height_px,
        })
    }
}

/// The start of a text, short enough for a message.
pub(crate) fn shown(text: &str) -> String {
    let mut short: String = text.chars().take(MAX_SHOWN_CHARS).collect();
    if text.chars().nth(MAX_SHOWN_CHARS).is_some() {
        short.push_str("...");
    }
    short
}

/// A message of another reader in one line of bounded length, free of control characters.
pub(crate) fn brief(message: &str) -> String {
    const LONGEST: usize = 300;
    let line = message.split_whitespace().collect::<Vec<_>>().join(" ");
    line.chars()
        .map(|c| if c.is_control() { '?' } else { c })
        .take(LONGEST)
        .collect()
}
