//! Pictures of common formats as grey images.

use std::io::Cursor;

use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader};

use crate::image::{Image8, ImageError, MAX_SIDE_PX};

/// What is read, for messages.
const SUPPORTED: &str = "PNG, PNM (PGM, PPM, PBM), JPEG or BMP";
/// Grey levels, of 256, below which a person is told how few a 16-bit picture leaves.
const FEW_LEVELS: u8 = 64;

/// A grey image, and what a person should know about how it was made of the picture.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Decoded {
    /// The image.
    pub image: Image8,
    /// In the order in which things were done.
    pub notes: Vec<PictureNote>,
}

/// Something that was done to a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PictureNote {
    /// The picture says that it is to be shown turned or mirrored, and it was.
    Turned {
        /// Its EXIF orientation, 2 to 8.
        orientation: u8,
    },
    /// A picture of 16 bits uses so little of them that few grey levels are left.
    FewLevels {
        /// The largest grey value, of 65535.
        largest: u16,
        /// The largest grey value left, of 255.
        left: u8,
    },
}

impl std::fmt::Display for PictureNote {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Turned { orientation } => write!(
                f,
                "its EXIF orientation is {orientation}: pixels are those of the picture turned \
                 upright, as viewers show it"
            ),
            Self::FewLevels { largest, left } => write!(
                f,
                "the largest of its 16-bit values is {largest}: 16 bits are taken to 8 by their \
                 full range, which leaves {left} of 255; stretch a picture of fewer bits to 65535 \
                 first"
            ),
        }
    }
}

/// Decodes a PNG, PNM, JPEG or BMP picture to grey of 8 bits, upright as its EXIF orientation says.
///
/// Colour becomes luma `0.2126 R + 0.7152 G + 0.0722 B` of the values as they are stored,
/// transparency is not looked at. 16 bits are rounded to 8 by their full range (`value / 257`), PNM
/// values of less than that by the largest value that the file states.
///
/// # Errors
/// [`ImageError::Decode`] for other formats, which are named, and damaged or cut off data;
/// [`ImageError::BadSize`] for sides above [`MAX_SIDE_PX`].
pub fn decode(bytes: &[u8]) -> Result<Decoded, ImageError> {
    let decode = |e: &dyn std::fmt::Display| ImageError::Decode(e.to_string());
    let mut reader = ImageReader::new(Cursor::new(bytes))
        .with_guessed_format()
        .map_err(|e| decode(&e))?;
    match reader.format() {
        Some(ImageFormat::Png | ImageFormat::Pnm | ImageFormat::Bmp) => {}
        Some(ImageFormat::Jpeg) if jpeg_ends(bytes) => {}
        Some(ImageFormat::Jpeg) => {
            return Err(ImageError::Decode("the JPEG data are cut off".into()));
        }
        Some(other) => {
            let name = format!("{other:?}").to_uppercase();
            return Err(decode(&format!("{name} data, expected {SUPPORTED}")));
        }
        None if bytes.is_empty() => {
            return Err(decode(&format!("no data, expected {SUPPORTED}")));
        }
        None => {
            let text = "the data do not begin as a picture";
            return Err(decode(&format!("{text}, expected {SUPPORTED}")));
        }
    }
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(MAX_SIDE_PX);
    limits.max_image_height = Some(MAX_SIDE_PX);
    reader.limits(limits.clone());
    let mut decoder = reader.into_decoder().map_err(|e| refusal(&e))?;
    let orientation = decoder.orientation().map_err(|e| refusal(&e))?;
    // What a header claims is not taken for granted before the pixels are there.
    let (claimed, (width_px, height_px)) = (decoder.total_bytes(), decoder.dimensions());
    limits.reserve(claimed).map_err(|_| {
        decode(&format!(
            "{width_px} x {height_px} px of its colours need {claimed} bytes, expected at most {}",
            limits.max_alloc.unwrap_or(u64::MAX)
        ))
    })?;
    let mut picture = DynamicImage::from_decoder(decoder).map_err(|e| refusal(&e))?;
    picture.apply_orientation(orientation);
    let mut notes = Vec::new();
    if orientation != Orientation::NoTransforms {
        let orientation = orientation.to_exif();
        notes.push(PictureNote::Turned { orientation });
    }
    let (width_px, height_px) = (picture.width(), picture.height());
    let pixels = match picture {
        DynamicImage::ImageLuma8(grey) => grey.into_raw(),
        DynamicImage::ImageLuma16(_)
        | DynamicImage::ImageLumaA16(_)
        | DynamicImage::ImageRgb16(_)
        | DynamicImage::ImageRgba16(_) => {
            let grey = picture.into_luma16().into_raw();
            let largest = grey.iter().copied().max().unwrap_or(0);
            let left = eight_of_sixteen(largest);
            if left < FEW_LEVELS {
                notes.push(PictureNote::FewLevels { largest, left });
            }
            grey.into_iter().map(eight_of_sixteen).collect()
        }
        other => other.into_luma8().into_raw(),
    };
    let image = Image8::from_raw(width_px, height_px, pixels)?;
    Ok(Decoded { image, notes })
}

/// What the decoder says, in words of our own where the data are cut off.
fn refusal(error: &image::ImageError) -> ImageError {
    ImageError::Decode(match error {
        image::ImageError::IoError(e) if e.kind() == std::io::ErrorKind::UnexpectedEof => {
            "the data are cut off".into()
        }
        other => other.to_string(),
    })
}

fn eight_of_sixteen(value: u16) -> u8 {
    ((u32::from(value) * 255 + 32_767) / 65_535) as u8
}

/// Whether a JPEG has an end behind the beginning of its pixels; the decoder fills what is missing
/// with grey.
fn jpeg_ends(bytes: &[u8]) -> bool {
    let mut at = 2;
    // Segments of a mark and their length, up to the one that the pixels follow.
    while let Some(&[0xff, mark, high, low]) = bytes.get(at..at + 4) {
        let length = usize::from(u16::from_be_bytes([high, low]));
        at += match mark {
            // A filling byte before a mark.
            0xff => 1,
            _ => 2 + length,
        };
        if mark == 0xda {
            let pixels = bytes.get(at..).unwrap_or_default();
            return pixels.windows(2).any(|pair| pair == [0xff, 0xd9]);
        }
    }
    false
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::encode_png;
    use image::{ExtendedColorType, ImageEncoder, codecs::jpeg::JpegEncoder};

    fn jpeg() -> Vec<u8> {
        let mut bytes = Vec::new();
        let pixels: Vec<u8> = (0..48 * 32).map(|i| (i % 48 * 5) as u8).collect();
        JpegEncoder::new_with_quality(&mut bytes, 95)
            .write_image(&pixels, 48, 32, ExtendedColorType::L8)
            .unwrap();
        bytes
    }

    /// An EXIF segment that holds an orientation alone (TIFF 6.0, tag 0x0112).
    fn with_orientation(jpeg: &[u8], orientation: u8) -> Vec<u8> {
        let mut exif = b"\xff\xe1\x00\x22Exif\0\0MM\0*\0\0\0\x08\0\x01".to_vec();
        exif.extend(b"\x01\x12\0\x03\0\0\0\x01\0");
        exif.extend([orientation, 0, 0, 0, 0, 0, 0]);
        [&jpeg[..2], &exif, &jpeg[2..]].concat()
    }

    #[test]
    fn a_jpeg_is_read_upright_and_a_cut_off_one_refused() {
        let plain = decode(&jpeg()).unwrap();
        assert_eq!(plain.notes, []);
        let at = |image: &Image8, u, v| f64::from(image.get(u, v).unwrap());
        for u in 0..48 {
            assert!((at(&plain.image, u, 16) - f64::from(5 * u)).abs() < 6.0);
        }
        // Orientation 6: turned a quarter to the right, so that what was left is on top.
        let turned = decode(&with_orientation(&jpeg(), 6)).unwrap();
        assert_eq!(turned.notes, [PictureNote::Turned { orientation: 6 }]);
        assert_eq!((turned.image.width_px, turned.image.height_px), (32, 48));
        for u in 0..48 {
            assert_eq!(turned.image.get(10, u), plain.image.get(u, 21));
        }
        let cut = &jpeg()[..jpeg().len() * 2 / 3];
        let refusal = decode(cut).unwrap_err().to_string();
        assert!(refusal.contains("cut off"), "{refusal}");
    }

    #[test]
    fn sixteen_bits_are_rounded_to_eight_and_it_is_told_when_few_are_left() {
        let pgm = |largest: &str, data: &[u8]| {
            decode(&[b"P5\n2 1\n", largest.as_bytes(), b"\n", data].concat()).unwrap()
        };
        let full = pgm("65535", &[0xff, 0xff, 0x80, 0x80]);
        assert_eq!((full.image.pixels, full.notes), (vec![255, 128], vec![]));
        let stated = pgm("4095", &[0x0f, 0xff, 0x08, 0x00]);
        assert_eq!(
            (stated.image.pixels, stated.notes),
            (vec![255, 128], vec![])
        );
        let few = pgm("65535", &[0x0f, 0xff, 0x08, 0x00]);
        assert_eq!(few.image.pixels, [16, 8]);
        let note = few.notes[0].to_string();
        assert!(
            note.contains("4095") && note.contains("16 of 255"),
            "{note}"
        );
    }

    #[test]
    fn colour_becomes_luma_and_transparency_is_not_looked_at() {
        let mut png = Vec::new();
        image::codecs::png::PngEncoder::new(&mut png)
            .write_image(
                &[255, 0, 0, 255, 0, 255, 0, 0, 0, 0, 255, 9],
                3,
                1,
                ExtendedColorType::Rgba8,
            )
            .unwrap();
        let weights = [0.2126, 0.7152, 0.0722].map(|w| 255.0 * w);
        for (found, expected) in decode(&png).unwrap().image.pixels.iter().zip(weights) {
            assert!(
                (f64::from(*found) - expected).abs() <= 1.0,
                "{found} {expected}"
            );
        }
    }

    #[test]
    fn damaged_and_foreign_data_are_refused_with_what_is_expected() {
        let mut png = encode_png(&Image8::from_raw(5, 3, vec![7; 15]).unwrap()).unwrap();
        png.truncate(40);
        let mut bmp = Vec::new();
        image::codecs::bmp::BmpEncoder::new(&mut bmp)
            .write_image(&[7; 45], 5, 3, ExtendedColorType::Rgb8)
            .unwrap();
        for (data, part) in [
            (&b"GIF89a......"[..], "GIF data, expected PNG, PNM"),
            (b"II*\0....", "TIFF data, expected"),
            (b"hello", "do not begin as a picture, expected"),
            (b"", "no data, expected"),
            (&png, "not a readable picture: the data are cut off"),
            (&bmp[..bmp.len() - 20], "the data are cut off"),
            (b"P5\n5 3\n255\n...", "Not enough data"),
            // Headers alone, of 1.6 GB.
            (b"P6\n16384 16384\n65535\n", "need 1610612736 bytes"),
        ] {
            let refusal = decode(data).unwrap_err().to_string();
            assert!(refusal.contains(part), "{refusal}");
        }
    }
}
