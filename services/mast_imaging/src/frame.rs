//! From a raw pair to a stereo frame.

use crate::SERVICE;
use rover_messages::{
    Fault,
    imaging::{RawPair, StereoFrame},
};
use rover_robot::CameraPairDescription;

/// The frame of a raw pair: its images with the believed models (rover frame) of `pair`.
///
/// # Errors
/// Fault `wrong_pair` when the images are another pair's, `wrong_image_size` when a model is made
/// for another size, `bad_frame` when the time is not a number.
pub fn attach_models(images: RawPair, pair: &CameraPairDescription) -> Result<StereoFrame, Fault> {
    let fault = |name, message: String| Fault::new(SERVICE, name, message);
    if images.pair != pair.name {
        return Err(fault(
            "wrong_pair",
            format!(
                "the cameras sent the pair `{}`, expected `{}`",
                images.pair, pair.name
            ),
        ));
    }
    if !images.sim_time_s.is_finite() {
        return Err(fault(
            "bad_frame",
            format!("pair `{}`: sim_time_s is {}", pair.name, images.sim_time_s),
        ));
    }
    let sides = [
        ("left", &images.left, &pair.cameras.left),
        ("right", &images.right, &pair.cameras.right),
    ];
    for (side, image, camera) in sides {
        let found = (image.width_px, image.height_px);
        let expected = (camera.width_px, camera.height_px);
        if found != expected {
            return Err(fault(
                "wrong_image_size",
                format!(
                    "the {side} image of the pair `{}` has {}x{} px, expected {}x{} px as its \
                     camera model",
                    pair.name, found.0, found.1, expected.0, expected.1
                ),
            )
            .with("found_width_px", found.0.into())
            .with("found_height_px", found.1.into())
            .with("expected_width_px", expected.0.into())
            .with("expected_height_px", expected.1.into()));
        }
    }
    Ok(StereoFrame {
        images,
        cameras: pair.cameras.clone(),
    })
}
