//! What a world is made of: the true arm, the rover that carries it, and what is in its reach.

use crate::{
    SimulationError,
    arm::{ArmModel, ArmPhysics, StaticSurface},
    description::SimulationDescription,
    rover::{Parts, Vehicle},
    standing::{Standing, arm_lump},
    statics,
    terrain::Terrain,
    truth::Truth,
};
use nalgebra::{Isometry3, Point3, Vector3};
use rover_robot::{Capsule, Robot, VehicleDynamics};

/// Centre of the arm's reach before the rover, rover frame, m, and half the width of the square of
/// terrain that the arm can touch, m.
const REACH_X_M: f64 = 0.8;
const REACH_HALF_M: f64 = 1.1;

fn vehicle_dynamics(robot: &Robot) -> Result<VehicleDynamics, SimulationError> {
    robot
        .description()
        .dynamics
        .as_ref()
        .and_then(|d| d.vehicle)
        .ok_or_else(|| SimulationError::Robot {
            robot: robot.name().into(),
            field: "dynamics.vehicle".into(),
            message: "missing; a simulator needs the masses of body and wheels".into(),
        })
}

/// The rover on its wheels, if the robot has any, with the arm at encoder angles `start_rad`.
pub(super) fn vehicle(
    robot: &Robot,
    model: &ArmModel,
    terrain: &Terrain,
    description: &SimulationDescription,
    seed: u64,
    start_rad: &[f64],
) -> Result<Option<Vehicle>, SimulationError> {
    let d = robot.description();
    let (Some(mobility), Some(dynamics)) = (&d.mobility, &d.dynamics) else {
        return Ok(None);
    };
    let parts = Parts {
        mobility,
        dynamics: &vehicle_dynamics(robot)?,
        arm: arm_lump(model, &Isometry3::identity(), start_rad)?,
        gravity_m_s2: Vector3::from(dynamics.gravity_m_s2),
    };
    Vehicle::new(&parts, terrain, description, seed).map(Some)
}

/// Puts the arm on the rover where it stands: its base, the springs under the body, and the body's
/// shape.
pub(super) fn stand(
    model: &mut ArmModel,
    robot: &Robot,
    truth: &Truth,
    world_from_rover: &Isometry3<f64>,
    rest_rad: &[f64],
) -> Result<(), SimulationError> {
    let d = robot.description();
    let v = vehicle_dynamics(robot)?;
    let Some(mobility) = &d.mobility else {
        return Ok(());
    };
    model.world_from_base = world_from_rover * truth.rover_from_base;
    let placed = |p: [f64; 3]| (world_from_rover * Point3::from(p)).coords.into();
    model.body = d
        .body
        .iter()
        .map(|c| Capsule {
            from_m: placed(c.from_m),
            to_m: placed(c.to_m),
            radius_m: c.radius_m,
        })
        .collect();
    let [x, z] = mobility.rocker_pivot_m;
    // Suspension and wheels stand on the ground: they do not tilt with the body.
    model.standing = Some(Standing {
        world_from_rover: *world_from_rover,
        pivot_m: Vector3::new(x, 0.0, z),
        mass_kg: v.body_kg,
        com_m: v.body_com_m.into(),
        inertia_kg_m2: v.body_inertia_kg_m2.into(),
        compliance: v.compliance,
        held_at_rad: statics::drooped_angles_rad(model, rest_rad)?,
    });
    Ok(())
}

/// The arm's world with what it can reach.
pub(super) fn arm_physics(
    model: &ArmModel,
    terrain: &Terrain,
    q0_rad: &[f64],
) -> Result<ArmPhysics, SimulationError> {
    let mut arm = ArmPhysics::new(model, &[], q0_rad)?;
    surround(&mut arm, model, terrain, &[])?;
    Ok(arm)
}

/// Puts what the arm can reach into its world, but for the bodies that are gone: all the terrain,
/// or around a rover that stands the part before it.
pub(super) fn surround(
    arm: &mut ArmPhysics,
    model: &ArmModel,
    terrain: &Terrain,
    gone: &[usize],
) -> Result<(), SimulationError> {
    let bodies = terrain.bodies.iter().enumerate();
    let Some(standing) = &model.standing else {
        let surfaces: Vec<_> = bodies
            .map(|(i, body)| StaticSurface {
                name: Terrain::name(i),
                positions: &body.mesh.positions,
                triangles: &body.mesh.triangles,
            })
            .collect();
        return arm.surround(model, &surfaces);
    };
    let centre = standing.world_from_rover * Point3::new(REACH_X_M, 0.0, 0.0);
    let near: Vec<_> = bodies
        .map(|(i, _)| {
            if gone.contains(&i) {
                (Vec::new(), Vec::new())
            } else {
                terrain.part(i, [centre.x, centre.y], REACH_HALF_M)
            }
        })
        .collect();
    let surfaces: Vec<_> = near
        .iter()
        .enumerate()
        .map(|(i, (positions, triangles))| StaticSurface {
            name: Terrain::name(i),
            positions,
            triangles,
        })
        .collect();
    arm.surround(model, &surfaces)
}

/// The true arm for rapier.
pub(crate) fn arm_model(
    robot: &Robot,
    truth: &Truth,
    description: &SimulationDescription,
) -> Result<ArmModel, SimulationError> {
    let d = robot.description();
    let dynamics = d.dynamics.as_ref().ok_or_else(|| SimulationError::Robot {
        robot: d.name.clone(),
        field: "dynamics".into(),
        message: "missing; a simulator needs masses and stiffnesses".into(),
    })?;
    let droop = if description.truth.droop { 1.0 } else { 0.0 };
    Ok(ArmModel {
        arm: truth.arm.clone(),
        world_from_base: truth.rover_from_base,
        standing: None,
        links: dynamics.links.clone(),
        shapes: d.arm.joints.iter().map(|j| j.shape.clone()).collect(),
        body: d.body.clone(),
        tip_in_link: robot.tool.tip_in_link,
        axis_in_link: robot.tool.axis_in_link,
        switch: d.tool.switch,
        contact: description.contact,
        gravity_m_s2: Vector3::from(dynamics.gravity_m_s2) * droop,
        step_s: description.step_s,
    })
}
