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
//! CAHVOR, without them CAHV. With `E = e0 e1 e2` and `T = 1`, `2` or `3` (perspective, fisheye,
//! general) besides it is CAHVORE; type 3 needs its parameter `P = x`, which the other two may
//! have only as the number that their type stands for (1 and 0), or as the 0 that the JPL
//! programs write. `Dimensions` (width and height, px), `Model` (its first word; what
//! follows another `=` is a description) and `Frame` (the frame of the vectors) may be missing; if
//! `Model` is there it must agree with the vectors. Any other line is refused with its number: the
//! reader never guesses what it leaves out. `Frame` is ours; the other lines are those of the JPL
//! calibration programs, whose covariance and internal-parameter blocks have to be cut off.

use super::{FormatError, MAX_BYTES, MAX_FRAME_CHARS, ModelFile, shown};
use crate::{Cahv, Cahvor, Cahvore, Camera, CameraModel};
use nalgebra::Vector3;
use std::fmt::Write;

/// A value and the line that gave it.
struct Given<T> {
    line: usize,
    value: T,
}

const VECTORS: [&str; 7] = ["C", "A", "H", "V", "O", "R", "E"];

/// Reads a camera model from its plain text form.
///
/// # Errors
/// [`FormatError`], with the number of the line at fault; `Camera(InvalidModel)` if the numbers
/// read do not make a camera (see [`Camera::validate`]).
pub fn read_text(text: &str) -> Result<ModelFile, FormatError> {
    if text.len() > MAX_BYTES {
        return Err(FormatError::TooLong { found: text.len() });
    }
    let mut vectors: [Option<Given<Vector3<f64>>>; 7] = Default::default();
    let mut model_name: Option<Given<&str>> = None;
    let mut size_px: Option<Given<[u32; 2]>> = None;
    let mut frame: Option<Given<&str>> = None;
    let mut kind: Option<Given<u32>> = None;
    let mut parameter: Option<Given<f64>> = None;
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
            "T" => set(&mut kind, line, "T", read_kind(line, value)?)?,
            "P" => set(&mut parameter, line, "P", read_number(line, "P", value)?)?,
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
    let linearity = linearity(kind, parameter)?;
    let model = assemble(vectors, linearity)?;
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

/// The linearity that the lines T and P stand for, with the line of the first of them.
fn linearity(
    kind: Option<Given<u32>>,
    parameter: Option<Given<f64>>,
) -> Result<Option<f64>, FormatError> {
    let Some(kind) = kind else {
        return match parameter {
            None => Ok(None),
            Some(_) => Err(FormatError::Missing { name: "T" }),
        };
    };
    let implied = match kind.value {
        1 => 1.0,
        2 => 0.0,
        _ => {
            let given = parameter.ok_or(FormatError::Missing { name: "P" })?;
            return Ok(Some(given.value));
        }
    };
    if let Some(Given { line, value }) = parameter
        && value != implied
        && value != 0.0
    {
        return Err(FormatError::Value {
            line,
            name: "P",
            found: value.to_string(),
            expected: "no line P, P = 0, or T = 3: types 1 and 2 have no parameter",
        });
    }
    Ok(Some(implied))
}

fn assemble(
    vectors: [Option<Given<Vector3<f64>>>; 7],
    linearity: Option<f64>,
) -> Result<CameraModel, FormatError> {
    let moving = vectors[6].is_some() || linearity.is_some();
    let distorted = moving || vectors[4].is_some() || vectors[5].is_some();
    let [c, a, h, v, o, r, e] = vectors.map(|given| given.map(|given| given.value));
    let need = |vector: Option<Vector3<f64>>, name| vector.ok_or(FormatError::Missing { name });
    let (c, a, h, v) = (need(c, "C")?, need(a, "A")?, need(h, "H")?, need(v, "V")?);
    if !distorted {
        return Ok(CameraModel::Cahv(Cahv { c, a, h, v }));
    }
    let (o, r) = (need(o, "O")?, need(r, "R")?);
    if !moving {
        return Ok(CameraModel::Cahvor(Cahvor { c, a, h, v, o, r }));
    }
    Ok(CameraModel::Cahvore(Cahvore {
        c,
        a,
        h,
        v,
        o,
        r,
        e: need(e, "E")?,
        linearity: linearity.ok_or(FormatError::Missing { name: "T" })?,
    }))
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
        push_vector(&mut text, name, vector);
    }
    if let Some([o, r]) = model.lens() {
        push_vector(&mut text, "O", o);
        push_vector(&mut text, "R", r);
    }
    if let CameraModel::Cahvore(Cahvore { e, linearity, .. }) = model {
        push_vector(&mut text, "E", e);
        if *linearity == 1.0 {
            push_line(&mut text, "T", &1);
        } else if *linearity == 0.0 {
            push_line(&mut text, "T", &2);
        } else {
            push_line(&mut text, "T", &3);
            push_line(&mut text, "P", linearity);
        }
    }
    Ok(text)
}

fn push_vector(text: &mut String, name: &str, vector: &Vector3<f64>) {
    push_line(
        text,
        name,
        &format_args!("{} {} {}", vector.x, vector.y, vector.z),
    );
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

fn read_number(line: usize, name: &'static str, value: &str) -> Result<f64, FormatError> {
    read_words::<f64, 1>(value, finite)
        .map(|[x]| x)
        .ok_or_else(|| FormatError::Value {
            line,
            name,
            found: shown(value),
            expected: "a finite number",
        })
}

fn read_kind(line: usize, value: &str) -> Result<u32, FormatError> {
    read_words::<u32, 1>(value, |word| {
        word.parse().ok().filter(|x| (1..=3).contains(x))
    })
    .map(|[x]| x)
    .ok_or_else(|| FormatError::Value {
        line,
        name: "T",
        found: shown(value),
        expected: "1 (perspective), 2 (fisheye) or 3 (general)",
    })
}

fn finite(word: &str) -> Option<f64> {
    word.parse().ok().filter(|x: &f64| x.is_finite())
}

fn read_vector(line: usize, name: &'static str, value: &str) -> Result<Vector3<f64>, FormatError> {
    read_words::<f64, 3>(value, finite)
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
