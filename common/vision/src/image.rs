//! Grey images: 8-bit as cameras give them, `f32` for working copies, files in and out.
//!
//! Pixel (0, 0) is the centre of the first pixel, u to the right, v down; rows are stored one
//! after the other from the top.

use std::path::{Path, PathBuf};

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use rover_files::FileError;

/// Largest width or height accepted from a file, px.
pub const MAX_SIDE_PX: u32 = 16_384;

/// Why an image could not be made, read or written.
#[derive(Debug, thiserror::Error)]
pub enum ImageError {
    /// The number of pixel values does not belong to the stated size.
    #[error(
        "an image of {width_px} x {height_px} px has {expected} pixels, got {found} pixel values"
    )]
    WrongLength {
        /// Stated width, px.
        width_px: u32,
        /// Stated height, px.
        height_px: u32,
        /// Width times height.
        expected: u64,
        /// Length of the pixel buffer.
        found: usize,
    },
    /// The image has no pixels, or more than [`MAX_SIDE_PX`] on a side.
    #[error("an image side must be 1 to {MAX_SIDE_PX} px, got {width_px} x {height_px} px")]
    BadSize {
        /// Stated width, px.
        width_px: u32,
        /// Stated height, px.
        height_px: u32,
    },
    /// The data are no picture of a supported format, or damaged.
    #[error("not a readable picture: {0}")]
    Decode(String),
    /// The PNG encoder refused.
    #[error("the image could not be written as PNG: {0}")]
    Encode(String),
    /// The file could not be read or written.
    #[error("{path}: {source}")]
    File {
        /// The file.
        path: PathBuf,
        /// What the operating system said.
        source: FileError,
    },
    /// The file was read, its content is not usable.
    #[error("{path}: {source}")]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong with the content.
        source: Box<ImageError>,
    },
}

/// A grey image with 8 bits per pixel (0 black, 255 white).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image8 {
    /// Width, px.
    pub width_px: u32,
    /// Height, px.
    pub height_px: u32,
    /// Grey values row by row; `width_px * height_px` of them.
    pub pixels: Vec<u8>,
}

fn check_size(width_px: u32, height_px: u32, found: usize) -> Result<(), ImageError> {
    let side = 1..=MAX_SIDE_PX;
    if !side.contains(&width_px) || !side.contains(&height_px) {
        return Err(ImageError::BadSize {
            width_px,
            height_px,
        });
    }
    let expected = u64::from(width_px) * u64::from(height_px);
    if expected != found as u64 {
        return Err(ImageError::WrongLength {
            width_px,
            height_px,
            expected,
            found,
        });
    }
    Ok(())
}

impl Image8 {
    /// An image from its grey values, row by row from the top.
    ///
    /// # Errors
    /// [`ImageError::BadSize`] or [`ImageError::WrongLength`].
    pub fn from_raw(width_px: u32, height_px: u32, pixels: Vec<u8>) -> Result<Self, ImageError> {
        check_size(width_px, height_px, pixels.len())?;
        Ok(Self {
            width_px,
            height_px,
            pixels,
        })
    }

    /// Checks that the pixel buffer belongs to the size (the fields are public).
    ///
    /// # Errors
    /// [`ImageError::BadSize`] or [`ImageError::WrongLength`].
    pub fn validate(&self) -> Result<(), ImageError> {
        check_size(self.width_px, self.height_px, self.pixels.len())
    }

    /// The grey value at column `u`, row `v`; `None` outside the image.
    #[must_use]
    pub fn get(&self, u: u32, v: u32) -> Option<u8> {
        if u < self.width_px && v < self.height_px {
            self.pixels
                .get(v as usize * self.width_px as usize + u as usize)
                .copied()
        } else {
            None
        }
    }

    /// Decodes a picture as [`crate::picture::decode`] does.
    ///
    /// # Errors
    /// As [`crate::picture::decode`].
    pub fn decode(bytes: &[u8]) -> Result<Self, ImageError> {
        crate::picture::decode(bytes).map(|decoded| decoded.image)
    }

    /// Reads a picture file, see [`Image8::decode`].
    ///
    /// # Errors
    /// [`ImageError::File`] or [`ImageError::Content`] naming the file.
    pub fn read(path: &Path) -> Result<Self, ImageError> {
        let bytes = std::fs::read(path).map_err(|source| ImageError::File {
            path: path.to_path_buf(),
            source: source.into(),
        })?;
        Self::decode(&bytes).map_err(|source| ImageError::Content {
            path: path.to_path_buf(),
            source: Box::new(source),
        })
    }

    /// Writes the image as a PNG file.
    ///
    /// # Errors
    /// [`ImageError::Encode`] or [`ImageError::File`].
    pub fn write_png(&self, path: &Path) -> Result<(), ImageError> {
        std::fs::write(path, encode_png(self)?).map_err(|source| ImageError::File {
            path: path.to_path_buf(),
            source: FileError::writing(source),
        })
    }
}

/// The image as the bytes of a grey 8-bit PNG file (fast compression).
///
/// # Errors
/// [`ImageError`] if the buffer does not belong to the size or the encoder refuses.
pub fn encode_png(image: &Image8) -> Result<Vec<u8>, ImageError> {
    image.validate()?;
    let mut bytes = Vec::with_capacity(image.pixels.len() / 2 + 1024);
    PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Up)
        .write_image(
            &image.pixels,
            image.width_px,
            image.height_px,
            ExtendedColorType::L8,
        )
        .map_err(|e| ImageError::Encode(e.to_string()))?;
    Ok(bytes)
}

/// A working copy with `f32` grey values.
#[derive(Clone, Debug, PartialEq)]
pub struct ImageF {
    width: usize,
    height: usize,
    values: Vec<f32>,
}

impl ImageF {
    /// An image from its values, row by row from the top.
    ///
    /// # Errors
    /// [`ImageError::BadSize`] or [`ImageError::WrongLength`].
    pub fn from_raw(width_px: u32, height_px: u32, values: Vec<f32>) -> Result<Self, ImageError> {
        check_size(width_px, height_px, values.len())?;
        Ok(Self {
            width: width_px as usize,
            height: height_px as usize,
            values,
        })
    }

    /// A copy of an 8-bit image.
    ///
    /// # Errors
    /// [`ImageError`] if the buffer does not belong to the size.
    pub fn from_image8(image: &Image8) -> Result<Self, ImageError> {
        image.validate()?;
        Ok(Self {
            width: image.width_px as usize,
            height: image.height_px as usize,
            values: image.pixels.iter().map(|&p| f32::from(p)).collect(),
        })
    }

    pub(crate) fn from_parts(width: usize, height: usize, values: Vec<f32>) -> Self {
        debug_assert_eq!(values.len(), width * height);
        Self {
            width,
            height,
            values,
        }
    }

    /// Width, px.
    #[must_use]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height, px.
    #[must_use]
    pub fn height(&self) -> usize {
        self.height
    }

    /// All values, row by row.
    #[must_use]
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// One row of values; empty if there is no such row.
    #[must_use]
    pub fn row(&self, v: usize) -> &[f32] {
        self.values
            .get(v * self.width..(v + 1) * self.width)
            .unwrap_or(&[])
    }

    /// The image rounded and clamped to 8 bits.
    #[must_use]
    pub fn to_image8(&self) -> Image8 {
        Image8 {
            width_px: self.width as u32,
            height_px: self.height as u32,
            pixels: self
                .values
                .iter()
                .map(|&x| x.round().clamp(0.0, 255.0) as u8)
                .collect(),
        }
    }

    /// Half the size: every pixel is the mean of 2 x 2. Pixel `i` of the result has its centre at
    /// `2 i + 0.5`. `None` if a side is shorter than 2 px.
    #[must_use]
    pub fn half(&self) -> Option<Self> {
        let (width, height) = (self.width / 2, self.height / 2);
        if width == 0 || height == 0 {
            return None;
        }
        let mut values = Vec::with_capacity(width * height);
        for v in 0..height {
            let (upper, lower) = (self.row(2 * v), self.row(2 * v + 1));
            values.extend(
                upper
                    .chunks_exact(2)
                    .zip(lower.chunks_exact(2))
                    .map(|(a, b)| (a[0] + a[1] + b[0] + b[1]) * 0.25),
            );
        }
        Some(Self {
            width,
            height,
            values,
        })
    }

    /// The image and its halvings, at most `levels` images, the largest first.
    #[must_use]
    pub fn pyramid(self, levels: usize) -> Vec<Self> {
        let mut all = vec![self];
        while all.len() < levels {
            match all.last().and_then(Self::half) {
                Some(next) => all.push(next),
                None => break,
            }
        }
        all
    }

    /// Smoothed by a Gaussian of standard deviation `sigma_px` (kernel cut at 4 sigma, borders
    /// repeated). A `sigma_px` of zero or less gives a plain copy.
    #[must_use]
    pub fn blurred(&self, sigma_px: f64) -> Self {
        if sigma_px.is_nan() || sigma_px <= 0.0 {
            return self.clone();
        }
        self.convolved_separable(&gaussian_kernel(sigma_px))
    }

    /// Convolved in both directions with a symmetric kernel given by its centre and right half
    /// (`half_kernel[0]` is the centre); borders are repeated.
    pub(crate) fn convolved_separable(&self, half_kernel: &[f32]) -> Self {
        let (w, h, radius) = (self.width, self.height, half_kernel.len() - 1);
        let centre = half_kernel[0];
        let mut across = vec![0.0f32; w * h];
        let mut padded = vec![0.0f32; w + 2 * radius];
        for v in 0..h {
            let row = self.row(v);
            padded[..radius].fill(row[0]);
            padded[radius..radius + w].copy_from_slice(row);
            padded[radius + w..].fill(row[w - 1]);
            let out = &mut across[v * w..(v + 1) * w];
            for (o, &x) in out.iter_mut().zip(row) {
                *o = centre * x;
            }
            for (k, &weight) in half_kernel.iter().enumerate().skip(1) {
                let left = &padded[radius - k..radius - k + w];
                let right = &padded[radius + k..radius + k + w];
                for ((o, &a), &b) in out.iter_mut().zip(left).zip(right) {
                    *o += weight * (a + b);
                }
            }
        }
        let mut values = vec![0.0f32; w * h];
        for v in 0..h {
            let out = &mut values[v * w..(v + 1) * w];
            for (o, &x) in out.iter_mut().zip(&across[v * w..(v + 1) * w]) {
                *o = centre * x;
            }
            for (k, &weight) in half_kernel.iter().enumerate().skip(1) {
                let (up, down) = (v.saturating_sub(k), (v + k).min(h - 1));
                let (up, down) = (
                    &across[up * w..(up + 1) * w],
                    &across[down * w..(down + 1) * w],
                );
                for ((o, &a), &b) in out.iter_mut().zip(up).zip(down) {
                    *o += weight * (a + b);
                }
            }
        }
        Self {
            width: w,
            height: h,
            values,
        }
    }
}

/// Centre and right half of a Gaussian kernel that sums to 1.
fn gaussian_kernel(sigma_px: f64) -> Vec<f32> {
    let radius = (4.0 * sigma_px).ceil().clamp(1.0, 200.0) as usize;
    let raw: Vec<f64> = (0..=radius)
        .map(|k| (-0.5 * (k as f64 / sigma_px).powi(2)).exp())
        .collect();
    let sum = raw[0] + 2.0 * raw[1..].iter().sum::<f64>();
    raw.iter().map(|x| (x / sum) as f32).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    fn ramp() -> Image8 {
        Image8::from_raw(5, 3, (0..15).map(|i| i * 16).collect()).unwrap()
    }

    #[test]
    fn a_buffer_of_the_wrong_length_is_refused_with_both_lengths() {
        let text = Image8::from_raw(4, 4, vec![0; 15]).unwrap_err().to_string();
        assert!(text.contains("16") && text.contains("15"), "{text}");
        assert!(matches!(
            Image8::from_raw(0, 4, vec![]),
            Err(ImageError::BadSize { .. })
        ));
    }

    #[test]
    fn png_and_pgm_round_trip_exactly() {
        let image = ramp();
        assert_eq!(Image8::decode(&encode_png(&image).unwrap()).unwrap(), image);
        let mut pgm = b"P5\n5 3\n255\n".to_vec();
        pgm.extend(&image.pixels);
        assert_eq!(Image8::decode(&pgm).unwrap(), image);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("ramp.png");
        image.write_png(&path).unwrap();
        assert_eq!(Image8::read(&path).unwrap(), image);
    }

    #[test]
    fn a_missing_file_is_named() {
        let text = Image8::read(Path::new("/nowhere/x.png"))
            .unwrap_err()
            .to_string();
        assert!(text.contains("/nowhere/x.png"), "{text}");
    }

    #[test]
    fn halving_takes_means_and_blurring_keeps_the_sum_of_a_dot() {
        let image = ImageF::from_image8(&ramp()).unwrap();
        let half = image.half().unwrap();
        assert_eq!((half.width(), half.height()), (2, 1));
        assert_eq!(half.values()[0], (0.0 + 16.0 + 80.0 + 96.0) / 4.0);
        let mut dot = vec![0.0; 41 * 41];
        dot[20 * 41 + 20] = 1000.0;
        let blurred = ImageF::from_raw(41, 41, dot).unwrap().blurred(1.5);
        let sum: f32 = blurred.values().iter().sum();
        assert!((sum - 1000.0).abs() < 0.05);
        let second: f32 = (0..41 * 41)
            .map(|i| blurred.values()[i] * ((i % 41) as f32 - 20.0).powi(2))
            .sum::<f32>()
            / sum;
        assert!((second - 2.25).abs() < 0.01, "{second}");
    }
}
