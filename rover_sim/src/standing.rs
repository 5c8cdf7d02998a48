//! A rover that stands: body and arm on springs for heave, pitch and roll.
//!
//! Rigid contacts under a rocker-bogie are statically determinate and give next to nothing; what
//! tilts a real rover when its arm moves is the compliance of tyres, soil and structure. It is
//! modelled as three springs between the ground and the body, at the suspension's pivot. With the
//! arm as it was when the wheels came to rest they hold the body where it stood.

use crate::{
    arm::ArmModel,
    convert::{isometry, pose, vector},
    rover::Lump,
};
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use rapier3d::prelude as rp;
use rover_kinematics::ArmError;
use rover_robot::ComplianceDescription;

/// Indices of rapier's generalised coordinates: along z, about y, about x.
const AXES: [usize; 3] = [2, 4, 3];
/// Mass of the links between the springs, kg.
const BETWEEN_KG: f64 = 0.05;

/// What a standing rover is made of.
#[derive(Clone, Debug)]
pub struct Standing {
    /// Where it stands, world frame.
    pub world_from_rover: Isometry3<f64>,
    /// The suspension's pivot, rover frame, m.
    pub pivot_m: Vector3<f64>,
    /// Mass of body and suspension, kg.
    pub mass_kg: f64,
    /// Their centre of mass, rover frame, m.
    pub com_m: Vector3<f64>,
    /// Their principal moments of inertia, kg m^2.
    pub inertia_kg_m2: Vector3<f64>,
    /// The springs.
    pub compliance: ComplianceDescription,
    /// True joint angles of the arm with which it stands there, rad.
    pub held_at_rad: Vec<f64>,
}

/// The springs' links in rapier's world.
#[derive(Clone, Debug)]
pub(crate) struct Base {
    joints: [rp::MultibodyJointHandle; 3],
    pub body: rp::RigidBodyHandle,
    stiffness: [f64; 3],
    rest: [f64; 3],
    pub damping: [f64; 3],
}

impl Standing {
    fn pivot_from_world(&self) -> Isometry3<f64> {
        (self.world_from_rover * Isometry3::from(self.pivot_m)).inverse()
    }

    /// Stiffness of heave, pitch and roll.
    fn stiffness(&self) -> [f64; 3] {
        let c = &self.compliance;
        [c.heave_n_m, c.pitch_nm_rad, c.roll_nm_rad]
    }

    /// Weight of the arm at true joint angles `q_rad`: force along z and moments about y and x of
    /// the pivot, N and N m; the body's own weight not included.
    fn arm_load(&self, model: &ArmModel, q_rad: &[f64]) -> Result<[f64; 3], ArmError> {
        let poses = model.arm.link_poses(q_rad)?;
        let pivot_from_world = self.pivot_from_world();
        let gravity = pivot_from_world.rotation * model.gravity_m_s2;
        let (mut force, mut moment) = (Vector3::zeros(), Vector3::zeros());
        for (link, pose) in model.links.iter().zip(&poses[1..]) {
            let com = model.world_from_base * (pose * Point3::from(Vector3::from(link.com_m)));
            let weight = gravity * link.mass_kg;
            force += weight;
            moment += (pivot_from_world * com).coords.cross(&weight);
        }
        Ok([force.z, moment.y, moment.x])
    }

    fn body_load(&self, model: &ArmModel) -> [f64; 3] {
        let gravity = self.pivot_from_world().rotation * model.gravity_m_s2;
        let weight = gravity * self.mass_kg;
        let moment = (self.com_m - self.pivot_m).cross(&weight);
        [weight.z + 2.0 * BETWEEN_KG * gravity.z, moment.y, moment.x]
    }

    /// The pose of the rover with the arm at rest at true joint angles `q_rad`, world frame, by
    /// statics alone.
    ///
    /// # Errors
    /// [`ArmError`] for joint angles that do not fit the arm.
    pub fn tilted(&self, model: &ArmModel, q_rad: &[f64]) -> Result<Isometry3<f64>, ArmError> {
        let (now, held) = (
            self.arm_load(model, q_rad)?,
            self.arm_load(model, &self.held_at_rad)?,
        );
        let k = self.stiffness();
        let [heave, pitch, roll] = [0, 1, 2].map(|i| (now[i] - held[i]) / k[i]);
        let turn = UnitQuaternion::from_scaled_axis(Vector3::y() * pitch)
            * UnitQuaternion::from_scaled_axis(Vector3::x() * roll);
        let moved = Isometry3::from_parts(Vector3::new(0.0, 0.0, heave).into(), turn);
        let pivot = Isometry3::from(self.pivot_m);
        Ok(self.world_from_rover * pivot * moved * pivot.inverse())
    }

    /// Inserts springs and body. The body's frame is the rover frame.
    pub(crate) fn insert(
        &self,
        world: &mut rp::PhysicsWorld,
        model: &ArmModel,
    ) -> Result<Base, ArmError> {
        let at = self.world_from_rover * Isometry3::from(self.pivot_m);
        let mut parent = world.insert_body(rp::RigidBodyBuilder::fixed().pose(pose(&at)));
        let arm_kg: f64 = model.links.iter().map(|l| l.mass_kg).sum();
        let d = self.com_m - self.pivot_m;
        let about =
            |i: usize| self.inertia_kg_m2[i] + self.mass_kg * (d.norm_squared() - d[i] * d[i]);
        let inertia = [self.mass_kg + arm_kg, about(1), about(0)];
        let stiffness = self.stiffness();
        let damping = [0, 1, 2]
            .map(|i| 2.0 * self.compliance.damping_ratio * (stiffness[i] * inertia[i]).sqrt());
        let (own, arm) = (
            self.body_load(model),
            self.arm_load(model, &self.held_at_rad)?,
        );
        let mut joints = [rp::MultibodyJointHandle::invalid(); 3];
        for (i, axis) in [
            rp::JointAxesMask::LIN_Z,
            rp::JointAxesMask::ANG_Y,
            rp::JointAxesMask::ANG_X,
        ]
        .into_iter()
        .enumerate()
        {
            let last = i == 2;
            let mass = if last {
                rp::MassProperties::new(
                    vector(&self.com_m),
                    self.mass_kg,
                    vector(&self.inertia_kg_m2),
                )
            } else {
                rp::MassProperties::new(
                    vector(&Vector3::zeros()),
                    BETWEEN_KG,
                    vector(&Vector3::repeat(1e-3)),
                )
            };
            let body = world.insert_body(
                rp::RigidBodyBuilder::dynamic()
                    .additional_mass_properties(mass)
                    .can_sleep(false),
            );
            let beyond = if last { self.pivot_m } else { Vector3::zeros() };
            let joint = rp::GenericJointBuilder::new(rp::JointAxesMask::all() & !axis)
                .local_frame2(pose(&Isometry3::from(beyond)))
                .contacts_enabled(false);
            joints[i] = world
                .multibody_joints
                .insert(parent, body, joint, true)
                .unwrap_or_else(rp::MultibodyJointHandle::invalid);
            parent = body;
        }
        Ok(Base {
            joints,
            body: parent,
            stiffness,
            // The springs hold the load with their coordinates at zero.
            rest: [0, 1, 2].map(|i| -(own[i] + arm[i]) / stiffness[i]),
            damping,
        })
    }
}

impl Base {
    pub fn set_springs(&self, joints: &mut rp::MultibodyJointSet) {
        for i in 0..3 {
            if let Some((multibody, id)) = joints.get_mut(self.joints[i])
                && let Some(link) = multibody.link_mut(id)
            {
                link.joint
                    .set_spring(AXES[i], self.stiffness[i], self.rest[i]);
            }
        }
    }

    /// Rates of pitch and roll, rad/s.
    pub fn rates(&self, joints: &rp::MultibodyJointSet) -> [f64; 2] {
        [1, 2].map(|i| {
            joints
                .get(self.joints[i])
                .and_then(|(multibody, id)| {
                    let link = multibody.link(id)?;
                    Some(multibody.joint_velocity(link)[0])
                })
                .unwrap_or(0.0)
        })
    }

    pub fn world_from_rover(&self, world: &rp::PhysicsWorld) -> Isometry3<f64> {
        isometry(world.bodies[self.body].position())
    }
}

/// The arm at true joint angles `q_rad` as one rigid lump, rover frame.
pub(crate) fn arm_lump(
    model: &ArmModel,
    world_from_rover: &Isometry3<f64>,
    q_rad: &[f64],
) -> Result<Lump, ArmError> {
    let rover_from_base = world_from_rover.inverse() * model.world_from_base;
    let poses = model.arm.link_poses(q_rad)?;
    let mut lump = Lump::default();
    for (link, pose) in model.links.iter().zip(&poses[1..]) {
        let com = rover_from_base * (pose * Point3::from(Vector3::from(link.com_m)));
        let one = Lump {
            mass_kg: link.mass_kg,
            com_m: com.coords,
            inertia_kg_m2: Vector3::from(link.inertia_kg_m2),
        };
        lump = if lump.mass_kg == 0.0 {
            one
        } else {
            lump.with(&one)
        };
    }
    Ok(lump)
}
