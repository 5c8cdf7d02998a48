//! The plain text form in which CAHV models are commonly exchanged.
//!
//! ```text
//! # a comment, up to the end of the line
//! Model = CAHVOR
//! Dimensions = 1024 1024
//! Frame = rover
//! C = 0.46726 0.130406 -1.24047
//! A = -0.726097 0.604262 0.328103
//! H = -1144.99 -638.601 168.422
//! V = -53.3346 50.7325 1320.91
//! O = -0.735599 0.581747 0.34708
//! R = 0.00096 -0.002183 0.018547
//! ```
//!
//! One `NAME = values` line each, in any order. C, A, H, V are required; with O and R the model is
//! CAHVOR, without them CAHV. `Dimensions` (width and height, px), `Model` (its first word; what
//! follows another `=` is a description) and `Frame` (the frame of the vectors) may be missing; if
//! `Model` is there it must agree with the vectors. Any other line is refused with its number: the
//! reader never guesses what it leaves out. `Frame` is ours; the other lines are those of the JPL
//! calibration programs, whose covariance and internal-parameter blocks have to be cut off.

use crate::{Cahv, Cahvor, Camera, CameraError, CameraModel};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use std::fmt::Write;
use thiserror::Error;

/// Longest text that is read, bytes. A model takes less than one thousand.
pub const MAX_BYTES: usize = 65_536;
/// Longest frame name, characters.
pub const MAX_FRAME_CHARS: usize = 64;
const MAX_SHOWN_CHARS: usize = 40;
const KNOWN: &str = "C, A, H, V, O, R, Model, Dimensions or Frame";

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
    /// A vector is missing.
    #[error("{name} is missing, expected a line {name} = x y z")]
    Missing {
        /// The vector's name.
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
    #[error("the image size is missing, expected a line Dimensions = WIDTH HEIGHT")]
    NoSize,
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

/// A value and the line that gave it.
struct Given<T> {
    line: usize,
    value: T,
}

const VECTORS: [&str; 6] = ["C", "A", "H", "V", "O", "R"];

/// Reads a camera model from its plain text form.
///
/// # Errors
/// [`FormatError`], with the number of the line at fault; `Camera(InvalidModel)` if the numbers
/// read do not make a camera (see [`Camera::validate`]).
pub fn read_text(text: &str) -> Result<ModelFile, FormatError> {
    if text.len() > MAX_BYTES {
        return Err(FormatError::TooLong { found: text.len() });
    }
    let mut vectors: [Option<Given<Vector3<f64>>>; 6] = Default::default();
    let mut model_name: Option<Given<&str>> = None;
    let mut size_px: Option<Given<[u32; 2]>> = None;
    let mut frame: Option<Given<&str>> = None;
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    for (index, full) in text.lines().enumerate() {
        let line = index + 1;
        let content = full.split('#').next().unwrap_or_default().trim();
        if content.is_empty() {
            continue;
        }
        let unknown = || FormatError::UnknownLine {
            line,
            found: shown(content),
        };
        let (name, value) = content.split_once('=').ok_or_else(unknown)?;
        let value = value.trim();
        match name.trim() {
            "Model" => {
                let word = value.split('=').next().unwrap_or_default().trim();
                set(&mut model_name, line, "Model", word)?;
            }
            "Dimensions" => set(&mut size_px, line, "Dimensions", read_size(line, value)?)?,
            "Frame" => set(&mut frame, line, "Frame", read_frame(line, value)?)?,
            name => {
                let at = VECTORS
                    .iter()
                    .position(|known| *known == name)
                    .ok_or_else(unknown)?;
                let name = VECTORS[at];
                set(
                    &mut vectors[at],
                    line,
                    name,
                    read_vector(line, name, value)?,
                )?;
            }
        }
    }
    let model = assemble(vectors)?;
    if let Some(Given { line, value }) = model_name
        && value != model.name()
    {
        let expected = model.name();
        return Err(FormatError::OtherModel {
            line,
            found: shown(value),
            expected,
        });
    }
    model.validate()?;
    Ok(ModelFile {
        frame: frame.map(|given| given.value.to_owned()),
        size_px: size_px.map(|given| given.value),
        model,
    })
}

fn assemble(vectors: [Option<Given<Vector3<f64>>>; 6]) -> Result<CameraModel, FormatError> {
    let distorted = vectors[4].is_some() || vectors[5].is_some();
    let [c, a, h, v, o, r] = vectors.map(|given| given.map(|given| given.value));
    let need = |vector: Option<Vector3<f64>>, name| vector.ok_or(FormatError::Missing { name });
    let (c, a, h, v) = (need(c, "C")?, need(a, "A")?, need(h, "H")?, need(v, "V")?);
    Ok(if distorted {
        CameraModel::Cahvor(Cahvor {
            c,
            a,
            h,
            v,
            o: need(o, "O")?,
            r: need(r, "R")?,
        })
    } else {
        CameraModel::Cahv(Cahv { c, a, h, v })
    })
}

/// Writes a camera in the plain text form. Numbers are written with as many digits as it takes to
/// read the same camera back.
///
/// # Errors
/// [`FormatError::FrameName`] if the format cannot hold the name of the frame, or
/// [`FormatError::Camera`] if the camera is not valid and so could not be read back.
pub fn write_text(camera: &Camera, frame: Option<&str>) -> Result<String, FormatError> {
    camera.validate()?;
    let Camera {
        model,
        width_px,
        height_px,
    } = camera;
    let mut text = format!(
        "Model = {}\nDimensions = {width_px} {height_px}\n",
        model.name()
    );
    if let Some(frame) = frame {
        if !is_frame_name(frame) {
            return Err(FormatError::FrameName {
                found: shown(frame),
            });
        }
        push_line(&mut text, "Frame", &frame);
    }
    for (name, vector) in VECTORS.iter().zip(model.cahv()) {
        push_line(
            &mut text,
            name,
            &format_args!("{} {} {}", vector.x, vector.y, vector.z),
        );
    }
    if let CameraModel::Cahvor(Cahvor { o, r, .. }) = model {
        for (name, vector) in [("O", o), ("R", r)] {
            push_line(
                &mut text,
                name,
                &format_args!("{} {} {}", vector.x, vector.y, vector.z),
            );
        }
    }
    Ok(text)
}

fn push_line(text: &mut String, name: &str, value: &dyn std::fmt::Display) {
    // Writing to a String cannot fail.
    let _ = writeln!(text, "{name} = {value}");
}

fn set<T>(
    slot: &mut Option<Given<T>>,
    line: usize,
    name: &'static str,
    value: T,
) -> Result<(), FormatError> {
    if let Some(Given { line: first, .. }) = slot {
        return Err(FormatError::Repeated {
            line,
            name,
            first: *first,
        });
    }
    *slot = Some(Given { line, value });
    Ok(())
}

/// Exactly `N` words, each taken by `read`.
fn read_words<T: Copy + Default, const N: usize>(
    value: &str,
    read: impl Fn(&str) -> Option<T>,
) -> Option<[T; N]> {
    let mut words = value.split_ascii_whitespace();
    let mut found = [T::default(); N];
    for slot in &mut found {
        *slot = read(words.next()?)?;
    }
    words.next().is_none().then_some(found)
}

fn read_vector(line: usize, name: &'static str, value: &str) -> Result<Vector3<f64>, FormatError> {
    read_words::<f64, 3>(value, |word| {
        word.parse().ok().filter(|x: &f64| x.is_finite())
    })
    .map(Vector3::from)
    .ok_or_else(|| FormatError::Value {
        line,
        name,
        found: shown(value),
        expected: "three finite numbers",
    })
}

fn read_size(line: usize, value: &str) -> Result<[u32; 2], FormatError> {
    read_words(value, |word| word.parse().ok().filter(|x: &u32| *x > 0)).ok_or_else(|| {
        FormatError::Value {
            line,
            name: "Dimensions",
            found: shown(value),
            expected: "two positive whole numbers",
        }
    })
}

fn read_frame(line: usize, value: &str) -> Result<&str, FormatError> {
    if is_frame_name(value) {
        return Ok(value);
    }
    Err(FormatError::Value {
        line,
        name: "Frame",
        found: shown(value),
        expected: "1 to 64 printable ASCII characters",
    })
}

fn is_frame_name(name: &str) -> bool {
    (1..=MAX_FRAME_CHARS).contains(&name.len())
        && name.trim() == name
        && name
            .bytes()
            .all(|b| (b' '..=b'~').contains(&b) && b != b'#')
}

/// The start of a text, short enough for a message.
fn shown(text: &str) -> String {
    let mut short: String = text.chars().take(MAX_SHOWN_CHARS).collect();
    if text.chars().nth(MAX_SHOWN_CHARS).is_some() {
        short.push_str("...");
    }
    short
}
