//! Kalibr camera chains: `cam0`, `cam1`, ... with `T_cn_cnm1` from each camera to the next.
//!
//! The models are in the frame of the first camera's axes. Read are `pinhole` cameras with
//! `radtan`, `equidistant` or no distortion; `omni`, `eucm`, `ds` and `fov` are refused.

use super::FormatError;
use super::lens::{Lens, LensCamera};
use super::pose::rotation;
use super::yaml::{self, all_finite, list, wrong};
use nalgebra::{Isometry3, Matrix3, Translation3, Vector3};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::fmt::Write;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    camera_model: String,
    intrinsics: Vec<f64>,
    #[serde(default)]
    distortion_model: Option<String>,
    #[serde(default)]
    distortion_coeffs: Vec<f64>,
    resolution: [u32; 2],
    #[serde(default, rename = "T_cn_cnm1")]
    from_previous: Option<Vec<Vec<f64>>>,
    #[serde(default, rename = "T_cam_imu")]
    _from_imu: Option<Vec<Vec<f64>>>,
    #[serde(default, rename = "T_imu_cam")]
    _to_imu: Option<Vec<Vec<f64>>>,
    #[serde(default, rename = "timeshift_cam_imu")]
    _time_shift_s: Option<f64>,
    #[serde(default, rename = "cam_overlaps")]
    _overlaps: Vec<u32>,
    #[serde(default, rename = "rostopic")]
    _topic: Option<String>,
    #[serde(default, rename = "line_delay")]
    _line_delay_s: Option<f64>,
}

/// Whether a text is of this format: its cameras are named `cam0`, `cam1`, ...
pub fn is_kalibr(text: &str) -> bool {
    text.lines().any(|line| line.starts_with("cam0:"))
}

/// Reads the cameras of a chain in order; each one's pose is in the first one's axes.
///
/// # Errors
/// [`FormatError::Structure`] with line and column, [`FormatError::Field`], or
/// [`FormatError::Camera`].
pub fn read(text: &str) -> Result<Vec<LensCamera>, FormatError> {
    let files: BTreeMap<String, File> = yaml::read(text)?;
    let mut cameras = Vec::with_capacity(files.len());
    let mut previous = Isometry3::identity();
    for n in 0..files.len() {
        let name = format!("cam{n}");
        let Some(file) = files.get(&name) else {
            let names: Vec<_> = files.keys().map(String::as_str).collect();
            return Err(wrong("cameras", names.join(", "), "cam0, cam1, ..."));
        };
        let at = |field: &str| format!("{name}.{field}");
        let frame_from_camera = match (&file.from_previous, n) {
            (None, 0) => Isometry3::identity(),
            (Some(rows), 1..) => previous * pose(&at("T_cn_cnm1"), rows)?.inverse(),
            (Some(_), 0) => {
                return Err(wrong(
                    &at("T_cn_cnm1"),
                    "a pose",
                    "none in the first camera",
                ));
            }
            (None, _) => return Err(wrong(&at("T_cn_cnm1"), "nothing", "a 4 x 4 pose")),
        };
        previous = frame_from_camera;
        let camera = camera(file, frame_from_camera, &at)?;
        camera.validate()?;
        cameras.push(camera);
    }
    if cameras.is_empty() {
        return Err(wrong("cameras", "none", "cam0, cam1, ..."));
    }
    Ok(cameras)
}

fn camera(
    file: &File,
    frame_from_camera: Isometry3<f64>,
    at: &dyn Fn(&str) -> String,
) -> Result<LensCamera, FormatError> {
    if file.camera_model != "pinhole" {
        return Err(wrong(&at("camera_model"), &file.camera_model, "pinhole"));
    }
    all_finite(&at("intrinsics"), &file.intrinsics)?;
    let &[fx, fy, cx, cy] = file.intrinsics.as_slice() else {
        return Err(wrong(
            &at("intrinsics"),
            format_args!("{} numbers", file.intrinsics.len()),
            "fu, fv, pu, pv",
        ));
    };
    all_finite(&at("distortion_coeffs"), &file.distortion_coeffs)?;
    let four = || match file.distortion_coeffs.as_slice() {
        &[a, b, c, d] => Ok([a, b, c, d]),
        other => Err(wrong(
            &at("distortion_coeffs"),
            format_args!("{} numbers", other.len()),
            "4 numbers",
        )),
    };
    let lens = match file.distortion_model.as_deref() {
        Some("radtan") => {
            let [k1, k2, p1, p2] = four()?;
            Lens::Polynomial {
                k: [k1, k2, 0.0, 0.0, 0.0, 0.0],
                p: [p1, p2],
            }
        }
        Some("equidistant") => Lens::Equidistant { k: four()? },
        None | Some("none") if file.distortion_coeffs.is_empty() => Lens::NONE,
        other => {
            return Err(wrong(
                &at("distortion_model"),
                other.unwrap_or("nothing, with coefficients"),
                "radtan, equidistant or none",
            ));
        }
    };
    Ok(LensCamera {
        frame_from_camera,
        focal_px: [fx, fy],
        centre_px: [cx, cy],
        size_px: file.resolution,
        lens,
    })
}

fn pose(field: &str, rows: &[Vec<f64>]) -> Result<Isometry3<f64>, FormatError> {
    let flat: Vec<f64> = rows.concat();
    if rows.len() != 4 || rows.iter().any(|row| row.len() != 4) {
        return Err(wrong(
            field,
            format_args!("{} rows, {} numbers", rows.len(), flat.len()),
            "4 x 4 numbers",
        ));
    }
    all_finite(field, &flat)?;
    if rows[3] != [0.0, 0.0, 0.0, 1.0] {
        return Err(wrong(
            field,
            format_args!("the last row {:?}", rows[3]),
            "the last row [0, 0, 0, 1]",
        ));
    }
    let shift = Vector3::new(rows[0][3], rows[1][3], rows[2][3]);
    let turn = rotation(field, &Matrix3::from_fn(|i, j| rows[i][j]))?;
    Ok(Isometry3::from_parts(Translation3::from(shift), turn))
}

/// Writes a chain of cameras.
///
/// # Errors
/// [`FormatError::Camera`] if a camera is not valid, [`FormatError::Field`] if Kalibr has no name
/// for its lens.
pub fn write(cameras: &[LensCamera]) -> Result<String, FormatError> {
    let mut text = String::new();
    for (n, camera) in cameras.iter().enumerate() {
        camera.validate()?;
        let (model, d) = match &camera.lens {
            Lens::Equidistant { k } => ("equidistant", *k),
            Lens::Polynomial { k, p } if k[2..] == [0.0; 4] => ("radtan", [k[0], k[1], p[0], p[1]]),
            Lens::Polynomial { k, .. } => {
                let field = format!("cam{n}.distortion_coeffs");
                return Err(wrong(&field, format_args!("{k:?}"), "k1 and k2 only"));
            }
        };
        let ([fx, fy], [cx, cy]) = (camera.focal_px, camera.centre_px);
        // Writing to a String cannot fail.
        let _ = writeln!(text, "cam{n}:");
        if let Some(before) = n.checked_sub(1).and_then(|m| cameras.get(m)) {
            let step =
                (camera.frame_from_camera.inverse() * before.frame_from_camera).to_homogeneous();
            text.push_str("  T_cn_cnm1:\n");
            for row in step.row_iter() {
                let row: Vec<f64> = row.iter().copied().collect();
                let _ = writeln!(text, "  - {}", list(&row));
            }
        }
        let others: Vec<String> = (0..cameras.len())
            .filter(|m| *m != n)
            .map(|m| m.to_string())
            .collect();
        let _ = write!(
            text,
            "  cam_overlaps: [{}]\n  camera_model: pinhole\n  distortion_coeffs: {}\n  \
             distortion_model: {model}\n  intrinsics: {}\n  resolution: [{}, {}]\n  \
             rostopic: /cam{n}/image_raw\n",
            others.join(", "),
            list(&d),
            list(&[fx, fy, cx, cy]),
            camera.size_px[0],
            camera.size_px[1],
        );
    }
    Ok(text)
}
