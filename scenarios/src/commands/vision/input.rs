//! Files and numbers that the vision commands take in, and JSON out.

use std::io::Read;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};
use rover_cameras::{Camera, StereoPair};
use rover_files::FileError;
use rover_vision::{Image8, picture};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::commands::CommandError;
use crate::commands::camera::files::{Loaded, check_one_frame, load_reported};
use crate::output::Output;

/// Reads all of a file; `-` is standard input.
fn bytes(path: &Path) -> Result<Vec<u8>, CommandError> {
    let refuse = |e: std::io::Error| {
        let e = FileError::from(e);
        CommandError::BadInput(format!("{}: {e}", path.display()))
    };
    if path == Path::new("-") {
        static IS_READ: AtomicBool = AtomicBool::new(false);
        if IS_READ.swap(true, Ordering::Relaxed) {
            let why = "- is given twice: expected standard input for one file only";
            return Err(CommandError::BadInput(why.into()));
        }
        let mut all = Vec::new();
        std::io::stdin().read_to_end(&mut all).map_err(refuse)?;
        return Ok(all);
    }
    std::fs::read(path).map_err(refuse)
}

fn text(path: &Path) -> Result<String, CommandError> {
    String::from_utf8(bytes(path)?)
        .map_err(|_| CommandError::BadInput(format!("{}: not a text in UTF-8", path.display())))
}

/// Reads an image; says on standard error what a person should know about how it became grey.
pub(in crate::commands) fn image(path: &Path) -> Result<Image8, CommandError> {
    let decoded = picture::decode(&bytes(path)?)
        .map_err(|e| CommandError::BadInput(format!("{}: {e}", path.display())))?;
    for note in &decoded.notes {
        eprintln!("rover: {}: {note}", path.display());
    }
    Ok(decoded.image)
}

/// Reads a TOML file of rules; the defaults without one.
pub fn rules<T: DeserializeOwned + Default>(path: Option<&Path>) -> Result<T, CommandError> {
    path.map_or_else(|| Ok(T::default()), toml_file)
}

/// Reads a TOML file.
pub fn toml_file<T: DeserializeOwned>(path: &Path) -> Result<T, CommandError> {
    toml::from_str(&text(path)?)
        .map_err(|e| CommandError::BadInput(format!("{}: {e}", path.display())))
}

/// Reads a camera model of any format that `rover camera` reads. A file without an image size takes
/// that of `image`; another size than the image's is refused.
pub fn camera(path: &Path, image: &Image8) -> Result<Camera, CommandError> {
    of_image(load_reported(path)?, image)
}

fn of_image(loaded: Loaded, image: &Image8) -> Result<Camera, CommandError> {
    let refuse =
        |e: &dyn std::fmt::Display| CommandError::BadInput(format!("{}: {e}", loaded.name));
    let size = [image.width_px, image.height_px];
    if let Some(stated) = loaded.file.size_px
        && stated != size
    {
        return Err(refuse(&format!(
            "the model is of {} x {} px, the image has {} x {} px",
            stated[0], stated[1], size[0], size[1]
        )));
    }
    let camera = Camera {
        model: loaded.file.model,
        width_px: size[0],
        height_px: size[1],
    };
    camera.validate().map_err(|e| refuse(&e))?;
    Ok(camera)
}

/// Reads both models of a stereo pair, which must be given in one frame.
pub fn pair(
    models: (&Path, &Path),
    images: (&Image8, &Image8),
) -> Result<StereoPair, CommandError> {
    let (left, right) = (load_reported(models.0)?, load_reported(models.1)?);
    check_one_frame(&left, &right)?;
    let pair = StereoPair {
        left: of_image(left, images.0)?,
        right: of_image(right, images.1)?,
    };
    pair.validate()
        .map_err(|e| CommandError::BadInput(e.to_string()))?;
    Ok(pair)
}

/// Comma-separated finite numbers, for an argument.
pub fn numbers<const N: usize>(found: &str) -> Result<[f64; N], String> {
    let refuse = || format!("`{found}` is given, {N} finite numbers with commas are expected");
    let mut all = [0.0f64; N];
    let mut parts = found.split(',');
    for x in &mut all {
        let part = parts.next().ok_or_else(refuse)?;
        *x = part.trim().parse().map_err(|_| refuse())?;
        if !x.is_finite() {
            return Err(refuse());
        }
    }
    if parts.next().is_some() {
        return Err(refuse());
    }
    Ok(all)
}

/// A pose argument: x, y, z in m, then the quaternion w, x, y, z.
pub fn pose(found: &str) -> Result<Isometry3<f64>, String> {
    let [x, y, z, w, i, j, k] = numbers::<7>(found)?;
    let q = Quaternion::new(w, i, j, k);
    if !(0.999..=1.001).contains(&q.norm()) {
        return Err(format!(
            "the quaternion of `{found}` has length {}, 1 is expected",
            q.norm()
        ));
    }
    Ok(Isometry3::from_parts(
        Translation3::new(x, y, z),
        UnitQuaternion::from_quaternion(q),
    ))
}

/// A vector argument.
pub fn vector(found: &str) -> Result<Vector3<f64>, String> {
    numbers::<3>(found).map(Vector3::from)
}

/// Writes a report as JSON.
pub fn write_json(out: &Output, report: &impl Serialize) -> Result<(), CommandError> {
    let mut text = serde_json::to_string_pretty(report).map_err(anyhow::Error::from)?;
    text.push('\n');
    Ok(out.write(&text)?)
}
