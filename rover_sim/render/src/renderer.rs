//! The renderer: a scene, and the cameras that look at it.

use crate::cast::{Caster, Hit};
use crate::error::RenderError;
use crate::frame::{Frame, Tile};
use crate::geometry::{Geometry, plate_mesh};
use crate::optics::Optics;
use crate::plate::{PlateFace, PlateFrame};
use crate::scene::{FrameState, Scene, Sun};
use crate::sensor::{Grey8, ImagingParameters, expose, mix};
use crate::shading::{BodyFrame, Material};
use crate::shadow::SunTree;
use crate::simd::Level;
use crate::view::View;
use nalgebra::{Isometry3, Rotation3, Translation3, UnitQuaternion, Vector3};
use rover_cameras::Camera;

/// A camera of a [`Renderer`], in the order of their addition.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct CameraId(pub usize);

/// One camera and what is kept for it.
struct Eye {
    optics: Optics,
    parameters: ImagingParameters,
    world_from_camera: Isometry3<f64>,
    /// The static scene, and whether it is as seen from here.
    still: View,
    still_seen: bool,
    moving: View,
    tiles: Vec<Tile>,
}

/// What all cameras share.
struct Stage {
    scene: Scene,
    level: Level,
    /// Static meshes, world frame.
    still: Geometry,
    /// Parts, then plates, each in its own frame.
    moving: Geometry,
    materials: Vec<Material>,
    plates: Vec<PlateFace>,
    present: Vec<bool>,
    sun_from_world: Isometry3<f64>,
    still_tree: SunTree,
    caster: Caster,
}

/// What one state of the parts means for every camera.
struct Moment<'a> {
    state: &'a FrameState,
    world_from_moving: Vec<Isometry3<f64>>,
    tree: SunTree,
}

/// Draws a scene through exact camera models. See the crate's text for what is drawn.
///
/// Results depend on the scene, the cameras, the state and the seed alone: not on the number of
/// threads, on what was drawn before, or on the instructions that the machine has.
pub struct Renderer {
    stage: Stage,
    eyes: Vec<Eye>,
}

impl Renderer {
    /// Prepares a scene for drawing (tables for shadows, ray casts and patterns).
    pub fn new(scene: Scene) -> Self {
        let mut still = Geometry::default();
        let mut moving = Geometry::default();
        for s in &scene.statics {
            still.push(&s.mesh, false);
        }
        for p in &scene.parts {
            moving.push(&p.mesh, false);
        }
        for p in &scene.plates {
            moving.push(&plate_mesh(p), true);
        }
        let surfaces = scene
            .statics
            .iter()
            .map(|s| &s.surface)
            .chain(scene.parts.iter().map(|p| &p.surface));
        let present = vec![true; scene.statics.len()];
        let mut stage = Stage {
            level: Level::detect(),
            materials: surfaces.map(Material::new).collect(),
            plates: scene.plates.iter().map(PlateFace::new).collect(),
            sun_from_world: Isometry3::identity(),
            still_tree: SunTree::default(),
            caster: Caster::new(&still, &moving),
            scene,
            still,
            moving,
            present,
        };
        stage.light_up();
        Self {
            stage,
            eyes: Vec::new(),
        }
    }

    /// Adds a camera whose model's vectors are in the world frame (or in a frame that
    /// [`Self::set_camera_pose`] places).
    ///
    /// # Errors
    /// [`RenderError`] if the image size or a parameter is out of range, or the model has no ray
    /// for some pixel, no single centre of projection, or a field of view over 160 deg.
    pub fn add_camera(
        &mut self,
        camera: &Camera,
        parameters: ImagingParameters,
    ) -> Result<CameraId, RenderError> {
        parameters.check()?;
        let (width, height) = (camera.width_px as usize, camera.height_px as usize);
        let optics = Optics::new(width, height, |u, v| {
            let ray = camera
                .ray(&nalgebra::Vector2::new(u, v))
                .map_err(|e| e.to_string())?;
            Ok((ray.origin, ray.direction))
        })?;
        self.eyes.push(Eye {
            optics,
            parameters,
            world_from_camera: Isometry3::identity(),
            still: View::default(),
            still_seen: false,
            moving: View::default(),
            tiles: Vec::new(),
        });
        Ok(CameraId(self.eyes.len() - 1))
    }

    /// Moves a camera: `world_from_camera` takes the frame that the model's vectors are given in
    /// to the world. A new camera is at the identity. A pose equal to the last one costs nothing,
    /// another one empties the camera's cache.
    ///
    /// # Errors
    /// [`RenderError::NoSuchCamera`], [`RenderError::Pose`].
    pub fn set_camera_pose(
        &mut self,
        id: CameraId,
        world_from_camera: &Isometry3<f64>,
    ) -> Result<(), RenderError> {
        check_pose(world_from_camera, || format!("camera {}", id.0))?;
        let eye = self.eye(id)?;
        if eye.world_from_camera != *world_from_camera {
            eye.world_from_camera = *world_from_camera;
            eye.forget();
        }
        Ok(())
    }

    /// Changes how a camera turns radiance into grey levels; keeps its cache.
    ///
    /// # Errors
    /// [`RenderError::NoSuchCamera`], [`RenderError::Imaging`].
    pub fn set_imaging(
        &mut self,
        id: CameraId,
        parameters: ImagingParameters,
    ) -> Result<(), RenderError> {
        parameters.check()?;
        self.eye(id)?.parameters = parameters;
        Ok(())
    }

    /// Takes one image. `noise_seed` decides the noise.
    ///
    /// # Errors
    /// [`RenderError::NoSuchCamera`], [`RenderError::PoseCount`], [`RenderError::Pose`].
    pub fn render(
        &mut self,
        id: CameraId,
        state: &FrameState,
        noise_seed: u64,
    ) -> Result<Grey8, RenderError> {
        let moment = self.stage.moment(state)?;
        let Self { stage, eyes } = self;
        let cameras = eyes.len();
        let eye = eyes.get_mut(id.0).ok_or(RenderError::NoSuchCamera {
            index: id.0,
            cameras,
        })?;
        Ok(stage.image(&moment, eye, noise_seed))
    }

    /// Takes two images of the same moment, side by side in time. The noise of each comes from
    /// `noise_seed` and the side, so a pair differs from two calls of [`Self::render`].
    ///
    /// # Errors
    /// As [`Self::render`], and [`RenderError::SameCamera`].
    pub fn render_pair(
        &mut self,
        left: CameraId,
        right: CameraId,
        state: &FrameState,
        noise_seed: u64,
    ) -> Result<(Grey8, Grey8), RenderError> {
        let moment = self.stage.moment(state)?;
        let Self { stage, eyes } = self;
        let cameras = eyes.len();
        for id in [left, right] {
            if id.0 >= cameras {
                return Err(RenderError::NoSuchCamera {
                    index: id.0,
                    cameras,
                });
            }
        }
        let Ok([l, r]) = eyes.get_disjoint_mut([left.0, right.0]) else {
            return Err(RenderError::SameCamera { index: left.0 });
        };
        let seeds = [mix(noise_seed), mix(mix(noise_seed) ^ 1)];
        Ok(rayon::join(
            || stage.image(&moment, l, seeds[0]),
            || stage.image(&moment, r, seeds[1]),
        ))
    }

    /// Takes a static mesh away (a scene change); the other meshes keep their indices. Empties all
    /// caches.
    ///
    /// # Errors
    /// [`RenderError::NoSuchStatic`] if there is none of this index (any more).
    pub fn remove_static(&mut self, mesh_index: usize) -> Result<(), RenderError> {
        let statics = self.stage.present.len();
        match self.stage.present.get_mut(mesh_index) {
            Some(present) if *present => *present = false,
            _ => {
                return Err(RenderError::NoSuchStatic {
                    index: mesh_index,
                    statics,
                });
            }
        }
        self.stage.light_up();
        self.eyes.iter_mut().for_each(Eye::forget);
        Ok(())
    }

    /// Moves or changes the sun. Empties all caches.
    ///
    /// # Errors
    /// [`RenderError::Imaging`] if a strength is negative or not finite.
    pub fn set_sun(&mut self, sun: Sun) -> Result<(), RenderError> {
        for (what, value) in [
            ("sun intensity", sun.intensity),
            ("ambient light", sun.ambient),
        ] {
            if !(0.0..=1e6).contains(&value) {
                return Err(RenderError::Imaging {
                    what,
                    value,
                    low: 0.0,
                    high: 1e6,
                });
            }
        }
        self.stage.scene.sun = sun;
        self.stage.light_up();
        self.eyes.iter_mut().for_each(Eye::forget);
        Ok(())
    }

    /// The first surface on a ray, exact in double precision: against the static meshes, and, with
    /// a state, against parts and plates as well. `None` if there is none, if the direction is
    /// zero or not finite, or if the state does not fit the scene.
    pub fn cast(
        &self,
        origin: &Vector3<f64>,
        direction: &Vector3<f64>,
        state: Option<&FrameState>,
    ) -> Option<Hit> {
        let moving = match state {
            Some(s) => self.stage.world_from_moving(s).ok()?,
            None => Vec::new(),
        };
        self.stage
            .caster
            .cast(origin, direction, &self.stage.present, &moving)
    }

    /// Forgets what is kept of a camera's last images, so that the next one is drawn in full. No
    /// image changes by this; it is for measuring.
    ///
    /// # Errors
    /// [`RenderError::NoSuchCamera`].
    pub fn clear_cache(&mut self, id: CameraId) -> Result<(), RenderError> {
        self.eye(id)?.forget();
        Ok(())
    }

    /// Runs without special instructions from now on. No image changes by this; it is for
    /// comparing.
    pub fn use_portable_kernels(&mut self) {
        self.stage.level = Level::Portable;
    }

    /// The scene as given.
    pub fn scene(&self) -> &Scene {
        &self.stage.scene
    }

    fn eye(&mut self, id: CameraId) -> Result<&mut Eye, RenderError> {
        let cameras = self.eyes.len();
        self.eyes.get_mut(id.0).ok_or(RenderError::NoSuchCamera {
            index: id.0,
            cameras,
        })
    }
}

impl Eye {
    fn forget(&mut self) {
        self.still_seen = false;
        self.tiles.iter_mut().for_each(Tile::forget);
    }

    fn world_from_axis(&self) -> Isometry3<f64> {
        let rotation = UnitQuaternion::from_rotation_matrix(&self.optics.camera_from_axis);
        let camera_from_axis =
            Isometry3::from_parts(Translation3::from(self.optics.centre), rotation);
        self.world_from_camera * camera_from_axis
    }
}

impl Stage {
    /// Prepares the shadows of the static scene.
    fn light_up(&mut self) {
        let z = self.scene.sun.direction_to_sun.into_inner();
        let aside = if z.z.abs() < 0.9 {
            Vector3::z()
        } else {
            Vector3::x()
        };
        let x = aside.cross(&z).normalize();
        let rotation = Rotation3::from_basis_unchecked(&[x, z.cross(&x), z]).inverse();
        self.sun_from_world = Isometry3::from_parts(
            Translation3::identity(),
            UnitQuaternion::from_rotation_matrix(&rotation),
        );
        self.still_tree = SunTree::new(&self.still, |b| {
            self.present[b].then_some(self.sun_from_world)
        });
    }

    /// `world_from_body` of all parts, then of all plates.
    fn world_from_moving(&self, state: &FrameState) -> Result<Vec<Isometry3<f64>>, RenderError> {
        let (given, expected) = (state.part_poses.len(), self.scene.parts.len());
        if given != expected {
            return Err(RenderError::PoseCount { given, expected });
        }
        for (index, pose) in state.part_poses.iter().enumerate() {
            check_pose(pose, || format!("part {index}"))?;
        }
        let plates = self
            .scene
            .plates
            .iter()
            .map(|p| state.part_poses[p.part] * p.part_from_plate);
        Ok(state.part_poses.iter().copied().chain(plates).collect())
    }

    fn moment<'a>(&self, state: &'a FrameState) -> Result<Moment<'a>, RenderError> {
        let world_from_moving = self.world_from_moving(state)?;
        let tree = SunTree::new(&self.moving, |b| {
            Some(self.sun_from_world * world_from_moving[b])
        });
        Ok(Moment {
            state,
            world_from_moving,
            tree,
        })
    }

    fn image(&self, moment: &Moment<'_>, eye: &mut Eye, noise_seed: u64) -> Grey8 {
        let world_from_axis = eye.world_from_axis();
        let axis_from_world = world_from_axis.inverse();
        let optics = &eye.optics;
        if !eye.still_seen {
            eye.still.see(optics, &self.still, |b| {
                self.present[b].then_some(axis_from_world)
            });
            eye.still_seen = true;
        }
        eye.moving.see(optics, &self.moving, |b| {
            Some(axis_from_world * moment.world_from_moving[b])
        });
        let to_sun = self.scene.sun.direction_to_sun.into_inner();
        let frame_of = |world_from_body: &Isometry3<f64>| {
            BodyFrame::new(
                world_from_body,
                &world_from_axis,
                &self.sun_from_world,
                &to_sun,
            )
        };
        let (parts, plates) = moment.world_from_moving.split_at(self.scene.parts.len());
        let up = axis_from_world.rotation * Vector3::z();
        let frame = Frame {
            level: self.level,
            optics,
            still: &eye.still,
            moving: &eye.moving,
            still_geometry: &self.still,
            moving_geometry: &self.moving,
            still_frame: frame_of(&Isometry3::identity()),
            part_frames: parts.iter().map(frame_of).collect(),
            plate_frames: plates
                .iter()
                .map(|world_from_plate| {
                    PlateFrame::new(
                        world_from_plate.inverse() * world_from_axis,
                        frame_of(world_from_plate),
                        moment.state.pattern_visible,
                    )
                })
                .collect(),
            materials: &self.materials,
            plates: &self.plates,
            light: (&self.scene.sun).into(),
            sky: self.scene.sky,
            up: [up.x as f32, up.y as f32, up.z as f32],
            still_tree: &self.still_tree,
            moving_tree: &moment.tree,
            sun_from_axis: (self.sun_from_world * world_from_axis).into(),
        };
        let radiance = frame.radiance(&mut eye.tiles);
        let (width, height) = (optics.width, optics.height);
        expose(
            self.level,
            width,
            height,
            &radiance,
            &eye.parameters,
            noise_seed,
        )
    }
}

fn check_pose(pose: &Isometry3<f64>, body: impl Fn() -> String) -> Result<(), RenderError> {
    let finite = pose.translation.vector.iter().all(|x| x.abs() < 1e6);
    if finite && (pose.rotation.norm() - 1.0).abs() < 1e-6 {
        return Ok(());
    }
    Err(RenderError::Pose { body: body() })
}
