//! Approach to a designated target: keep it in sight, drive to it, choose where to stand, hand it
//! over to the body cameras.
//!
//! The algorithm files know no bus and no clock. `track` finds the target again in each new image
//! (`warp`, `patch`, `align`, `surface`, `relief`), `filter` carries its position, `first_ray` meets
//! the ray first designated with the near map, `handover` goes over to the body pair; `obstacles`
//! and `drive` find the way, `base_pose` the place to stand, out of the rover's own shadow (`shade`). `service` puts them on the bus; without the feature
//! `bus` the algorithms build alone.

// `!(x >= limit)` refuses a NaN as well, which `x < limit` would let through
#![allow(clippy::neg_cmp_op_on_partial_ord)]

pub mod align;
pub mod anchor;
pub mod base_pose;
#[cfg(feature = "bus")]
mod budget;
pub mod drive;
pub mod egomotion;
pub mod error;
pub mod filter;
pub mod first_ray;
pub mod fix;
pub mod handover;
#[cfg(feature = "bus")]
mod hardware;
pub mod obstacles;
pub mod own_shadow;
pub mod patch;
pub mod relief;
#[cfg(feature = "bus")]
mod report;
#[cfg(feature = "bus")]
pub mod service;
#[cfg(feature = "bus")]
mod session;
pub mod shade;
pub mod surface;
pub mod track;
pub mod view;
pub mod warp;
