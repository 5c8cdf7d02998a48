//! The instrument on the last link.

use crate::arm::Arm;
use crate::rows::ArmError;
use nalgebra::{Isometry3, Quaternion, Unit, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// The instrument: its tool point and its approach axis, both in the last link's frame.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq)]
#[serde(deny_unknown_fields)]
pub struct Tool {
    /// The point that is placed on the target, last link frame, metres.
    pub tip_in_link: Vector3<f64>,
    /// The direction in which the instrument points and approaches, unit, last link frame.
    pub axis_in_link: Unit<Vector3<f64>>,
}

impl Tool {
    /// A tool of a turret whose instruments sit around `y` of the last link, as the flight
    /// table of the Mars Exploration Rover gives them: the axis is the link's z turned by
    /// `angle_rad` about its y, and the tip lies `length_m` along that axis.
    pub fn on_turret(length_m: f64, angle_rad: f64) -> Self {
        let (s, c) = angle_rad.sin_cos();
        let axis = Unit::new_normalize(Vector3::new(s, 0.0, c));
        Self {
            tip_in_link: axis.into_inner() * length_m,
            axis_in_link: axis,
        }
    }

    /// The tool's frame on the last link: origin at the tip, z along the approach axis, turned from
    /// the link's own frame by the shortest way (about y where the axis points back). For the turret
    /// of the Mars Exploration Rover this is the tool frame of its flight software.
    pub fn frame(&self) -> Isometry3<f64> {
        let v = self.axis_in_link;
        // Half-angle form: exact for an axis next to z, where an arc cosine is not.
        let onto = |x: f64, y: f64, z: f64| {
            UnitQuaternion::from_quaternion(Quaternion::new(1.0 + z, -y, x, 0.0))
        };
        let turn = if v.z > -1.0 + 1e-9 {
            onto(v.x, v.y, v.z)
        } else {
            onto(-v.x, -v.y, -v.z)
                * UnitQuaternion::new_unchecked(Quaternion::new(0.0, 0.0, 1.0, 0.0))
        };
        Isometry3::from_parts(self.tip_in_link.into(), turn)
    }

    /// Tool point (metres) and approach axis (unit) for a given pose of the last link, in the
    /// frame in which that pose is given.
    pub fn placed(&self, base_from_link: &Isometry3<f64>) -> (Vector3<f64>, Unit<Vector3<f64>>) {
        let tip = base_from_link.rotation * self.tip_in_link + base_from_link.translation.vector;
        (
            tip,
            Unit::new_unchecked(base_from_link.rotation * self.axis_in_link.into_inner()),
        )
    }

    /// Tool point (metres) and approach axis (unit) in the arm base frame at joint angles
    /// `q` (radians).
    ///
    /// # Errors
    /// As [`Arm::forward`].
    pub fn at(&self, arm: &Arm, q: &[f64]) -> Result<(Vector3<f64>, Unit<Vector3<f64>>), ArmError> {
        Ok(self.placed(&arm.forward(q)?))
    }
}
