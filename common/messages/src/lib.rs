//! The wire: every message, key and encoding that peers share.
//!
//! A message is a plain struct that implements [`Wire`]: it has a schema name with a version and
//! checks its own meaning after decoding. Services speak bincode to each other; any other client
//! may speak JSON ([`codec`]). The keys are in [`keys`]; all of them lie inside the robot's
//! namespace. Positions are metres in the rover frame unless the field says otherwise, angles
//! radians, times simulated seconds.

pub mod approach;
pub mod arm;
pub mod codec;
pub mod imaging;
pub mod keys;
pub mod mobility;
pub mod panorama;
pub mod placement;
pub mod planning;
pub mod simulation;
pub mod status;
pub mod target;
pub mod wire;

pub use wire::{Fault, Nothing, Wire};
