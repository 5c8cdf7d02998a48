//! The simulated world, field by field, as a scenario describes it.
//!
//! Everything is in the world frame, which for a wall-mounted testbed is the rover frame: x
//! forward, y left, z up. Every field has a default, so a scenario names only what it changes.

mod mobile;

pub use mobile::{RockField, RoverStart, SoftPatch, SoilDescription};
use serde::{Deserialize, Serialize};

/// Everything that the simulator needs besides the robot file and a seed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimulationDescription {
    /// Physics and control step, s. The robot's heartbeats must be whole multiples of it.
    pub step_s: f64,
    /// How the true robot differs from the believed one.
    pub truth: TruthDescription,
    /// Ground and rocks.
    pub terrain: TerrainDescription,
    /// The sun.
    pub sun: SunDescription,
    /// Lens blur, exposure and sensor noise.
    pub image: ImageDescription,
    /// Behaviour of the arm's driver.
    pub driver: DriverDescription,
    /// Contact and contact switch.
    pub contact: ContactDescription,
    /// Where the fiducial's pattern cannot be seen.
    pub occlusion: Option<OcclusionDescription>,
    /// The pixel that the target is designated by; occlusion is measured from the surface seen
    /// there.
    pub target: Option<TargetPixel>,
    /// Where a robot that drives stands at the start; at the origin if not given.
    pub rover: Option<RoverStart>,
    /// Faults shown from the start or at a given moment.
    pub faults: FaultsDescription,
}

impl Default for SimulationDescription {
    fn default() -> Self {
        Self {
            step_s: 0.002,
            truth: TruthDescription::default(),
            terrain: TerrainDescription::default(),
            sun: SunDescription::default(),
            image: ImageDescription::default(),
            driver: DriverDescription::default(),
            contact: ContactDescription::default(),
            occlusion: None,
            target: None,
            rover: None,
            faults: FaultsDescription::default(),
        }
    }
}

/// One-sigma differences between the true robot and the believed one. The draws depend on the seed
/// alone; zeros give the believed robot.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TruthDescription {
    /// Joint offsets, twist angles and the rotation of each camera mount, deg.
    pub angle_deg: f64,
    /// Link lengths, link offsets and the translation of each camera mount, mm.
    pub length_mm: f64,
    /// Noise of one encoder reading, rad.
    pub encoder_noise_rad: f64,
    /// Full width of each joint's backlash, rad.
    pub backlash_rad: f64,
    /// Whether gravity bends the arm (droop is gravity torque over joint stiffness).
    pub droop: bool,
    /// Camera intrinsics.
    pub intrinsics: IntrinsicsError,
    /// Errors of mast, odometry and attitude sensor as a multiple of what the robot file states;
    /// 1 if not given.
    pub mobility_scale: Option<f64>,
}

impl Default for TruthDescription {
    fn default() -> Self {
        Self {
            angle_deg: 0.0,
            length_mm: 0.0,
            encoder_noise_rad: 0.0,
            backlash_rad: 0.0,
            droop: true,
            intrinsics: IntrinsicsError::default(),
            mobility_scale: None,
        }
    }
}

/// One-sigma error of each camera's intrinsic calibration.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct IntrinsicsError {
    /// Focal length, as a fraction of itself.
    pub focal_fraction: f64,
    /// Each coordinate of the principal point, px.
    pub principal_point_px: f64,
}

/// Ground as a height field, and rocks on it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TerrainDescription {
    /// Centre of the ground, x and y, m.
    pub centre_m: [f64; 2],
    /// Extent along x and y, m.
    pub size_m: [f64; 2],
    /// Mean height, m.
    pub height_m: f64,
    /// Edge of a cell of the height field, m.
    pub cell_m: f64,
    /// Height of the coarsest undulation, m, one sigma.
    pub relief_m: f64,
    /// Wavelength of the coarsest undulation, m; each further octave has half the wavelength.
    pub relief_wavelength_m: f64,
    /// Height of each octave over that of the next coarser one.
    pub relief_gain: f64,
    /// Seed of undulation, texture and scattered rocks.
    pub seed: u64,
    /// Rocks at given places. Their index here is the one that faults name; scattered rocks
    /// follow.
    pub rocks: Vec<RockDescription>,
    /// Small rocks at random places.
    pub scattered: ScatteredRocks,
    /// Large rocks at random places; their indices follow the scattered ones'.
    pub field: Option<RockField>,
    /// The ground under wheels.
    pub soil: Option<SoilDescription>,
}

impl Default for TerrainDescription {
    fn default() -> Self {
        Self {
            centre_m: [0.72, 0.0],
            size_m: [1.6, 1.6],
            height_m: 0.0,
            cell_m: 0.01,
            relief_m: 0.006,
            relief_wavelength_m: 0.5,
            relief_gain: 0.45,
            seed: 1,
            rocks: vec![RockDescription::default()],
            scattered: ScatteredRocks::default(),
            field: None,
            soil: None,
        }
    }
}

/// One rock: a sphere with bumps, partly in the ground.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RockDescription {
    /// Centre, m.
    pub position_m: [f64; 3],
    /// Mean radius, m.
    pub radius_m: f64,
    /// Height of the largest bumps over the radius.
    pub roughness: f64,
    /// Subdivisions of the icosahedron that it is made from (20 * 4^n triangles).
    pub subdivisions_n: u32,
    /// Seed of its shape and texture.
    pub seed: u64,
}

impl Default for RockDescription {
    fn default() -> Self {
        Self {
            position_m: [0.70, 0.02, 0.02],
            radius_m: 0.14,
            roughness: 0.10,
            subdivisions_n: 5,
            seed: 7,
        }
    }
}

/// Small rocks at random places on the ground.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ScatteredRocks {
    /// How many.
    pub count_n: u32,
    /// Smallest and largest radius, m.
    pub radius_m: [f64; 2],
    /// Subdivisions of the icosahedron that each is made from.
    pub subdivisions_n: u32,
}

impl Default for ScatteredRocks {
    fn default() -> Self {
        Self {
            count_n: 24,
            radius_m: [0.006, 0.025],
            subdivisions_n: 2,
        }
    }
}

/// Where the sun stands and how bright it is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SunDescription {
    /// Azimuth of the direction towards the sun, from x towards y, deg.
    pub azimuth_deg: f64,
    /// Elevation above the horizon, deg.
    pub elevation_deg: f64,
    /// Radiance of a white diffuse surface that faces the sun.
    pub intensity: f64,
    /// Radiance of a white diffuse surface that sees only the sky.
    pub ambient: f64,
}

impl Default for SunDescription {
    fn default() -> Self {
        Self {
            azimuth_deg: 130.0,
            elevation_deg: 55.0,
            intensity: 0.8,
            ambient: 0.2,
        }
    }
}

/// What lens and sensor do to a picture.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ImageDescription {
    /// Grey level of radiance 1 (a white surface in full light), DN.
    pub exposure_dn: f64,
    /// Lens blur, px, one sigma.
    pub psf_sigma_px: f64,
    /// Read noise, DN, one sigma.
    pub read_noise_dn: f64,
    /// Electrons per grey level: sets the shot noise; 0 for none.
    pub electrons_per_dn: f64,
}

impl Default for ImageDescription {
    fn default() -> Self {
        Self {
            exposure_dn: 290.0,
            psf_sigma_px: 0.6,
            read_noise_dn: 1.0,
            electrons_per_dn: 60.0,
        }
    }
}

/// What the arm's driver tolerates.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DriverDescription {
    /// Largest difference between the first point of a trajectory and the present encoder angles,
    /// rad; taken up smoothly during the motion.
    pub start_tolerance_rad: f64,
    /// Following error of any joint at which the driver gives up, whatever the goal's guard, rad.
    pub max_following_error_rad: f64,
    /// Longest deceleration after a stop, s.
    pub stop_ramp_s: f64,
    /// Joint rates below which the arm counts as being at rest, rad/s.
    pub rest_rate_rad_s: f64,
    /// Longest wait for rest after a motion, s.
    pub settle_limit_s: f64,
}

impl Default for DriverDescription {
    fn default() -> Self {
        Self {
            start_tolerance_rad: 2e-3,
            max_following_error_rad: 0.02,
            stop_ramp_s: 0.025,
            rest_rate_rad_s: 2e-5,
            settle_limit_s: 2.0,
        }
    }
}

/// Contact mechanics and the plunger of the contact switch.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ContactDescription {
    /// Natural frequency of a contact, Hz: contacts are springs, and this one lets the tip sink
    /// in by some micrometres.
    pub natural_frequency_hz: f64,
    /// Damping ratio of a contact.
    pub damping_ratio: f64,
    /// Coefficient of friction between instrument and terrain.
    pub friction: f64,
    /// Mass of the plunger, kg; part of the last link's mass.
    pub plunger_mass_kg: f64,
    /// Damping of the plunger, N s/m.
    pub plunger_damping_ns_m: f64,
    /// The switch opens again at so much less travel than it closes at, m.
    pub hysteresis_m: f64,
    /// Radius of the surface patch over which the true normal is averaged, m: the instrument's
    /// footprint.
    pub footprint_m: f64,
}

impl Default for ContactDescription {
    fn default() -> Self {
        Self {
            natural_frequency_hz: 500.0,
            damping_ratio: 1.0,
            friction: 0.6,
            plunger_mass_kg: 0.02,
            plunger_damping_ns_m: 4.0,
            hysteresis_m: 0.0003,
            footprint_m: 0.010,
        }
    }
}

/// Where the fiducial's pattern cannot be seen.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OcclusionDescription {
    /// The pattern is hidden while the true tip is nearer than this to the true surface point of
    /// the target, m.
    pub fiducial_hidden_within_m: f64,
}

/// A pixel of a pair's left image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TargetPixel {
    /// Name of the camera pair.
    pub pair: String,
    /// Column and row in the left image, px.
    pub pixel_px: [f64; 2],
}

/// Faults that the world shows by itself.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FaultsDescription {
    /// A rock vanishes.
    pub rock_vanishes: Option<VanishingRock>,
    /// The contact switch never closes.
    pub switch_dead: bool,
    /// The fiducial's pattern is never visible.
    pub fiducial_hidden: bool,
}

/// A rock that is gone from some moment on.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VanishingRock {
    /// Index of the rock in the terrain.
    pub rock_n: u32,
    /// When it vanishes.
    pub when: Moment,
}

/// A moment of a run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Moment {
    /// At this simulated time, s.
    AtTimeS(f64),
    /// When the arm starts its first motion.
    FirstArmMotion,
}
