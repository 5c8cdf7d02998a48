//! Model files in and out, in any of the formats.

use crate::commands::CommandError;
use anyhow::Context;
use rover_cameras::{
    Camera, CameraModel,
    formats::{
        Conversion, ConversionError, ConversionRules, Family, FormatError, LensCamera, MAX_BYTES,
        ModelFile, kalibr, opencv, read_text, read_toml, ros, write_text, write_toml,
    },
};
use rover_files::FileError;
use std::{
    fs::File,
    io::{self, Read},
    path::{Path, PathBuf},
};

/// The frame of a model that has no pose.
const OWN_AXES: &str = "camera_optical";

/// The formats of model files.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum Format {
    /// Plain text, one NAME = x y z line per vector
    Cahv,
    /// TOML
    Toml,
    /// ROS CameraInfo YAML
    Ros,
    /// OpenCV FileStorage YAML
    Opencv,
    /// Kalibr camera chain
    Kalibr,
}

/// How well a converted model stands for the original.
#[derive(Clone, Copy, Debug, serde::Serialize)]
pub(super) struct Fidelity {
    pub(super) exact: bool,
    pub(super) worst_px: f64,
    /// Share of the image in which the original has rays.
    pub(super) covered: f64,
}

/// What a person says about a model file beside its name.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct About {
    /// Largest pixel error that is accepted of a lens that must be fitted
    #[arg(long, value_name = "PX", default_value_t = ConversionRules::default().limit_px)]
    pub(super) limit_px: f64,
    /// Image size, if the file does not give it (OpenCV stereo files do not)
    #[arg(long, value_name = "WIDTHxHEIGHT", value_parser = size)]
    size: Option<[u32; 2]>,
    /// R and T of an OpenCV stereo file MODEL#2, if they are in another file, as stereo_calib writes it
    #[arg(long, value_name = "FILE")]
    extrinsics: Option<PathBuf>,
    /// Unit of T of an OpenCV stereo file MODEL#2, as the squares of the board were given [default: 1]
    #[arg(long, value_name = "M")]
    unit_m: Option<f64>,
}

impl Default for About {
    fn default() -> Self {
        Self {
            limit_px: ConversionRules::default().limit_px,
            size: None,
            extrinsics: None,
            unit_m: None,
        }
    }
}

impl About {
    /// The rules of conversion: the two models shall agree from `near_m` on, m.
    pub(super) fn rules(&self, near_m: f64) -> Result<ConversionRules, CommandError> {
        let limit_px = self.limit_px;
        if [limit_px, near_m].iter().all(|x| *x > 0.0 && x.is_finite()) {
            return Ok(ConversionRules { limit_px, near_m });
        }
        Err(CommandError::BadInput(format!(
            "--limit-px {limit_px} --near-m {near_m}: expected numbers above 0"
        )))
    }
}

fn size(text: &str) -> Result<[u32; 2], String> {
    let sides = text.split_once('x').and_then(|(w, h)| {
        let side = |text: &str| text.trim().parse().ok().filter(|n: &u32| *n > 0);
        Some([side(w)?, side(h)?])
    });
    sides.ok_or_else(|| "expected WIDTHxHEIGHT in whole pixels, e.g. 640x480".into())
}

/// A model that was read, whatever it was written in.
pub(in crate::commands) struct Loaded {
    /// The file's name for messages.
    pub(in crate::commands) name: String,
    pub(super) format: Format,
    pub(in crate::commands) file: ModelFile,
    /// `None` for the formats of the CAHV family itself.
    pub(super) fidelity: Option<Fidelity>,
    /// What a person should know about how the file was read.
    notes: Vec<String>,
    /// Whether its own axes are those of the rectified left camera, if it is that one.
    may_be_left: bool,
}

impl Loaded {
    /// The camera with its image size.
    pub(super) fn camera(&self) -> Result<Camera, CommandError> {
        self.file.camera().map_err(|e| bad(&self.name, &e))
    }

    /// Says on standard error how the file was read.
    pub(super) fn report_notes(&self) {
        for note in &self.notes {
            eprintln!("{}: {note}", self.name);
        }
    }

    /// The camera, without an image size if the file has none.
    pub(super) fn model(&self) -> &CameraModel {
        &self.file.model
    }
}

fn bad(name: &str, error: &dyn std::fmt::Display) -> CommandError {
    CommandError::BadInput(format!("{name}: {error}"))
}

/// Refuses two models of a pair that are not given in one frame.
pub(in crate::commands) fn check_one_frame(
    left: &Loaded,
    right: &Loaded,
) -> Result<(), CommandError> {
    let (Some(l), Some(r)) = (&left.file.frame, &right.file.frame) else {
        return Ok(());
    };
    if l == r || (left.may_be_left && r == ros::RECTIFIED) {
        return Ok(());
    }
    Err(CommandError::BadInput(format!(
        "{} is given in the frame `{l}`, {} in `{r}`: expected one frame",
        left.name, right.name
    )))
}

/// Reads a model; one that is not of the CAHV family is converted under `rules`.
pub(super) fn load(
    path: &Path,
    rules: &ConversionRules,
    about: &About,
) -> Result<Loaded, CommandError> {
    let (path, member) = member(path)?;
    let (name, text) = text(&path)?;
    let format = format_of(&path, &text);
    let fail = |e: FormatError| bad(&name, &e);
    if let Some(n) = member
        && !matches!(format, Format::Kalibr | Format::Opencv)
    {
        let why =
            format!("no camera #{n}: only Kalibr chains and OpenCV stereo files have several");
        return Err(bad(&name, &why));
    }
    for (option, is_given) in [
        ("--extrinsics", about.extrinsics.is_some()),
        ("--unit-m", about.unit_m.is_some()),
    ] {
        if is_given && format != Format::Opencv {
            let why = format!("{option} is for an OpenCV stereo file");
            return Err(bad(&name, &why));
        }
    }
    let (mut notes, mut may_be_left) = (Vec::new(), false);
    let (mut file, fidelity) = match format {
        Format::Cahv => (read_text(&text).map_err(fail)?, None),
        Format::Toml => (read_toml(&text).map_err(fail)?, None),
        Format::Ros => {
            let info = ros::read(&text).map_err(fail)?;
            let frame = if info.posed {
                let at = info.camera.frame_from_camera.translation.vector;
                notes.push(format!(
                    "pose by its R and P: {:.6} {:.6} {:.6} m in the axes of the rectified left \
                     camera ({})",
                    at.x,
                    at.y,
                    at.z,
                    ros::RECTIFIED
                ));
                ros::RECTIFIED.into()
            } else {
                info.name.unwrap_or_else(|| OWN_AXES.into())
            };
            may_be_left = info.may_be_left;
            if may_be_left {
                notes.push(format!(
                    "its R and P leave it in its own axes, frame `{frame}`; if it is the left camera \
                     of a rectified pair, they are those of the right one too ({})",
                    ros::RECTIFIED
                ));
            }
            converted(&name, &info.camera, &frame, rules)?
        }
        Format::Opencv => {
            let second_from_first = match &about.extrinsics {
                None => None,
                Some(path) => {
                    let (name, text) = self::text(path)?;
                    Some(opencv::read_extrinsics(&text).map_err(|e| bad(&name, &e))?)
                }
            };
            let choice = opencv::Choice {
                number: member,
                size_px: about.size,
                second_from_first,
                unit_m: about.unit_m,
            };
            let found = opencv::read_chosen(&text, &choice).map_err(fail)?;
            if member.is_none() && found.number.is_some() {
                notes.push(format!(
                    "the first camera of a pair; the second is {name}#2"
                ));
            }
            if found.number == Some(2) && found.frame != "camera1_optical" {
                notes.push(
                    "no R and T in the file: the second camera is in its own axes; `rover camera \
                     convert --extrinsics FILE` takes them from another"
                        .into(),
                );
            } else if found.number == Some(2) {
                let unit = about.unit_m.unwrap_or(1.0);
                notes.push(format!(
                    "pose by R and T in the axes of the first camera: a baseline of {:.6} m, if the \
                     unit of T is {unit} m ({})",
                    found.camera.frame_from_camera.translation.vector.norm(),
                    match about.unit_m {
                        None => "the file does not say; `rover camera convert --unit-m` changes it",
                        Some(_) => "--unit-m",
                    }
                ));
            }
            converted(&name, &found.camera, found.frame, rules)?
        }
        Format::Kalibr => {
            let chain = kalibr::read(&text).map_err(fail)?;
            let member = member.unwrap_or(0);
            let camera = chain.get(member).ok_or_else(|| {
                let last = chain.len() - 1;
                bad(
                    &name,
                    &format!("no camera #{member}: the chain has #0 to #{last}"),
                )
            })?;
            converted(&name, camera, "cam0", rules)?
        }
    };
    if let Some([w, h]) = about.size {
        if let Some(given) = file.size_px.filter(|given| *given != [w, h]) {
            return Err(CommandError::BadInput(format!(
                "--size {w}x{h}: {name} says {} x {} px",
                given[0], given[1]
            )));
        }
        file.size_px = Some([w, h]);
    }
    Ok(Loaded {
        name,
        format,
        file,
        fidelity,
        notes,
        may_be_left,
    })
}

/// Reads a model under the usual rules; a conversion that is not exact is reported.
pub(in crate::commands) fn load_reported(path: &Path) -> Result<Loaded, CommandError> {
    let loaded = load(path, &ConversionRules::default(), &About::default())?;
    loaded.report_notes();
    if let Some(fidelity) = loaded.fidelity.filter(|f| !f.exact) {
        eprintln!(
            "{}: its lens was fitted, {:.2e} px off at worst",
            loaded.name, fidelity.worst_px
        );
    }
    Ok(loaded)
}

fn converted(
    name: &str,
    camera: &LensCamera,
    frame: &str,
    rules: &ConversionRules,
) -> Result<(ModelFile, Option<Fidelity>), CommandError> {
    let found = camera.to_camera(rules).map_err(|e| unconverted(name, &e))?;
    let fidelity = fidelity(&found);
    let file = ModelFile {
        frame: Some(frame.to_owned()),
        size_px: Some([found.camera.width_px, found.camera.height_px]),
        model: found.camera.model,
    };
    Ok((file, Some(fidelity)))
}

/// A failed conversion, with the way to accept a larger error.
fn unconverted(name: &str, error: &ConversionError) -> CommandError {
    let ConversionError::TooFar { worst_px, .. } = error else {
        return bad(name, error);
    };
    let enough = rounded_up(*worst_px);
    bad(
        name,
        &format!("{error}; `rover camera convert --limit-px {enough}` accepts that"),
    )
}

/// A number above 0, rounded up to two digits.
fn rounded_up(x: f64) -> String {
    let place = 1 - x.log10().floor() as i32;
    let steps = (x * 10_f64.powi(place)).ceil();
    if place <= 0 {
        format!("{:.0}", steps * 10_f64.powi(-place))
    } else {
        format!("{:.*}", place as usize, steps / 10_f64.powi(place))
    }
}

fn fidelity<T>(found: &Conversion<T>) -> Fidelity {
    Fidelity {
        exact: found.exact,
        worst_px: found.worst_px,
        covered: found.covered,
    }
}

/// `FILE#N` is the camera that `FILE` itself numbers N: `cam1` of a Kalibr chain, `M2` of an OpenCV
/// pair.
fn member(path: &Path) -> Result<(std::path::PathBuf, Option<usize>), CommandError> {
    let whole = path.to_string_lossy();
    match whole.rsplit_once('#') {
        Some((file, number)) if !path.exists() => {
            let n = number
                .parse()
                .map_err(|_| bad(&whole, &"expected a camera's number after #, as in FILE#1"))?;
            Ok((file.into(), Some(n)))
        }
        _ => Ok((path.into(), None)),
    }
}

/// The text of a file or of standard input, no longer than a model file may be.
fn text(path: &Path) -> Result<(String, String), CommandError> {
    let name = if path == Path::new("-") {
        "standard input".to_owned()
    } else {
        path.display().to_string()
    };
    let mut bytes = Vec::new();
    let limit = MAX_BYTES as u64 + 1;
    let read = if path == Path::new("-") {
        io::stdin().lock().take(limit).read_to_end(&mut bytes)
    } else {
        File::open(path).and_then(|file| file.take(limit).read_to_end(&mut bytes))
    };
    read.map_err(|e| bad(&name, &FileError::from(e)))?;
    if bytes.len() > MAX_BYTES {
        let found = format!("longer than the {MAX_BYTES} bytes of a model file");
        return Err(bad(&name, &found));
    }
    let text = String::from_utf8(bytes).map_err(|e| {
        let line = 1 + e.as_bytes()[..e.utf8_error().valid_up_to()]
            .iter()
            .filter(|b| **b == b'\n')
            .count();
        bad(&name, &format!("line {line}: not UTF-8 text"))
    })?;
    Ok((name, text))
}

/// The format of a text, by the file's extension and, for YAML and standard input, by content.
fn format_of(path: &Path, text: &str) -> Format {
    if let Some(format) = by_extension(path) {
        return format;
    }
    if opencv::is_opencv(text) {
        return Format::Opencv;
    }
    if kalibr::is_kalibr(text) {
        return Format::Kalibr;
    }
    let has = |start: &str| {
        text.lines()
            .any(|line| line.trim_start().starts_with(start))
    };
    if has("[model") {
        Format::Toml
    } else if has("image_width:") || has("distortion_model:") || is_yaml(path) {
        Format::Ros
    } else {
        Format::Cahv
    }
}

fn extension(path: &Path) -> String {
    path.extension()
        .map(|e| e.to_string_lossy().to_lowercase())
        .unwrap_or_default()
}

fn is_yaml(path: &Path) -> bool {
    matches!(extension(path).as_str(), "yaml" | "yml")
}

/// The format that an extension alone stands for.
pub(super) fn by_extension(path: &Path) -> Option<Format> {
    match extension(path).as_str() {
        "toml" => Some(Format::Toml),
        "cahv" | "cahvor" | "cahvore" | "txt" => Some(Format::Cahv),
        _ => None,
    }
}

/// The text of a model in a format, and how well it stands for it.
pub(super) fn express(
    loaded: &Loaded,
    format: Format,
    rules: &ConversionRules,
) -> Result<(String, Option<Fidelity>), CommandError> {
    let fail = |e: FormatError| bad(&loaded.name, &e);
    let frame = loaded.file.frame.as_deref();
    let as_lens = |families: &[Family]| -> Result<_, CommandError> {
        let found = LensCamera::from_camera(&loaded.camera()?, families, rules)
            .map_err(|e| unconverted(&loaded.name, &e))?;
        let fidelity = fidelity(&found);
        Ok((found.camera, Some(fidelity)))
    };
    let all = [Family::PlumbBob, Family::Rational, Family::Equidistant];
    Ok(match format {
        Format::Cahv => (write_text(&loaded.camera()?, frame).map_err(fail)?, None),
        Format::Toml => (write_toml(&loaded.file).map_err(fail)?, None),
        Format::Ros => {
            let (camera, fidelity) = as_lens(&all)?;
            let name = frame.unwrap_or("camera");
            (ros::write(&camera, name).map_err(fail)?, fidelity)
        }
        Format::Opencv => {
            let (camera, fidelity) = as_lens(&all)?;
            (opencv::write(&camera).map_err(fail)?, fidelity)
        }
        Format::Kalibr => {
            let families = [Family::RadialTangential, Family::Equidistant];
            let (camera, fidelity) = as_lens(&families)?;
            (kalibr::write(&[camera]).map_err(fail)?, fidelity)
        }
    })
}

/// JSON as the reporting commands write it.
pub(super) fn json(value: &impl serde::Serialize) -> Result<String, CommandError> {
    let mut text = serde_json::to_string_pretty(value).context("report as JSON")?;
    text.push('\n');
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::rounded_up;

    #[test]
    fn a_limit_that_is_suggested_is_above_what_was_found_and_short() {
        for (x, expected) in [
            (0.0123, "0.013"),
            (0.000_999_9, "0.00100"),
            (0.21, "0.21"),
            (7.31, "7.4"),
            (12.3, "13"),
            (123.4, "130"),
        ] {
            let found = rounded_up(x);
            assert_eq!(found, expected);
            assert!(found.parse().is_ok_and(|limit: f64| limit >= x), "{found}");
        }
    }
}
