//! Camera models of the CAHV family, rays, and stereo triangulation.
//!
//! # Conventions
//!
//! - **Pixels** are `(u, v)`, u to the right and v down; (0, 0) is the *centre* of the first pixel,
//!   so the image covers `[-0.5, width - 0.5] x [-0.5, height - 0.5]` and the centre of a 640 x 480
//!   image is (319.5, 239.5). Tools that put the origin at the corner of the first pixel give
//!   values larger by 0.5.
//! - **Frames**: a model's vectors, the points that go in and the rays that come out are all in one
//!   frame, which the holder of the model names; in this project the rover frame (x forward, y
//!   left, z up, metres). [`Camera::transformed`] changes it.
//! - **Camera axes**, where they are spoken of: x right, y down, z forward along A.
//! - Everything is `f64`; angles are radians, but degrees in the text of errors.
//!
//! # Models
//!
//! | model | vectors | a point at `d = P - C` is imaged at |
//! |---|---|---|
//! | [`Cahv`] | C A H V | `u = d.H / d.A`, `v = d.V / d.A` |
//! | [`Cahvor`] | C A H V O R | the same, of `d + mu l`: `l = d - (d.O) O`, `tau = l.l / (d.O)^2`, `mu = r0 + r1 tau + r2 tau^2` |
//! | [`Cahvore`] | C A H V O R E, linearity | as CAHVOR, but about an entrance pupil that moves along O, and with a projection of angles between perspective and fisheye |
//!
//! C is the projection centre, A the unit normal of the image plane,
//! `H = hs H' + hc A` and `V = vs V' + vc A` with the unit vectors H' (right) and V' (down) in the
//! image plane, the focal lengths hs, vs and the boresight's pixel (hc, vc). O is the unit optical
//! axis about which the lens distorts, R its coefficients. [`Camera::intrinsics`] takes a model
//! apart into these terms; [`Camera::pinhole`] and [`Camera::pinhole_distorted`] put one together.
//!
//! # What is promised
//!
//! - Pixels agree with the JPL library (cmod) within 1e-9 px, rays within 1e-12, on every reference
//!   vector of the flight models in `tests/data`.
//! - Derivatives are exact, not differences. (The JPL library's own derivative of a CAHVOR ray is
//!   an approximation, off by up to 0.3 % on flight models; that of ours is the inverse of the
//!   projection's to 1e-11.)
//! - Pixel to ray to point to pixel returns within 1e-9 px if O is of unit length; for published
//!   vectors of six digits see [`Camera::ray`] and [`Camera::with_unit_axes`].
//! - A distortion polynomial describes a lens only up to the angle where it stops rising; beyond,
//!   far-off points would fold back into the image. Such points and pixels are refused
//!   ([`CameraError::OutsideField`]), as is everything behind the camera or not finite. No answer
//!   is ever NaN.
//! - Nothing in projection, ray or triangulation allocates.
//!
//! # Example
//!
//! The camera pair of the EPEC paper: 8 cm baseline, 45 degrees down, 2.8 mm lens, 640 x 480
//! pixels of 4.65 um.
//!
//! ```
//! use nalgebra::{Isometry3, Matrix2, Translation3, UnitQuaternion, Vector3};
//! use rover_cameras::{Camera, MissLimit, StereoPair};
//!
//! // Camera axes in the rover frame: z forward and down; y, image down, backward and down; so
//! // that x, image right, is the rover's right (-y).
//! let rover_from_camera = UnitQuaternion::face_towards(
//!     &Vector3::new(1.0, 0.0, -1.0),
//!     &Vector3::new(-1.0, 0.0, -1.0),
//! );
//! let camera = |y_m: f64| {
//!     let pose = Isometry3::from_parts(Translation3::new(0.2, y_m, 0.6), rover_from_camera);
//!     Camera::pinhole(&pose, [602.15; 2], [319.5, 239.5], [640, 480])
//! };
//! let pair = StereoPair { left: camera(0.04), right: camera(-0.04) };
//! pair.validate()?;
//!
//! let target = Vector3::new(0.6, 0.02, 0.2);
//! let left_px = pair.left.project(&target)?;
//! let right_px = pair.right.project(&target)?;
//! assert!(pair.left.contains(&left_px, 10.0));
//!
//! // 0.1 px of noise in each coordinate of each image.
//! let noise = Matrix2::identity() * 0.01;
//! let (seen, covariance) =
//!     pair.triangulate_with_covariance(&left_px, &right_px, &noise, &noise)?;
//! seen.check_miss(&MissLimit::default())?;
//! assert!((seen.point - target).norm() < 1e-12);
//! assert!(covariance.trace().sqrt() < 1.5e-3);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # References
//!
//! 1. Y. Yakimovsky, R. Cunningham, "A system for extracting three-dimensional measurements from a
//!    stereo pair of TV cameras", Computer Graphics and Image Processing 7, 1978 (CAHV).
//! 2. D. B. Gennery, "Least-squares camera calibration including lens distortion and automatic
//!    editing of calibration points", in Calibration and Orientation of Cameras in Computer Vision,
//!    2001 (CAHVOR).
//! 3. D. B. Gennery, "Generalized camera calibration including fish-eye lenses", International
//!    Journal of Computer Vision 68, 2006 (CAHVORE).
//! 4. T. Litwin, cmod, the JPL camera model library, in NASA-AMMOS/VICAR, `vos/p2/sub/cahvor`.

// `!(x > limit)` is meant: a NaN has to take the branch of the error.
#![allow(clippy::neg_cmp_op_on_partial_ord)]

mod cahv;
mod cahvor;
mod cahvore;
pub mod calibration;
mod camera;
mod error;
pub mod formats;
mod intrinsics;
mod least_squares;
mod linear;
mod pupil;
mod radial;
mod stereo;
mod window;

pub use cahv::Cahv;
pub use cahvor::Cahvor;
pub use cahvore::Cahvore;
pub use camera::{Camera, CameraModel, Projection, Ray, RayJacobians};
pub use error::CameraError;
pub use intrinsics::Intrinsics;
pub use stereo::{MissLimit, Side, StereoPair, Triangulation, TriangulationError, closest_point};
