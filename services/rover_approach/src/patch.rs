//! Windows of grey values: cut as templates, resampled through a warp at the template's resolution.

use crate::warp::PlaneWarp;
use nalgebra::{Matrix2, Vector2};
use rover_cameras::Camera;
use rover_vision::PreparedImage;

/// Half sizes of a window, px: it reaches from `-half` to `half` in each direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HalfSize {
    /// Across.
    pub u: usize,
    /// Down.
    pub v: usize,
}

impl HalfSize {
    /// Larger by `by` on every side.
    #[must_use]
    pub fn grown(self, by: usize) -> Self {
        Self {
            u: self.u + by,
            v: self.v + by,
        }
    }

    /// Columns.
    #[must_use]
    pub fn columns(self) -> usize {
        2 * self.u + 1
    }

    /// The window's offsets from its middle, px, row by row.
    pub fn offsets(self) -> impl Iterator<Item = Vector2<f64>> {
        let (hu, hv) = (self.u as i64, self.v as i64);
        (-hv..=hv).flat_map(move |v| (-hu..=hu).map(move |u| Vector2::new(u as f64, v as f64)))
    }

    /// Rows.
    #[must_use]
    pub fn rows(self) -> usize {
        2 * self.v + 1
    }
}

/// Grey values on the whole-pixel offsets of a template's window, row by row.
#[derive(Clone, Debug, PartialEq)]
pub struct Patch {
    /// Its half sizes.
    pub half: HalfSize,
    /// `half.columns() * half.rows()` grey values.
    pub values: Vec<f64>,
}

/// Most sub-samples per template pixel and direction.
const MAX_SAMPLES: usize = 10;

impl Patch {
    /// The grey values of `image` that `warp` assigns to the template's pixels, each the mean over
    /// the pixel's footprint; `None` if one leaves the image.
    #[must_use]
    pub fn warped(
        image: &PreparedImage,
        camera: &Camera,
        warp: &PlaneWarp,
        half: HalfSize,
    ) -> Option<Self> {
        let footprint = warp.jacobian(camera)?;
        Self::by_map(image, half, &footprint, |d| warp.pixel(camera, d))
    }

    /// As [`Self::warped`], but any map from template offsets (px) to pixels; `footprint` is its
    /// derivative at the middle.
    pub fn by_map(
        image: &PreparedImage,
        half: HalfSize,
        footprint: &Matrix2<f64>,
        map: impl Fn(&Vector2<f64>) -> Option<Vector2<f64>>,
    ) -> Option<Self> {
        let count = |k: usize| {
            let n = footprint.column(k).norm();
            n.is_finite()
                .then(|| (n.ceil() as usize).clamp(1, MAX_SAMPLES))
        };
        let (nu, nv) = (count(0)?, count(1)?);
        let place = |k: usize, n: usize| (k as f64 + 0.5) / n as f64 - 0.5;
        let offsets: Vec<Vector2<f64>> = (0..nv)
            .flat_map(|j| {
                (0..nu).map(move |i| footprint * Vector2::new(place(i, nu), place(j, nv)))
            })
            .collect();
        let scale = 1.0 / offsets.len() as f64;
        let (hu, hv) = (half.u as i64, half.v as i64);
        let mut values = Vec::with_capacity(half.columns() * half.rows());
        for v in -hv..=hv {
            for u in -hu..=hu {
                let q = map(&Vector2::new(u as f64, v as f64))?;
                let mut sum = 0.0;
                for o in &offsets {
                    sum += f64::from(image.value(q.x + o.x, q.y + o.y)?);
                }
                values.push(sum * scale);
            }
        }
        Some(Self { half, values })
    }

    /// The value at column `i` and row `j` from the top left.
    #[inline]
    #[must_use]
    pub fn at(&self, i: usize, j: usize) -> f64 {
        self.values[j * self.half.columns() + i]
    }
}
