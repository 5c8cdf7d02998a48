//! Pictures with marks drawn over them.

use super::PageError;
use base64::{Engine, engine::general_purpose::STANDARD};
use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use rover_messages::imaging::ImageData;
use rover_page::{YELLOW, escape};
use std::fmt::Write;

/// What is drawn over a picture, px; (0, 0) is the centre of the first pixel.
#[derive(Default)]
pub(super) struct Overlay {
    /// Named places.
    pub marks: Vec<Mark>,
    /// A way through the picture.
    pub path: Vec<[f64; 2]>,
}

/// One named place.
pub(super) struct Mark {
    at_px: [f64; 2],
    colour: &'static str,
    name: &'static str,
    cross: bool,
}

impl Mark {
    /// An open cross.
    pub fn cross(at_px: [f64; 2], colour: &'static str, name: &'static str) -> Self {
        Self {
            at_px,
            colour,
            name,
            cross: true,
        }
    }

    /// A ring.
    pub fn ring(at_px: [f64; 2], colour: &'static str, name: &'static str) -> Self {
        Self {
            at_px,
            colour,
            name,
            cross: false,
        }
    }

    fn svg(&self) -> String {
        let [u, v] = self.at_px;
        let shape = if self.cross {
            format!(
                "<path d=\"M{} {v}h-16M{} {v}h16M{u} {}v-16M{u} {}v16\"/><circle cx=\"{u}\" cy=\"{v}\" r=\"1.6\" fill=\"{}\" stroke=\"none\"/>",
                u - 6.0,
                u + 6.0,
                v - 6.0,
                v + 6.0,
                self.colour
            )
        } else {
            format!("<circle cx=\"{u}\" cy=\"{v}\" r=\"12\"/>")
        };
        format!(
            "<g fill=\"none\" stroke=\"#000\" stroke-opacity=\".45\" stroke-width=\"4.5\">{shape}</g>\
             <g fill=\"none\" stroke=\"{0}\" stroke-width=\"2.2\">{shape}</g>\
             <text x=\"{1}\" y=\"{2}\" class=\"mark\" style=\"fill:{0}\">{3}</text>",
            self.colour,
            u + 18.0,
            v - 12.0,
            self.name
        )
    }
}

/// A figure of an 8-bit grey image with an overlay.
pub(super) fn figure(
    image: &ImageData,
    overlay: &Overlay,
    caption: &str,
) -> Result<String, PageError> {
    let mut png = Vec::new();
    PngEncoder::new(&mut png).write_image(
        &image.pixels,
        image.width_px,
        image.height_px,
        ExtendedColorType::L8,
    )?;
    let mut drawn = String::new();
    if overlay.path.len() > 1 {
        let points: Vec<_> = overlay
            .path
            .iter()
            .map(|[u, v]| format!("{u:.2},{v:.2}"))
            .collect();
        let _ = write!(
            drawn,
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{YELLOW}\" stroke-width=\"1.4\" stroke-opacity=\".8\" stroke-dasharray=\"4 3\"/>",
            points.join(" ")
        );
    }
    for [u, v] in &overlay.path {
        let _ = write!(
            drawn,
            "<circle cx=\"{u:.2}\" cy=\"{v:.2}\" r=\"2.4\" fill=\"{YELLOW}\"/>"
        );
    }
    for mark in &overlay.marks {
        drawn += &mark.svg();
    }
    let (w, h) = (image.width_px, image.height_px);
    // The first pixel's centre is (0, 0), so the picture begins half a pixel before it.
    Ok(format!(
        "<figure><svg viewBox=\"-0.5 -0.5 {w} {h}\" role=\"img\">\
         <image x=\"-0.5\" y=\"-0.5\" width=\"{w}\" height=\"{h}\" \
         href=\"data:image/png;base64,{}\"/>{drawn}</svg><figcaption>{}</figcaption></figure>",
        STANDARD.encode(&png),
        escape(caption)
    ))
}
