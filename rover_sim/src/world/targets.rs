//! Places on the terrain: what a pixel shows, and places that a person might choose.

use super::{World, lock};
use crate::{SimulationError, eyes::SurfacePoint};
use nalgebra::{Isometry3, Point3, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rover_messages::{
    Fault,
    keys::service::HARDWARE,
    simulation::{Pick, PickRequest, SurfaceKind, TruePlace},
};
use std::f64::consts::FRAC_PI_4;

/// Largest angle between a picked surface's normal and the direction towards the camera, rad.
const FACING_RAD: f64 = 1.0;
/// A picked surface on a rock lies so much above the ground at most, m.
const HIGHEST_M: f64 = 0.30;
/// Half the width of the field before the rover in which places are looked for, and where there is
/// none, rad.
const AHEAD_RAD: [f64; 2] = [0.5, 0.9];
/// Least distance of a picked place from the edge of the terrain, and where there is none, m: the
/// rover must find a place to stand about it.
const EDGES_M: [f64; 2] = [1.5, 0.8];
/// Rocks smaller than this are not picked, m.
const ROCK_M: f64 = 0.10;

/// Distances to the next edge that are asked for, one after the other: ten, six and three pixels
/// of a mast camera, rad.
const MARGINS_RAD: [f64; 3] = [0.008, 0.005, 0.0025];

/// What a pixel showed when it was named.
#[derive(Clone, Debug)]
pub(crate) struct Designation {
    pair: String,
    pixel_px: [u64; 2],
    pub surface: SurfacePoint,
    /// Where the rover was then.
    pub world_from_rover: Isometry3<f64>,
}

impl World {
    /// Names the pixel of the target: its true surface point is found now, before anything moves
    /// or vanishes, and is what occlusion and scores refer to. The same pixel named again is
    /// answered from memory.
    ///
    /// # Errors
    /// [`SimulationError::NoSurface`].
    pub fn designate(
        &mut self,
        pair: &str,
        pixel_px: [f64; 2],
    ) -> Result<SurfacePoint, SimulationError> {
        self.designation(pair, pixel_px).map(|d| d.surface)
    }

    pub(crate) fn designation(
        &mut self,
        pair: &str,
        pixel_px: [f64; 2],
    ) -> Result<Designation, SimulationError> {
        let bits = pixel_px.map(f64::to_bits);
        let known = |d: &&Designation| d.pair == pair && d.pixel_px == bits;
        if let Some(known) = self.designated.iter().find(known) {
            return Ok(known.clone());
        }
        let surface = lock(&self.eyes).surface_at(&self.moment(), pair, pixel_px)?;
        let new = Designation {
            pair: pair.into(),
            pixel_px: bits,
            surface,
            world_from_rover: self.world_from_rover().unwrap_or_else(Isometry3::identity),
        };
        self.designated.push(new.clone());
        Ok(new)
    }

    /// The place of a surface point as seen from the rover now.
    pub(crate) fn true_place(&self, surface: &SurfacePoint) -> TruePlace {
        let origin = self
            .world_from_rover()
            .map_or_else(Vector3::zeros, |pose| pose.translation.vector);
        let apart = surface.point_m - origin;
        TruePlace {
            point_in_world_m: surface.point_m.into(),
            normal_in_world: surface.normal.into_inner().into(),
            rock_n: surface.body_n.checked_sub(1).map(|n| n as u32),
            range_m: apart.x.hypot(apart.y),
        }
    }

    /// A place that a person might choose as a target: in view before the rover, on a face turned
    /// to the mast. The same question has the same answer while nothing moves.
    ///
    /// # Errors
    /// Fault `no_place` with the number of places tried.
    pub fn pick(&self, request: &PickRequest) -> Result<Pick, Fault> {
        const TRIES: u32 = 2000;
        let world_from_rover = self.world_from_rover().unwrap_or_else(Isometry3::identity);
        let eye = self.lookout(&world_from_rover);
        let mut random = ChaCha8Rng::seed_from_u64(self.origin.0);
        random.set_stream(40 + u64::from(request.choice_n));
        let yaw = world_from_rover.rotation.euler_angles().2;
        let [near, far] = request.range_m;
        // A person looks ahead first, prefers the middle of a surface, and takes what there is.
        let wishes = EDGES_M.into_iter().flat_map(|edge| {
            AHEAD_RAD
                .into_iter()
                .flat_map(move |ahead| MARGINS_RAD.map(|margin| (edge, ahead, margin)))
        });
        let tried_n = wishes.clone().count() as u32 * TRIES;
        for (edge_m, ahead_rad, margin_rad) in wishes.flat_map(|w| (0..TRIES).map(move |_| w)) {
            let [u, v]: [f64; 2] = std::array::from_fn(|_| random.random());
            let range = near + u * (far - near);
            let azimuth = yaw + (2.0 * v - 1.0) * ahead_rad;
            let lift = 0.4 * random.random::<f64>();
            let origin = world_from_rover.translation.vector;
            let (x, y) = (
                origin.x + range * azimuth.cos(),
                origin.y + range * azimuth.sin(),
            );
            let ground = self.terrain.height_near_m(x, y);
            let aim = match request.surface {
                SurfaceKind::Rock => Vector3::new(x, y, ground + lift),
                SurfaceKind::Ground => Vector3::new(x, y, ground),
            };
            let along = aim - eye;
            let Some(found) = lock(&self.eyes).first_on(&eye, &along.normalize()) else {
                continue;
            };
            let place = self.true_place(&found);
            let height =
                found.point_m.z - self.terrain.height_near_m(found.point_m.x, found.point_m.y);
            let fits = match request.surface {
                SurfaceKind::Ground => place.rock_n.is_none(),
                SurfaceKind::Rock => {
                    place.rock_n.is_some()
                        && self.terrain.size_m(found.body_n) > 2.0 * ROCK_M
                        && found.normal.angle(&-along) < FACING_RAD
                        && (0.04..HIGHEST_M).contains(&height)
                        && found.normal.z > 0.15
                }
            };
            let at = &found.point_m;
            if !fits
                || !self.terrain.has_about(at.x, at.y, edge_m)
                || !(near..=far).contains(&place.range_m)
                || !self.is_lit(&found)
                || !self.is_plain(&eye, &found, margin_rad)
            {
                continue;
            }
            let in_rover = (world_from_rover.inverse() * Point3::from(found.point_m)).coords;
            let mast_rad = self
                .robot
                .description()
                .mast
                .and_then(|mast| mast.angles_towards(&in_rover.into()));
            let pixel_px = lock(&self.eyes).pixel_of(&self.moment(), &request.pair, &found.point_m);
            return Ok(Pick {
                place,
                mast_rad,
                pixel_px,
            });
        }
        let message = format!(
            "no {:?} between {near} and {far} m that faces the rover, {tried_n} places tried",
            request.surface
        );
        Err(Fault::new(HARDWARE, "no_place", message).with("tried_n", f64::from(tried_n)))
    }

    /// Whether the sun shines on a surface point.
    fn is_lit(&self, place: &SurfacePoint) -> bool {
        /// Sines of smaller angles are grazing light.
        const GRAZING: f64 = 0.15;
        /// Start of the ray above the surface, m.
        const LIFT_M: f64 = 0.002;
        let sun = &self.description.sun;
        let (azimuth, elevation) = (sun.azimuth_deg.to_radians(), sun.elevation_deg.to_radians());
        let level = elevation.cos();
        let towards = Vector3::new(
            level * azimuth.cos(),
            level * azimuth.sin(),
            elevation.sin(),
        );
        let start = place.point_m + place.normal.into_inner() * LIFT_M;
        place.normal.dot(&towards) > GRAZING
            && lock(&self.eyes).first_on(&start, &towards).is_none()
    }

    /// Whether what surrounds a surface point by `margin_rad` as seen from `eye` is the same
    /// surface: nobody names a target on an edge.
    fn is_plain(&self, eye: &Vector3<f64>, place: &SurfacePoint, margin_rad: f64) -> bool {
        /// Least distance of what must be alike, m.
        const AROUND_M: f64 = 0.03;
        /// Largest step in range, m, and largest angle between the normals, rad.
        const STEP_M: f64 = 0.10;
        const BEND_RAD: f64 = 0.7;
        let along = place.point_m - eye;
        let (range_m, along) = (along.norm(), along.normalize());
        let around_m = AROUND_M.max(margin_rad * range_m);
        let aside = along.cross(&Vector3::z()).normalize();
        let up = aside.cross(&along);
        (0..8).map(|i| f64::from(i) * FRAC_PI_4).all(|angle| {
            let way = aside * angle.cos() + up * angle.sin();
            let towards = (along * range_m + way * around_m).normalize();
            lock(&self.eyes).first_on(eye, &towards).is_some_and(|at| {
                let flat_m = STEP_M + around_m / along.dot(&place.normal).abs().max(0.05);
                at.body_n == place.body_n
                    && ((at.point_m - eye).norm() - range_m).abs() < flat_m
                    && at.normal.angle(&place.normal) < BEND_RAD
            })
        })
    }

    /// Where the view is best: the mast's head, or the first pair.
    fn lookout(&self, world_from_rover: &Isometry3<f64>) -> Vector3<f64> {
        let in_rover = match &self.robot.description().mast {
            Some(mast) => mast.rover_from_head(0.0, 0.0).isometry.translation.vector,
            None => self.robot.mount_centre(),
        };
        (world_from_rover * Point3::from(in_rover)).coords
    }
}
