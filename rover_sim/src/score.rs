//! A placement measured against the truth.

use crate::{statics, world::World};
use nalgebra::{Point3, Vector3};
use rover_messages::{
    Fault,
    keys::service::HARDWARE,
    simulation::{Score, ScoreRequest},
};

impl World {
    /// Measures what the arm did against the true surface point of the designated pixel.
    ///
    /// # Errors
    /// Fault `no_surface` when the pixel shows no terrain, `unknown_pair`, or `bad_joints` for
    /// open-loop joint angles that do not fit the arm.
    pub fn score(&mut self, request: &ScoreRequest) -> Result<Score, Fault> {
        let target = &request.target;
        let fault = |name, message: String| Fault::new(HARDWARE, name, message);
        let designation = self
            .designation(&target.pair, target.pixel_px)
            .map_err(|e| fault("no_surface", e.to_string()))?;
        // The rover frame in which the target is believed: that of the moment it was measured.
        let (believed, world_from_rover) = match &request.handed_over {
            Some(placed) => (placed, self.world_from_rover()),
            None => (target, Some(designation.world_from_rover)),
        };
        let true_pair = self.truth.pair(&believed.pair).ok_or_else(|| {
            fault(
                "unknown_pair",
                format!("no camera pair `{}`", believed.pair),
            )
        })?;
        let believed_from_true = true_pair.believed_from_true;
        let surface = designation.surface;
        let (at, normal) = (surface.point_m, surface.normal);
        let contact = self.contact;
        let apart = contact.map(|c| c.point_m - at);
        let open_loop = request
            .open_loop_joints_rad
            .as_ref()
            .map(|q| self.open_loop_error_m(q, &at, &normal))
            .transpose()
            .map_err(|message| fault("bad_joints", message))?
            .flatten();
        // A robot that does not drive has its rover frame in the world's.
        let drives = self.world_from_rover();
        let world_from_rover = drives.and(world_from_rover);
        let mut believed_target =
            believed_from_true.inverse() * Point3::from(believed.position_m.coords);
        if let Some(pose) = world_from_rover {
            believed_target = pose * believed_target;
        }
        let encoders = self.state().joints_rad;
        let believed_tip = self
            .robot
            .rover_from_link(&encoders)
            .map(|pose| pose.isometry * Point3::from(self.robot.tool.tip_in_link))
            .map_err(|e| fault("bad_joints", e.to_string()))?;
        let mut tip = Point3::from(self.tip_in_world());
        if let Some(pose) = drives {
            tip = pose.inverse() * tip;
        }
        let seen_tip = believed_from_true * tip;
        Ok(Score {
            target_in_world_m: at.into(),
            normal_in_world: normal.into_inner().into(),
            believed_in_world_m: believed_target.coords.into(),
            contact_in_world_m: contact.map(|c| c.point_m.into()),
            lateral_error_mm: apart.map(|d| lateral(&d, &normal).norm() * 1e3),
            range_error_mm: apart.map(|d| d.dot(&normal) * 1e3),
            axis_error_deg: contact.map(|c| c.axis.angle(&-normal.into_inner()).to_degrees()),
            open_loop_lateral_error_mm: open_loop.map(|m| m * 1e3),
            arm_model_error_mm: (seen_tip - believed_tip).norm() * 1e3,
            target_error_mm: (believed_target.coords - at).norm() * 1e3,
        })
    }

    /// Where the instrument would touch the target's plane if it were at encoder angles `q` and
    /// went on along its own axis: distance from the target, m. None if it would never.
    fn open_loop_error_m(
        &self,
        q: &[f64],
        target: &Vector3<f64>,
        normal: &Vector3<f64>,
    ) -> Result<Option<f64>, String> {
        let drooped = statics::drooped_angles_rad(&self.model, q).map_err(|e| e.to_string())?;
        let base_from_link = self
            .model
            .arm
            .forward(&drooped)
            .map_err(|e| e.to_string())?;
        let mut world_from_link = self.model.world_from_base * base_from_link;
        if let Some(standing) = &self.model.standing {
            let tilted = standing
                .tilted(&self.model, &drooped)
                .map_err(|e| e.to_string())?;
            world_from_link = tilted * standing.world_from_rover.inverse() * world_from_link;
        }
        let tip = (world_from_link * Point3::from(self.model.tip_in_link)).coords;
        let axis = world_from_link.rotation * self.model.axis_in_link.into_inner();
        let closing = axis.dot(normal);
        // Nearly parallel to the plane, or away from it.
        if closing > -0.05 {
            return Ok(None);
        }
        let landed = tip + axis * ((target - tip).dot(normal) / closing);
        Ok(Some((landed - target).norm()))
    }
}

/// The part of `v` in the plane of `normal`.
fn lateral(v: &Vector3<f64>, normal: &Vector3<f64>) -> Vector3<f64> {
    v - normal * v.dot(normal)
}
