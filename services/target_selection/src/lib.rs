//! Target selection: from one pixel to a place on a surface, or to the reason why nothing can be
//! placed there (the paper's section 3, target designation).
//!
//! The pixel is matched in the other image, the point triangulated and a plane fitted to its
//! surroundings ([`target_at`]); the arm must be able to touch it along its normal
//! ([`check_reach`]). [`serve`] puts both on the network.

mod select;
mod service;

pub use select::{STANDOFF_M, TRAVEL_BEYOND_M, check_pixel, check_reach, is_distant, target_at};
pub use service::serve;

/// Name under which the service raises its faults.
const SERVICE: &str = rover_messages::keys::service::TARGET_SELECTION;
