//! The arm at rest: gravity torques and the droop that they cause.

use crate::arm::ArmModel;
use nalgebra::Vector3;
use rover_kinematics::ArmError;

/// Torque of gravity on each joint at joint angles `q_rad`, N m; with the plunger released.
///
/// # Errors
/// [`ArmError`] for joint angles that do not fit the arm.
pub fn gravity_torques_nm(model: &ArmModel, q_rad: &[f64]) -> Result<Vec<f64>, ArmError> {
    let poses = model.arm.link_poses(q_rad)?;
    let gravity = model.world_from_base.rotation.inverse() * model.gravity_m_s2;
    let mut torques = vec![0.0; model.links.len()];
    // Moment of the weight of everything beyond a joint, about the base's origin, and its weight.
    let (mut moment, mut weight) = (Vector3::zeros(), Vector3::zeros());
    for joint in (0..model.links.len()).rev() {
        let link = &model.links[joint];
        let force = gravity * link.mass_kg;
        moment += (poses[joint + 1] * nalgebra::Point3::from(link.com_m))
            .coords
            .cross(&force);
        weight += force;
        let axis = poses[joint].rotation * Vector3::z();
        torques[joint] = axis.dot(&(moment - poses[joint].translation.vector.cross(&weight)));
    }
    Ok(torques)
}

/// The true joint angles at which the arm rests when its drives' springs are at `rest_rad` and
/// nothing but gravity acts: the droop is torque over stiffness at the drooped angles.
///
/// # Errors
/// [`ArmError`] for joint angles that do not fit the arm.
pub fn drooped_angles_rad(model: &ArmModel, rest_rad: &[f64]) -> Result<Vec<f64>, ArmError> {
    let mut q = rest_rad.to_vec();
    // Each round gains the ratio of gravity's own stiffness to the drives', three digits.
    for _ in 0..12 {
        let torques = gravity_torques_nm(model, &q)?;
        for (i, torque) in torques.iter().enumerate() {
            q[i] = rest_rad[i] + torque / model.links[i].stiffness_nm_rad;
        }
    }
    Ok(q)
}
