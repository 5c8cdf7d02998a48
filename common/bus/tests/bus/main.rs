//! The bus against real Zenoh sessions on loopback.
//!
//! Guarantees: happy paths in both encodings; every bad payload gets a typed refusal and the
//! server lives on; heartbeats, cancels and goals are repeatable; nobody waits for a peer that is
//! gone; services do not see the simulator's keys; a plain Zenoh client can do everything.
#![allow(clippy::unwrap_used, clippy::expect_used, missing_docs)]

mod actions;
mod foreign;
mod interruptions;
mod network;
mod presence;
mod queries;
mod refusals;
mod streams;
mod support;
