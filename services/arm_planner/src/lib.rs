//! Arm planning: collision-free motions of the arm to postures, joint angles and tool poses, and
//! straight lines of the instrument's tip.
//!
//! The algorithm ([`Planner`]) is pure; [`serve`] puts it on the network. What it knows of the
//! surroundings is a map of heights made from one stereo frame ([`TerrainMap`]), the robot's own
//! shape, and the stated quality of its model ([`Margins`]).

pub mod collision;
mod leg;
mod plan;
mod search;
pub mod segment;
mod service;
mod straight;
pub mod terrain_map;
pub mod visibility;

pub use collision::{CollisionModel, ContactZone, Margins};
pub use plan::Planner;
pub use service::serve;
pub use terrain_map::{MapError, MapRules, TerrainMap};

/// Name under which the planner raises its faults.
const SERVICE: &str = rover_messages::keys::service::ARM_PLANNER;
