//! Terrain, rock and cameras of the rendered approaches.

use nalgebra::{Isometry3, Translation3, Unit, Vector2, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rover_approach::view::View;
use rover_cameras::{Cahv, Camera, CameraModel, StereoPair};
use rover_render::{
    FrameState, Grey8, Hit, ImagingParameters, Mesh, Renderer, Scene, Sky, StaticMesh, Sun,
    Surface, shapes,
};
use rover_vision::{Image8, PreparedImage};

pub type AnyError = Box<dyn std::error::Error>;

/// Focal lengths, px.
const MAST_FOCAL_PX: f64 = 1290.0;
const BODY_FOCAL_PX: f64 = 602.0;
/// Size of the rendered part of the mast images, px.
const MAST_CROP: [u32; 2] = [440, 260];
/// Size of the whole mast images, px.
const MAST_SIZE: [u32; 2] = [1024, 768];
const MAST_BASELINE_M: f64 = 0.20;
const MAST_HEIGHT_M: f64 = 1.2;

/// Height of the ground without pebbles, m.
fn height(x: f64, y: f64, seed: u64) -> f64 {
    let coarse = shapes::noise(&Vector3::new(x / 1.5, y / 1.5, 0.5), seed);
    let fine = shapes::fractal_noise(&Vector3::new(x / 0.3, y / 0.3, 0.0), seed + 1, 5, 0.55);
    0.03 * coarse + 0.007 * fine
}

/// Grid lines: 8 mm apart within `fine` of the centre, then ever wider.
fn lines(centre: f64, fine: f64, reach: f64) -> Vec<f64> {
    let mut half = vec![0.0];
    let (mut at, mut step) = (0.0, 0.008);
    while at < reach {
        if at > fine {
            step *= 1.12;
        }
        at += step;
        half.push(at);
    }
    let back = half.iter().skip(1).rev().map(|x| centre - x);
    back.chain(half.iter().map(|x| centre + x)).collect()
}

/// A scene with its target.
pub struct Stage {
    pub renderer: Renderer,
    pub target: Vector3<f64>,
    frames: u64,
}

/// What is designated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    Rock,
    Ground,
}

impl Stage {
    /// A scene with a target at `range_m` from the origin, visible from the mast there.
    pub fn new(
        kind: Kind,
        range_m: f64,
        seed: u64,
        rng: &mut ChaCha8Rng,
    ) -> Result<Self, AnyError> {
        let ground = shapes::heightfield_mesh(
            &lines(range_m, 0.9, 14.0),
            &lines(0.0, 0.7, 12.0),
            |x, y| height(x, y, seed),
        );
        let mut statics = vec![StaticMesh {
            mesh: ground,
            surface: Surface::ground(seed as u32),
        }];
        let mut stones = Mesh::default();
        for k in 0..110 {
            let radius = 0.004 + 0.021 * rng.random::<f64>().powi(3);
            let (x, y) = (
                range_m + rng.random_range(-1.2..1.0),
                rng.random_range(-0.9..0.9),
            );
            let lift = Translation3::new(x, y, height(x, y, seed) + 0.2 * radius);
            stones.append(&shapes::rock(seed * 977 + k, radius, 2, 0.3).transformed(&lift.into()));
        }
        statics.push(StaticMesh {
            mesh: stones,
            surface: Surface::rock(seed as u32 + 1),
        });
        if kind == Kind::Rock {
            let radius = rng.random_range(0.16..0.30);
            let lift = Translation3::new(range_m, 0.0, height(range_m, 0.0, seed) + 0.3 * radius);
            statics.push(StaticMesh {
                mesh: shapes::rock(seed * 31 + 7, radius, 6, 0.28).transformed(&lift.into()),
                surface: Surface::rock(seed as u32 + 2),
            });
        }
        let azimuth: f64 = rng.random_range(0.6..2.5);
        let elevation: f64 = rng.random_range(0.6..1.0);
        let sun = Sun {
            direction_to_sun: Unit::new_normalize(Vector3::new(
                azimuth.cos() * elevation.cos(),
                azimuth.sin() * elevation.cos(),
                elevation.sin(),
            )),
            intensity: 1.0,
            ambient: 0.16,
        };
        let scene = Scene::new(statics, Vec::new(), Vec::new(), sun, Sky::default())?;
        let renderer = Renderer::new(scene);
        let eye = Vector3::new(0.0, 0.0, MAST_HEIGHT_M);
        for _ in 0..4000 {
            let aim = match kind {
                Kind::Rock => Vector3::new(
                    range_m,
                    rng.random_range(-0.25..0.25),
                    rng.random_range(0.0..0.3),
                ),
                Kind::Ground => Vector3::new(
                    range_m + rng.random_range(-0.3..0.3),
                    rng.random_range(-0.3..0.3),
                    0.0,
                ),
            };
            let Some(hit) = renderer.cast(&eye, &(aim - eye), None) else {
                continue;
            };
            let sight = (eye - hit.point).normalize();
            let wanted = match kind {
                Kind::Rock => hit.mesh_index == 2 && hit.smooth_normal.dot(&sight) > 0.5,
                Kind::Ground => hit.mesh_index == 0,
            };
            if wanted {
                return Ok(Self {
                    renderer,
                    target: hit.point,
                    frames: seed * 1000,
                });
            }
        }
        Err("no visible target in this scene".into())
    }

    /// What a pixel of a camera (world frame) sees.
    pub fn cast(&self, camera: &Camera, pixel: &Vector2<f64>) -> Option<Hit> {
        let ray = camera.ray(pixel).ok()?;
        self.renderer.cast(&ray.origin, &ray.direction, None)
    }

    /// Takes a stereo pair: drawn with `truth` (world frame), delivered with `believed`.
    pub fn take(&mut self, truth: &StereoPair, believed: &StereoPair) -> Result<View, AnyError> {
        let imaging = ImagingParameters::default();
        let left = self.renderer.add_camera(&truth.left, imaging)?;
        let right = self.renderer.add_camera(&truth.right, imaging)?;
        let state = FrameState {
            part_poses: Vec::new(),
            pattern_visible: false,
        };
        self.frames += 1;
        let (a, b) = self
            .renderer
            .render_pair(left, right, &state, self.frames)?;
        Ok(View::new(prepared(a)?, prepared(b)?, believed.clone())?)
    }
}

fn prepared(image: Grey8) -> Result<PreparedImage, AnyError> {
    let image = Image8 {
        width_px: image.width as u32,
        height_px: image.height as u32,
        pixels: image.pixels,
    };
    Ok(PreparedImage::new(&image)?)
}

fn camera(
    c: Vector3<f64>,
    axis: Vector3<f64>,
    focal_px: f64,
    centre_px: [f64; 2],
    size: [u32; 2],
) -> Camera {
    let right = axis.cross(&Vector3::z()).normalize();
    let down = axis.cross(&right);
    let model = CameraModel::Cahv(Cahv {
        c,
        a: axis,
        h: right * focal_px + axis * centre_px[0],
        v: down * focal_px + axis * centre_px[1],
    });
    Camera {
        model,
        width_px: size[0],
        height_px: size[1],
    }
}

/// The mast pair aimed at a point of the rover frame: the whole images or the part about it.
pub fn mast_pair(aim: &Vector3<f64>, whole: bool) -> StereoPair {
    let size = if whole { MAST_SIZE } else { MAST_CROP };
    let centre = Vector3::new(0.0, 0.0, MAST_HEIGHT_M);
    let axis = (aim - centre).normalize();
    let right = axis.cross(&Vector3::z()).normalize() * (0.5 * MAST_BASELINE_M);
    let [u0, v0] = size.map(|n| (f64::from(n) - 1.0) / 2.0);
    let shift = (MAST_FOCAL_PX * 0.5 * MAST_BASELINE_M / (aim - centre).norm()).round();
    let at = |c, u| camera(c, axis, MAST_FOCAL_PX, [u, v0], size);
    StereoPair {
        left: at(centre - right, u0 - shift),
        right: at(centre + right, u0 + shift),
    }
}

/// The body pair, rover frame.
pub fn body_pair() -> StereoPair {
    let down = std::f64::consts::FRAC_1_SQRT_2;
    let axis = Vector3::new(down, 0.0, -down);
    let at = |y| {
        let c = Vector3::new(0.10, y, 0.6);
        camera(c, axis, BODY_FOCAL_PX, [319.5, 239.5], [640, 480])
    };
    StereoPair {
        left: at(0.04),
        right: at(-0.04),
    }
}

/// A small rotation about the mast's head.
pub fn pointing_error(rotation: Vector3<f64>) -> Isometry3<f64> {
    let centre = Vector3::new(0.0, 0.0, MAST_HEIGHT_M);
    let turn = nalgebra::UnitQuaternion::from_scaled_axis(rotation);
    Isometry3::from_parts((centre - turn * centre).into(), turn)
}
