//! The runner: scenarios, launching simulator and services, the mission, reports.
//!
//! The `rover` binary is a thin command line over this library; tests drive the library directly.
//!
//! | module | question it answers |
//! |---|---|
//! | [`scenario`] | what is to be done, in which world |
//! | [`launch`] | how do simulator and services come up, and down again |
//! | [`placement`] | what happens in which order |
//! | [`report`] | what did the run come to |
//! | [`campaign`] | what do many runs come to |
//! | [`html`] | how does a person see it |
//! | [`rover_study`] | what does the method achieve, and the others |
//! | [`tables`] | how do numbers come in from files and go out again |
//! | [`registry`] | what is this payload on the network |

pub mod campaign;
pub mod commands;
pub mod embedded;
pub mod evidence;
pub mod html;
pub mod launch;
pub mod output;
pub mod placement;
pub mod progress;
pub mod registry;
pub mod report;
pub mod scenario;
pub mod tables;
