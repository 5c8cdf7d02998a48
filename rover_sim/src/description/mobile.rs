//! What a scenario says about a world in which a robot drives.

use serde::{Deserialize, Serialize};

/// Where the rover stands at the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RoverStart {
    /// Position of the rover frame's origin, x and y, world frame, m.
    pub position_m: [f64; 2],
    /// Heading from the world's x towards its y, deg.
    pub heading_deg: f64,
}

/// Rocks that a rover can put its instrument on, or must drive around, at random places.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RockField {
    /// How many.
    pub count_n: u32,
    /// Smallest and largest radius, m.
    pub radius_m: [f64; 2],
    /// How deep a rock's centre lies under the ground, fraction of its radius.
    pub buried: f64,
    /// Height of the largest bumps over the radius.
    pub roughness: f64,
    /// Subdivisions of the icosahedron that each is made from.
    pub subdivisions_n: u32,
    /// Radius about the world's origin in which no rock lies, m.
    pub clear_m: f64,
    /// Smallest gap between two rocks, m.
    pub gap_m: f64,
}

impl Default for RockField {
    fn default() -> Self {
        Self {
            count_n: 6,
            radius_m: [0.16, 0.36],
            buried: 0.35,
            roughness: 0.12,
            subdivisions_n: 5,
            clear_m: 1.6,
            gap_m: 0.5,
        }
    }
}

/// How wheels sink in and slip.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SoilDescription {
    /// Resistance of a wheel's own track over its load; the rover knows this mean.
    pub resistance_ratio: f64,
    /// Variation of the slip from place to place, fraction of itself, one sigma.
    pub variation: f64,
    /// Extent of these places, m.
    pub wavelength_m: f64,
    /// Soft patches that the rover does not know of.
    pub soft: Vec<SoftPatch>,
}

impl Default for SoilDescription {
    fn default() -> Self {
        Self {
            resistance_ratio: 0.04,
            variation: 0.3,
            wavelength_m: 0.7,
            soft: Vec::new(),
        }
    }
}

/// A round patch of soft soil.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SoftPatch {
    /// Centre, x and y, world frame, m.
    pub centre_m: [f64; 2],
    /// Radius, m.
    pub radius_m: f64,
    /// Resistance in its inner part over that of firm ground.
    pub factor: f64,
}
