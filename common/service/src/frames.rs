//! Stereo frames: asked for, and made ready for matching.

use rover_bus::Peer;
use rover_messages::{
    Fault,
    imaging::{CaptureRequest, ImageData, StereoFrame},
    keys,
};
use rover_vision::{Image8, PreparedImage};
use std::time::Duration;

/// Wall-clock limit for one stereo frame.
const FRAME_LIMIT: Duration = Duration::from_secs(60);

/// Asks for a stereo frame of `pair` on behalf of `service`.
///
/// # Errors
/// The fault of who takes the frame, or one that says that nobody does.
pub async fn capture(peer: &Peer, service: &str, pair: &str) -> Result<StereoFrame, Fault> {
    let key = keys::imaging_capture(pair);
    peer.ask(&key, &CaptureRequest::default(), FRAME_LIMIT)
        .await
        .map_err(|e| e.into_fault(service))
}

/// Both images of a frame, ready for matching: left, right.
///
/// # Errors
/// Fault `bad_frame` if an image's pixels do not belong to its size.
pub fn prepared(
    service: &str,
    frame: &StereoFrame,
) -> Result<(PreparedImage, PreparedImage), Fault> {
    let prepare = |side: &str, image: &ImageData| {
        let image = Image8 {
            width_px: image.width_px,
            height_px: image.height_px,
            pixels: image.pixels.clone(),
        };
        PreparedImage::new(&image)
            .map_err(|e| Fault::new(service, "bad_frame", format!("{side} image: {e}")))
    };
    let images = &frame.images;
    Ok((
        prepare("left", &images.left)?,
        prepare("right", &images.right)?,
    ))
}
