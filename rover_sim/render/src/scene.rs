//! What is to be drawn: meshes that stand still, parts that move, marked plates, sun and sky.

use crate::error::SceneError;
use nalgebra::{Isometry3, Unit, Vector3};
use std::sync::Arc;

/// A triangle mesh. Triangles are counter-clockwise seen from outside; only their outside is
/// drawn and only their outside casts shadows, so a body should be closed (a terrain need not).
#[derive(Clone, Debug, Default)]
pub struct Mesh {
    /// Vertex positions, metres, in the frame of whatever carries the mesh.
    pub positions: Vec<Vector3<f64>>,
    /// Smooth outward unit normals, one per vertex.
    pub normals: Vec<Vector3<f64>>,
    /// Vertex indices of each triangle.
    pub triangles: Vec<[u32; 3]>,
}

/// A random pattern defined in space (value noise summed over octaves). It varies the albedo and,
/// through `relief`, the direction of the surface, in every octave that a pixel can resolve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Texture {
    /// Longest wavelength, metres.
    pub coarsest_wavelength_m: f64,
    /// Octaves (each half the wavelength of the one before) go on down to this wavelength, metres.
    pub finest_wavelength_m: f64,
    /// Relative variation of albedo by the coarsest octave (0.35: about +-20 % in a 15-pixel
    /// window over all octaves that it holds).
    pub amplitude: f64,
    /// Amplitude of each octave over that of the next coarser one; 1.0 gives stereo matching
    /// something to hold at every distance.
    pub octave_gain: f64,
    /// Slope of the fine relief per octave, which tilts the shaded normal (not the geometry).
    pub relief: f64,
    /// Squeezes the pattern along the mesh's axes (values above 1 make it finer there).
    pub squeeze: [f64; 3],
    /// Which pattern of all those alike.
    pub seed: u32,
}

/// How a surface reflects.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Surface {
    /// Soil: diffuse.
    Ground {
        /// Mean fraction of light reflected.
        albedo: f64,
        /// Its pattern.
        texture: Texture,
    },
    /// Stone: diffuse, with stronger relief.
    Rock {
        /// Mean fraction of light reflected.
        albedo: f64,
        /// Its pattern.
        texture: Texture,
    },
    /// Bare metal: a diffuse part and a highlight.
    Metal {
        /// Mean fraction of light reflected diffusely.
        albedo: f64,
        /// Strength of the highlight (1: as bright at its centre as a white diffuse surface
        /// facing the sun).
        specular: f64,
        /// Blinn-Phong exponent.
        shininess: u32,
        /// Its pattern.
        texture: Texture,
    },
    /// Paint: diffuse, nearly even.
    Paint {
        /// Mean fraction of light reflected.
        albedo: f64,
        /// Its pattern.
        texture: Texture,
    },
}

impl Texture {
    /// No pattern at all.
    pub const PLAIN: Self = Self {
        coarsest_wavelength_m: 1.0,
        finest_wavelength_m: 1.0,
        amplitude: 0.0,
        octave_gain: 1.0,
        relief: 0.0,
        squeeze: [1.0; 3],
        seed: 0,
    };
}

impl Surface {
    /// Soil with detail from 0.25 m down to 1.5 mm.
    pub fn ground(seed: u32) -> Self {
        let texture = Texture {
            coarsest_wavelength_m: 0.25,
            finest_wavelength_m: 0.0015,
            amplitude: 0.22,
            octave_gain: 1.0,
            relief: 0.17,
            squeeze: [1.0; 3],
            seed,
        };
        Self::Ground {
            albedo: 0.30,
            texture,
        }
    }

    /// Stone with detail from 0.12 m down to 1.5 mm.
    pub fn rock(seed: u32) -> Self {
        let texture = Texture {
            coarsest_wavelength_m: 0.12,
            finest_wavelength_m: 0.0015,
            amplitude: 0.24,
            octave_gain: 1.0,
            relief: 0.2,
            squeeze: [1.0, 1.0, 1.6],
            seed,
        };
        Self::Rock {
            albedo: 0.34,
            texture,
        }
    }

    /// Machined metal with a soft highlight.
    pub fn metal(seed: u32) -> Self {
        let texture = Texture {
            coarsest_wavelength_m: 0.06,
            finest_wavelength_m: 0.0015,
            amplitude: 0.05,
            octave_gain: 0.9,
            relief: 0.01,
            squeeze: [1.0; 3],
            seed,
        };
        Self::Metal {
            albedo: 0.30,
            specular: 0.55,
            shininess: 40,
            texture,
        }
    }

    /// Light paint.
    pub fn paint(albedo: f64, seed: u32) -> Self {
        let texture = Texture {
            coarsest_wavelength_m: 0.08,
            finest_wavelength_m: 0.002,
            amplitude: 0.03,
            octave_gain: 0.9,
            relief: 0.0,
            squeeze: [1.0; 3],
            seed,
        };
        Self::Paint { albedo, texture }
    }

    /// The diffuse albedo and the texture.
    pub(crate) fn diffuse(&self) -> (f64, &Texture) {
        match self {
            Self::Ground { albedo, texture }
            | Self::Rock { albedo, texture }
            | Self::Metal {
                albedo, texture, ..
            }
            | Self::Paint { albedo, texture } => (*albedo, texture),
        }
    }

    /// Strength and exponent of the highlight.
    pub(crate) fn highlight(&self) -> (f64, u32) {
        match self {
            Self::Metal {
                specular,
                shininess,
                ..
            } => (*specular, *shininess),
            _ => (0.0, 1),
        }
    }
}

/// A mesh that stands still, in the world frame.
#[derive(Clone, Debug)]
pub struct StaticMesh {
    /// The shape, world frame.
    pub mesh: Mesh,
    /// How it reflects.
    pub surface: Surface,
}

/// A rigid body that moves: its mesh is in its own frame, its pose comes with every frame.
#[derive(Clone, Debug)]
pub struct DynamicPart {
    /// The shape, part frame.
    pub mesh: Mesh,
    /// How it reflects.
    pub surface: Surface,
}

/// What is printed on a plate: albedo at `(x_m, y_m)` of the plate frame, `None` where the pattern
/// says nothing (the plate's blank albedo holds there).
pub type Pattern = Arc<dyn Fn(f64, f64) -> Option<f64> + Send + Sync>;

/// A thin rectangle fixed to a part, with a pattern on its face (the side of `+z` of the plate
/// frame, centred on the origin). It casts and receives shadow and is seen from both sides.
///
/// The pattern is drawn by 8x8 samples per pixel through the exact plane. Where it is even it is
/// taken from a table of 128x128 cells sampled 6x6 each, so it should have no feature smaller than
/// 1/768 of the plate.
#[derive(Clone)]
pub struct Plate {
    /// Index of the part that carries the plate.
    pub part: usize,
    /// Pose of the plate in the part's frame.
    pub part_from_plate: Isometry3<f64>,
    /// Half of the extent along x, metres.
    pub half_width_m: f64,
    /// Half of the extent along y, metres.
    pub half_height_m: f64,
    /// The pattern on the face.
    pub albedo: Pattern,
    /// Albedo of the face when the pattern is not visible.
    pub blank_albedo: f64,
    /// Albedo of the other side.
    pub back_albedo: f64,
}

impl std::fmt::Debug for Plate {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Plate")
            .field("part", &self.part)
            .field("part_from_plate", &self.part_from_plate)
            .field("half_width_m", &self.half_width_m)
            .field("half_height_m", &self.half_height_m)
            .finish_non_exhaustive()
    }
}

/// The sun, and the light that comes from everywhere else.
#[derive(Clone, Copy, Debug)]
pub struct Sun {
    /// Towards the sun, world frame.
    pub direction_to_sun: Unit<Vector3<f64>>,
    /// Radiance of a white diffuse surface that faces the sun, without sky light.
    pub intensity: f64,
    /// Radiance of a white diffuse surface that faces the sky and does not see the sun.
    pub ambient: f64,
}

/// Radiance of the sky, graded by elevation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sky {
    /// At the horizon and below.
    pub horizon: f64,
    /// Overhead.
    pub zenith: f64,
}

impl Default for Sky {
    fn default() -> Self {
        Self {
            horizon: 0.42,
            zenith: 0.22,
        }
    }
}

/// A scene that has been checked. Indices of meshes, used by [`Hit`](crate::Hit) and
/// `remove_static`: static meshes in the order given, then parts, then plates.
#[derive(Clone, Debug)]
pub struct Scene {
    pub(crate) statics: Vec<StaticMesh>,
    pub(crate) parts: Vec<DynamicPart>,
    pub(crate) plates: Vec<Plate>,
    pub(crate) sun: Sun,
    pub(crate) sky: Sky,
}

impl Scene {
    /// Puts a scene together.
    ///
    /// # Errors
    /// [`SceneError`] names the first thing that cannot be drawn: an index out of range, a
    /// position that is not finite, a normal that is not of unit length (1e-3), an albedo outside
    /// 0..=1, a plate on a part that does not exist, an impossible wavelength.
    pub fn new(
        statics: Vec<StaticMesh>,
        parts: Vec<DynamicPart>,
        plates: Vec<Plate>,
        sun: Sun,
        sky: Sky,
    ) -> Result<Self, SceneError> {
        for (index, s) in statics.iter().enumerate() {
            check_mesh(&format!("static mesh {index}"), &s.mesh, &s.surface)?;
        }
        for (index, p) in parts.iter().enumerate() {
            check_mesh(&format!("part {index}"), &p.mesh, &p.surface)?;
        }
        for (index, p) in plates.iter().enumerate() {
            check_plate(&format!("plate {index}"), p, parts.len())?;
        }
        let count = statics.len() + parts.len() + plates.len();
        if count > usize::from(u16::MAX) {
            return Err(SceneError::TooMany {
                count,
                most: usize::from(u16::MAX),
            });
        }
        for (name, value) in [
            ("sun intensity", sun.intensity),
            ("ambient light", sun.ambient),
            ("sky at the horizon", sky.horizon),
            ("sky at the zenith", sky.zenith),
        ] {
            in_range(name, "radiance", value, 0.0, 1e6)?;
        }
        in_range(
            "sun",
            "length of its direction",
            sun.direction_to_sun.norm(),
            0.999,
            1.001,
        )?;
        Ok(Self {
            statics,
            parts,
            plates,
            sun,
            sky,
        })
    }

    /// How many parts a frame's state must place.
    pub fn part_count(&self) -> usize {
        self.parts.len()
    }

    /// How many static meshes there were at first.
    pub fn static_count(&self) -> usize {
        self.statics.len()
    }
}

fn in_range(
    body: &str,
    what: &'static str,
    value: f64,
    low: f64,
    high: f64,
) -> Result<(), SceneError> {
    if value >= low && value <= high {
        return Ok(());
    }
    Err(SceneError::OutOfRange {
        body: body.to_owned(),
        what,
        value,
        low,
        high,
    })
}

fn check_mesh(body: &str, mesh: &Mesh, surface: &Surface) -> Result<(), SceneError> {
    let vertices = mesh.positions.len();
    if mesh.normals.len() != vertices {
        let normals = mesh.normals.len();
        return Err(SceneError::NormalCount {
            body: body.to_owned(),
            normals,
            vertices,
        });
    }
    for (triangle, corners) in mesh.triangles.iter().enumerate() {
        if let Some(&index) = corners.iter().find(|&&i| i as usize >= vertices) {
            return Err(SceneError::Index {
                body: body.to_owned(),
                triangle,
                index,
                vertices,
            });
        }
    }
    for (vertex, (p, n)) in mesh.positions.iter().zip(&mesh.normals).enumerate() {
        if !p.iter().all(|x| x.abs() < 1e6) {
            return Err(SceneError::Position {
                body: body.to_owned(),
                vertex,
            });
        }
        let is_unit = (n.norm() - 1.0).abs() < 1e-3;
        if !is_unit {
            return Err(SceneError::Normal {
                body: body.to_owned(),
                vertex,
                norm: n.norm(),
            });
        }
    }
    let (albedo, texture) = surface.diffuse();
    in_range(body, "albedo", albedo, 0.0, 1.0)?;
    in_range(body, "texture amplitude", texture.amplitude, 0.0, 2.0)?;
    in_range(body, "texture octave gain", texture.octave_gain, 0.0, 4.0)?;
    in_range(body, "texture relief", texture.relief, 0.0, 2.0)?;
    in_range(
        body,
        "finest wavelength, m",
        texture.finest_wavelength_m,
        1e-5,
        1e4,
    )?;
    let finest = texture.finest_wavelength_m;
    in_range(
        body,
        "coarsest wavelength, m",
        texture.coarsest_wavelength_m,
        finest,
        1e4,
    )?;
    for squeeze in texture.squeeze {
        in_range(body, "texture squeeze", squeeze, 1e-3, 1e3)?;
    }
    let (specular, shininess) = surface.highlight();
    in_range(body, "specular strength", specular, 0.0, 1e3)?;
    in_range(body, "shininess", f64::from(shininess), 1.0, 1e6)
}

fn check_plate(body: &str, plate: &Plate, parts: usize) -> Result<(), SceneError> {
    if plate.part >= parts {
        return Err(SceneError::NoSuchPart {
            body: body.to_owned(),
            part: plate.part,
            parts,
        });
    }
    in_range(body, "half width, m", plate.half_width_m, 1e-4, 1e3)?;
    in_range(body, "half height, m", plate.half_height_m, 1e-4, 1e3)?;
    in_range(body, "blank albedo", plate.blank_albedo, 0.0, 1.0)?;
    in_range(body, "back albedo", plate.back_albedo, 0.0, 1.0)?;
    let pose = &plate.part_from_plate;
    let size = pose.translation.vector.norm() + (pose.rotation.norm() - 1.0).abs() * 1e9;
    in_range(body, "pose on its part (distance, m)", size, 0.0, 1e3)
}

/// What changes from frame to frame.
#[derive(Clone, Debug)]
pub struct FrameState {
    /// `world_from_part`, one pose per part.
    pub part_poses: Vec<Isometry3<f64>>,
    /// Whether the plates show their patterns (else their faces are blank).
    pub pattern_visible: bool,
}
