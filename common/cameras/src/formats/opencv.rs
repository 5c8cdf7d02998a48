//! OpenCV `FileStorage` YAML as its calibration programs write it: `image_width`, `image_height`,
//! `camera_matrix`, `distortion_coefficients`, and `fisheye_model: 1` for the equidistant lens.
//!
//! Such a file is a store of anything; other names in it are not looked at. It holds no pose: the
//! model is in the camera's own axes.

use super::lens::{Lens, LensCamera};
use super::ros::{pinhole, polynomial};
use super::yaml::{self, all_finite, list, wrong};
use super::{FormatError, MAX_BYTES};
use nalgebra::Isometry3;
use serde::Deserialize;

#[derive(Deserialize)]
struct File {
    image_width: u32,
    image_height: u32,
    camera_matrix: Matrix,
    #[serde(alias = "distortion_coeffs", alias = "dist_coeffs")]
    distortion_coefficients: Matrix,
    #[serde(default)]
    fisheye_model: u32,
}

#[derive(Deserialize)]
struct Matrix {
    rows: usize,
    cols: usize,
    data: Vec<f64>,
}

impl Matrix {
    fn numbers(&self, field: &str, expected: &[usize]) -> Result<&[f64], FormatError> {
        let n = self.data.len();
        if self.rows.checked_mul(self.cols) != Some(n) || !expected.contains(&n) {
            return Err(wrong(
                field,
                format_args!("{} x {} with {n} numbers", self.rows, self.cols),
                format!("{expected:?} numbers, as many as rows times columns"),
            ));
        }
        all_finite(field, &self.data)?;
        Ok(&self.data)
    }
}

/// Whether a text is of this format: it says so in its first line or names its matrices.
pub fn is_opencv(text: &str) -> bool {
    text.trim_start_matches('\u{feff}').starts_with("%YAML:") || text.contains("!!opencv-matrix")
}

/// Reads a camera.
///
/// # Errors
/// [`FormatError::Structure`] with line and column, [`FormatError::Field`], or
/// [`FormatError::Camera`].
pub fn read(text: &str) -> Result<LensCamera, FormatError> {
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
    let file: File = yaml::read(&text)?;
    let k = file.camera_matrix.numbers("camera_matrix", &[9])?;
    let (focal_px, centre_px) = pinhole("camera_matrix", k)?;
    let field = "distortion_coefficients";
    let d = &file.distortion_coefficients;
    let lens = match file.fisheye_model {
        0 => {
            let d = d.numbers(field, &[4, 5, 8, 12, 14])?;
            if d.iter().skip(8).any(|x| *x != 0.0) {
                return Err(wrong(
                    field,
                    format_args!("{:?}", &d[8..]),
                    "zeros after the eighth: no thin prism and no tilt",
                ));
            }
            polynomial(d)
        }
        1 => {
            let d = d.numbers(field, &[4])?;
            Lens::Equidistant {
                k: [d[0], d[1], d[2], d[3]],
            }
        }
        other => return Err(wrong("fisheye_model", other, "0 or 1")),
    };
    let camera = LensCamera {
        frame_from_camera: Isometry3::identity(),
        focal_px,
        centre_px,
        size_px: [file.image_width, file.image_height],
        lens,
    };
    camera.validate()?;
    Ok(camera)
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
