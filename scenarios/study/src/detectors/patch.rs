//! Rendered patches: a flat thing before a textured ground, seen by a small pinhole camera, with
//! lens blur, uneven light and grey noise.

use nalgebra::{
    Isometry3, Matrix3, Point3, Rotation3, Translation3, Unit, UnitQuaternion, Vector2, Vector3,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rover_cameras::Camera;
use rover_vision::Image8;
use rover_vision::texture::texture;

/// Focal length of all patches, px: that of the paper's cameras.
pub const FOCAL_PX: f64 = 602.15;

/// The generator of one trial.
pub fn rng(stream: u64, trial: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(stream);
    rng.set_stream(trial);
    rng
}

/// A camera of `width` x `height` px at `position`, looking along z, x right, y down.
pub fn camera(width: u32, height: u32, position: Vector3<f64>, shift_px: f64) -> Camera {
    let middle = [
        (f64::from(width) - 1.0) / 2.0 + shift_px,
        (f64::from(height) - 1.0) / 2.0,
    ];
    let pose = Isometry3::from_parts(Translation3::from(position), UnitQuaternion::identity());
    Camera::pinhole(&pose, [FOCAL_PX; 2], middle, [width, height])
}

/// A pose within 3 px of the image's middle, at a range of 0.45 to 0.8 m, tilted by up to
/// `max_tilt_rad` about any axis, turned by up to `max_turn_rad`.
pub fn pose(rng: &mut ChaCha8Rng, max_tilt_rad: f64, max_turn_rad: f64) -> Isometry3<f64> {
    let range = rng.random_range(0.45..0.8);
    let mut offset = || rng.random_range(-3.0..3.0) / FOCAL_PX;
    let place = Vector3::new(offset(), offset(), 1.0) * range;
    let azimuth = rng.random_range(0.0..std::f64::consts::TAU);
    let axis = Unit::new_normalize(Vector3::new(azimuth.cos(), azimuth.sin(), 0.0));
    let tilt = rng.random_range(0.0..max_tilt_rad);
    let turn = rng.random_range(-max_turn_rad..=max_turn_rad);
    // x right, y up, z towards the camera
    let facing =
        Rotation3::from_matrix_unchecked(Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, -1.0)));
    let rotation = Rotation3::from_axis_angle(&axis, tilt)
        * facing
        * Rotation3::from_axis_angle(&Vector3::z_axis(), turn);
    Isometry3::from_parts(
        Translation3::from(place),
        UnitQuaternion::from_rotation_matrix(&rotation),
    )
}

/// Where the camera sees a point of the pose's plane.
pub fn seen(camera: &Camera, pose: &Isometry3<f64>, x: f64, y: f64) -> Option<Vector2<f64>> {
    let p = pose * Point3::new(x, y, 0.0);
    camera.project(&p.coords).ok()
}

/// What is varied from patch to patch.
pub struct Light {
    gain: f64,
    offset_dn: f64,
    /// Change of the gain from one side of the patch to the other, in u and in v.
    slope: [f64; 2],
    pub blur_px: f64,
}

impl Light {
    pub fn random(rng: &mut ChaCha8Rng) -> Self {
        Self {
            gain: rng.random_range(0.5..1.0),
            offset_dn: rng.random_range(0.0..25.0),
            slope: [rng.random_range(-0.2..0.2), rng.random_range(-0.2..0.2)],
            blur_px: rng.random_range(0.4..1.0),
        }
    }
}

impl Light {
    /// Grey values per grey value of the scene, in the middle of the patch.
    pub fn gain(&self) -> f64 {
        self.gain
    }
}

/// A standard normal number (Box and Muller).
pub fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let (a, b): (f64, f64) = (rng.random(), rng.random());
    (-2.0 * (1.0 - a).ln()).sqrt() * (std::f64::consts::TAU * b).cos()
}

/// Samples of a pixel and the generator of their lattice.
pub type Samples = (usize, usize);
/// For flat colours with hard edges: a Fibonacci lattice, whose lines are at most 0.07 px apart in
/// whatever direction an edge runs, so that edges are straight to 0.03 px.
pub const EDGES: Samples = (233, 144);
/// For smooth texture, whose finest wavelength is above a pixel.
pub const SMOOTH: Samples = (8, 3);

/// Rays of a camera's subpixels fall on a pose's plane; `shade` gives the grey value there, and
/// where it gives none `ground` does, by pixel.
pub fn draw(
    camera: &Camera,
    pose: &Isometry3<f64>,
    shade: &dyn Fn(f64, f64) -> Option<f64>,
    ground: &dyn Fn(f64, f64) -> f64,
    samples: Samples,
) -> Vec<f64> {
    // a lattice whose samples have different places in u and in v: an edge along the pixels is met
    // as finely as any other; pixels whose rim and middle are alike need no more
    const FEW: [(f64, f64); 5] = [
        (0.0, 0.0),
        (-0.5, -0.5),
        (0.5, -0.5),
        (-0.5, 0.5),
        (0.5, 0.5),
    ];
    let lattice = |n: usize, k: usize| {
        let part = |k: usize| (k as f64 + 0.5) / n as f64 - 0.5;
        (part(k), part(samples.1 * k % n))
    };
    let (w, h) = (camera.width_px as usize, camera.height_px as usize);
    let intrinsics = camera.intrinsics();
    let [cu, cv] = [intrinsics.hc, intrinsics.vc];
    let origin = pose.inverse_transform_point(&Point3::from(*camera.model.cahv()[0]));
    let turn = pose.rotation.inverse();
    let (across, down, ahead) = (
        turn * Vector3::x(),
        turn * Vector3::y(),
        turn * Vector3::z(),
    );
    let at = |u: f64, v: f64| {
        let d = across * ((u - cu) / FOCAL_PX) + down * ((v - cv) / FOCAL_PX) + ahead;
        let t = -origin.z / d.z;
        (t > 0.0)
            .then(|| shade(origin.x + t * d.x, origin.y + t * d.y))
            .flatten()
    };
    let mut picture = Vec::with_capacity(w * h);
    for v in 0..h {
        for u in 0..w {
            let (u, v) = (u as f64, v as f64);
            let mut outside = None;
            let mut seen = |(x, y): (f64, f64)| {
                at(u + x, v + y).unwrap_or_else(|| *outside.get_or_insert_with(|| ground(u, v)))
            };
            if samples.0 > 8 {
                let first = seen(FEW[0]);
                if FEW[1..].iter().all(|&place| seen(place) == first) {
                    picture.push(first);
                    continue;
                }
            }
            let sum: f64 = (0..samples.0).map(|k| seen(lattice(samples.0, k))).sum();
            picture.push(sum / samples.0 as f64);
        }
    }
    picture
}

/// Lens, light and sensor: blur, gain and its slope, noise, 8 bits.
pub fn expose(
    picture: &[f64],
    width: u32,
    light: &Light,
    noise_dn: f64,
    rng: &mut ChaCha8Rng,
) -> Option<Image8> {
    let w = width as usize;
    let h = picture.len() / w;
    let radius = (3.5 * light.blur_px).ceil() as isize;
    let kernel: Vec<f64> = (-radius..=radius)
        .map(|k| (-0.5 * (k as f64 / light.blur_px).powi(2)).exp())
        .collect();
    let sum: f64 = kernel.iter().sum();
    let clamp = |x: isize, size: usize| x.clamp(0, size as isize - 1) as usize;
    let pass = |source: &[f64], across: bool| -> Vec<f64> {
        (0..w * h)
            .map(|i| {
                let (u, v) = ((i % w) as isize, (i / w) as isize);
                let taps = kernel.iter().zip(-radius..);
                let total: f64 = taps
                    .map(|(weight, k)| {
                        let at = if across {
                            v as usize * w + clamp(u + k, w)
                        } else {
                            clamp(v + k, h) * w + u as usize
                        };
                        weight * source[at]
                    })
                    .sum();
                total / sum
            })
            .collect()
    };
    let blurred = pass(&pass(picture, true), false);
    let pixels = blurred
        .iter()
        .enumerate()
        .map(|(i, x)| {
            let (u, v) = (
                (i % w) as f64 / w as f64 - 0.5,
                (i / w) as f64 / h as f64 - 0.5,
            );
            let gain = light.gain * (1.0 + light.slope[0] * u + light.slope[1] * v);
            let grey = gain * x + light.offset_dn + noise_dn * normal(rng);
            grey.round().clamp(0.0, 255.0) as u8
        })
        .collect();
    Image8::from_raw(width, h as u32, pixels).ok()
}

/// A textured patch without any fiducial; three in ten are of hard black and white patches.
pub fn blank(width: u32, height: u32, noise_dn: f64, rng: &mut ChaCha8Rng) -> Option<Image8> {
    let contrast = rng.random_range(3.0..60.0);
    let finest = rng.random_range(1.0..16.0);
    let coarsest = rng.random_range(16.0..80.0);
    let hard = rng.random_bool(0.3);
    let seed: u64 = rng.random();
    let picture: Vec<f64> = (0..width * height)
        .map(|i| {
            let (u, v) = (f64::from(i % width), f64::from(i / width));
            let x = texture(u, v, coarsest, finest, contrast, seed >> 1);
            if hard {
                110.0 + (x - 110.0).clamp(-1.0, 1.0) * 80.0
            } else {
                x
            }
        })
        .collect();
    let light = Light::random(rng);
    expose(&picture, width, &light, noise_dn, rng)
}
