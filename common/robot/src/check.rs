//! The checks of a robot description: field, what was found, what was expected.

use crate::{CameraMount, Capsule, PoseDescription, RobotDescription, RobotError};
use nalgebra::{Isometry3, Matrix3, Rotation3, Unit, UnitQuaternion, Vector3};

/// Longest heartbeat period of the arm, and of wheels and mast, which are slow, s.
const LONGEST_HEARTBEATS_S: [f64; 2] = [0.05, 0.5];

pub(crate) struct Check<'a> {
    pub origin: &'a str,
}

impl Check<'_> {
    pub fn error(&self, field: &str, message: impl Into<String>) -> RobotError {
        RobotError::Field {
            origin: self.origin.into(),
            field: field.into(),
            message: message.into(),
        }
    }

    fn require(&self, ok: bool, field: &str, message: impl Into<String>) -> Result<(), RobotError> {
        if ok {
            Ok(())
        } else {
            Err(self.error(field, message))
        }
    }

    fn positive(&self, field: &str, value: f64) -> Result<(), RobotError> {
        self.require(
            value.is_finite() && value > 0.0,
            field,
            format!("{value}, expected a positive number"),
        )
    }

    pub fn direction(&self, field: &str, v: [f64; 3]) -> Result<Unit<Vector3<f64>>, RobotError> {
        Unit::try_new(Vector3::from(v), 1e-9)
            .filter(|u| u.iter().all(|x| x.is_finite()))
            .ok_or_else(|| {
                self.error(
                    field,
                    format!("{v:?}, expected a direction other than zero"),
                )
            })
    }

    fn capsules(&self, field: &str, capsules: &[Capsule]) -> Result<(), RobotError> {
        for (i, c) in capsules.iter().enumerate() {
            self.positive(&format!("{field}[{i}].radius_m"), c.radius_m)?;
            let ends = c.from_m.iter().chain(&c.to_m);
            self.require(
                ends.clone().all(|x| x.is_finite()),
                &format!("{field}[{i}]"),
                "an end is not finite",
            )?;
        }
        Ok(())
    }

    pub fn all(&self, d: &RobotDescription) -> Result<(), RobotError> {
        let named = !d.name.is_empty()
            && d.name
                .chars()
                .all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_');
        self.require(
            named,
            "name",
            format!("`{}`, expected lower-case letters, digits and `_`", d.name),
        )?;
        self.positive("model_quality.angle_deg", d.model_quality.angle_deg)?;
        self.positive("model_quality.length_mm", d.model_quality.length_mm)?;
        let [arm, slow] = LONGEST_HEARTBEATS_S;
        for (field, heartbeat_s, longest_s) in [
            ("arm", Some(d.arm.heartbeat_s), arm),
            ("mobility", d.mobility.as_ref().map(|m| m.heartbeat_s), slow),
            ("mast", d.mast.as_ref().map(|m| m.heartbeat_s), slow),
        ] {
            let Some(found_s) = heartbeat_s else { continue };
            let field = format!("{field}.heartbeat_s");
            self.positive(&field, found_s)?;
            self.require(
                found_s <= longest_s,
                &field,
                format!("{found_s}, expected at most {longest_s} s"),
            )?;
        }
        for (i, j) in d.arm.joints.iter().enumerate() {
            self.capsules(&format!("arm.joints[{i}].shape"), &j.shape)?;
        }
        self.capsules("body", &d.body)?;
        let s = &d.tool.switch;
        for (field, value) in [
            ("tool.switch.ball_radius_m", s.ball_radius_m),
            ("tool.switch.closes_at_m", s.closes_at_m),
            ("tool.switch.spring_n_m", s.spring_n_m),
            ("tool.switch.preload_n", s.preload_n),
        ] {
            self.positive(field, value)?;
        }
        self.require(
            s.travel_m > s.closes_at_m,
            "tool.switch.travel_m",
            format!(
                "{}, expected more than closes_at_m = {}",
                s.travel_m, s.closes_at_m
            ),
        )?;
        self.require(
            !d.cameras.is_empty(),
            "cameras",
            "none, expected at least one pair",
        )?;
        for pair in &d.cameras {
            for (side, camera) in [("left", &pair.cameras.left), ("right", &pair.cameras.right)] {
                camera.validate().map_err(|e| {
                    self.error(&format!("cameras.{}.{side}", pair.name), e.to_string())
                })?;
            }
            self.positive(
                &format!("cameras.{}.range_min_m", pair.name),
                pair.range_min_m,
            )?;
            self.require(
                pair.range_max_m > pair.range_min_m,
                &format!("cameras.{}.range_max_m", pair.name),
                format!("{}, expected more than range_min_m", pair.range_max_m),
            )?;
        }
        self.postures(d)?;
        self.mobile(d)?;
        self.dynamics(d)
    }

    fn postures(&self, d: &RobotDescription) -> Result<(), RobotError> {
        for (name, q) in &d.postures {
            let field = format!("postures.{name}");
            self.require(
                q.len() == d.arm.joints.len(),
                &field,
                format!("{} angles, expected {}", q.len(), d.arm.joints.len()),
            )?;
            for (joint, &angle) in d.arm.joints.iter().zip(q) {
                self.require(
                    (joint.lower_rad..=joint.upper_rad).contains(&angle),
                    &field,
                    format!(
                        "{angle} rad for joint `{}`, expected {} to {}",
                        joint.name, joint.lower_rad, joint.upper_rad
                    ),
                )?;
            }
        }
        Ok(())
    }

    fn dynamics(&self, d: &RobotDescription) -> Result<(), RobotError> {
        let Some(dynamics) = &d.dynamics else {
            return Ok(());
        };
        self.require(
            dynamics.links.len() == d.arm.joints.len(),
            "dynamics.links",
            format!(
                "{}, expected one per joint ({})",
                dynamics.links.len(),
                d.arm.joints.len()
            ),
        )?;
        if let Some(v) = &dynamics.vehicle {
            for (field, value) in [
                ("body_kg", v.body_kg),
                ("rocker_kg", v.rocker_kg),
                ("bogie_kg", v.bogie_kg),
                ("steer_kg", v.steer_kg),
                ("wheel_kg", v.wheel_kg),
                ("wheel_torque_nm", v.wheel_torque_nm),
                ("friction", v.friction),
                (
                    "body_inertia_kg_m2",
                    v.body_inertia_kg_m2
                        .iter()
                        .copied()
                        .fold(f64::MAX, f64::min),
                ),
                ("compliance.heave_n_m", v.compliance.heave_n_m),
                ("compliance.pitch_nm_rad", v.compliance.pitch_nm_rad),
                ("compliance.roll_nm_rad", v.compliance.roll_nm_rad),
                ("compliance.damping_ratio", v.compliance.damping_ratio),
            ] {
                self.positive(&format!("dynamics.vehicle.{field}"), value)?;
            }
            self.require(
                d.mobility.is_some(),
                "dynamics.vehicle",
                "given, but the robot has no [mobility]",
            )?;
        }
        for (i, link) in dynamics.links.iter().enumerate() {
            for (field, value) in [
                ("mass_kg", link.mass_kg),
                ("stiffness_nm_rad", link.stiffness_nm_rad),
                ("damping_nms_rad", link.damping_nms_rad),
                ("max_torque_nm", link.max_torque_nm),
                (
                    "inertia_kg_m2",
                    link.inertia_kg_m2.iter().copied().fold(f64::MAX, f64::min),
                ),
            ] {
                self.positive(&format!("dynamics.links[{i}].{field}"), value)?;
            }
        }
        Ok(())
    }

    pub fn plate(&self, d: &RobotDescription) -> Result<Isometry3<f64>, RobotError> {
        let f = &d.fiducial;
        f.layout
            .validate()
            .map_err(|e| self.error("fiducial.layout", e.to_string()))?;
        let z = self.direction("fiducial.normal", f.normal)?.into_inner();
        let right = Vector3::from(f.right);
        let x = self
            .direction("fiducial.right", (right - z * z.dot(&right)).into())?
            .into_inner();
        let axes = Matrix3::from_columns(&[x, z.cross(&x), z]);
        let rotation =
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
        Ok(Isometry3::from_parts(
            Vector3::from(f.centre_m).into(),
            rotation,
        ))
    }

    fn poses(&self, field: &str, poses: &[(&str, &PoseDescription)]) -> Result<(), RobotError> {
        for (name, p) in poses {
            let ok = p.xyz_m.iter().chain(&p.rpy_deg).all(|x| x.is_finite());
            self.require(ok, &format!("{field}.{name}"), "a number is not finite")?;
        }
        Ok(())
    }

    /// Mast and wheels.
    fn mobile(&self, d: &RobotDescription) -> Result<(), RobotError> {
        for pair in &d.cameras {
            self.require(
                pair.mount == CameraMount::Body || d.mast.is_some(),
                &format!("cameras.{}.mount", pair.name),
                "mast, expected body: the robot has no [mast]",
            )?;
        }
        self.require(
            d.cameras[0].mount == CameraMount::Body,
            "cameras[0].mount",
            "mast, expected the first pair on the body: the arm's error is seen from there",
        )?;
        if let Some(m) = &d.mast {
            self.poses(
                "mast",
                &[("base", &m.base), ("tilt", &m.tilt), ("head", &m.head)],
            )?;
            for (field, [low, high]) in [("pan_rad", m.pan_rad), ("tilt_rad", m.tilt_rad)] {
                self.require(
                    low < high && low >= -7.0 && high <= 7.0,
                    &format!("mast.{field}"),
                    format!("[{low}, {high}], expected a lower and an upper limit"),
                )?;
            }
            for (field, value) in [
                ("max_rate_rad_s", m.max_rate_rad_s),
                ("max_acceleration_rad_s2", m.max_acceleration_rad_s2),
                ("quality.angle_deg", m.quality.angle_deg),
                ("quality.length_mm", m.quality.length_mm),
                ("quality.pointing_deg", m.quality.pointing_deg),
            ] {
                self.positive(&format!("mast.{field}"), value)?;
            }
        }
        let Some(m) = &d.mobility else {
            return Ok(());
        };
        let (l, o) = (&m.limits, &m.odometry);
        for (field, value) in [
            ("wheel_radius_m", m.wheel_radius_m),
            ("wheel_width_m", m.wheel_width_m),
            ("track_m", m.track_m),
            ("footprint_half_m[0]", m.footprint_half_m[0]),
            ("footprint_half_m[1]", m.footprint_half_m[1]),
            ("limits.speed_m_s", l.speed_m_s),
            ("limits.acceleration_m_s2", l.acceleration_m_s2),
            ("limits.turn_rate_rad_s", l.turn_rate_rad_s),
            ("limits.curvature_1_m", l.curvature_1_m),
            ("limits.steer_rate_rad_s", l.steer_rate_rad_s),
            ("limits.slope_rad", l.slope_rad),
            ("limits.tilt_rad", l.tilt_rad),
            ("limits.step_m", l.step_m),
            ("limits.clearance_m", l.clearance_m),
            ("limits.slip", l.slip),
            ("odometry.along_fraction", o.along_fraction),
            ("odometry.across_fraction", o.across_fraction),
            ("odometry.heading_deg_sqrt_m", o.heading_deg_sqrt_m),
            ("odometry.turn_fraction", o.turn_fraction),
            ("odometry.tilt_deg", o.tilt_deg),
        ] {
            self.positive(&format!("mobility.{field}"), value)?;
        }
        let [front, middle, rear] = m.axles_x_m;
        let [rocker_x, rocker_z] = m.rocker_pivot_m;
        let [bogie_x, bogie_z] = m.bogie_pivot_m;
        self.require(
            front > middle && middle > rear,
            "mobility.axles_x_m",
            format!("{:?}, expected front to rear", m.axles_x_m),
        )?;
        self.require(
            front > rocker_x && rocker_x > bogie_x,
            "mobility.rocker_pivot_m",
            format!("x = {rocker_x}, expected between front axle and bogie pivot"),
        )?;
        self.require(
            middle > bogie_x && bogie_x > rear,
            "mobility.bogie_pivot_m",
            format!("x = {bogie_x}, expected between middle and rear axle"),
        )?;
        self.require(
            rocker_z.is_finite() && bogie_z.is_finite(),
            "mobility.rocker_pivot_m",
            "a height is not finite",
        )
    }
}
