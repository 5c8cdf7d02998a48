//! Streams, queries and actions over Zenoh.
//!
//! A [`Peer`] is one Zenoh session with a name. On it:
//! - a **stream** is published on its key and answers a query on the same key with the latest
//!   value ([`Peer::stream`], [`Peer::watch`], [`Peer::latest`]);
//! - a **query** is one question with one answer or one [`Fault`](rover_messages::Fault)
//!   ([`Peer::serve`], [`Peer::ask`]);
//! - an **action** is a goal with feedback, result and cancel ([`Peer::serve_action`],
//!   [`Peer::command`]); in lockstep its clock is the commander's heartbeat;
//! - **presence** is a liveliness token by which peers find and lose each other
//!   ([`Peer::announce`], [`Peer::await_presence`]).
//!
//! Services write bincode to each other. A question in JSON, or without payload, is answered in
//! JSON, refusals included, so that any Zenoh tool can take part. A payload that is malformed, too
//! large or of another version is answered with a fault and changes nothing.
//!
//! Nothing here blocks inside a Zenoh callback, waits by polling, or runs a handler for a query
//! with wildcards: those read streams only.

mod action;
mod config;
mod error;
mod exchange;
mod peer;
mod presence;
mod query;
mod stream;

pub use action::{
    ActionPolicy, Beat, CancelRequest, Canceller, Goal, GoalContext, GoalRequest, GoalState,
    Interrupt, Progress, ResultRequest,
};
pub use config::{CONNECT_LIMIT, LEASE, MAX_MESSAGE_BYTES, NetworkConfig, Role};
pub use error::BusError;
pub use peer::Peer;
pub use presence::{Presence, PresenceWatcher};
pub use query::Served;
pub use stream::{PictureStream, RawSample, RawWatcher, Stream, Watcher};
