//! What cameras see: the scene that the renderer draws, and the rays that score a placement.

use crate::{
    SimulationError,
    description::{ImageDescription, SimulationDescription, SunDescription},
    rover::vehicle_parts,
    terrain::Terrain,
    truth::Truth,
};
use nalgebra::{Isometry3, Point3, Rotation3, Unit, UnitQuaternion, Vector2, Vector3};
use rover_cameras::Camera;
use rover_messages::{
    Fault,
    imaging::{ImageData, RawPair},
    keys::service::HARDWARE,
    mobility::{MastState, WheelsState},
    simulation::{View, ViewRequest},
};
use rover_render::{
    CameraId, DynamicPart, FrameState, Grey8, ImagingParameters, Mesh, Plate, Renderer, Scene, Sky,
    StaticMesh, Sun, Surface, shapes,
};
use rover_robot::{CameraMount, Capsule, FiducialDescription, Robot};
use std::{
    collections::BTreeMap,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Instant,
};

/// Segments of a round part.
const SEGMENTS: usize = 32;
/// How many differently shaped outside cameras are kept.
const MOST_VIEWS: usize = 16;

/// The world at one instant, as far as a picture can tell.
#[derive(Clone, Debug)]
pub struct Moment {
    /// Simulated time, s.
    pub sim_time_s: f64,
    /// Control step.
    pub step: u64,
    pub(crate) frame: FrameState,
    /// Bodies of the terrain that are gone.
    pub(crate) gone: Vec<usize>,
    /// The rover that carries cameras and arm; `None` if they are fixed to the world.
    pub(crate) rover: Option<RoverMoment>,
}

/// A rover at one instant.
#[derive(Clone, Debug)]
pub(crate) struct RoverMoment {
    pub world_from_rover: Isometry3<f64>,
    /// True pose of the mast's head, world frame.
    pub world_from_head: Option<Isometry3<f64>>,
    /// What the rover itself reports.
    pub mast: Option<MastState>,
    pub wheels: WheelsState,
}

impl Moment {
    /// Pose of what a pair is mounted on, world frame; `None` if it is fixed to the world.
    fn world_from_mount(&self, mount: CameraMount) -> Option<Isometry3<f64>> {
        let rover = self.rover.as_ref()?;
        match mount {
            CameraMount::Body => Some(rover.world_from_rover),
            CameraMount::Mast => rover.world_from_head,
        }
    }
}

/// A place on the true terrain.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePoint {
    /// Position on the mesh's facet, world frame, m.
    pub point_m: Vector3<f64>,
    /// Outward normal, averaged over the instrument's footprint, world frame.
    pub normal: Unit<Vector3<f64>>,
    /// Body of the terrain: 0 for the ground, then the rocks.
    pub body_n: usize,
}

/// The true cameras and the scene before them.
pub struct Eyes {
    renderer: Renderer,
    pairs: Vec<EyePair>,
    views: BTreeMap<(u32, u32, u64), CameraId>,
    gone: Vec<usize>,
    terrain: Arc<Terrain>,
    seed: u64,
    footprint_m: f64,
    /// Computing time spent on pictures, ns of wall time.
    pub(crate) wall_ns: Arc<AtomicU64>,
}

struct EyePair {
    name: String,
    mount: CameraMount,
    left: Camera,
    ids: [CameraId; 2],
}

impl Eyes {
    pub(crate) fn new(
        robot: &Robot,
        truth: &Truth,
        terrain: Arc<Terrain>,
        d: &SimulationDescription,
        seed: u64,
    ) -> Result<Self, SimulationError> {
        let mut statics = terrain.bodies.clone();
        let (mut parts, plate) = robot_parts(robot);
        match &robot.description().mobility {
            Some(mobility) => parts.extend(vehicle_parts(robot, mobility)),
            None => {
                let body = robot.description().body.iter().enumerate();
                statics.extend(body.map(|(i, c)| StaticMesh {
                    mesh: capsule_mesh(c),
                    surface: Surface::metal(100 + i as u32),
                }));
            }
        }
        let scene = Scene::new(statics, parts, vec![plate], sun(&d.sun), Sky::default())?;
        let mut renderer = Renderer::new(scene);
        let parameters = imaging(&d.image);
        let pairs = truth
            .pairs
            .iter()
            .zip(&robot.description().cameras)
            .map(|(pair, described)| {
                Ok(EyePair {
                    name: pair.name.clone(),
                    mount: described.mount,
                    left: pair.cameras.left.clone(),
                    ids: [
                        renderer.add_camera(&pair.cameras.left, parameters)?,
                        renderer.add_camera(&pair.cameras.right, parameters)?,
                    ],
                })
            })
            .collect::<Result<_, SimulationError>>()?;
        Ok(Self {
            renderer,
            pairs,
            views: BTreeMap::new(),
            gone: Vec::new(),
            terrain,
            seed,
            footprint_m: d.contact.footprint_m,
            wall_ns: Arc::default(),
        })
    }

    /// Takes one stereo pair. The noise depends on the run's seed, the pair, the control step and
    /// the exposure alone.
    ///
    /// # Errors
    /// Fault `unknown_pair`, or `rendering_failed` with the renderer's words.
    pub fn grab(&mut self, moment: &Moment, pair: &str, exposure_n: u32) -> Result<RawPair, Fault> {
        let start = Instant::now();
        self.follow(moment)?;
        let Some(index) = self.pairs.iter().position(|p| p.name == pair) else {
            let known: Vec<_> = self.pairs.iter().map(|p| p.name.as_str()).collect();
            let message = format!("no camera pair `{pair}`; there are: {}", known.join(", "));
            return Err(Fault::new(HARDWARE, "unknown_pair", message));
        };
        let noise = [index as u64, moment.step, u64::from(exposure_n)]
            .iter()
            .fold(self.seed, |hash, word| mix(hash ^ word));
        let [left, right] = self.pairs[index].ids;
        if let Some(pose) = moment.world_from_mount(self.pairs[index].mount) {
            for id in [left, right] {
                self.renderer
                    .set_camera_pose(id, &pose)
                    .map_err(|e| Fault::new(HARDWARE, "rendering_failed", e.to_string()))?;
            }
        }
        let (left, right) = self
            .renderer
            .render_pair(left, right, &moment.frame, noise)
            .map_err(|e| Fault::new(HARDWARE, "rendering_failed", e.to_string()))?;
        self.wall_ns
            .fetch_add(start.elapsed().as_nanos() as u64, Ordering::Relaxed);
        Ok(RawPair {
            pair: pair.into(),
            sim_time_s: moment.sim_time_s,
            step: moment.step,
            left: image(left),
            right: image(right),
            mast: moment.rover.as_ref().and_then(|r| r.mast.clone()),
            wheels: moment.rover.as_ref().map(|r| r.wheels.clone()),
        })
    }

    /// What an outside camera sees, without blur or noise.
    ///
    /// # Errors
    /// Fault `bad_view` that names the field, what was found and what was expected.
    pub fn view(&mut self, moment: &Moment, request: &ViewRequest) -> Result<View, Fault> {
        let start = Instant::now();
        self.follow(moment)?;
        let bad = |message: String| Fault::new(HARDWARE, "bad_view", message);
        for (field, x) in [
            ("width_px", request.width_px),
            ("height_px", request.height_px),
        ] {
            if !(16..=2048).contains(&x) {
                return Err(bad(format!("{field}: {x}, expected 16 to 2048")));
            }
        }
        let field_deg = request.field_of_view_deg;
        if !(1.0..=120.0).contains(&field_deg) {
            return Err(bad(format!(
                "field_of_view_deg: {field_deg}, expected 1 to 120"
            )));
        }
        let world_from_camera = looking(&request.eye_m.into(), &request.look_at_m.into())
            .ok_or_else(|| bad("eye_m and look_at_m: expected two different points".into()))?;
        let key = (request.width_px, request.height_px, field_deg.to_bits());
        let failed = |e: rover_render::RenderError| bad(e.to_string());
        let id = match self.views.get(&key) {
            Some(id) => *id,
            None if self.views.len() >= MOST_VIEWS => {
                let message = format!(
                    "{MOST_VIEWS} sizes and fields of view have been asked for; take one of them"
                );
                return Err(Fault::new(HARDWARE, "too_many_views", message));
            }
            None => {
                let [w, h] = [request.width_px, request.height_px].map(f64::from);
                let focal_px = w / 2.0 / (field_deg.to_radians() / 2.0).tan();
                let camera = Camera::pinhole(
                    &Isometry3::identity(),
                    [focal_px; 2],
                    [(w - 1.0) / 2.0, (h - 1.0) / 2.0],
                    [request.width_px, request.height_px],
                );
                let still = ImagingParameters {
                    psf_sigma_px: 0.0,
                    read_noise_dn: 0.0,
                    electrons_per_dn: f64::INFINITY,
                    ..ImagingParameters::default()
                };
                let id = self.renderer.add_camera(&camera, still).map_err(failed)?;
                self.views.insert(key, id);
                id
            }
        };
        self.renderer
            .set_camera_pose(id, &world_from_camera)
            .map_err(failed)?;
        let picture = self.renderer.render(id, &moment.frame, 0).map_err(failed)?;
        self.wall_ns
            .fetch_add(start.elapsed().as_nanos() as u64, Ordering::Relaxed);
        Ok(View {
            image: image(picture),
        })
    }

    /// The true surface point seen at a pixel of a pair's left image.
    ///
    /// # Errors
    /// [`SimulationError::NoSurface`] when there is no such pair, no ray or no terrain.
    pub fn surface_at(
        &self,
        moment: &Moment,
        pair: &str,
        pixel_px: [f64; 2],
    ) -> Result<SurfacePoint, SimulationError> {
        let [u_px, v_px] = pixel_px;
        let none = || SimulationError::NoSurface {
            pair: pair.into(),
            u_px,
            v_px,
        };
        let eye = self
            .pairs
            .iter()
            .find(|p| p.name == pair)
            .ok_or_else(none)?;
        let ray = eye
            .left
            .ray(&Vector2::new(u_px, v_px))
            .map_err(|_| none())?;
        let (mut origin, mut direction) = (ray.origin, ray.direction.into_inner());
        if let Some(pose) = moment.world_from_mount(eye.mount) {
            origin = (pose * Point3::from(origin)).coords;
            direction = pose.rotation * direction;
        }
        let hit = self
            .renderer
            .cast(&origin, &direction, None)
            .ok_or_else(none)?;
        // The robot's own body, which comes after the terrain, is no target.
        let normal = self
            .terrain
            .mean_normal(hit.mesh_index, &hit.point, self.footprint_m)
            .ok_or_else(none)?;
        let normal = Unit::try_new(normal, 1e-12).unwrap_or(Unit::new_normalize(hit.normal));
        Ok(SurfacePoint {
            point_m: hit.point,
            normal,
            body_n: hit.mesh_index,
        })
    }

    /// Whether a pair's left camera sees a point of the terrain, and at which pixel: nothing of
    /// terrain or robot is before it.
    pub(crate) fn pixel_of(
        &self,
        moment: &Moment,
        pair: &str,
        point: &Vector3<f64>,
    ) -> Option<[f64; 2]> {
        let eye = self.pairs.iter().find(|p| p.name == pair)?;
        let pose = moment
            .world_from_mount(eye.mount)
            .unwrap_or_else(Isometry3::identity);
        let in_mount = (pose.inverse() * Point3::from(*point)).coords;
        let pixel = eye.left.project(&in_mount).ok()?;
        if !eye.left.contains(&pixel, 0.0) {
            return None;
        }
        let centre = (pose * Point3::from(*eye.left.model.cahv()[0])).coords;
        let along = point - centre;
        let hit = self
            .renderer
            .cast(&centre, &along.normalize(), Some(&moment.frame))?;
        ((hit.point - point).norm() < 1e-3).then_some(pixel.into())
    }

    /// The first thing of the terrain on a ray: point, facet normal, and which body.
    pub(crate) fn first_on(
        &self,
        origin: &Vector3<f64>,
        along: &Vector3<f64>,
    ) -> Option<SurfacePoint> {
        let hit = self.renderer.cast(origin, along, None)?;
        let normal = self
            .terrain
            .mean_normal(hit.mesh_index, &hit.point, self.footprint_m)?;
        Some(SurfacePoint {
            point_m: hit.point,
            normal: Unit::try_new(normal, 1e-12)?,
            body_n: hit.mesh_index,
        })
    }

    /// Where a ray meets the terrain, world frame, m.
    #[cfg(test)]
    pub(crate) fn cast(&self, origin: &Vector3<f64>, along: &Vector3<f64>) -> Option<Vector3<f64>> {
        self.renderer.cast(origin, along, None).map(|hit| hit.point)
    }

    /// Removes what has vanished from the world since the last picture.
    fn follow(&mut self, moment: &Moment) -> Result<(), Fault> {
        for &body in &moment.gone {
            if !self.gone.contains(&body) {
                self.gone.push(body);
                self.renderer
                    .remove_static(body)
                    .map_err(|e| Fault::new(HARDWARE, "rendering_failed", e.to_string()))?;
            }
        }
        Ok(())
    }
}

/// The links, the plunger, and the fiducial's plate on the last link. The parts' poses are those of
/// the links in order, then the plunger's.
fn robot_parts(robot: &Robot) -> (Vec<DynamicPart>, Plate) {
    let d = robot.description();
    let last = d.arm.joints.len() - 1;
    let plate_from_link = robot.link_from_plate.inverse();
    let mut parts: Vec<DynamicPart> = d
        .arm
        .joints
        .iter()
        .enumerate()
        .map(|(i, joint)| {
            let mut mesh = Mesh::default();
            // Capsules in the plate stand for the plate, which is drawn as such.
            for c in joint
                .shape
                .iter()
                .filter(|c| i != last || !lies_in_plate(c, &plate_from_link, &d.fiducial))
            {
                mesh.append(&capsule_mesh(c));
            }
            let surface = if i < last {
                Surface::paint(0.62, 10 + i as u32)
            } else {
                Surface::metal(10 + i as u32)
            };
            DynamicPart { mesh, surface }
        })
        .collect();
    parts.push(plunger_part(robot));
    let layout = Arc::new(d.fiducial.layout.clone());
    let plate = Plate {
        part: last,
        part_from_plate: robot.link_from_plate,
        half_width_m: layout.half_width_m,
        half_height_m: layout.half_height_m,
        albedo: Arc::new({
            let layout = layout.clone();
            move |x, y| layout.albedo(x, y)
        }),
        blank_albedo: 0.35,
        back_albedo: 0.30,
    };
    (parts, plate)
}

/// A ball and the rod behind it, origin at the ball's centre, z along the approach axis.
fn plunger_part(robot: &Robot) -> DynamicPart {
    let switch = &robot.description().tool.switch;
    let r = switch.ball_radius_m;
    let rod = Capsule {
        from_m: [0.0, 0.0, -(switch.travel_m + 6.0 * r)],
        to_m: [0.0; 3],
        radius_m: 0.7 * r,
    };
    let ball = Capsule {
        from_m: [0.0; 3],
        to_m: [0.0, 0.0, 0.0],
        radius_m: r,
    };
    let mut mesh = capsule_mesh(&rod);
    mesh.append(&capsule_mesh(&ball));
    DynamicPart {
        mesh,
        surface: Surface::metal(99),
    }
}

pub(crate) fn capsule_mesh(c: &Capsule) -> Mesh {
    let (from, to) = (Vector3::from(c.from_m), Vector3::from(c.to_m));
    let along = to - from;
    let turn = UnitQuaternion::rotation_between(&Vector3::z(), &along)
        .unwrap_or_else(|| UnitQuaternion::from_scaled_axis(Vector3::x() * std::f64::consts::PI));
    shapes::capsule(c.radius_m, along.norm(), SEGMENTS)
        .transformed(&Isometry3::from_parts(from.into(), turn))
}

fn lies_in_plate(
    c: &Capsule,
    plate_from_link: &Isometry3<f64>,
    fiducial: &FiducialDescription,
) -> bool {
    [c.from_m, c.to_m].iter().all(|end| {
        let p = plate_from_link * Point3::from(*end);
        p.x.abs() <= fiducial.layout.half_width_m
            && p.y.abs() <= fiducial.layout.half_height_m
            && p.z.abs() < c.radius_m
    })
}

pub(crate) fn encloses(c: &Capsule, p: &Vector3<f64>) -> bool {
    let (from, to) = (Vector3::from(c.from_m), Vector3::from(c.to_m));
    let along = to - from;
    let s = ((p - from).dot(&along) / along.norm_squared().max(1e-18)).clamp(0.0, 1.0);
    (from + along * s - p).norm() < c.radius_m
}

fn sun(d: &SunDescription) -> Sun {
    let (a, e) = (d.azimuth_deg.to_radians(), d.elevation_deg.to_radians());
    let direction = Vector3::new(e.cos() * a.cos(), e.cos() * a.sin(), e.sin());
    Sun {
        direction_to_sun: Unit::new_normalize(direction),
        intensity: d.intensity,
        ambient: d.ambient,
    }
}

fn imaging(d: &ImageDescription) -> ImagingParameters {
    ImagingParameters {
        psf_sigma_px: d.psf_sigma_px,
        gain_dn: d.exposure_dn,
        read_noise_dn: d.read_noise_dn,
        electrons_per_dn: if d.electrons_per_dn > 0.0 {
            d.electrons_per_dn
        } else {
            f64::INFINITY
        },
    }
}

fn image(picture: Grey8) -> ImageData {
    ImageData {
        width_px: picture.width as u32,
        height_px: picture.height as u32,
        pixels: picture.pixels,
    }
}

/// Pose of a camera (x right, y down, z forward) at `eye` that looks at `at`, z of the world up in
/// the picture.
fn looking(eye: &Vector3<f64>, at: &Vector3<f64>) -> Option<Isometry3<f64>> {
    let z = (at - eye).try_normalize(1e-9)?;
    let aside = z.cross(&Vector3::z());
    let x = aside.try_normalize(1e-6).unwrap_or_else(|| -Vector3::y());
    if !(eye.iter().chain(z.iter()).all(|v| v.is_finite())) {
        return None;
    }
    let axes = Rotation3::from_basis_unchecked(&[x, z.cross(&x), z]);
    Some(Isometry3::from_parts(
        (*eye).into(),
        UnitQuaternion::from_rotation_matrix(&axes),
    ))
}

/// A well-mixed word (splitmix64).
pub(crate) fn mix(word: u64) -> u64 {
    let mut z = word.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}
