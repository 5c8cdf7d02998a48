//! The servo's estimator and the methods that it drives, against perturbed robots.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod driven;
mod estimator;
mod support;
