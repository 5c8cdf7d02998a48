//! The simulator: a rapier world with the true arm, its driver and contact switch, the terrain
//! that is both drawn and touched, and the true cameras. Nothing outside this crate knows the
//! truth; on the bus it can be asked for only under `sim/`.
//!
//! [`World`] is the simulator as a plain value; [`Hardware`] offers it on the bus as the robot's
//! hardware.
//!
//! | module | what it holds |
//! |---|---|
//! | `description` | what a scenario says about the world |
//! | `truth` | the true robot, drawn from a seed |
//! | `terrain`, `facets` | meshes of ground and rocks, and their mean normals |
//! | `arm`, `contact_switch`, `statics` | the multibody, the plunger, droop at rest |
//! | `driver` | trajectories, stops, limits of the motors |
//! | `eyes` | what true cameras see |
//! | `rover` | wheels, slip, odometry, mast: the driving rover |
//! | `standing` | the rover on its springs while the arm works |
//! | `still` | the true robot at rest anywhere, without physics, for studies |
//! | `world`, `score` | all of it together, and a placement against the truth |
//! | `hardware` | the keys on the bus |

mod arm;
mod check;
mod contact_switch;
mod convert;
mod description;
mod driver;
mod error;
mod eyes;
mod facets;
pub mod hardware;
mod rover;
mod score;
mod standing;
mod statics;
mod still;
mod terrain;
#[cfg(test)]
mod tests;
mod truth;
mod world;

pub use arm::{ArmModel, ArmPhysics, Contacts, StaticSurface, TipContact};
pub use description::{
    ContactDescription, DriverDescription, FaultsDescription, ImageDescription, IntrinsicsError,
    Moment as FaultMoment, OcclusionDescription, RockDescription, RockField, RoverStart,
    ScatteredRocks, SimulationDescription, SoftPatch, SoilDescription, SunDescription, TargetPixel,
    TerrainDescription, TruthDescription, VanishingRock,
};
pub use error::SimulationError;
pub use eyes::{Eyes, Moment, SurfacePoint};
pub use hardware::Hardware;
pub use standing::Standing;
pub use statics::{drooped_angles_rad, gravity_torques_nm};
pub use still::{StillArm, StillWorld};
pub use terrain::Terrain;
pub use truth::{TruePair, Truth, disturbed_camera};
pub use world::{Advance, Collision, Touch, World};
