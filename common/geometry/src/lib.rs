//! Rigid geometry with named frames.
//!
//! Conventions (REP-103): metres, radians, right-handed, x forward, y left, z up. A transform is
//! named and typed from right to left: `rover_from_arm_base: Transform<Rover, ArmBase>` takes a
//! point given in the arm base frame to the same point in the rover frame, so
//! `rover_from_tool = rover_from_arm_base * arm_base_from_tool` and the inner names cancel.
//! Quantities of different frames do not mix: the frame is a type parameter.
//!
//! Numerical kernels (kinematics, cameras) work on plain `nalgebra` vectors in one documented
//! frame; the typed wrappers are for the places where frames meet.

mod frame;
mod plane;

pub use frame::{ArmBase, Direction, Frame, Link, MastHead, Point, Rover, Site, Transform, World};
pub use plane::{Plane, PlaneError, tangent_basis};
