//! Guarded motion along the target's normal until the contact switch closes (paper, section 3
//! *Instrument Contact*): `guarded_move` is the motion as plain values, `service` puts it on the
//! bus.

pub mod guarded_move;
mod service;

pub use service::serve;
