//! Epipolar rectification of a pair: both images as two equal, parallel pinhole cameras would have
//! taken them, so that a point lies on the same row in both.
//!
//! The projection centres stay where they are. The common axes are x along the baseline, z the mean
//! of both optical axes less its part along x, y = z x x. Lens distortion is taken out on the way.

use nalgebra::{Vector2, Vector3};
use rover_cameras::{Cahv, Camera, CameraError, CameraModel, Side, StereoPair};

use crate::image::{Image8, ImageError};

/// Why a pair cannot be rectified.
#[derive(Debug, thiserror::Error)]
pub enum RectifyError {
    /// The cameras have no common epipolar rows.
    #[error("the pair cannot be rectified: {0}")]
    Geometry(String),
    /// A camera model has no answer.
    #[error("the pair cannot be rectified: {0}")]
    Camera(#[from] CameraError),
    /// An image cannot be used.
    #[error(transparent)]
    Image(#[from] ImageError),
}

/// Fraction bits of a source position.
const FRACTION_BITS: u32 = 5;
const ONE: i32 = 1 << FRACTION_BITS;
/// Mark of a pixel without a source.
const NOWHERE: i32 = i32::MIN;
/// Distance at which a direction is imaged, m: the models' centres are points.
const FAR_M: f64 = 1e6;

/// The maps from rectified pixels to those of the taken images.
#[derive(Clone, Debug)]
pub struct Rectifier {
    /// The rectified cameras; both CAHV, with the same A, H, V but for the baseline's offset.
    pub pair: StereoPair,
    maps: [Vec<[i32; 2]>; 2],
}

/// What the rectified cameras of a pair have in common, whatever their shift.
struct Axes {
    x: Vector3<f64>,
    y: Vector3<f64>,
    z: Vector3<f64>,
    focal_px: f64,
    baseline_m: f64,
    /// Where both images' middles look on the average: tangents along x and y.
    aim: Vector2<f64>,
}

/// The middle of an image of this size.
fn middle(size_px: [u32; 2]) -> Vector2<f64> {
    Vector2::from(size_px.map(|s| 0.5 * (f64::from(s) - 1.0)))
}

impl Axes {
    fn of(pair: &StereoPair) -> Result<Self, RectifyError> {
        let centre = |c: &Camera| *c.model.cahv()[0];
        let axis = |c: &Camera| *c.model.cahv()[1];
        let baseline = centre(&pair.right) - centre(&pair.left);
        let x = baseline
            .try_normalize(1e-9)
            .ok_or_else(|| RectifyError::Geometry("both cameras are at the same place".into()))?;
        let mean = axis(&pair.left) + axis(&pair.right);
        let z = (mean - x * x.dot(&mean))
            .try_normalize(0.2)
            .ok_or_else(|| {
                RectifyError::Geometry("the cameras look along their baseline".into())
            })?;
        let y = z.cross(&x);
        let (size, other) = (
            [pair.left.width_px, pair.left.height_px],
            [pair.right.width_px, pair.right.height_px],
        );
        if size != other {
            return Err(RectifyError::Geometry(format!(
                "the images have {} x {} and {} x {} px, expected equal sizes",
                size[0], size[1], other[0], other[1]
            )));
        }
        let middle = middle(size);
        // focal length: the scale that both images have in their middles
        let (mut focal_px, mut aim) = (0.0, [Vector2::zeros(); 2]);
        for (camera, aim) in [&pair.left, &pair.right].into_iter().zip(&mut aim) {
            let (ray, turn) = camera.ray_with_jacobian(&middle)?;
            focal_px += 0.5 * 2f64.sqrt() / turn.norm();
            let d = ray.direction.into_inner();
            if !(d.dot(&z) > 0.2) {
                return Err(RectifyError::Geometry("the cameras look apart".into()));
            }
            *aim = Vector2::new(d.dot(&x), d.dot(&y)) / d.dot(&z);
        }
        Ok(Self {
            x,
            y,
            z,
            focal_px,
            baseline_m: baseline.norm(),
            // the rows' origin is common, the columns' too but for the shift
            aim: (aim[0] + aim[1]) * 0.5,
        })
    }
}

impl Rectifier {
    /// Plans the rectification. `shift_px` moves the right image's content to the right, which
    /// lowers all disparities by as much: with the disparity of the farthest point of interest the
    /// search can start at 0.
    ///
    /// # Errors
    /// [`RectifyError::Geometry`] if the cameras look along their baseline.
    pub fn new(pair: &StereoPair, shift_px: f64) -> Result<Self, RectifyError> {
        let Axes {
            x,
            y,
            z,
            focal_px: focal,
            aim,
            ..
        } = Axes::of(pair)?;
        let size = [pair.left.width_px, pair.left.height_px];
        let middle = middle(size);
        let hc = middle.x - focal * aim.x - 0.5 * shift_px;
        let vc = middle.y - focal * aim.y;
        let virtual_camera = |camera: &Camera, shift: f64| Camera {
            model: CameraModel::Cahv(Cahv {
                c: *camera.model.cahv()[0],
                a: z,
                h: x * focal + z * (hc + shift),
                v: y * focal + z * vc,
            }),
            width_px: size[0],
            height_px: size[1],
        };
        let rectified = StereoPair {
            left: virtual_camera(&pair.left, 0.0),
            right: virtual_camera(&pair.right, shift_px),
        };
        let maps = [
            plan(&pair.left, [x, y, z], focal, [hc, vc]),
            plan(&pair.right, [x, y, z], focal, [hc + shift_px, vc]),
        ];
        Ok(Self {
            pair: rectified,
            maps,
        })
    }

    /// Disparity times depth of the rectified pair (focal length times baseline), px m: a point at
    /// depth z, m, along the common optical axis has a disparity of this over z, less the shift.
    ///
    /// # Errors
    /// As [`Rectifier::new`].
    pub fn disparity_depth_px_m(pair: &StereoPair) -> Result<f64, RectifyError> {
        let axes = Axes::of(pair)?;
        Ok(axes.focal_px * axes.baseline_m)
    }

    /// Rectifies an image; pixels that the taken image does not show are 0.
    ///
    /// # Errors
    /// [`RectifyError::Image`] for another size than the camera's.
    pub fn apply(&self, image: &Image8, side: Side) -> Result<Image8, RectifyError> {
        image.validate()?;
        let (map, camera) = match side {
            Side::Left => (&self.maps[0], &self.pair.left),
            Side::Right => (&self.maps[1], &self.pair.right),
        };
        if (image.width_px, image.height_px) != (camera.width_px, camera.height_px) {
            return Err(RectifyError::Geometry(format!(
                "the {side} image has {} x {} px, its camera {} x {} px",
                image.width_px, image.height_px, camera.width_px, camera.height_px
            )));
        }
        let width = image.width_px as usize;
        let pixels = map
            .iter()
            .map(|&[u, v]| {
                if u == NOWHERE {
                    return 0;
                }
                let (fu, fv) = (u & (ONE - 1), v & (ONE - 1));
                let at = (v >> FRACTION_BITS) as usize * width + (u >> FRACTION_BITS) as usize;
                let p = |k: usize| i32::from(image.pixels[at + k]);
                let top = p(0) * (ONE - fu) + p(1) * fu;
                let bottom = p(width) * (ONE - fu) + p(width + 1) * fu;
                let sum = top * (ONE - fv) + bottom * fv;
                ((sum + ONE * ONE / 2) >> (2 * FRACTION_BITS)) as u8
            })
            .collect();
        Ok(Image8::from_raw(image.width_px, image.height_px, pixels)?)
    }
}

impl Rectifier {
    /// Whether the taken image of a side shows a rectified pixel.
    #[must_use]
    pub fn shows(&self, side: Side, u: i64, v: i64) -> bool {
        let (map, camera) = match side {
            Side::Left => (&self.maps[0], &self.pair.left),
            Side::Right => (&self.maps[1], &self.pair.right),
        };
        let (w, h) = (i64::from(camera.width_px), i64::from(camera.height_px));
        (0..w).contains(&u) && (0..h).contains(&v) && map[(v * w + u) as usize][0] != NOWHERE
    }
}

/// Source of every rectified pixel.
fn plan(
    camera: &Camera,
    [x, y, z]: [Vector3<f64>; 3],
    focal: f64,
    [hc, vc]: [f64; 2],
) -> Vec<[i32; 2]> {
    let (w, h) = (camera.width_px, camera.height_px);
    let origin = *camera.model.cahv()[0];
    let mut map = Vec::with_capacity(w as usize * h as usize);
    let last = [f64::from(w) - 2.0, f64::from(h) - 2.0];
    for v in 0..h {
        for u in 0..w {
            let direction =
                x * ((f64::from(u) - hc) / focal) + y * ((f64::from(v) - vc) / focal) + z;
            let seen = camera.project(&(origin + direction * FAR_M)).ok();
            map.push(match seen {
                Some(p) if p.x >= 0.0 && p.y >= 0.0 && p.x <= last[0] && p.y <= last[1] => {
                    let fixed = |x: f64| (x * f64::from(ONE)).round() as i32;
                    [fixed(p.x), fixed(p.y)]
                }
                _ => [NOWHERE, NOWHERE],
            });
        }
    }
    map
}
