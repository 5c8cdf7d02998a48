//! A picture as a predicted pose, or a given affine map, would show it.

use nalgebra::{Isometry3, Matrix2, Point3, Vector2};
use rover_cameras::Camera;

use super::{NoFinding, positive};
use crate::image::{Image8, ImageF};
use crate::sample::SplineImage;

/// How the searched picture appears in the image.
#[derive(Clone, Copy, Debug)]
pub enum Appearance<'a> {
    /// The picture's middle is expected at `place_px`, and an offset d of the picture at
    /// `image_from_picture` d.
    Affine {
        /// Expected pixel of the picture's middle.
        place_px: Vector2<f64>,
        /// Takes picture offsets (px) to image offsets (px).
        image_from_picture: Matrix2<f64>,
    },
    /// The picture is flat, `width_m` wide, and at a predicted pose: origin in its middle, x to its
    /// right, y up, z out of it.
    Pose {
        /// The camera that took the image.
        camera: &'a Camera,
        /// Takes picture coordinates (m) to the frame of the camera model's vectors.
        camera_frame_from_picture: Isometry3<f64>,
        /// Width of the picture, from its first pixel's left edge to its last one's right, m.
        width_m: f64,
    },
}

/// A rectangle of values to be found.
pub(super) struct Patch {
    pub width: usize,
    pub height: usize,
    pub values: Vec<f32>,
    pub mask: Option<Vec<bool>>,
    /// The reported point, from the rectangle's middle, px.
    pub offset: Vector2<f64>,
}

/// Largest side of a warped template, px.
const MAX_SIDE_PX: f64 = 400.0;
/// Least side, px.
const MIN_SIDE_PX: f64 = 8.0;

/// The picture as the image should show it, and where its middle should be.
pub(super) fn warp(
    picture: &Image8,
    appearance: &Appearance,
) -> Result<(Patch, Vector2<f64>), NoFinding> {
    let (w, h) = (f64::from(picture.width_px), f64::from(picture.height_px));
    let bad = |e: &dyn std::fmt::Display| NoFinding::BadInput(format!("appearance: {e}"));
    let middle = Vector2::new((w - 1.0) / 2.0, (h - 1.0) / 2.0);
    // picture px (from its middle) to image px
    let forward = |d: &Vector2<f64>| -> Result<Vector2<f64>, NoFinding> {
        match appearance {
            Appearance::Affine {
                place_px,
                image_from_picture,
            } => Ok(place_px + image_from_picture * d),
            Appearance::Pose {
                camera,
                camera_frame_from_picture,
                width_m,
            } => {
                let s = width_m / w;
                let p = camera_frame_from_picture * Point3::new(d.x * s, -d.y * s, 0.0);
                camera.project(&p.coords).map_err(|e| bad(&e))
            }
        }
    };
    let back = |q: &Vector2<f64>| -> Option<Vector2<f64>> {
        match appearance {
            Appearance::Affine {
                place_px,
                image_from_picture,
            } => Some(image_from_picture.try_inverse()? * (q - place_px)),
            Appearance::Pose {
                camera,
                camera_frame_from_picture,
                width_m,
            } => {
                let ray = camera.ray(q).ok()?;
                let o =
                    camera_frame_from_picture.inverse_transform_point(&Point3::from(ray.origin));
                let d = camera_frame_from_picture.inverse_transform_vector(ray.direction.as_ref());
                if !(o.z > 0.0 && d.z < 0.0) {
                    return None; // the picture's back
                }
                let t = -o.z / d.z;
                let s = w / width_m;
                Some(Vector2::new((o.x + t * d.x) * s, -(o.y + t * d.y) * s))
            }
        }
    };
    if let Appearance::Pose { width_m, .. } = appearance {
        positive("appearance", "width_m", *width_m)?;
    }
    let place = forward(&Vector2::zeros())?;
    let (mut low, mut high) = (place, place);
    for (x, y) in [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)] {
        let corner = forward(&Vector2::new(x * w, y * h))?;
        low = low.inf(&corner);
        high = high.sup(&corner);
    }
    let extent = high - low;
    if !(extent.max() <= MAX_SIDE_PX) {
        return Err(bad(&format!(
            "the picture would be {:.0} x {:.0} px, expected at most {MAX_SIDE_PX} px",
            extent.x, extent.y
        )));
    }
    if !(extent.min() >= MIN_SIDE_PX) {
        return Err(NoFinding::TooSmall {
            found_px: extent.min(),
            needed_px: MIN_SIDE_PX,
        });
    }
    let (left, top) = (low.x.floor(), low.y.floor());
    let width = (high.x.ceil() - left) as usize + 1;
    let height = (high.y.ceil() - top) as usize + 1;
    // picture px per image px along each image axis, for the averaging
    let per_px =
        |d: Vector2<f64>| -> Option<f64> { Some((back(&(place + d))? - back(&place)?).norm()) };
    let shrink = per_px(Vector2::x())
        .zip(per_px(Vector2::y()))
        .map(|(a, b)| a.max(b))
        .ok_or_else(|| bad(&"the picture shows its back or its edge"))?;
    let samples = (2.0 * shrink).ceil().clamp(1.0, 8.0) as usize;
    let spline = SplineImage::new(&ImageF::from_image8(picture)?);
    let mut values = vec![0.0f32; width * height];
    let mut mask = vec![false; width * height];
    for j in 0..height {
        for i in 0..width {
            let at = Vector2::new(left + i as f64, top + j as f64);
            let mut sum = 0.0f32;
            let mut whole = true;
            for k in 0..samples * samples {
                let part = |k: usize| (k as f64 + 0.5) / samples as f64 - 0.5;
                let q = at + Vector2::new(part(k % samples), part(k / samples));
                match back(&q).and_then(|d| spline.sample(middle.x + d.x, middle.y + d.y)) {
                    Some(s) => sum += s.value,
                    None => whole = false,
                }
            }
            if whole {
                values[j * width + i] = sum / (samples * samples) as f32;
                mask[j * width + i] = true;
            }
        }
    }
    let grid_middle = Vector2::new(
        left + (width as f64 - 1.0) / 2.0,
        top + (height as f64 - 1.0) / 2.0,
    );
    let patch = Patch {
        width,
        height,
        values,
        mask: Some(mask),
        offset: place - grid_middle,
    };
    Ok((patch, place))
}
