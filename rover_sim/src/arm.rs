//! The arm as rapier sees it: one multibody of links, compliant drives and the switch's plunger.
//!
//! Each link is a body whose frame is the link's Denavit-Hartenberg frame. A drive is a joint
//! spring, an implicit term of the mass matrix: its rest angle is the motor shaft's angle and its
//! stiffness that of gearbox and link in series, so gravity and contact bend the arm by
//! `J^T F / k` and nothing rings. Joint motors would be solved iteratively and leave errors that
//! look like droop and are none.

use crate::{
    SimulationError, contact_switch,
    contact_switch::Plunger,
    convert::{isometry, pose, vector},
    description::ContactDescription,
    standing::{Base, Standing},
};
use nalgebra::{Isometry3, Point3, Unit, Vector3};
use rapier3d::prelude as rp;
use rover_kinematics::Arm;
use rover_robot::{Capsule, ContactSwitch, LinkDynamics};
use std::ops::RangeInclusive;

/// Index of rapier's generalised coordinate about z.
const ANGLE_Z: usize = 5;

const TERRAIN: rp::Group = rp::Group::GROUP_1;
const BODY: rp::Group = rp::Group::GROUP_2;
const LINKS: rp::Group = rp::Group::GROUP_3;
pub(crate) const PLUNGER: rp::Group = rp::Group::GROUP_4;

/// What the arm is made of; the true one.
#[derive(Clone, Debug)]
pub struct ArmModel {
    /// Kinematics.
    pub arm: Arm,
    /// Pose of the base, world frame; of a rover that stands as the wheels left it.
    pub world_from_base: Isometry3<f64>,
    /// The rover that carries the base; `None` if it is fixed to the world.
    pub standing: Option<Standing>,
    /// Mass, compliance and torque of each joint and its link.
    pub links: Vec<LinkDynamics>,
    /// Shape of each link, link frame.
    pub shapes: Vec<Vec<Capsule>>,
    /// Shape of the body that carries the arm, world frame.
    pub body: Vec<Capsule>,
    /// Contact point with the plunger released, last link frame, m.
    pub tip_in_link: Vector3<f64>,
    /// Approach direction, last link frame.
    pub axis_in_link: Unit<Vector3<f64>>,
    /// The plunger's spring and travel.
    pub switch: ContactSwitch,
    /// Contact mechanics.
    pub contact: ContactDescription,
    /// Gravity, world frame, m/s^2.
    pub gravity_m_s2: Vector3<f64>,
    /// Physics step, s.
    pub step_s: f64,
}

/// The surface of a body that stands still, world frame.
#[derive(Clone, Debug)]
pub struct StaticSurface<'a> {
    /// Name for messages.
    pub name: String,
    /// Vertices, m.
    pub positions: &'a [Vector3<f64>],
    /// Triangles, counter-clockwise from outside; none for a body that is out of reach.
    pub triangles: &'a [[u32; 3]],
}

/// What touches what after a step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Contacts {
    /// Touch of the plunger's ball.
    pub tip: Option<TipContact>,
    /// Force on anything else of the arm, N, and the link (from 0) that it acts on.
    pub elsewhere: Option<(usize, f64)>,
}

/// Touch of the plunger's ball on something solid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TipContact {
    /// Where, world frame, m.
    pub point_m: Vector3<f64>,
    /// Direction of the force on the ball, world frame.
    pub normal: Unit<Vector3<f64>>,
    /// Normal force along the plunger's axis, N.
    pub axial_force_n: f64,
}

/// The arm in its world.
pub struct ArmPhysics {
    world: rp::PhysicsWorld,
    joints: Vec<rp::MultibodyJointHandle>,
    links: Vec<rp::RigidBodyHandle>,
    link_colliders: Vec<(usize, rp::ColliderHandle)>,
    plunger: Plunger,
    statics: Vec<Option<rp::ColliderHandle>>,
    world_from_base: Isometry3<f64>,
    base: Option<Base>,
    tip_in_link: Vector3<f64>,
    stiffness_nm_rad: Vec<f64>,
}

impl ArmPhysics {
    /// Builds the arm at joint angles `q0_rad` with the drives at rest there, and the surfaces
    /// around it.
    ///
    /// # Errors
    /// [`SimulationError`] for a surface of which no collider can be made.
    pub fn new(
        model: &ArmModel,
        surfaces: &[StaticSurface<'_>],
        q0_rad: &[f64],
    ) -> Result<Self, SimulationError> {
        let mut world = rp::PhysicsWorld::new();
        world.gravity = vector(&model.gravity_m_s2);
        set_parameters(&mut world.integration_parameters, model);
        let statics = insert_surfaces(&mut world, model, surfaces)?;
        for capsule in &model.body {
            let groups = groups(BODY, LINKS | PLUNGER);
            world.insert_collider(capsule_collider(capsule, groups, model), None);
        }
        let base = model
            .standing
            .as_ref()
            .map(|standing| standing.insert(&mut world, model))
            .transpose()?;
        let root = match &base {
            Some(base) => base.body,
            None => {
                world.insert_body(rp::RigidBodyBuilder::fixed().pose(pose(&model.world_from_base)))
            }
        };
        let mut arm = Self {
            joints: Vec::new(),
            links: Vec::new(),
            link_colliders: Vec::new(),
            plunger: Plunger::default(),
            statics,
            world_from_base: model.world_from_base,
            base,
            tip_in_link: model.tip_in_link,
            stiffness_nm_rad: model.links.iter().map(|l| l.stiffness_nm_rad).collect(),
            world,
        };
        let mut parent = root;
        for i in 0..model.links.len() {
            parent = arm.insert_link(model, i, parent);
        }
        arm.plunger = contact_switch::insert(&mut arm.world, model, parent);
        arm.finish(model, q0_rad);
        Ok(arm)
    }

    fn insert_link(
        &mut self,
        model: &ArmModel,
        i: usize,
        parent: rp::RigidBodyHandle,
    ) -> rp::RigidBodyHandle {
        let link = &model.links[i];
        let (mut mass, mut com) = (link.mass_kg, Vector3::from(link.com_m));
        if i + 1 == model.links.len() {
            // The plunger is part of the last link's mass and a body of its own here.
            let plunger = model.contact.plunger_mass_kg;
            com = (com * mass - model.tip_in_link * plunger) / (mass - plunger);
            mass -= plunger;
        }
        let inertia = Vector3::from(link.inertia_kg_m2);
        let properties = rp::MassProperties::new(vector(&com), mass, vector(&inertia));
        let body = rp::RigidBodyBuilder::dynamic()
            .additional_mass_properties(properties)
            .can_sleep(false);
        let body = self.world.insert_body(body);
        for capsule in &model.shapes[i] {
            // The first link is mounted to the body.
            let others = if i == 0 { TERRAIN } else { TERRAIN | BODY };
            let collider = capsule_collider(capsule, groups(LINKS, others), model);
            self.link_colliders
                .push((i, self.world.insert_collider(collider, Some(body))));
        }
        let row = &model.arm.rows()[i];
        let mut offset = Isometry3::rotation(Vector3::z() * row.theta_offset_rad);
        if let (0, Some(standing)) = (i, &model.standing) {
            offset = standing.world_from_rover.inverse() * model.world_from_base * offset;
        }
        let beyond = Isometry3::translation(row.a_m, 0.0, row.d_m)
            * Isometry3::rotation(Vector3::x() * row.alpha_rad);
        let joint = rp::GenericJointBuilder::new(rp::JointAxesMask::LOCKED_REVOLUTE_AXES)
            .locked_axes(rp::JointAxesMask::all() & !rp::JointAxesMask::ANG_Z)
            .local_frame1(pose(&offset))
            .local_frame2(pose(&beyond.inverse()))
            .contacts_enabled(false);
        if let Some(handle) = self
            .world
            .multibody_joints
            .insert(parent, body, joint, true)
        {
            self.joints.push(handle);
        }
        self.links.push(body);
        body
    }

    /// Sets angles, damping and springs of the finished chain.
    fn finish(&mut self, model: &ArmModel, q0_rad: &[f64]) {
        let world = &mut self.world;
        let Some((multibody, _)) = world.multibody_joints.get_mut(self.plunger.joint) else {
            return;
        };
        multibody.set_self_contacts_enabled(false);
        // Degrees of freedom are counted only now; before, a fixed root still has six.
        multibody.forward_kinematics(&world.bodies, true);
        let dofs = multibody.ndofs();
        let first = dofs - model.links.len() - 1;
        for (i, link) in model.links.iter().enumerate() {
            multibody.damping_mut()[first + i] = link.damping_nms_rad;
        }
        multibody.damping_mut()[dofs - 1] = model.contact.plunger_damping_ns_m;
        if let Some(base) = &self.base {
            for (i, damping) in base.damping.iter().enumerate() {
                multibody.damping_mut()[first - 3 + i] = *damping;
            }
        }
        for (handle, &q) in self.joints.iter().zip(q0_rad) {
            if let Some((multibody, id)) = world.multibody_joints.get_mut(*handle)
                && let Some(link) = multibody.link_mut(id)
            {
                link.joint.apply_displacement(&[q]);
            }
        }
        self.plunger.set_spring(&mut world.multibody_joints);
        if let Some(base) = &self.base {
            base.set_springs(&mut world.multibody_joints);
        }
        if let Some((multibody, _)) = world.multibody_joints.get_mut(self.plunger.joint) {
            multibody.forward_kinematics(&world.bodies, true);
            multibody.update_rigid_bodies(&mut world.bodies, true);
        }
        self.set_rest(q0_rad);
    }

    /// Sets the rest angles of the drives' springs, rad.
    pub fn set_rest(&mut self, rest_rad: &[f64]) {
        for ((handle, &rest), &k) in self.joints.iter().zip(rest_rad).zip(&self.stiffness_nm_rad) {
            if let Some((multibody, id)) = self.world.multibody_joints.get_mut(*handle)
                && let Some(link) = multibody.link_mut(id)
            {
                link.joint.set_spring(ANGLE_Z, k, rest);
            }
        }
    }

    /// One physics step.
    pub fn step(&mut self) {
        self.plunger.set_spring(&mut self.world.multibody_joints);
        self.world.step();
    }

    /// Writes the true joint angles, rad, and rates, rad/s.
    pub fn read(&self, angles_rad: &mut [f64], rates_rad_s: &mut [f64]) {
        for (i, handle) in self.joints.iter().enumerate() {
            if let Some((multibody, id)) = self.world.multibody_joints.get(*handle)
                && let Some(link) = multibody.link(id)
            {
                angles_rad[i] = link.joint().coords()[ANGLE_Z];
                rates_rad_s[i] = multibody.joint_velocity(link)[0];
            }
        }
    }

    /// Travel of the plunger, m, positive when pressed in.
    pub fn switch_travel_m(&self) -> f64 {
        self.plunger.travel_m(&self.world.multibody_joints)
    }

    /// Pose of a link (from 0), world frame.
    pub fn world_from_link(&self, link: usize) -> Isometry3<f64> {
        isometry(self.world.bodies[self.links[link]].position())
    }

    /// Pose of the base with a rigid mount, world frame.
    pub fn world_from_base(&self) -> Isometry3<f64> {
        self.world_from_base
    }

    /// Pose of the rover that carries the arm, world frame, if there is one.
    pub fn world_from_rover(&self) -> Option<Isometry3<f64>> {
        self.base.as_ref().map(|b| b.world_from_rover(&self.world))
    }

    /// Rates of the rover's pitch and roll, rad/s, if there is one.
    pub fn tilt_rates_rad_s(&self) -> Option<[f64; 2]> {
        self.base
            .as_ref()
            .map(|b| b.rates(&self.world.multibody_joints))
    }

    /// Pose of the plunger: origin at the ball's centre, z along the approach axis, world frame.
    pub fn world_from_plunger(&self) -> Isometry3<f64> {
        isometry(self.world.bodies[self.plunger.body].position())
    }

    /// Where the contact point is with the plunger released, world frame, m.
    pub fn tip_in_world(&self) -> Vector3<f64> {
        let world_from_link = self.world_from_link(self.links.len() - 1);
        (world_from_link * Point3::from(self.tip_in_link)).coords
    }

    /// What touched what in the last step.
    pub fn contacts(&self) -> Contacts {
        let narrow = &self.world.narrow_phase;
        let dt = self.world.integration_parameters.dt;
        let tip = self.plunger.contact(&self.world, dt);
        let mut elsewhere: Option<(usize, f64)> = None;
        for &(link, collider) in &self.link_colliders {
            for pair in narrow.contact_pairs_with(collider) {
                let force_n = pair.total_impulse_magnitude() / dt;
                if force_n > elsewhere.map_or(0.0, |(_, f)| f) {
                    elsewhere = Some((link, force_n));
                }
            }
        }
        Contacts { tip, elsewhere }
    }

    /// Puts the surfaces into a world that has none yet.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn surround(
        &mut self,
        model: &ArmModel,
        surfaces: &[StaticSurface<'_>],
    ) -> Result<(), SimulationError> {
        self.statics = insert_surfaces(&mut self.world, model, surfaces)?;
        Ok(())
    }

    /// Takes a surface (its index in the order given to [`Self::new`]) out of the world. Returns
    /// whether it was there.
    pub fn remove_surface(&mut self, index: usize) -> bool {
        let Some(handle) = self.statics.get_mut(index).and_then(Option::take) else {
            return false;
        };
        self.world.remove_collider(handle).is_some()
    }
}

fn set_parameters(p: &mut rp::IntegrationParameters, model: &ArmModel) {
    p.dt = model.step_s;
    // An iteration is a substep of its own: n of them are the same as one at dt / n.
    p.num_solver_iterations = 1;
    let softness = rp::SpringCoefficients::new(
        model.contact.natural_frequency_hz,
        model.contact.damping_ratio,
    );
    p.contact_softness = softness;
    p.static_contact_softness = softness;
    p.contact_recycling = false;
    p.max_ccd_substeps = 0;
    p.normalized_prediction_distance = 0.002;
}

fn groups(member: rp::Group, others: rp::Group) -> rp::InteractionGroups {
    rp::InteractionGroups::new(member, others, Default::default())
}

pub(crate) fn plunger_groups() -> rp::InteractionGroups {
    groups(PLUNGER, TERRAIN | BODY)
}

fn capsule_collider(
    capsule: &Capsule,
    groups: rp::InteractionGroups,
    model: &ArmModel,
) -> rp::ColliderBuilder {
    let (a, b) = (Vector3::from(capsule.from_m), Vector3::from(capsule.to_m));
    let builder = if (a - b).norm() < 1e-9 {
        rp::ColliderBuilder::ball(capsule.radius_m).translation(vector(&a))
    } else {
        rp::ColliderBuilder::capsule_from_endpoints(vector(&a), vector(&b), capsule.radius_m)
    };
    builder
        .density(0.0)
        .friction(model.contact.friction)
        .collision_groups(groups)
}

/// The colliders of surfaces in their order; none for one without triangles.
fn insert_surfaces(
    world: &mut rp::PhysicsWorld,
    model: &ArmModel,
    surfaces: &[StaticSurface<'_>],
) -> Result<Vec<Option<rp::ColliderHandle>>, SimulationError> {
    surfaces
        .iter()
        .map(|s| {
            if s.triangles.is_empty() {
                return Ok(None);
            }
            let collider = surface_collider(s, model)?;
            Ok(Some(world.insert_collider(collider, None)))
        })
        .collect()
}

fn surface_collider(
    surface: &StaticSurface<'_>,
    model: &ArmModel,
) -> Result<rp::ColliderBuilder, SimulationError> {
    let positions = surface.positions.iter().map(vector).collect();
    let builder = rp::ColliderBuilder::trimesh_with_flags(
        positions,
        surface.triangles.to_vec(),
        rp::TriMeshFlags::FIX_INTERNAL_EDGES,
    )
    .map_err(|e| SimulationError::Collider {
        body: surface.name.clone(),
        message: e.to_string(),
    })?;
    Ok(builder
        .friction(model.contact.friction)
        .collision_groups(groups(TERRAIN, LINKS | PLUNGER)))
}

/// The range that a simulated contact's natural frequency may have, Hz.
pub(crate) const CONTACT_FREQUENCY_HZ: RangeInclusive<f64> = 30.0..=2000.0;
