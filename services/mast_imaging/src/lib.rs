//! Stereo frames: raw pairs from the cameras with the camera models that belong to them (the
//! paper's section 3, image acquisition), and the images as pictures for anybody to look at.
//!
//! [`attach_models`] is the pure part; [`serve`] puts it on the network.

mod frame;
pub mod panorama;
mod service;

pub use frame::attach_models;
pub use service::serve;

/// Name under which the service raises its faults.
const SERVICE: &str = rover_messages::keys::service::MAST_IMAGING;
