//! What every service tells about itself.

use crate::{Fault, wire};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// A service's state, published on `<service>/status`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ServiceStatus {
    /// The service's name.
    pub service: String,
    /// What it is doing: `ready`, or the name of its activity.
    pub state: String,
    /// The last fault it raised.
    pub last_fault: Option<Fault>,
    /// What it has counted since its start.
    pub counters: BTreeMap<String, u64>,
    /// Wall time that it has computed since its start, by kind (see [`work`]), s. It says where
    /// time goes and nothing of what was done.
    pub busy_s: BTreeMap<String, f64>,
    /// SHA-256 of the effective robot description.
    pub configuration_sha256: String,
    /// Version of the build.
    pub version: String,
}

/// A fault with what was done about it, published on `fault/<service>`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FaultReport {
    /// The fault.
    pub fault: Fault,
    /// What was done, e.g. `goal refused`, `arm stopped`.
    pub action: String,
}

/// Kinds of computing.
pub mod work {
    /// Steps of the simulated world.
    pub const PHYSICS: &str = "physics";
    /// Pictures of the simulated world.
    pub const RENDERING: &str = "rendering";
    /// Finding, matching, tracking in images.
    pub const VISION: &str = "vision";
    /// Ways of arm and rover.
    pub const PLANNING: &str = "planning";
    /// What is left of a run's wall time: messages on their way, waiting, bookkeeping.
    pub const BUS: &str = "bus";
}

wire! { ServiceStatus = "service_status/2", FaultReport = "fault_report/1" }
