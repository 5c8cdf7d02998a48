//! Where the mast and its cameras are, as the robot believes.

use crate::{
    CameraMount, CameraPairDescription, MastDescription, MobilityDescription, Robot, RobotError,
    robot::pose,
};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rover_cameras::StereoPair;
use rover_geometry::{MastHead, Point, Rover, Transform};

impl MastDescription {
    /// Pose of the head at pan and tilt, rad.
    pub fn rover_from_head(&self, pan_rad: f64, tilt_rad: f64) -> Transform<Rover, MastHead> {
        let turn = |axis: Vector3<f64>, angle: f64| {
            Isometry3::from_parts(
                Translation3::identity(),
                UnitQuaternion::from_scaled_axis(axis * angle),
            )
        };
        let panned = pose(&self.base) * turn(Vector3::z(), pan_rad) * pose(&self.tilt);
        (panned * turn(Vector3::y(), tilt_rad) * pose(&self.head)).into()
    }

    /// Pan and tilt, rad, at which the head's x axis goes through a point: the limits are not
    /// looked at. `None` for a point too near to the mast's axis.
    pub fn angles_towards(&self, point: &Point<Rover>) -> Option<[f64; 2]> {
        let mut angles = [0.0, 0.0];
        // Each round takes off what is left of the offsets between joints and head.
        for _ in 0..20 {
            let seen = self.rover_from_head(angles[0], angles[1]).inverse() * *point;
            let p = seen.coords;
            let level = p.x.hypot(p.y);
            if level.hypot(p.z) < 0.05 || !(level.is_finite() && p.z.is_finite()) {
                return None;
            }
            // A pan joint turns the view less, the more the head looks down.
            let [aside, down] = [p.y.atan2(p.x), (-p.z).atan2(level)];
            let reach = angles[1].cos().abs().max(0.2);
            angles[0] += aside.clamp(-1.0, 1.0) * if aside.abs() < 0.5 { 1.0 / reach } else { 1.0 };
            angles[1] += down;
            if aside.abs() < 1e-12 && down.abs() < 1e-12 {
                break;
            }
        }
        let seen = self.rover_from_head(angles[0], angles[1]).inverse() * *point;
        let off = seen.coords.y.hypot(seen.coords.z);
        (seen.coords.x > 0.0 && off < 1e-6 * seen.coords.x).then_some(angles)
    }
}

impl Robot {
    /// The mast.
    ///
    /// # Errors
    /// [`RobotError::Lacks`] for a robot without.
    pub fn mast(&self) -> Result<&MastDescription, RobotError> {
        let missing = self.lacks("mast");
        self.description().mast.as_ref().ok_or(missing)
    }

    /// Wheels and suspension.
    ///
    /// # Errors
    /// [`RobotError::Lacks`] for a robot without.
    pub fn mobility(&self) -> Result<&MobilityDescription, RobotError> {
        let missing = self.lacks("mobility");
        self.description().mobility.as_ref().ok_or(missing)
    }

    fn lacks(&self, section: &'static str) -> RobotError {
        RobotError::Lacks {
            robot: self.name().into(),
            section,
        }
    }

    /// The believed models of a pair, rover frame; `mast_rad` are pan and tilt, which a pair on
    /// the body does not need.
    ///
    /// # Errors
    /// [`RobotError::Lacks`] for a mast pair of a robot without a mast, or without angles.
    pub fn cameras_at(
        &self,
        pair: &CameraPairDescription,
        mast_rad: Option<[f64; 2]>,
    ) -> Result<StereoPair, RobotError> {
        match pair.mount {
            CameraMount::Body => Ok(pair.cameras.clone()),
            CameraMount::Mast => {
                let [pan, tilt] = mast_rad.ok_or_else(|| self.lacks("mast angles"))?;
                let rover_from_head = self.mast()?.rover_from_head(pan, tilt);
                Ok(pair.cameras.transformed(&rover_from_head.isometry))
            }
        }
    }
}
