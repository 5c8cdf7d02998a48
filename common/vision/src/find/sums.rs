//! The normal equations of a shape's fit, summed up over the pixels of its window.

use nalgebra::DMatrix;

use super::NoFinding;
use super::pixels::{PixelModel, SATURATION_DN};
use crate::image::Image8;

/// Linear parameters beside the shape's: slope of light in u and v, value, one.
pub(super) const LINEAR: usize = 4;

/// Brightness by which light multiplies: the model's image in units of its own mean size.
#[derive(Clone, Copy, Debug)]
pub(super) struct Brightness {
    pub offset: f64,
    pub gain: f64,
}

/// Normal equations over the window: `N` slopes, deformations if asked for, the slope of light in u
/// and v, value, one, and the grey value last.
pub(super) struct Sums {
    pub matrix: DMatrix<f64>,
    /// Fraction of the pixels that are clipped.
    pub saturated: f64,
    /// Number of pixels.
    pub counted: f64,
}

/// Pixels of the window around the centre, if it lies inside the image.
fn window_of<const N: usize>(
    image: &Image8,
    model: &impl PixelModel<N>,
    p: &[f64; N],
) -> Result<[std::ops::RangeInclusive<usize>; 2], NoFinding> {
    let reach = model.reach(p);
    let fits = |x: f64, size: u32| x - reach >= 0.0 && x + reach <= f64::from(size) - 1.0;
    if !(fits(p[0], image.width_px) && fits(p[1], image.height_px)) {
        return Err(NoFinding::OutsideImage {
            u_px: p[0],
            v_px: p[1],
        });
    }
    let range = |x: f64| (x - reach).ceil() as usize..=(x + reach).floor() as usize;
    Ok([range(p[0]), range(p[1])])
}

/// One pixel's column of the design matrix without the grey value; its weight.
#[inline(always)]
fn design<const N: usize, M: PixelModel<N>>(
    model: &M,
    (p, shared): (&[f64; N], &M::Shared),
    light: Brightness,
    deformations: usize,
    (u, v): (usize, usize),
    column: &mut [f64],
) -> f64 {
    let (u, v) = (u as f64, v as f64);
    let mut slopes = [0.0; N];
    let (value, weight) = model.at(shared, u, v, &mut slopes);
    if !(weight > 0.0) {
        return 0.0;
    }
    column[..N].copy_from_slice(&slopes);
    let k = N + deformations;
    if deformations > 0 {
        column[N..k].fill(0.0);
        model.deform(p, u, v, &mut column[N..k]);
    }
    let brightness = light.offset + light.gain * value;
    column[k] = (u - p[0]) * brightness;
    column[k + 1] = (v - p[1]) * brightness;
    column[k + 2] = value;
    column[k + 3] = 1.0;
    weight
}

/// Sums over the window around the parameters' centre.
pub(super) fn accumulate<const N: usize, M: PixelModel<N>>(
    image: &Image8,
    model: &M,
    p: &[f64; N],
    light: Brightness,
    deformations: usize,
) -> Result<Sums, NoFinding> {
    let window = window_of(image, model, p)?;
    if deformations == 0 && N + LINEAR < SMALL {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            return Ok(unsafe { accumulate_avx2(image, model, p, light, window) });
        }
        return Ok(accumulate_small(image, model, p, light, window));
    }
    let [columns, rows] = window;
    let size = N + deformations + LINEAR;
    let shared = model.shared(p);
    let mut sums = vec![0.0; (size + 1) * (size + 1)];
    let mut column = vec![0.0; size + 1];
    let (mut saturated, mut counted) = (0.0, 0.0);
    for v in rows {
        let row = &image.pixels[v * image.width_px as usize..][..image.width_px as usize];
        for u in columns.clone() {
            let at = (p, &shared);
            let weight = design(model, at, light, deformations, (u, v), &mut column[..size]);
            if weight == 0.0 {
                continue;
            }
            counted += 1.0;
            saturated += f64::from(u8::from(row[u] >= SATURATION_DN));
            column[size] = f64::from(row[u]);
            // the lower triangle, column by column
            let mut start = 0;
            for (i, &x) in column.iter().enumerate() {
                let weighted = weight * x;
                let end = start + size + 1;
                for (m, &y) in sums[start + i..end].iter_mut().zip(&column[i..]) {
                    *m += weighted * y;
                }
                start = end;
            }
        }
    }
    let mut matrix = DMatrix::from_vec(size + 1, size + 1, sums);
    matrix.fill_upper_triangle_with_lower_triangle();
    Ok(Sums {
        matrix,
        saturated: saturated / f64::max(counted, 1.0),
        counted,
    })
}

/// Most columns of a design matrix that is summed up in arrays of fixed length.
const SMALL: usize = 12;

/// [`accumulate_small`] with wider vectors.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn accumulate_avx2<const N: usize, M: PixelModel<N>>(
    image: &Image8,
    model: &M,
    p: &[f64; N],
    light: Brightness,
    window: [std::ops::RangeInclusive<usize>; 2],
) -> Sums {
    accumulate_small(image, model, p, light, window)
}

/// [`accumulate`] without deformations, for fewer than [`SMALL`] columns beside the grey value.
#[inline(always)]
fn accumulate_small<const N: usize, M: PixelModel<N>>(
    image: &Image8,
    model: &M,
    p: &[f64; N],
    light: Brightness,
    [columns, rows]: [std::ops::RangeInclusive<usize>; 2],
) -> Sums {
    let size = N + LINEAR;
    let shared = model.shared(p);
    let mut sums = [[0.0f64; SMALL]; SMALL];
    let mut column = [0.0f64; SMALL];
    let (mut saturated, mut counted) = (0.0, 0.0);
    for v in rows {
        let row = &image.pixels[v * image.width_px as usize..][..image.width_px as usize];
        for u in columns.clone() {
            let weight = design(model, (p, &shared), light, 0, (u, v), &mut column[..size]);
            if weight == 0.0 {
                continue;
            }
            counted += 1.0;
            saturated += f64::from(u8::from(row[u] >= SATURATION_DN));
            column[size] = f64::from(row[u]);
            for (line, &x) in sums[..=size].iter_mut().zip(&column) {
                let weighted = weight * x;
                for (m, &y) in line.iter_mut().zip(&column) {
                    *m += weighted * y;
                }
            }
        }
    }
    // both triangles hold the same products, rounded differently
    let matrix = DMatrix::from_fn(size + 1, size + 1, |i, j| sums[i.min(j)][i.max(j)]);
    Sums {
        matrix,
        saturated: saturated / f64::max(counted, 1.0),
        counted,
    }
}
