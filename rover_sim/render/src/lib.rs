//! Images of a rover's surroundings on the CPU, without a GPU, a display or a system library.
//!
//! What is drawn: triangle meshes, static and moving, through the exact rays of a CAHV or CAHVOR
//! camera; sixteen coverage samples per pixel; a sun with hard shadows and light from sky and
//! ground; textures with detail in every octave that a pixel resolves; highlights on metal; marked
//! plates by 8x8 samples per pixel; lens blur, photon noise, read noise, eight bits. What is not:
//! penumbrae (half a pixel wide for the sun of Mars at arm's length), reflections, depth of field,
//! motion blur, cameras whose entrance pupil moves.
//!
//! How: triangles are rasterised in three dimensions. A pixel's ray is tabulated once (`optics`);
//! a triangle becomes three planes through the centre of projection (`view`); a sample is covered
//! where its ray is on the inner side of all three (`visibility`), so straight edges come out
//! curved as the lens has them, and nothing needs clipping. Samples of one pixel that see the same
//! surface are shaded together (`resolve`, `shading`, `texture`, `plate`). Shadows are looked up in
//! a frame with the sun overhead, where they are rectangles (`shadow`). Tiles of 32x16 pixels are
//! the unit of work and of what is kept between frames (`frame`). Kernels are written once for
//! eight lanes and run as AVX2 or as plain arrays with the same bits (`simd`).

// lanes and axes index several arrays at once
#![allow(clippy::needless_range_loop)]

mod cast;
#[cfg(test)]
mod coverage_tests;
mod error;
mod frame;
mod geometry;
mod optics;
mod plate;
mod renderer;
mod resolve;
mod scene;
mod sensor;
mod shading;
mod shadow;
pub mod shapes;
mod simd;
#[cfg(target_arch = "x86_64")]
mod simd_avx2;
mod texture;
mod view;
mod visibility;

pub use cast::Hit;
pub use error::{RenderError, SceneError};
pub use renderer::{CameraId, Renderer};
pub use scene::{
    DynamicPart, FrameState, Mesh, Pattern, Plate, Scene, Sky, StaticMesh, Sun, Surface, Texture,
};
pub use sensor::{Grey8, ImagingParameters};
