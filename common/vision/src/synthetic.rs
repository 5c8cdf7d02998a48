//! A small reference renderer for tests and benches: exact rays, supersampling, lens blur, noise.
//! It shares no code with the detectors.

use nalgebra::{
    Isometry3, Matrix3x2, Point3, Rotation3, Translation3, UnitQuaternion, Vector2, Vector3,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rover_cameras::{Cahvor, Camera, CameraModel, StereoPair};
pub use rover_vision::texture::texture;

/// Focal length of the test cameras, px.
pub const FOCAL_PX: f64 = 602.15;

/// A camera 45 degrees down at (0, `y`, 0) of the rover frame (x forward, y left, z up), 640 x 480,
/// mild distortion.
pub fn camera(y: f64) -> Camera {
    let s = std::f64::consts::FRAC_1_SQRT_2;
    let a = Vector3::new(s, 0.0, -s);
    let right = Vector3::new(0.0, -1.0, 0.0);
    let down = a.cross(&right);
    Camera {
        model: CameraModel::Cahvor(Cahvor {
            c: Vector3::new(0.0, y, 0.0),
            a,
            h: right * FOCAL_PX + a * 319.5,
            v: down * FOCAL_PX + a * 239.5,
            o: a,
            r: Vector3::new(0.0005, -0.05, 0.01),
        }),
        width_px: 640,
        height_px: 480,
    }
}

/// The 8 cm pair.
pub fn pair() -> StereoPair {
    StereoPair {
        left: camera(0.04),
        right: camera(-0.04),
    }
}

/// A pose whose origin lies `range_m` along the ray of `pixel`, whose z axis points back at the
/// camera, then tilted by `tilt_rad` about an image-plane axis at `azimuth_rad`, with the x axis
/// turned by `roll_rad` from "right in the image".
pub fn facing_pose(
    camera: &Camera,
    pixel: Vector2<f64>,
    range_m: f64,
    tilt_rad: f64,
    azimuth_rad: f64,
    roll_rad: f64,
) -> Isometry3<f64> {
    let ray = camera.ray(&pixel).unwrap();
    let z = -ray.direction.into_inner();
    let [_, a, h, _] = camera.model.cahv();
    let right = (h - a * a.dot(h)).normalize();
    let x = (right - z * z.dot(&right)).normalize();
    let y = z.cross(&x);
    let base = Rotation3::from_basis_unchecked(&[x, y, z]);
    let axis =
        nalgebra::Unit::new_normalize(Vector3::new(azimuth_rad.cos(), azimuth_rad.sin(), 0.0));
    let turn = base
        * Rotation3::from_axis_angle(&axis, tilt_rad)
        * Rotation3::from_axis_angle(&Vector3::z_axis(), roll_rad);
    Isometry3::from_parts(
        Translation3::from(ray.at(range_m)),
        UnitQuaternion::from_rotation_matrix(&turn),
    )
}

/// Rays of every pixel with their derivatives.
pub struct Rays {
    width: usize,
    height: usize,
    origin: Vector3<f64>,
    rays: Vec<(Vector3<f64>, Matrix3x2<f64>)>,
}

impl Rays {
    /// Of a camera whose ray origin is the same for all pixels.
    pub fn new(camera: &Camera) -> Self {
        let (w, h) = (camera.width_px as usize, camera.height_px as usize);
        let mut rays = Vec::with_capacity(w * h);
        let mut origin = Vector3::zeros();
        for v in 0..h {
            for u in 0..w {
                let (ray, slope) = camera
                    .ray_with_jacobian(&Vector2::new(u as f64, v as f64))
                    .unwrap();
                origin = ray.origin;
                rays.push((ray.direction.into_inner(), slope));
            }
        }
        Self {
            width: w,
            height: h,
            origin,
            rays,
        }
    }
}

/// A rectangle of pixels: first column, first row, columns, rows.
pub type Region = (usize, usize, usize, usize);

/// Draws `shade(origin, direction)` with `n` x `n` samples per pixel over `region` into `picture`
/// (row-major, as large as the camera's image).
pub fn draw(
    picture: &mut [f64],
    rays: &Rays,
    region: Region,
    n: usize,
    shade: &dyn Fn(&Vector3<f64>, &Vector3<f64>) -> Option<f64>,
) {
    let (u0, v0, w, h) = region;
    for v in v0..(v0 + h).min(rays.height) {
        for u in u0..(u0 + w).min(rays.width) {
            let at = v * rays.width + u;
            let (direction, slope) = &rays.rays[at];
            let mut sum = 0.0;
            for k in 0..n * n {
                let offset = |i: usize| (i as f64 + 0.5) / n as f64 - 0.5;
                let d = direction + slope * Vector2::new(offset(k % n), offset(k / n));
                sum += shade(&rays.origin, &d).unwrap_or(picture[at]);
            }
            picture[at] = sum / (n * n) as f64;
        }
    }
}

/// Where a ray meets the plane z = 0 of a pose: plane coordinates.
pub fn hit_plane(
    pose: &Isometry3<f64>,
    origin: &Vector3<f64>,
    direction: &Vector3<f64>,
) -> Option<Vector2<f64>> {
    let o = pose.inverse_transform_point(&Point3::from(*origin));
    let d = pose.inverse_transform_vector(direction);
    let t = -o.z / d.z;
    (t > 0.0).then(|| Vector2::new(o.x + t * d.x, o.y + t * d.y))
}

/// Blurs (Gaussian), adds Gaussian noise, rounds to 8 bits. Outside `region` the picture is only
/// rounded.
pub fn expose(
    picture: &[f64],
    width: usize,
    region: Region,
    blur_px: f64,
    noise_dn: f64,
    rng: &mut ChaCha8Rng,
) -> Vec<u8> {
    let height = picture.len() / width;
    let (u0, v0, w, h) = region;
    let (u1, v1) = ((u0 + w).min(width), (v0 + h).min(height));
    let radius = (4.0 * blur_px).ceil() as isize;
    let kernel: Vec<f64> = (-radius..=radius)
        .map(|k| (-0.5 * (k as f64 / blur_px).powi(2)).exp())
        .collect();
    let sum: f64 = kernel.iter().sum();
    let clamp = |x: isize, size: usize| x.clamp(0, size as isize - 1) as usize;
    let pass = |source: &[f64], across: bool| {
        let mut out = source.to_vec();
        for v in v0..v1 {
            for u in u0..u1 {
                let mut total = 0.0;
                for (k, weight) in kernel.iter().enumerate() {
                    let k = k as isize - radius;
                    let at = if across {
                        v * width + clamp(u as isize + k, width)
                    } else {
                        clamp(v as isize + k, height) * width + u
                    };
                    total += weight * source[at];
                }
                out[v * width + u] = total / sum;
            }
        }
        out
    };
    let mut blurred = pass(&pass(picture, true), false);
    for v in v0..v1 {
        for x in &mut blurred[v * width + u0..v * width + u1] {
            *x += noise_dn * normal(rng);
        }
    }
    blurred
        .iter()
        .map(|x| x.round().clamp(0.0, 255.0) as u8)
        .collect()
}

/// A standard normal number (Box-Muller).
pub fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let (a, b): (f64, f64) = (rng.random(), rng.random());
    (-2.0 * (1.0 - a).ln()).sqrt() * (2.0 * std::f64::consts::PI * b).cos()
}

/// A generator for a test case.
pub fn rng(seed: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed)
}
