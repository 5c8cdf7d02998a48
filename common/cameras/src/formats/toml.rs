//! A camera model as TOML.
//!
//! ```toml
//! frame = "rover"
//! size_px = [640, 480]
//!
//! [model.cahv]
//! c = [0.2, 0.04, 0.6]
//! a = [0.707, 0.0, -0.707]
//! h = [225.9, -602.2, -225.9]
//! v = [-256.4, 0.0, -595.1]
//! ```
//!
//! `frame` and `size_px` may be missing; unknown names are refused. CAHVOR has `o` and `r` besides,
//! CAHVORE also `e` and `linearity` (see [`crate::Cahvore`]).

use super::{FormatError, MAX_BYTES, ModelFile};

/// Reads a camera model from TOML.
///
/// # Errors
/// [`FormatError::TooLong`], [`FormatError::Structure`] with line and column, or
/// [`FormatError::Camera`] if the numbers do not make a camera.
pub fn read_toml(text: &str) -> Result<ModelFile, FormatError> {
    if text.len() > MAX_BYTES {
        return Err(FormatError::TooLong { found: text.len() });
    }
    let file: ModelFile = ::toml::from_str(text).map_err(|error| {
        let line = error.span().map_or(1, |span| {
            1 + text.as_bytes()[..span.start.min(text.len())]
                .iter()
                .filter(|byte| **byte == b'\n')
                .count()
        });
        FormatError::Structure {
            message: format!("line {line}: {}", super::brief(error.message())),
        }
    })?;
    file.model.validate()?;
    if let Some(size) = file.size_px.filter(|size| size.contains(&0)) {
        return Err(FormatError::Field {
            field: "size_px".into(),
            found: format!("{size:?}"),
            expected: "two positive whole numbers".into(),
        });
    }
    Ok(file)
}

/// Writes a camera model as TOML.
///
/// # Errors
/// [`FormatError::Camera`] if the model is not valid and so could not be read back.
pub fn write_toml(file: &ModelFile) -> Result<String, FormatError> {
    file.model.validate()?;
    ::toml::to_string(file).map_err(|error| FormatError::Structure {
        message: error.to_string(),
    })
}
