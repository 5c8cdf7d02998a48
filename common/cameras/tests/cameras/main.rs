//! The camera models against references that share no code with them.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod cahvore;
mod calibration;
mod calibration_quality;
mod common;
mod conversion;
mod conversion_fit;
mod foreign_files;
mod formats;
mod models;
mod reference;
mod round_trip;
mod stereo;
