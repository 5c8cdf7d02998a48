//! From a raw pair to a stereo frame.

use crate::SERVICE;
use rover_messages::{
    Fault,
    imaging::{RawPair, StereoFrame},
};
use rover_robot::{CameraMount, CameraPairDescription, Robot};

/// The frame of a raw pair: its images with the believed models of `pair`, rover frame. The models
/// of a pair on the mast are placed by the mast's kinematics at the angles that came with the
/// images; the attitude that came with them takes the frame on to the site
/// ([`StereoFrame::site_from_rover`]).
///
/// # Errors
/// Fault `wrong_pair` when the images are another pair's, `wrong_image_size` when a model is made
/// for another size, `bad_frame` when the time is not a number, `no_mast_angles` when a mast pair
/// came without, `mast_moving` when it was exposed while the mast moved.
pub fn attach_models(
    images: RawPair,
    robot: &Robot,
    pair: &CameraPairDescription,
) -> Result<StereoFrame, Fault> {
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
    if pair.mount == CameraMount::Mast && images.mast.as_ref().is_some_and(|m| m.moving) {
        let message = format!("the mast moved while the pair `{}` was exposed", pair.name);
        return Err(fault("mast_moving", message));
    }
    let angles = images.mast.as_ref().map(|m| [m.pan_rad, m.tilt_rad]);
    let cameras = robot
        .cameras_at(pair, angles)
        .map_err(|e| fault("no_mast_angles", format!("pair `{}`: {e}", pair.name)))?;
    Ok(StereoFrame { images, cameras })
}
