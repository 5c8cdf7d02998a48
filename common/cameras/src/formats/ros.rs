//! ROS `CameraInfo` as YAML: the calibration files of `camera_calibration_parsers`, and the message
//! itself as `ros2 topic echo` prints it.
//!
//! `R` and `P` describe the rectified image. In a file of a stereo pair they hold its pose too: `R`
//! turns the camera's axes to those of the rectified pair, and the fourth column of `P` is
//! `-fx Bx, -fy By` for a camera at `(Bx, By, 0)` from the left one. If `R` is not the identity or that
//! column not zero, the model is therefore given in the axes of the rectified left camera
//! ([`RECTIFIED`]: x right along the baseline, y down, z forward), the same for both cameras of the
//! pair. Otherwise (and if they are missing or all zeros) it is in the camera's own axes (x right,
//! y down, z forward; `camera_optical` unless the file names its frame): for the left camera of a
//! pair that was taken rectified these are the same axes, but the file of a camera without a partner
//! looks alike. What else `P` says, the
//! focal lengths of the rectified image, is not used.

use super::lens::{Lens, LensCamera};
use super::pose::rotation;
use super::yaml::{self, list, number, wrong};
use super::{FormatError, shown};
use nalgebra::{Isometry3, Matrix3, Translation3, UnitQuaternion};
use serde::de::{MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};
use std::fmt::{self, Write};

/// The frame of models that take their pose from `R` and `P`.
pub const RECTIFIED: &str = "rectified_left";

/// What a file holds.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraInfo {
    /// The camera, in its own axes or, if it is `posed`, in those of the rectified left camera.
    pub camera: LensCamera,
    /// Whether `R` and `P` gave it a pose.
    pub posed: bool,
    /// Whether `R` and `P` are there and do nothing: if this is the left camera of a rectified pair,
    /// its own axes are those of [`RECTIFIED`].
    pub may_be_left: bool,
    /// `camera_name`, or the frame of the message's header.
    pub name: Option<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(alias = "width")]
    image_width: u32,
    #[serde(alias = "height")]
    image_height: u32,
    #[serde(default)]
    camera_name: Option<String>,
    #[serde(default)]
    header: Option<Header>,
    #[serde(alias = "K", alias = "k")]
    camera_matrix: Matrix,
    #[serde(alias = "camera_model")]
    distortion_model: String,
    #[serde(alias = "D", alias = "d")]
    distortion_coefficients: Matrix,
    #[serde(default, alias = "R", alias = "r")]
    rectification_matrix: Option<Matrix>,
    #[serde(default, alias = "P", alias = "p")]
    projection_matrix: Option<Matrix>,
    #[serde(default)]
    binning_x: u32,
    #[serde(default)]
    binning_y: u32,
    #[serde(default)]
    roi: Option<Roi>,
}

#[derive(Deserialize)]
struct Header {
    #[serde(default)]
    frame_id: Option<String>,
}

#[derive(Deserialize, PartialEq)]
struct Roi {
    #[serde(default)]
    x_offset: u32,
    #[serde(default)]
    y_offset: u32,
    #[serde(default)]
    width: u32,
    #[serde(default)]
    height: u32,
}

/// A list of numbers, or `rows`, `cols` and `data`.
struct Matrix {
    shape: Option<(usize, usize)>,
    data: Vec<f64>,
}

impl<'de> Deserialize<'de> for Matrix {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        struct Either;
        impl<'de> Visitor<'de> for Either {
            type Value = Matrix;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a list of numbers, or rows, cols and data of a matrix")
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Matrix, A::Error> {
                let mut data = Vec::new();
                while let Some(x) = list.next_element()? {
                    data.push(x);
                }
                Ok(Matrix { shape: None, data })
            }

            fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<Matrix, A::Error> {
                #[derive(Deserialize)]
                #[serde(deny_unknown_fields)]
                struct Shaped {
                    #[serde(default)]
                    rows: Option<usize>,
                    #[serde(default)]
                    cols: Option<usize>,
                    #[serde(default, rename = "dt")]
                    _type: Option<String>,
                    data: Vec<f64>,
                }
                let from = serde::de::value::MapAccessDeserializer::new(map);
                let Shaped {
                    rows, cols, data, ..
                } = Shaped::deserialize(from)?;
                Ok(Matrix {
                    shape: rows.zip(cols),
                    data,
                })
            }
        }
        from.deserialize_any(Either)
    }
}

impl Matrix {
    /// The numbers, if they are as many as the shape says and as `expected` allows.
    fn numbers(&self, field: &str, expected: &[usize]) -> Result<&[f64], FormatError> {
        yaml::check_matrix(field, self.shape, &self.data, expected)?;
        Ok(&self.data)
    }
}

/// Focal lengths and centre of a 3 x 3 camera matrix, row by row.
pub(super) fn pinhole(field: &str, k: &[f64]) -> Result<([f64; 2], [f64; 2]), FormatError> {
    let zeros = [k[1], k[3], k[6], k[7]];
    if zeros.iter().any(|x| *x != 0.0) || k[8] != 1.0 {
        return Err(wrong(
            field,
            format_args!("{k:?}"),
            "[fx, 0, cx, 0, fy, cy, 0, 0, 1] (no skew)",
        ));
    }
    Ok(([k[0], k[4]], [k[2], k[5]]))
}

/// The coefficients k1, k2, p1, p2, k3, ... in the order of OpenCV.
pub(super) fn polynomial(d: &[f64]) -> Lens {
    let at = |i: usize| d.get(i).copied().unwrap_or(0.0);
    Lens::Polynomial {
        k: [at(0), at(1), at(4), at(5), at(6), at(7)],
        p: [at(2), at(3)],
    }
}

/// Reads a camera.
///
/// # Errors
/// [`FormatError::Structure`] with line and column, [`FormatError::Field`], or
/// [`FormatError::Camera`].
pub fn read(text: &str) -> Result<CameraInfo, FormatError> {
    let file: File = yaml::read(text)?;
    let k = file.camera_matrix.numbers("camera_matrix", &[9])?;
    let (focal_px, centre_px) = pinhole("camera_matrix", k)?;
    let d = |expected: &[usize]| {
        file.distortion_coefficients
            .numbers("distortion_coefficients", expected)
    };
    let lens = match file.distortion_model.as_str() {
        "plumb_bob" => polynomial(d(&[0, 4, 5])?),
        "rational_polynomial" => polynomial(d(&[8])?),
        "equidistant" | "fisheye" => {
            let d = d(&[4])?;
            Lens::Equidistant {
                k: [d[0], d[1], d[2], d[3]],
            }
        }
        "" | "none" => {
            d(&[0])?;
            Lens::NONE
        }
        other => {
            return Err(wrong(
                "distortion_model",
                format_args!("{:?}", shown(other)),
                "plumb_bob, rational_polynomial or equidistant",
            ));
        }
    };
    let frame_from_camera = pose(&file)?;
    if file.binning_x > 1 || file.binning_y > 1 {
        return Err(wrong(
            "binning",
            format_args!("{} x {}", file.binning_x, file.binning_y),
            "0 or 1: bin the converted model with a downsample instead",
        ));
    }
    if let Some(roi) = &file.roi
        && (roi.x_offset, roi.y_offset) != (0, 0)
    {
        return Err(wrong(
            "roi",
            format_args!(
                "{} x {} from ({}, {})",
                roi.width, roi.height, roi.x_offset, roi.y_offset
            ),
            "no offset: cut the converted model with a subframe instead",
        ));
    }
    let camera = LensCamera {
        frame_from_camera: frame_from_camera.unwrap_or_else(Isometry3::identity),
        focal_px,
        centre_px,
        size_px: [file.image_width, file.image_height],
        lens,
    };
    camera.validate()?;
    let says = |matrix: &Option<Matrix>| {
        matrix
            .as_ref()
            .is_some_and(|m| m.data.iter().any(|x| *x != 0.0))
    };
    let may_be_left = frame_from_camera.is_none()
        && says(&file.rectification_matrix)
        && says(&file.projection_matrix);
    let name = file
        .camera_name
        .or_else(|| file.header.and_then(|header| header.frame_id));
    Ok(CameraInfo {
        camera,
        posed: frame_from_camera.is_some(),
        may_be_left,
        name,
    })
}

/// The pose that `R` and `P` give, in the axes of the rectified left camera.
fn pose(file: &File) -> Result<Option<Isometry3<f64>>, FormatError> {
    let numbers = |matrix: &Option<Matrix>, field: &str, n: usize| {
        let data = matrix.as_ref().map(|m| m.numbers(field, &[n]));
        let data = data.transpose()?.unwrap_or_default().to_vec();
        Ok::<_, FormatError>(Some(data).filter(|data| data.iter().any(|x| *x != 0.0)))
    };
    let r = numbers(&file.rectification_matrix, "rectification_matrix", 9)?;
    let p = numbers(&file.projection_matrix, "projection_matrix", 12)?;
    let turn = match r {
        Some(r) => rotation("rectification_matrix", &Matrix3::from_row_slice(&r))?,
        None => UnitQuaternion::identity(),
    };
    let mut shift = Translation3::identity();
    if let Some(p) = p {
        if p[11] != 0.0 || [p[0], p[5]].iter().any(|f| !(*f > 0.0)) {
            return Err(wrong(
                "projection_matrix",
                format_args!("{p:?}"),
                "[fx, 0, cx, -fx Bx, 0, fy, cy, -fy By, 0, 0, 1, 0]",
            ));
        }
        // Without the sign of a zero.
        shift = Translation3::new(0.0 - p[3] / p[0], 0.0 - p[7] / p[5], 0.0);
    }
    // Rectification that does nothing is written to seven digits or more.
    let own = turn.angle() < 1e-9 && shift.vector.amax() == 0.0;
    Ok((!own).then(|| Isometry3::from_parts(shift, turn)))
}

/// Writes the calibration file of a camera. Its pose has no place in it.
///
/// # Errors
/// [`FormatError::Camera`] if the camera is not valid.
pub fn write(camera: &LensCamera, name: &str) -> Result<String, FormatError> {
    camera.validate()?;
    let (model, d) = match &camera.lens {
        Lens::Equidistant { k } => ("equidistant", k.to_vec()),
        Lens::Polynomial { k, p } if k[3..] == [0.0; 3] => {
            ("plumb_bob", vec![k[0], k[1], p[0], p[1], k[2]])
        }
        Lens::Polynomial { k, p } => (
            "rational_polynomial",
            vec![k[0], k[1], p[0], p[1], k[2], k[3], k[4], k[5]],
        ),
    };
    let ([fx, fy], [cx, cy]) = (camera.focal_px, camera.centre_px);
    let mut text = String::new();
    // Writing to a String cannot fail.
    let _ = write!(
        text,
        "image_width: {}\nimage_height: {}\ncamera_name: {}\n\
         camera_matrix:\n  rows: 3\n  cols: 3\n  data: {}\n\
         distortion_model: {model}\n\
         distortion_coefficients:\n  rows: 1\n  cols: {}\n  data: {}\n\
         rectification_matrix:\n  rows: 3\n  cols: 3\n  data: {}\n\
         projection_matrix:\n  rows: 3\n  cols: 4\n  data: [{}, 0.0, {}, 0.0, 0.0, {}, {}, 0.0, \
         0.0, 0.0, 1.0, 0.0]\n",
        camera.size_px[0],
        camera.size_px[1],
        quoted(name),
        list(&[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        d.len(),
        list(&d),
        list(&[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
        number(fx),
        number(cx),
        number(fy),
        number(cy),
    );
    Ok(text)
}

/// A name in double quotes, reduced to printable ASCII.
fn quoted(name: &str) -> String {
    let plain: String = shown(name)
        .chars()
        .filter(|c| (' '..='~').contains(c) && !"\"\\".contains(*c))
        .collect();
    format!("\"{plain}\"")
}
