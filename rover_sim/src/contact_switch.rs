//! The contact switch: a ball on a sprung plunger, the last link of the arm's multibody.
//!
//! The plunger slides along the instrument's axis between its outer stop (travel 0, where the
//! spring holds it with its preload) and its inner stop. With the plunger released the foremost
//! point of the ball is the robot's `tool.tip`.

use crate::{
    arm::{ArmModel, TipContact, plunger_groups},
    convert::{nalgebra_vector, pose, vector},
};
use nalgebra::{Isometry3, Unit, UnitQuaternion, Vector3};
use rapier3d::prelude as rp;

/// Index of rapier's generalised coordinate along z.
const ALONG_Z: usize = 2;

/// Stiffness of the inner stop, N/m. A rigid limit in series with a stiff contact would leave the
/// arm ringing when it is pressed on.
const INNER_STOP_N_M: f64 = 1e5;

/// The plunger in rapier's world.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Plunger {
    pub joint: rp::MultibodyJointHandle,
    pub body: rp::RigidBodyHandle,
    collider: rp::ColliderHandle,
    spring_n_m: f64,
    rest_m: f64,
    inner_stop_m: f64,
    ball_radius_m: f64,
}

impl Default for Plunger {
    fn default() -> Self {
        Self {
            joint: rp::MultibodyJointHandle::invalid(),
            body: rp::RigidBodyHandle::invalid(),
            collider: rp::ColliderHandle::invalid(),
            spring_n_m: 0.0,
            rest_m: 0.0,
            inner_stop_m: 0.0,
            ball_radius_m: 0.0,
        }
    }
}

/// Pose of the released plunger: origin at the ball's centre, z along the approach axis.
pub(crate) fn link_from_ball(model: &ArmModel) -> Isometry3<f64> {
    let axis = model.axis_in_link.into_inner();
    let turn = UnitQuaternion::rotation_between(&Vector3::z(), &axis)
        .unwrap_or_else(|| UnitQuaternion::from_scaled_axis(Vector3::x() * std::f64::consts::PI));
    Isometry3::from_parts(
        (model.tip_in_link - axis * model.switch.ball_radius_m).into(),
        turn,
    )
}

/// Adds the plunger to the arm's last link.
pub(crate) fn insert(
    world: &mut rp::PhysicsWorld,
    model: &ArmModel,
    link: rp::RigidBodyHandle,
) -> Plunger {
    let (switch, contact) = (&model.switch, &model.contact);
    let (radius, mass) = (switch.ball_radius_m, contact.plunger_mass_kg);
    let link_from_ball = link_from_ball(model);
    // A rod of that mass, a few centimetres long.
    let inertia = Vector3::new(1e-5, 1e-5, 1e-6) * (mass / 0.02);
    let properties = rp::MassProperties::new(vector(&Vector3::zeros()), mass, vector(&inertia));
    let body = world.insert_body(
        rp::RigidBodyBuilder::dynamic()
            .additional_mass_properties(properties)
            .can_sleep(false),
    );
    let ball = rp::ColliderBuilder::ball(radius)
        .density(0.0)
        .friction(contact.friction)
        .collision_groups(plunger_groups());
    let collider = world.insert_collider(ball, Some(body));
    let joint = rp::GenericJointBuilder::new(rp::JointAxesMask::LOCKED_PRISMATIC_AXES)
        .locked_axes(rp::JointAxesMask::all() & !rp::JointAxesMask::LIN_Z)
        .local_frame1(pose(&link_from_ball))
        .limits(rp::JointAxis::LinZ, [-2.0 * switch.travel_m, 0.0])
        .contacts_enabled(false);
    let joint = world
        .multibody_joints
        .insert(link, body, joint, true)
        .unwrap_or_else(rp::MultibodyJointHandle::invalid);
    Plunger {
        joint,
        body,
        collider,
        spring_n_m: switch.spring_n_m,
        rest_m: switch.preload_n / switch.spring_n_m,
        inner_stop_m: switch.travel_m,
        ball_radius_m: radius,
    }
}

impl Plunger {
    /// Sets the spring for the next step: the switch's own, and past the inner stop that of the
    /// stop beside it, as one linear spring with the sum of both forces.
    pub fn set_spring(&self, joints: &mut rp::MultibodyJointSet) {
        let pressed = self.travel_m(joints) > self.inner_stop_m;
        let stop_n_m = if pressed { INNER_STOP_N_M } else { 0.0 };
        let stiffness_n_m = self.spring_n_m + stop_n_m;
        let rest_m = (self.spring_n_m * self.rest_m - stop_n_m * self.inner_stop_m) / stiffness_n_m;
        if let Some((multibody, id)) = joints.get_mut(self.joint)
            && let Some(link) = multibody.link_mut(id)
        {
            link.joint.set_spring(ALONG_Z, stiffness_n_m, rest_m);
        }
    }

    pub fn travel_m(&self, joints: &rp::MultibodyJointSet) -> f64 {
        joints
            .get(self.joint)
            .and_then(|(multibody, id)| multibody.link(id))
            .map_or(0.0, |link| -link.joint().coords()[ALONG_Z])
    }

    /// The touch of the ball in the last step, of `dt` seconds.
    pub fn contact(&self, world: &rp::PhysicsWorld, dt: f64) -> Option<TipContact> {
        let mut force = Vector3::zeros();
        for pair in world.narrow_phase.contact_pairs_with(self.collider) {
            let impulse = nalgebra_vector(&pair.total_impulse());
            // The impulse points from the first collider to the second.
            let on_ball = if pair.collider1 == self.collider {
                -impulse
            } else {
                impulse
            };
            force += on_ball / dt;
        }
        let normal = Unit::try_new(force, 1e-9)?;
        let ball = world.bodies[self.body].position();
        let axis = nalgebra_vector(&(ball.rotation * rp::Vector::Z));
        let centre = nalgebra_vector(&ball.translation);
        Some(TipContact {
            point_m: centre - normal.into_inner() * self.ball_radius_m,
            normal,
            axial_force_n: -force.dot(&axis),
        })
    }
}

/// Opens and closes with hysteresis on the plunger's travel.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Switch {
    pub closes_at_m: f64,
    pub opens_at_m: f64,
    /// A dead switch never closes.
    pub dead: bool,
    pub closed: bool,
}

impl Switch {
    /// Takes a new travel and says whether the switch has closed just now.
    pub fn update(&mut self, travel_m: f64) -> bool {
        let before = self.closed;
        self.closed = !self.dead
            && travel_m
                >= if before {
                    self.opens_at_m
                } else {
                    self.closes_at_m
                };
        self.closed && !before
    }
}
