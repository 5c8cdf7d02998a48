//! OpenCV `FileStorage` YAML as its calibration programs write it: `image_width`, `image_height`,
//! `camera_matrix`, `distortion_coefficients`, and `fisheye_model: 1` (or a `distortion_model` as in
//! ROS) for the equidistant lens. Stereo programs write `M1`, `D1`, `M2`, `D2` (or `K1`, ...) without
//! an image size, and `R`, `T` with `X2 = R X1 + T` in the same file or another.
//!
//! Such a file is a store of anything: other names in it are not looked at, but those that would
//! change what the numbers mean are refused. A single camera has no pose: the model is in its own
//! axes (x right, y down, z forward). So is the first camera of a pair; the second is given in the
//! axes of the first if `R` and `T` are there, or in a second file (`extrinsics.yml` beside
//! `intrinsics.yml`, as OpenCV's `stereo_calib` writes them). `T` has the unit that the squares of
//! the board were given in; the file does not say which. `R1`, `R2`, `P1`, `P2`, `Q` follow from the
//! rest and are not looked at.

use super::lens::{Lens, LensCamera};
use super::pose::rotation;
use super::ros::{pinhole, polynomial};
use super::yaml::{self, list, wrong};
use super::{FormatError, MAX_BYTES, shown};
use nalgebra::{Isometry3, Matrix3, Translation3};
use serde::Deserialize;
use serde::de::IgnoredAny;

/// What to take from a file.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Choice {
    /// Which camera of a stereo pair: 1 or 2, as in `M1` and `M2`. The first if it is not given.
    pub number: Option<usize>,
    /// Width and height of the image, px, for a file that does not say.
    pub size_px: Option<[u32; 2]>,
    /// Takes the first camera's axes to the second's, in the unit of `T`: [`read_extrinsics`] of
    /// another file.
    pub second_from_first: Option<Isometry3<f64>>,
    /// The unit of `T`, m; metres if not given.
    pub unit_m: Option<f64>,
}

/// A camera of a file.
#[derive(Clone, Debug, PartialEq)]
pub struct Found {
    /// The camera.
    pub camera: LensCamera,
    /// 1 or 2 for a camera of a pair.
    pub number: Option<usize>,
    /// The axes it is in: `camera_optical` for a single camera, `camera1_optical` for the first of a
    /// pair and for a second with `R` and `T`, `camera2_optical` for one without.
    pub frame: &'static str,
}

#[derive(Deserialize)]
struct File {
    #[serde(default, alias = "image_Width")]
    image_width: Option<u32>,
    #[serde(default, alias = "image_Height")]
    image_height: Option<u32>,
    #[serde(
        default,
        alias = "Camera_Matrix",
        alias = "cameraMatrix",
        alias = "K",
        alias = "M"
    )]
    camera_matrix: Option<Matrix>,
    #[serde(
        default,
        alias = "distortion_coeffs",
        alias = "dist_coeffs",
        alias = "Distortion_Coefficients",
        alias = "distCoeffs",
        alias = "D"
    )]
    distortion_coefficients: Option<Matrix>,
    #[serde(default, rename = "M1", alias = "K1", alias = "cameraMatrix1")]
    m1: Option<Matrix>,
    #[serde(default, rename = "D1", alias = "distCoeffs1")]
    d1: Option<Matrix>,
    #[serde(default, rename = "M2", alias = "K2", alias = "cameraMatrix2")]
    m2: Option<Matrix>,
    #[serde(default, rename = "D2", alias = "distCoeffs2")]
    d2: Option<Matrix>,
    #[serde(default, rename = "R")]
    turn: Option<Matrix>,
    #[serde(default, rename = "T")]
    shift: Option<Matrix>,
    #[serde(default)]
    fisheye_model: Option<u32>,
    #[serde(default)]
    distortion_model: Option<String>,
    #[serde(default)]
    camera_model: Option<String>,
    #[serde(default)]
    xi: Option<IgnoredAny>,
    #[serde(default, alias = "alpha")]
    skew: Option<IgnoredAny>,
    #[serde(default, alias = "is_fisheye", alias = "use_fisheye")]
    fisheye: Option<IgnoredAny>,
}

#[derive(Deserialize)]
struct Matrix {
    rows: usize,
    cols: usize,
    data: Vec<f64>,
}

impl Matrix {
    fn numbers(&self, field: &str, expected: &[usize]) -> Result<&[f64], FormatError> {
        yaml::check_matrix(field, Some((self.rows, self.cols)), &self.data, expected)?;
        Ok(&self.data)
    }
}

impl File {
    /// Whether the lens is the equidistant one.
    fn is_equidistant(&self) -> Result<bool, FormatError> {
        let kinds = "plumb_bob, rational_polynomial, pinhole, equidistant or fisheye";
        let mut says: Vec<(&str, bool)> = Vec::new();
        match self.fisheye_model {
            None => {}
            Some(0) => says.push(("fisheye_model", false)),
            Some(1) => says.push(("fisheye_model", true)),
            Some(other) => return Err(wrong("fisheye_model", other, "0 or 1")),
        }
        for (field, model, camera) in [
            ("distortion_model", &self.distortion_model, false),
            ("camera_model", &self.camera_model, true),
        ] {
            let Some(model) = model else {
                continue;
            };
            match model.to_lowercase().as_str() {
                "equidistant" | "fisheye" | "kannala_brandt" => says.push((field, true)),
                "plumb_bob" | "radtan" | "rational_polynomial" => says.push((field, false)),
                // A pinhole may have either distortion.
                "pinhole" | "perspective" if camera => {}
                _ => return Err(wrong(field, format_args!("{:?}", shown(model)), kinds)),
            }
        }
        for (field, found) in [
            ("xi", &self.xi),
            ("skew", &self.skew),
            ("fisheye", &self.fisheye),
        ] {
            if found.is_some() {
                return Err(wrong(
                    field,
                    "a name that changes what the numbers mean",
                    "fisheye_model or distortion_model, and no skew or mirror",
                ));
            }
        }
        let equidistant = says.first().is_some_and(|(_, is)| *is);
        match says.iter().find(|(_, is)| *is != equidistant) {
            None => Ok(equidistant),
            Some((field, _)) => Err(wrong(
                field,
                "another lens",
                format!("the one that {} names", says[0].0),
            )),
        }
    }

    fn lens(&self, field: &str, d: &Matrix) -> Result<Lens, FormatError> {
        if self.is_equidistant()? {
            let d = d.numbers(field, &[4])?;
            return Ok(Lens::Equidistant {
                k: [d[0], d[1], d[2], d[3]],
            });
        }
        let d = d.numbers(field, &[4, 5, 8, 12, 14])?;
        if d.iter().skip(8).any(|x| *x != 0.0) {
            return Err(wrong(
                field,
                format_args!("{:?}", &d[8..]),
                "zeros after the eighth: no thin prism and no tilt",
            ));
        }
        Ok(polynomial(d))
    }

    /// Takes the first camera's axes to the second's, if the file says so.
    fn second_from_first(&self) -> Result<Option<Isometry3<f64>>, FormatError> {
        let (r, t) = match (&self.turn, &self.shift) {
            (None, None) => return Ok(None),
            (Some(r), Some(t)) => (r, t),
            (Some(_), None) => return Err(wrong("T", "nothing", "the shift that goes with R")),
            (None, Some(_)) => return Err(wrong("R", "nothing", "the turn that goes with T")),
        };
        let turn = Matrix3::from_row_slice(r.numbers("R", &[9])?);
        let t = t.numbers("T", &[3])?;
        let shift = Translation3::new(t[0], t[1], t[2]);
        Ok(Some(Isometry3::from_parts(shift, rotation("R", &turn)?)))
    }

    /// The pose of the chosen camera of a pair, in metres, if it is not in its own axes: takes the
    /// first camera's axes to the second's.
    fn pose_of(
        &self,
        number: Option<usize>,
        choice: &Choice,
    ) -> Result<Option<Isometry3<f64>>, FormatError> {
        if let Some(unit_m) = choice.unit_m
            && !(unit_m.is_finite() && unit_m > 0.0)
        {
            return Err(wrong("--unit-m", unit_m, "a number above 0"));
        }
        // Of a camera alone, R and T are not looked at.
        let here = match number {
            Some(_) => self.second_from_first()?,
            None => None,
        };
        let pose = match (number, here, choice.second_from_first) {
            (Some(2), Some(_), Some(_)) => {
                return Err(wrong(
                    "R, T",
                    "both here and in --extrinsics",
                    "one of them",
                ));
            }
            (Some(2), here, there) => here.or(there),
            (_, _, Some(_)) => {
                return Err(wrong(
                    "--extrinsics",
                    "a pose for the second camera of a pair",
                    "the second camera chosen, as FILE#2, of a file with M1, D1, M2, D2",
                ));
            }
            _ => None,
        };
        match (pose, choice.unit_m) {
            (None, Some(_)) => Err(wrong(
                "--unit-m",
                "no T to which it applies",
                "the second camera of a pair, as FILE#2, with its R and T",
            )),
            (Some(pose), Some(unit_m)) => Ok(Some(Isometry3::from_parts(
                Translation3::from(pose.translation.vector * unit_m),
                pose.rotation,
            ))),
            (pose, None) => Ok(pose),
        }
    }
}

/// Reads `R` and `T` of a file that holds them without the cameras: takes the first camera's axes to
/// the second's, in the unit of `T`.
///
/// # Errors
/// As [`read_chosen`].
pub fn read_extrinsics(text: &str) -> Result<Isometry3<f64>, FormatError> {
    let found = parse(text)?.second_from_first()?;
    found.ok_or_else(|| wrong("R, T", "nothing", "the pose of the second camera of a pair"))
}

/// Whether a text is of this format: it says so in its first line or names its matrices.
pub fn is_opencv(text: &str) -> bool {
    text.trim_start_matches('\u{feff}').starts_with("%YAML:") || text.contains("!!opencv-matrix")
}

/// Reads the camera of a file that gives its image size, or the first of a pair.
///
/// # Errors
/// As [`read_chosen`].
pub fn read(text: &str) -> Result<LensCamera, FormatError> {
    read_chosen(text, &Choice::default()).map(|found| found.camera)
}

/// Reads a camera.
///
/// # Errors
/// [`FormatError::Structure`] with line and column, [`FormatError::Field`], or
/// [`FormatError::Camera`].
pub fn read_chosen(text: &str, choice: &Choice) -> Result<Found, FormatError> {
    let file = parse(text)?;
    let pair = file.camera_matrix.is_none() && (file.m1.is_some() || file.m2.is_some());
    if !pair && file.camera_matrix.is_none() && file.turn.is_some() && file.shift.is_some() {
        return Err(wrong(
            "camera_matrix",
            "R and T of a pair alone",
            "the cameras: this is the file that goes with theirs as --extrinsics",
        ));
    }
    let number = match (pair, choice.number) {
        (false, None) => None,
        (true, None | Some(1)) => Some(1),
        (true, Some(2)) => Some(2),
        (pair, Some(n)) => {
            let expected = if pair {
                "1 or 2"
            } else {
                "none: the file has one camera"
            };
            return Err(wrong("the number of the camera", n, expected));
        }
    };
    let (k, d, k_field, d_field) = match number {
        None => (
            &file.camera_matrix,
            &file.distortion_coefficients,
            "camera_matrix",
            "distortion_coefficients",
        ),
        Some(1) => (&file.m1, &file.d1, "M1", "D1"),
        Some(_) => (&file.m2, &file.d2, "M2", "D2"),
    };
    let missing = |field: &str| wrong(field, "nothing", "a matrix (!!opencv-matrix)");
    let k = k.as_ref().ok_or_else(|| missing(k_field))?;
    let d = d.as_ref().ok_or_else(|| missing(d_field))?;
    let (focal_px, centre_px) = pinhole(k_field, k.numbers(k_field, &[9])?)?;
    let lens = file.lens(d_field, d)?;
    let size_px = match (file.image_width.zip(file.image_height), choice.size_px) {
        (Some((w, h)), None) => [w, h],
        (None, Some(size)) => size,
        (Some((w, h)), Some(size)) if size == [w, h] => size,
        (Some((w, h)), Some(size)) => {
            return Err(wrong(
                "image_width, image_height",
                format_args!("{w} x {h}"),
                format!("{} x {} as asked for", size[0], size[1]),
            ));
        }
        (None, None) => {
            return Err(wrong(
                "image_width, image_height",
                "nothing",
                "the image size; `rover camera convert --size WIDTHxHEIGHT` gives it",
            ));
        }
    };
    let pose = file.pose_of(number, choice)?;
    let camera = LensCamera {
        frame_from_camera: pose.map_or_else(Isometry3::identity, |pose| pose.inverse()),
        focal_px,
        centre_px,
        size_px,
        lens,
    };
    camera.validate()?;
    let frame = match (number, pose) {
        (None, _) => "camera_optical",
        (Some(2), None) => "camera2_optical",
        _ => "camera1_optical",
    };
    Ok(Found {
        camera,
        number,
        frame,
    })
}

fn parse(text: &str) -> Result<File, FormatError> {
    if text.len() > MAX_BYTES {
        return Err(FormatError::TooLong { found: text.len() });
    }
    // `%YAML:1.0` and `!!opencv-matrix` are OpenCV's own; blanks of the same length keep the
    // places that an error names.
    let text = text
        .strip_prefix('\u{feff}')
        .unwrap_or(text)
        .replace("!!opencv-matrix", "               ");
    let text = match text.strip_prefix("%YAML:") {
        Some(rest) => {
            let end = rest.find('\n').unwrap_or(rest.len());
            format!("#{}", &rest[end..])
        }
        None => text,
    };
    yaml::read(&text)
}

/// Writes a camera. Its pose has no place in the file.
///
/// # Errors
/// [`FormatError::Camera`] if the camera is not valid.
pub fn write(camera: &LensCamera) -> Result<String, FormatError> {
    camera.validate()?;
    let (fisheye, d) = match &camera.lens {
        Lens::Equidistant { k } => (1, k.to_vec()),
        Lens::Polynomial { k, p } => {
            let mut d = vec![k[0], k[1], p[0], p[1], k[2]];
            if k[3..] != [0.0; 3] {
                d.extend(&k[3..]);
            }
            (0, d)
        }
    };
    let ([fx, fy], [cx, cy]) = (camera.focal_px, camera.centre_px);
    let matrix = |rows: usize, cols: usize, data: &[f64]| {
        format!(
            "!!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: {}\n",
            list(data)
        )
    };
    Ok(format!(
        "%YAML:1.0\n---\nimage_width: {}\nimage_height: {}\nfisheye_model: {fisheye}\n\
         camera_matrix: {}distortion_coefficients: {}",
        camera.size_px[0],
        camera.size_px[1],
        matrix(3, 3, &[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        matrix(d.len(), 1, &d),
    ))
}
