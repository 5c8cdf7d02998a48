//! Speed of the physics and of whole control steps.
fn main() {}
