//! Actions: work that takes time, can be watched and can be called off.
//!
//! Five keys for an action on `K`: `K` takes the goal, `K/beat` the heartbeats, `K/cancel` and
//! `K/result` what they say, `K/feedback` is a stream. All answers are a [`Progress`].
//! - One goal at a time; another one is refused as `busy`.
//! - Ids make everything repeatable: a goal sent twice is answered from memory, a heartbeat with
//!   the same number grants one period, a cancel that overtakes its goal is remembered.
//! - The commander must be present, and the goal is interrupted when he is lost.
//! - In lockstep the heartbeat is the clock: one heartbeat grants one period, and is answered
//!   when that period is over. No heartbeat, no time; none within the wall-clock limit is an
//!   interruption of its own.

mod client;
mod context;
mod server;
mod wire;

pub use client::{Canceller, Goal};
pub use context::{GoalContext, Interrupt};
pub use server::ActionPolicy;
pub use wire::{Beat, CancelRequest, GoalRequest, GoalState, Progress, ResultRequest};
