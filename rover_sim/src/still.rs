//! The true robot at rest wherever it is told to be: no physics, no time.
//!
//! What a motion that has come to rest leads to can be computed outright: the drives' springs at
//! the commanded angles, the arm drooped from there. Studies that need thousands of pictures use
//! this in place of [`crate::World`], whose arm has to travel.

use crate::{
    SimulationError,
    arm::ArmModel,
    contact_switch::link_from_ball,
    description::SimulationDescription,
    eyes::{Eyes, Moment, mix},
    statics,
    terrain::Terrain,
    truth::{TruePair, Truth},
    world::arm_model,
};
use nalgebra::{Isometry3, Point3, Translation3, Vector3};
use rover_kinematics::{Arm, ArmError};
use rover_messages::{Fault, imaging::RawPair};
use rover_render::FrameState;
use rover_robot::Robot;
use std::sync::Arc;

/// Where parts are put that shall not be seen, world frame, m.
const OUT_OF_SIGHT_M: f64 = -1000.0;

/// The true arm at rest under its own weight.
#[derive(Clone, Debug)]
pub struct StillArm {
    model: ArmModel,
}

impl StillArm {
    /// The true arm of a robot that does not drive.
    ///
    /// # Errors
    /// [`SimulationError::Robot`] without dynamics, or for a robot with wheels.
    pub fn new(
        robot: &Robot,
        truth: &Truth,
        description: &SimulationDescription,
    ) -> Result<Self, SimulationError> {
        if robot.description().mobility.is_some() {
            return Err(SimulationError::Robot {
                robot: robot.name().into(),
                field: "mobility".into(),
                message: "found; a still arm needs a mount that does not move".into(),
            });
        }
        let model = arm_model(robot, truth, description)?;
        Ok(Self { model })
    }

    /// The same masses and springs with other kinematics.
    pub fn with_arm(&self, arm: Arm) -> Self {
        let mut model = self.model.clone();
        model.arm = arm;
        Self { model }
    }

    /// The kinematics.
    pub fn kinematics(&self) -> &Arm {
        &self.model.arm
    }

    /// True joint angles at rest when the encoders read `encoder_rad`, rad.
    ///
    /// # Errors
    /// [`ArmError`] for joint angles that do not fit the arm.
    pub fn rest_rad(&self, encoder_rad: &[f64]) -> Result<Vec<f64>, ArmError> {
        statics::drooped_angles_rad(&self.model, encoder_rad)
    }

    /// True pose of the last link at rest, world frame.
    ///
    /// # Errors
    /// As [`Self::rest_rad`].
    pub fn world_from_link(&self, encoder_rad: &[f64]) -> Result<Isometry3<f64>, ArmError> {
        let rest = self.rest_rad(encoder_rad)?;
        Ok(self.model.world_from_base * self.model.arm.forward(&rest)?)
    }

    /// True position of the tip at rest (plunger released), world frame, m: what a laser tracker
    /// would find.
    ///
    /// # Errors
    /// As [`Self::rest_rad`].
    pub fn tip_in_world(&self, encoder_rad: &[f64]) -> Result<Vector3<f64>, ArmError> {
        let link = self.world_from_link(encoder_rad)?;
        Ok((link * Point3::from(self.model.tip_in_link)).coords)
    }

    /// Poses of the links in order, then of the plunger, world frame.
    fn part_poses(&self, encoder_rad: &[f64]) -> Result<Vec<Isometry3<f64>>, ArmError> {
        let rest = self.rest_rad(encoder_rad)?;
        let links = self.model.arm.link_poses(&rest)?;
        let mut poses: Vec<_> = links
            .iter()
            .skip(1)
            .map(|p| self.model.world_from_base * p)
            .collect();
        if let Some(last) = poses.last() {
            poses.push(last * link_from_ball(&self.model));
        }
        Ok(poses)
    }
}

/// The true robot, its terrain and its cameras, without motion.
pub struct StillWorld {
    arm: StillArm,
    truth: Truth,
    eyes: Eyes,
}

impl StillWorld {
    /// The world of that seed; the same truth and the same terrain as [`crate::World`] has.
    ///
    /// # Errors
    /// [`SimulationError`] with the field, what was found and what was expected.
    pub fn new(
        robot: &Robot,
        description: &SimulationDescription,
        seed: u64,
    ) -> Result<Self, SimulationError> {
        let truth = Truth::draw(robot, &description.truth, seed)?;
        let arm = StillArm::new(robot, &truth, description)?;
        let terrain = Arc::new(Terrain::new(&description.terrain));
        let eyes = Eyes::new(robot, &truth, terrain, description, seed)?;
        Ok(Self { arm, truth, eyes })
    }

    /// The true arm.
    pub fn arm(&self) -> &StillArm {
        &self.arm
    }

    /// The true pair of that name.
    pub fn pair(&self, name: &str) -> Option<&TruePair> {
        self.truth.pair(name)
    }

    /// A stereo pair with the arm at rest where the encoders read `encoder_rad`. The picture's
    /// noise belongs to these angles: whoever comes back to them sees the same picture.
    ///
    /// # Errors
    /// [`SimulationError::Arm`], or [`SimulationError::Picture`] with the fault of
    /// [`Eyes::grab`].
    pub fn grab(&mut self, pair: &str, encoder_rad: &[f64]) -> Result<RawPair, SimulationError> {
        let poses = self.arm.part_poses(encoder_rad)?;
        let key = encoder_rad.iter().fold(1, |k, q| mix(k ^ q.to_bits()));
        self.picture(pair, poses, key)
    }

    /// A stereo pair of the last link alone, with its fiducial, at any pose (world frame): a
    /// fiducial that somebody holds there.
    ///
    /// # Errors
    /// As [`Self::grab`].
    pub fn grab_held(
        &mut self,
        pair: &str,
        world_from_link: &Isometry3<f64>,
    ) -> Result<RawPair, SimulationError> {
        let joints = self.arm.model.links.len();
        let away = Isometry3::from(Translation3::new(0.0, 0.0, OUT_OF_SIGHT_M));
        let mut poses = vec![away; joints + 1];
        if let Some(last) = poses.get_mut(joints - 1) {
            *last = *world_from_link;
        }
        let coordinates = world_from_link.to_matrix();
        let key = coordinates.iter().fold(2, |k, x| mix(k ^ x.to_bits()));
        self.picture(pair, poses, key)
    }

    fn picture(
        &mut self,
        pair: &str,
        part_poses: Vec<Isometry3<f64>>,
        key: u64,
    ) -> Result<RawPair, SimulationError> {
        let moment = Moment {
            sim_time_s: 0.0,
            step: key,
            frame: FrameState {
                part_poses,
                pattern_visible: true,
            },
            gone: Vec::new(),
            rover: None,
        };
        self.eyes
            .grab(&moment, pair, 0)
            .map_err(|fault: Fault| SimulationError::Picture(fault.message))
    }
}
