//! The system as its users meet it: the `rover` command and the network.
#![allow(clippy::unwrap_used, clippy::expect_used, missing_docs)]

mod campaign;
mod command;
mod faults;
mod foreign_client;
mod placement;
mod single_cycle;
