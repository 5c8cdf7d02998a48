//! The ways to place an end-effector by vision that the EPEC paper names (section 2), behind one
//! interface: what was seen of the fiducial goes in, the command that brings the tip to a
//! reference point comes out.
//!
//! | module | methods |
//! |---|---|
//! | [`epec`] | kinematics alone; the paper's last error vector |
//! | [`field`] | the error vector as a field with a kinematic prior, anchored or not |
//! | [`hips`] | hybrid image plane/stereo: camera models adjusted to the arm |
//! | [`camera_space`] | camera-space manipulation, six parameters and linear |
//! | [`mount_calibration`] | camera mount from point correspondences |
//! | [`kinematic_calibration`] | all 26 model errors from pixels |
//! | [`position_based`] | position-based visual servoing |
//! | [`image_based`] | image-based visual servoing, with a modelled or a learnt Jacobian |
//!
//! Points are in the rover frame, metres; pixels as in `rover-cameras`. A reference is where the
//! tip shall be *as the believed cameras see it*, a command is where the believed kinematics shall
//! put it; the direction of the tool is never corrected, as in the paper.

pub mod camera_space;
pub mod epec;
pub mod field;
pub mod hips;
pub mod image_based;
pub mod kinematic_calibration;
mod linear;
pub mod mount_calibration;
pub mod position_based;
mod setup;
#[cfg(test)]
mod tests;

pub use setup::{MethodError, Reference, Sample, Setup};

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use std::{fmt::Debug, sync::Arc};

/// A method with what it has learnt in one placement.
pub trait Method: Debug + Send + Sync {
    /// Takes in one sighting of the fiducial.
    ///
    /// # Errors
    /// [`MethodError`] when it cannot be used; what was learnt before is kept.
    fn observe(&mut self, sample: &Sample) -> Result<(), MethodError>;

    /// Where to command the tip, rover frame, m, so that it is seen at `reference`; `near` are
    /// joint angles close to the answer, rad.
    ///
    /// # Errors
    /// [`MethodError`] when the method has no answer there.
    fn command(&self, reference: &Reference, near: &[f64]) -> Result<Vector3<f64>, MethodError>;

    /// A copy with all that was learnt.
    fn duplicate(&self) -> Box<dyn Method>;

    /// Bytes that the method keeps from one cycle to the next.
    fn state_bytes(&self) -> usize;
}

/// Which method.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Kinematics alone.
    Kinematic,
    /// The paper's rule.
    Epec,
    /// Field with a kinematic prior, anchored on the last vector.
    #[default]
    EpecField,
    /// The same, not anchored.
    EpecFieldFree,
    /// Camera models fitted once, to initial poses.
    HipsLimited,
    /// Camera models fitted to initial poses and refitted with every image.
    HipsFull,
    /// Camera models refitted with every image of the approach alone.
    HipsApproach,
    /// Camera-space manipulation, six parameters per camera.
    CameraSpace,
    /// Camera-space manipulation, eleven linear parameters per camera.
    CameraSpaceLinear,
    /// Rigid fit of the mount to the approach (Kabsch).
    MountKabsch,
    /// Mount by weighted maximum a posteriori.
    MountMap,
    /// All 26 errors, from initial poses and the approach.
    KinematicCalibration,
    /// Position-based visual servoing, gain 1.
    PositionBased,
    /// Position-based visual servoing, gain 0.5.
    PositionBasedHalf,
    /// Image-based visual servoing, gain 1, believed Jacobian.
    ImageBased,
    /// Image-based visual servoing, Jacobian updated by Broyden's rule.
    ImageBasedBroyden,
}

impl Kind {
    /// Every method.
    pub const ALL: [Self; 16] = [
        Self::Kinematic,
        Self::Epec,
        Self::EpecField,
        Self::EpecFieldFree,
        Self::HipsLimited,
        Self::HipsFull,
        Self::HipsApproach,
        Self::CameraSpace,
        Self::CameraSpaceLinear,
        Self::MountKabsch,
        Self::MountMap,
        Self::KinematicCalibration,
        Self::PositionBased,
        Self::PositionBasedHalf,
        Self::ImageBased,
        Self::ImageBasedBroyden,
    ];

    /// The name, as in scenarios and reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Kinematic => "kinematic",
            Self::Epec => "epec",
            Self::EpecField => "epec_field",
            Self::EpecFieldFree => "epec_field_free",
            Self::HipsLimited => "hips_limited",
            Self::HipsFull => "hips_full",
            Self::HipsApproach => "hips_approach",
            Self::CameraSpace => "camera_space",
            Self::CameraSpaceLinear => "camera_space_linear",
            Self::MountKabsch => "mount_kabsch",
            Self::MountMap => "mount_map",
            Self::KinematicCalibration => "kinematic_calibration",
            Self::PositionBased => "position_based",
            Self::PositionBasedHalf => "position_based_half",
            Self::ImageBased => "image_based",
            Self::ImageBasedBroyden => "image_based_broyden",
        }
    }

    /// What the method is, in a few words.
    pub fn title(self) -> &'static str {
        match self {
            Self::Kinematic => "kinematics alone, no image of the arm",
            Self::Epec => "the paper's rule: the last error vector",
            Self::EpecField => "EPEC with the vector as a field with a kinematic prior",
            Self::EpecFieldFree => "the same, not anchored on the last vector",
            Self::HipsLimited => "HIPS, camera models fitted once, to 12 initial poses",
            Self::HipsFull => "HIPS, fitted to initial poses and every image",
            Self::HipsApproach => "HIPS, fitted to the images of the approach alone",
            Self::CameraSpace => "camera-space manipulation, six parameters per camera",
            Self::CameraSpaceLinear => "camera-space manipulation, linear, eleven parameters",
            Self::MountKabsch => "mount from point correspondences, rigid fit (Kabsch)",
            Self::MountMap => "mount from point correspondences, weighted, with prior",
            Self::KinematicCalibration => "kinematic calibration, all 26 errors, with prior",
            Self::PositionBased => "position-based visual servoing, gain 1",
            Self::PositionBasedHalf => "position-based visual servoing, gain 0.5",
            Self::ImageBased => "image-based visual servoing, gain 1",
            Self::ImageBasedBroyden => "image-based visual servoing, Jacobian by Broyden",
        }
    }

    /// What the method takes as known beforehand.
    pub fn needs(self) -> &'static str {
        match self {
            Self::Kinematic => "arm and mount exactly",
            Self::Epec | Self::PositionBased | Self::PositionBasedHalf => {
                "stereo pair (relative), arm and mount roughly"
            }
            Self::EpecField | Self::EpecFieldFree | Self::KinematicCalibration => {
                "stereo pair (relative), arm and mount roughly, and how roughly"
            }
            Self::HipsLimited | Self::HipsFull | Self::HipsApproach => {
                "arm roughly, lenses; start values of the camera models"
            }
            Self::CameraSpace => "arm roughly, lenses, depth of the target roughly",
            Self::CameraSpaceLinear => "arm roughly",
            Self::MountKabsch | Self::MountMap => "stereo pair (relative), arm",
            Self::ImageBased => "cameras and mount roughly",
            Self::ImageBasedBroyden => "cameras and mount roughly, as a start",
        }
    }

    /// Poses over the view at which the fiducial is looked at before the approach.
    pub fn initial_poses(self) -> usize {
        match self {
            Self::HipsLimited
            | Self::HipsFull
            | Self::CameraSpaceLinear
            | Self::MountMap
            | Self::KinematicCalibration => 12,
            _ => 0,
        }
    }

    /// Whether the method looks at the fiducial during the approach.
    pub fn looks_on_approach(self) -> bool {
        !matches!(self, Self::Kinematic | Self::HipsLimited)
    }

    /// The method, for one placement on `target`.
    pub fn start(self, setup: Arc<Setup>, target: Reference) -> Box<dyn Method> {
        use field::Anchor;
        match self {
            Self::Kinematic => Box::new(epec::Kinematic),
            Self::Epec => Box::new(epec::Epec::new(setup)),
            Self::EpecField => Box::new(field::Field::new(setup, Anchor::LastVector)),
            Self::EpecFieldFree => Box::new(field::Field::new(setup, Anchor::None)),
            Self::HipsLimited => Box::new(hips::Hips::new(setup, target, hips::Samples::Initial)),
            Self::HipsFull => Box::new(hips::Hips::new(setup, target, hips::Samples::All)),
            Self::HipsApproach => Box::new(hips::Hips::new(setup, target, hips::Samples::All)),
            Self::CameraSpace => Box::new(camera_space::CameraSpace::new(setup, target)),
            Self::CameraSpaceLinear => {
                Box::new(camera_space::LinearCameraSpace::new(setup, target))
            }
            Self::MountKabsch => Box::new(mount_calibration::Kabsch::new(setup)),
            Self::MountMap => Box::new(mount_calibration::MountMap::new(setup, target)),
            Self::KinematicCalibration => {
                Box::new(kinematic_calibration::KinematicCalibration::new(setup))
            }
            Self::PositionBased => Box::new(position_based::PositionBased::new(setup, 1.0)),
            Self::PositionBasedHalf => Box::new(position_based::PositionBased::new(setup, 0.5)),
            Self::ImageBased => Box::new(image_based::ImageBased::modelled(setup, 1.0)),
            Self::ImageBasedBroyden => Box::new(image_based::ImageBased::broyden(setup, 1.0)),
        }
    }
}
