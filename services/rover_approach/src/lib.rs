//! Approach to a designated target: keep it in sight, drive to it, hand it over to the body
//! cameras.
//!
//! The algorithm files know no bus and no clock: `track` finds the target again in each new image
//! (`warp`, `patch`, `align`, `surface`, `relief`).

// `!(x >= limit)` refuses a NaN as well, which `x < limit` would let through
#![allow(clippy::neg_cmp_op_on_partial_ord)]

pub mod align;
pub mod error;
pub mod filter;
pub mod first_ray;
pub mod handover;
pub mod patch;
pub mod relief;
pub mod surface;
pub mod track;
pub mod view;
pub mod warp;
