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
        let true_pair = self
            .truth
            .pair(&target.pair)
            .ok_or_else(|| fault("unknown_pair", format!("no camera pair `{}`", target.pair)))?;
        let believed_from_true = true_pair.believed_from_true;
        let surface = self
            .designate(&target.pair, target.pixel_px)
            .map_err(|e| fault("no_surface", e.to_string()))?;
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
        let believed_target = believed_from_true.inverse() * Point3::from(target.position_m.coords);
        let encoders = self.state().joints_rad;
        let believed_tip = self
            .robot
            .rover_from_link(&encoders)
            .map(|pose| pose.isometry * Point3::from(self.robot.tool.tip_in_link))
            .map_err(|e| fault("bad_joints", e.to_string()))?;
        let seen_tip = believed_from_true * Point3::from(self.tip_in_world());
        Ok(Score {
            target_in_world_m: at.into(),
            normal_in_world: normal.into_inner().into(),
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
        let world_from_link = self.model.world_from_base * base_from_link;
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
