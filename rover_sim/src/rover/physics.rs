//! The driving rover as rapier sees it: one multibody of body, rockers, bogies, steering drives
//! and wheels on the terrain.
//!
//! Everything is in reduced coordinates and every drive is a joint spring, an implicit term of the
//! mass matrix: with joints solved iteratively the wheels creep down slopes by centimetres per
//! minute. The differential couples the two rockers' angles exactly. Wheels are balls: they roll
//! over facets without edges of their own.

use crate::{
    SimulationError,
    convert::{isometry, nalgebra_vector, pose, vector},
    terrain::Terrain,
};
use nalgebra::{Isometry3, Vector3};
use rapier3d::prelude as rp;
use rover_robot::{MobilityDescription, VehicleDynamics};

/// Indices of rapier's generalised coordinates about y and z.
const ABOUT_Y: usize = 4;
const ABOUT_Z: usize = 5;

const WHEEL_STIFFNESS_NM_RAD: f64 = 2000.0;
const WHEEL_DAMPING_NMS_RAD: f64 = 20.0;
const STEER_STIFFNESS_NM_RAD: f64 = 5000.0;
const STEER_DAMPING_NMS_RAD: f64 = 50.0;
const ROCKER_DAMPING_NMS_RAD: f64 = 8.0;
const BOGIE_DAMPING_NMS_RAD: f64 = 3.0;

const TERRAIN: rp::Group = rp::Group::GROUP_1;
const WHEELS: rp::Group = rp::Group::GROUP_2;

/// Mass, centre of mass and principal moments of inertia of something rigid, rover frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Lump {
    pub mass_kg: f64,
    pub com_m: Vector3<f64>,
    pub inertia_kg_m2: Vector3<f64>,
}

impl Lump {
    /// Both together; products of inertia are left out.
    pub fn with(&self, other: &Self) -> Self {
        let mass_kg = self.mass_kg + other.mass_kg;
        let com_m = (self.com_m * self.mass_kg + other.com_m * other.mass_kg) / mass_kg;
        let steiner = |l: &Self| {
            let d = (l.com_m - com_m).map(|x| x * x);
            l.inertia_kg_m2 + Vector3::new(d.y + d.z, d.z + d.x, d.x + d.y) * l.mass_kg
        };
        Self {
            mass_kg,
            com_m,
            inertia_kg_m2: steiner(self) + steiner(other),
        }
    }
}

/// Where the wheels' centres are on level ground, rover frame, m: front left, front right, middle
/// left, middle right, rear left, rear right.
pub(crate) fn wheel_centres_m(d: &MobilityDescription) -> [Vector3<f64>; 6] {
    std::array::from_fn(|i| {
        let side = if i % 2 == 0 { 0.5 } else { -0.5 };
        Vector3::new(d.axles_x_m[i / 2], side * d.track_m, d.wheel_radius_m)
    })
}

/// The rover in its world. The body's frame is the rover frame.
pub(crate) struct RoverPhysics {
    world: rp::PhysicsWorld,
    body: rp::RigidBodyHandle,
    rockers: Vec<Limb>,
    bogies: Vec<Limb>,
    /// Front left, front right, rear left, rear right.
    steers: Vec<Limb>,
    wheels: Vec<Limb>,
    colliders: Vec<rp::ColliderHandle>,
    statics: Vec<Option<rp::ColliderHandle>>,
    wheel_torque_nm: f64,
    /// Torque of each wheel's drive at the end of the last step, N m.
    pub torque_nm: [f64; 6],
    /// Angles and rates that the wheels' springs were set to for the last step.
    last_command: [(f64, f64); 6],
}

/// A link and the joint that carries it.
#[derive(Clone, Copy)]
struct Limb {
    joint: rp::MultibodyJointHandle,
    body: rp::RigidBodyHandle,
    axis: usize,
    damping: f64,
}

impl RoverPhysics {
    pub fn new(
        d: &MobilityDescription,
        dynamics: &VehicleDynamics,
        arm: &Lump,
        gravity_m_s2: &Vector3<f64>,
        step_s: f64,
        terrain: &Terrain,
        world_from_rover: &Isometry3<f64>,
    ) -> Result<Self, SimulationError> {
        let mut world = rp::PhysicsWorld::new();
        world.gravity = vector(gravity_m_s2);
        let p = &mut world.integration_parameters;
        p.dt = step_s;
        p.num_solver_iterations = 1;
        let softness = rp::SpringCoefficients::new(500.0, 1.0);
        p.contact_softness = softness;
        p.static_contact_softness = softness;
        p.max_ccd_substeps = 0;
        // Twice as far as a wheel comes in a step at full speed: nearer, and a wheel may be deep in a
        // stone before the solver knows it; farther, and it sees triangles by the dozen.
        p.normalized_prediction_distance = 0.002;
        let statics = terrain_colliders(terrain, dynamics.friction)?
            .into_iter()
            .map(|c| c.map(|c| world.insert_collider(c, None)))
            .collect();
        let body = Lump {
            mass_kg: dynamics.body_kg,
            com_m: dynamics.body_com_m.into(),
            inertia_kg_m2: dynamics.body_inertia_kg_m2.into(),
        }
        .with(arm);
        let properties = rp::MassProperties::new(
            vector(&body.com_m),
            body.mass_kg,
            vector(&body.inertia_kg_m2),
        );
        let body = world.insert_body(
            rp::RigidBodyBuilder::dynamic()
                .pose(pose(world_from_rover))
                .additional_mass_properties(properties)
                .can_sleep(false),
        );
        let mut rover = Self {
            world,
            body,
            rockers: Vec::new(),
            bogies: Vec::new(),
            steers: Vec::new(),
            wheels: Vec::new(),
            colliders: Vec::new(),
            statics,
            wheel_torque_nm: dynamics.wheel_torque_nm,
            torque_nm: [0.0; 6],
            last_command: [(0.0, 0.0); 6],
        };
        rover.build(d, dynamics);
        rover.finish();
        Ok(rover)
    }

    /// Inserts the links, left side first, from the body outwards.
    fn build(&mut self, d: &MobilityDescription, dynamics: &VehicleDynamics) {
        let centres = wheel_centres_m(d);
        let mut wheels: [Option<Limb>; 6] = [None; 6];
        let mut steers: [Option<Limb>; 4] = [None; 4];
        for side in 0..2 {
            let y = if side == 0 { 0.5 } else { -0.5 } * d.track_m;
            let rocker_at = Vector3::new(d.rocker_pivot_m[0], y, d.rocker_pivot_m[1]);
            let bogie_at = Vector3::new(d.bogie_pivot_m[0], y, d.bogie_pivot_m[1]);
            let [front, middle, rear] = [side, 2 + side, 4 + side];
            let bar = |a: &Vector3<f64>, b: &Vector3<f64>, mass_kg: f64| {
                let along = (a - b).norm_squared() * mass_kg / 12.0;
                Lump {
                    mass_kg,
                    com_m: (a + b) / 2.0,
                    inertia_kg_m2: Vector3::new(0.2 * along + 1e-3, along + 1e-3, along + 1e-3),
                }
            };
            let rocker_mass = bar(
                &(centres[front] - rocker_at),
                &(bogie_at - rocker_at),
                dynamics.rocker_kg,
            );
            let rocker = self.limb(
                self.body,
                &rocker_at,
                ABOUT_Y,
                ROCKER_DAMPING_NMS_RAD,
                &rocker_mass,
            );
            let bogie_mass = bar(
                &(centres[middle] - bogie_at),
                &(centres[rear] - bogie_at),
                dynamics.bogie_kg,
            );
            let bogie = self.limb(
                rocker.body,
                &(bogie_at - rocker_at),
                ABOUT_Y,
                BOGIE_DAMPING_NMS_RAD,
                &bogie_mass,
            );
            let drive = Lump {
                mass_kg: dynamics.steer_kg,
                com_m: Vector3::zeros(),
                inertia_kg_m2: Vector3::repeat(1e-3),
            };
            let r2 = d.wheel_radius_m * d.wheel_radius_m * dynamics.wheel_kg;
            let wheel = Lump {
                mass_kg: dynamics.wheel_kg,
                com_m: Vector3::zeros(),
                inertia_kg_m2: Vector3::new(0.35, 0.5, 0.35) * r2,
            };
            for (wheel_n, steer_n, parent, at) in [
                (front, Some(side), rocker, centres[front] - rocker_at),
                (middle, None, bogie, centres[middle] - bogie_at),
                (rear, Some(2 + side), bogie, centres[rear] - bogie_at),
            ] {
                let (carrier, at) = match steer_n {
                    Some(n) => {
                        let steer =
                            self.limb(parent.body, &at, ABOUT_Z, STEER_DAMPING_NMS_RAD, &drive);
                        steers[n] = Some(steer);
                        (steer.body, Vector3::zeros())
                    }
                    None => (parent.body, at),
                };
                wheels[wheel_n] =
                    Some(self.limb(carrier, &at, ABOUT_Y, WHEEL_DAMPING_NMS_RAD, &wheel));
            }
            self.rockers.push(rocker);
            self.bogies.push(bogie);
        }
        self.wheels = wheels.into_iter().flatten().collect();
        self.steers = steers.into_iter().flatten().collect();
        for wheel in &self.wheels {
            let ball = rp::ColliderBuilder::ball(d.wheel_radius_m)
                .density(0.0)
                .friction(dynamics.friction)
                .collision_groups(rp::InteractionGroups::new(
                    WHEELS,
                    TERRAIN,
                    Default::default(),
                ));
            self.colliders
                .push(self.world.insert_collider(ball, Some(wheel.body)));
        }
    }

    fn limb(
        &mut self,
        parent: rp::RigidBodyHandle,
        at: &Vector3<f64>,
        axis: usize,
        damping: f64,
        mass: &Lump,
    ) -> Limb {
        let properties = rp::MassProperties::new(
            vector(&mass.com_m),
            mass.mass_kg,
            vector(&mass.inertia_kg_m2),
        );
        let body = self.world.insert_body(
            rp::RigidBodyBuilder::dynamic()
                .additional_mass_properties(properties)
                .can_sleep(false),
        );
        let free = if axis == ABOUT_Y {
            rp::JointAxesMask::ANG_Y
        } else {
            rp::JointAxesMask::ANG_Z
        };
        let joint = rp::GenericJointBuilder::new(rp::JointAxesMask::LOCKED_REVOLUTE_AXES)
            .locked_axes(rp::JointAxesMask::all() & !free)
            .local_frame1(pose(&Isometry3::translation(at.x, at.y, at.z)))
            .contacts_enabled(false);
        let joint = self
            .world
            .multibody_joints
            .insert(parent, body, joint, true)
            .unwrap_or_else(rp::MultibodyJointHandle::invalid);
        Limb {
            joint,
            body,
            axis,
            damping,
        }
    }

    /// Couples the rockers and sets damping and springs of the finished chain.
    fn finish(&mut self) {
        let [left, right] = [0, 1].map(|i| {
            let joints = &self.world.multibody_joints;
            joints.get(self.rockers[i].joint).map_or(0, |(_, id)| id)
        });
        let limbs: Vec<Limb> = self
            .rockers
            .iter()
            .chain(&self.bogies)
            .chain(&self.steers)
            .chain(&self.wheels)
            .copied()
            .collect();
        let world = &mut self.world;
        let Some((multibody, _)) = world.multibody_joints.get_mut(self.rockers[0].joint) else {
            return;
        };
        multibody.set_self_contacts_enabled(false);
        multibody.add_dof_coupling(rp::MultibodyDofCoupling {
            link1: left,
            dof1: 0,
            axis1: ABOUT_Y,
            link2: right,
            dof2: 0,
            axis2: ABOUT_Y,
            coeff: -1.0,
            offset: 0.0,
        });
        multibody.forward_kinematics(&world.bodies, true);
        // One degree of freedom per limb, in the order of insertion, after the body's six.
        let first = multibody.ndofs() - limbs.len();
        for limb in &limbs {
            if let Some((multibody, id)) = world.multibody_joints.get_mut(limb.joint) {
                multibody.damping_mut()[first + id - 1] = limb.damping;
            }
        }
        if let Some((multibody, _)) = world.multibody_joints.get_mut(self.rockers[0].joint) {
            multibody.forward_kinematics(&world.bodies, true);
            multibody.update_rigid_bodies(&mut world.bodies, true);
        }
        self.command(&[0.0; 4], &[0.0; 4], &mut [0.0; 6], &[0.0; 6]);
    }

    /// Sets the drives: angles and rates of steering and wheels, rad and rad/s. A wheel whose
    /// drive would need more than its torque stalls: its angle is drawn back. Returns which.
    pub fn command(
        &mut self,
        steer_rad: &[f64; 4],
        steer_rate: &[f64; 4],
        wheel_rad: &mut [f64; 6],
        wheel_rate: &[f64; 6],
    ) -> [bool; 6] {
        for i in 0..4 {
            let lead = STEER_DAMPING_NMS_RAD * steer_rate[i] / STEER_STIFFNESS_NM_RAD;
            self.spring(self.steers[i], STEER_STIFFNESS_NM_RAD, steer_rad[i] + lead);
        }
        let wind_up = self.wheel_torque_nm / WHEEL_STIFFNESS_NM_RAD;
        let mut stalled = [false; 6];
        for i in 0..6 {
            let (angle, rate) = self.joint_state(self.wheels[i]);
            let possible = wheel_rad[i].clamp(angle - wind_up, angle + wind_up);
            stalled[i] = possible != wheel_rad[i];
            wheel_rad[i] = possible;
            let lead = WHEEL_DAMPING_NMS_RAD * wheel_rate[i] / WHEEL_STIFFNESS_NM_RAD;
            // Where the wheel is now it came to under the last step's command.
            let (commanded, commanded_rate) = self.last_command[i];
            self.torque_nm[i] = WHEEL_STIFFNESS_NM_RAD * (commanded - angle)
                + WHEEL_DAMPING_NMS_RAD * (commanded_rate - rate);
            self.last_command[i] = (possible, wheel_rate[i]);
            self.spring(self.wheels[i], WHEEL_STIFFNESS_NM_RAD, possible + lead);
        }
        stalled
    }

    fn spring(&mut self, limb: Limb, stiffness: f64, rest: f64) {
        if let Some((multibody, id)) = self.world.multibody_joints.get_mut(limb.joint)
            && let Some(link) = multibody.link_mut(id)
        {
            link.joint.set_spring(limb.axis, stiffness, rest);
        }
    }

    fn joint_state(&self, limb: Limb) -> (f64, f64) {
        self.world
            .multibody_joints
            .get(limb.joint)
            .and_then(|(multibody, id)| {
                let link = multibody.link(id)?;
                Some((
                    link.joint().coords()[limb.axis],
                    multibody.joint_velocity(link)[0],
                ))
            })
            .unwrap_or((0.0, 0.0))
    }

    /// One physics step.
    pub fn step(&mut self) {
        self.world.step();
    }

    /// True pose of the rover.
    pub fn world_from_rover(&self) -> Isometry3<f64> {
        isometry(self.world.bodies[self.body].position())
    }

    /// Speeds of the body: m/s and rad/s.
    pub fn speeds(&self) -> (f64, f64) {
        let body = &self.world.bodies[self.body];
        (body.linvel().length(), body.angvel().length())
    }

    /// Angles of left rocker, right rocker, left bogie, right bogie, rad.
    pub fn suspension_rad(&self) -> [f64; 4] {
        [
            self.rockers[0],
            self.rockers[1],
            self.bogies[0],
            self.bogies[1],
        ]
        .map(|l| self.joint_state(l).0)
    }

    /// Poses of rockers, bogies and wheels in this order, world frame.
    pub fn part_poses(&self) -> Vec<Isometry3<f64>> {
        self.rockers
            .iter()
            .chain(&self.bogies)
            .chain(&self.wheels)
            .map(|l| isometry(self.world.bodies[l.body].position()))
            .collect()
    }

    /// Centre of each wheel, world frame, m.
    pub fn wheel_centres_m(&self) -> [Vector3<f64>; 6] {
        std::array::from_fn(|i| {
            nalgebra_vector(&self.world.bodies[self.wheels[i].body].translation())
        })
    }

    /// Load on each wheel in the last step, N.
    pub fn loads_n(&self) -> [f64; 6] {
        let dt = self.world.integration_parameters.dt;
        std::array::from_fn(|i| {
            self.world
                .narrow_phase
                .contact_pairs_with(self.colliders[i])
                .map(|pair| pair.total_impulse_magnitude() / dt)
                .sum()
        })
    }

    /// Takes a body of the terrain out of the world.
    pub fn remove_surface(&mut self, index: usize) {
        if let Some(handle) = self.statics.get_mut(index).and_then(Option::take) {
            self.world.remove_collider(handle);
        }
    }
}

/// The ground as a height field and every rock as its convex hull.
fn terrain_colliders(
    terrain: &Terrain,
    friction: f64,
) -> Result<Vec<Option<rp::ColliderBuilder>>, SimulationError> {
    let [xs, ys] = &terrain.grid_m;
    let ground = &terrain.bodies[0].mesh.positions;
    let (rows, columns) = (ys.len(), xs.len());
    // Heights along local y, rows along z; upright after a quarter turn about x, with which the
    // rows run against the world's y.
    let mut heights = Vec::with_capacity(rows * columns);
    for column in 0..columns {
        for row in 0..rows {
            heights.push(ground[(rows - 1 - row) * columns + column].z);
        }
    }
    let ends = |v: &[f64]| (v[0], v[v.len() - 1]);
    let ((x0, x1), (y0, y1)) = (ends(xs), ends(ys));
    let place = Isometry3::from_parts(
        Vector3::new((x0 + x1) / 2.0, (y0 + y1) / 2.0, 0.0).into(),
        nalgebra::UnitQuaternion::from_scaled_axis(Vector3::x() * std::f64::consts::FRAC_PI_2),
    );
    let field = rp::ColliderBuilder::heightfield(
        rp::Array2::new(rows, columns, heights),
        rp::Vector::new(x1 - x0, 1.0, y1 - y0),
    );
    let finish = |c: rp::ColliderBuilder| {
        c.friction(friction)
            .collision_groups(rp::InteractionGroups::new(
                TERRAIN,
                WHEELS,
                Default::default(),
            ))
    };
    let mut all = vec![Some(finish(field.position(pose(&place))))];
    for (i, body) in terrain.bodies.iter().enumerate().skip(1) {
        let points: Vec<_> = body.mesh.positions.iter().map(vector).collect();
        let hull =
            rp::ColliderBuilder::convex_hull(&points).ok_or_else(|| SimulationError::Collider {
                body: Terrain::name(i),
                message: "its points have no convex hull".into(),
            })?;
        all.push(Some(finish(hull)));
    }
    Ok(all)
}
