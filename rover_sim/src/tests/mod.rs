//! Tests of the simulator's parts against theory and against each other.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod physics;
mod support;
mod truth;
mod world;
