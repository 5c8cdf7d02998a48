//! What a mobile robot has beside an arm: wheels on a rocker-bogie, and a mast.

use crate::PoseDescription;
use serde::{Deserialize, Serialize};

/// Wheels, suspension, limits and odometry.
///
/// Six wheels on a rocker-bogie, numbered front left, front right, middle left, middle right, rear
/// left, rear right; a rocker carries the front wheel and the pivot of the bogie, the bogie the
/// middle and the rear wheel, and a differential turns the two rockers by opposite angles. Front
/// and rear wheels are steered. The rover frame's origin lies on level ground under the mid point
/// of the middle wheels, x forward, z up.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MobilityDescription {
    /// Heartbeat period of the wheels' driver, s: simulated time never passes it without a
    /// heartbeat from the commander.
    pub heartbeat_s: f64,
    /// Radius of a wheel, m.
    pub wheel_radius_m: f64,
    /// Width of a wheel, m.
    pub wheel_width_m: f64,
    /// Distance between the mid planes of left and right wheels, m.
    pub track_m: f64,
    /// Axles of front, middle and rear wheels along x, rover frame, m.
    pub axles_x_m: [f64; 3],
    /// Pivot of the rockers, x and z, rover frame, m.
    pub rocker_pivot_m: [f64; 2],
    /// Pivot of the bogies on level ground, x and z, rover frame, m.
    pub bogie_pivot_m: [f64; 2],
    /// Half the body's extent along x and y about the rover frame's origin, m: what must stay
    /// clear of rocks higher than the belly.
    pub footprint_half_m: [f64; 2],
    /// What the rover may be asked for.
    pub limits: MobilityLimits,
    /// How well the rover knows where it is.
    pub odometry: OdometryQuality,
}

/// What the rover may be asked for.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MobilityLimits {
    /// Speed of the rover frame's origin, m/s.
    pub speed_m_s: f64,
    /// Acceleration, m/s^2.
    pub acceleration_m_s2: f64,
    /// Rate of a turn in place, rad/s.
    pub turn_rate_rad_s: f64,
    /// Sharpest curvature of an arc, 1/m.
    pub curvature_1_m: f64,
    /// Rate of the steering drives, rad/s.
    pub steer_rate_rad_s: f64,
    /// Steepest ground, rad.
    pub slope_rad: f64,
    /// Largest tilt of the body against gravity, rad: the driver stops there.
    pub tilt_rad: f64,
    /// Highest obstacle that a wheel may climb, m.
    pub step_m: f64,
    /// Height of the belly above level ground, m.
    pub clearance_m: f64,
    /// Largest slip: the driver stops there.
    pub slip: f64,
}

/// Stated quality of odometry and attitude sensor, one sigma.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OdometryQuality {
    /// Error along the way, fraction of the way.
    pub along_fraction: f64,
    /// Error across the way, fraction of the way, beside what the heading makes.
    pub across_fraction: f64,
    /// Random walk of the heading over the way, deg per square root of a metre.
    pub heading_deg_sqrt_m: f64,
    /// Error of the heading of a turn in place, fraction of the angle.
    pub turn_fraction: f64,
    /// Roll and pitch by the attitude sensor, deg.
    pub tilt_deg: f64,
}

impl OdometryQuality {
    /// Covariance of (along, across, heading) after a way of `way_m` (its absolute value counts)
    /// and turns in place of `turn_rad` in all, in the axes of the start, m^2, m rad and rad^2:
    /// the heading's random walk and its integral across, the fractions of the way beside it.
    pub fn covariance(&self, way_m: f64, turn_rad: f64) -> [[f64; 3]; 3] {
        let way = way_m.abs();
        let walk = self.heading_deg_sqrt_m.to_radians().powi(2);
        let turn = (self.turn_fraction * turn_rad).powi(2);
        let along = (self.along_fraction * way).powi(2);
        let across =
            (self.across_fraction * way).powi(2) + walk * way.powi(3) / 3.0 + turn * way * way;
        let coupled = walk * way * way / 2.0 + turn * way;
        [
            [along, 0.0, 0.0],
            [0.0, across, coupled],
            [0.0, coupled, walk * way + turn],
        ]
    }
}

/// A mast with a pan joint below a tilt joint.
///
/// `rover_from_head = base * Rz(pan) * tilt * Ry(tilt angle) * head`: pan is positive to the left,
/// tilt positive downwards.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MastDescription {
    /// Heartbeat period of the mast's driver, s, as [`MobilityDescription::heartbeat_s`].
    pub heartbeat_s: f64,
    /// Frame of the pan joint, its z axis the axis, rover frame.
    pub base: PoseDescription,
    /// Frame of the tilt joint, its y axis the axis, in the frame that pan turns.
    pub tilt: PoseDescription,
    /// The head's frame (x along the view) in the frame that tilt turns.
    pub head: PoseDescription,
    /// Lower and upper limit of pan, rad.
    pub pan_rad: [f64; 2],
    /// Lower and upper limit of tilt, rad.
    pub tilt_rad: [f64; 2],
    /// Largest rate of both joints, rad/s.
    pub max_rate_rad_s: f64,
    /// Largest acceleration of both joints, rad/s^2.
    pub max_acceleration_rad_s2: f64,
    /// Stated calibration quality, one sigma.
    pub quality: MastQuality,
}

/// Stated quality of the mast's calibration, one sigma.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MastQuality {
    /// Rotation of the mast's base in the rover frame, per axis, deg.
    pub angle_deg: f64,
    /// Translation of the mast's base in the rover frame, per axis, mm.
    pub length_mm: f64,
    /// What the encoders do not know of pan and tilt at each stop, deg.
    pub pointing_deg: f64,
}

/// What a camera pair is mounted on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CameraMount {
    /// The robot's body; the models are in the rover frame.
    #[default]
    Body,
    /// The mast's head; the models are in the head's frame.
    Mast,
}

impl CameraMount {
    /// Whether it is the body.
    pub fn is_body(&self) -> bool {
        *self == Self::Body
    }
}

/// Masses and stiffnesses of a mobile robot's body, for simulation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VehicleDynamics {
    /// Mass of the body without suspension and arm, kg.
    pub body_kg: f64,
    /// Its centre of mass, rover frame, m.
    pub body_com_m: [f64; 3],
    /// Its principal moments of inertia, kg m^2.
    pub body_inertia_kg_m2: [f64; 3],
    /// Mass of a rocker, kg.
    pub rocker_kg: f64,
    /// Mass of a bogie, kg.
    pub bogie_kg: f64,
    /// Mass of a steering drive, kg.
    pub steer_kg: f64,
    /// Mass of a wheel, kg.
    pub wheel_kg: f64,
    /// Largest torque of a wheel's drive, N m.
    pub wheel_torque_nm: f64,
    /// Coefficient of friction between wheel and ground.
    pub friction: f64,
    /// Compliance of suspension, wheels and ground while the rover stands.
    pub compliance: ComplianceDescription,
}

/// Springs between the ground and the body of a rover that stands.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ComplianceDescription {
    /// Heave, N/m.
    pub heave_n_m: f64,
    /// Pitch about the suspension's pivot, N m/rad.
    pub pitch_nm_rad: f64,
    /// Roll about the suspension's pivot, N m/rad.
    pub roll_nm_rad: f64,
    /// Damping ratio of all three.
    pub damping_ratio: f64,
}
