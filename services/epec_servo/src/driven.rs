//! Any other method of `rover-methods` in the servo's loop: what was seen becomes the pixels of one
//! point of the last link, the method's command becomes a tool pose.

use crate::observe::Sighting;
use crate::{estimator::Seen, place::error_model};
use nalgebra::{Unit, Vector2, Vector3};
use rover_cameras::StereoPair;
use rover_compensation::Compensation;
use rover_messages::placement::Method as Kind;
use rover_methods::{Method, MethodError, Reference, Sample, Setup};
use rover_robot::Robot;
use std::sync::Arc;

/// A method that is driven by the servo.
///
/// The methods know one point of the arm by its pixels. With the position of one mark that is the
/// mark itself; with the pose of the whole plate it is the instrument's tip, whose pixels are the
/// projections of where the pose puts it. None of them corrects the tool's direction.
#[derive(Debug)]
pub struct Driven {
    kind: Kind,
    target: Reference,
    /// From the first frame on, because the camera models come with it.
    running: Option<(Arc<Setup>, Box<dyn Method>)>,
}

impl Driven {
    /// A method that has seen nothing: until then it commands the reference itself. `target` and
    /// the outward `normal` are in the rover frame, m.
    pub fn new(kind: Kind, target: &Vector3<f64>, normal: &Unit<Vector3<f64>>) -> Self {
        Self {
            kind,
            target: Reference {
                tip_in_rover: *target,
                axis_in_rover: -*normal,
            },
            running: None,
        }
    }

    /// Where the tip shall be seen at a distance from the target along the normal, m.
    pub fn reference(&self, distance_m: f64) -> Reference {
        let axis = self.target.axis_in_rover;
        Reference {
            tip_in_rover: self.target.tip_in_rover - axis.into_inner() * distance_m,
            axis_in_rover: axis,
        }
    }

    /// Takes in what was seen at joint angles `q`; `reference` is where the tip was sent, none for
    /// a pose before the approach.
    ///
    /// # Errors
    /// One line that says why the method cannot use it.
    pub fn observe(
        &mut self,
        robot: &Robot,
        cameras: &StereoPair,
        q: &[f64],
        sighting: &Sighting,
        reference: Option<Reference>,
    ) -> Result<(), String> {
        let (point_in_link, left_px, right_px) = seen_point(robot, cameras, sighting)?;
        let (setup, method) = self.running.get_or_insert_with(|| {
            let quality = robot.description().model_quality;
            let setup = Arc::new(Setup {
                model: error_model(robot),
                cameras: cameras.clone(),
                fiducial_in_link: point_in_link,
                angle_rad: quality.angle_deg.to_radians(),
                length_m: quality.length_mm * 1e-3,
                pixel_sigma_px: Setup::LEAST_SIGMA_PX,
            });
            let method = self.kind.start(Arc::clone(&setup), self.target.clone());
            (setup, method)
        });
        if setup.cameras != *cameras {
            return Err(format!(
                "the camera models are not those of the first frame; {} expects cameras that do \
                 not move against the arm's base",
                self.kind.name()
            ));
        }
        let sample = Sample {
            joints_rad: q.to_vec(),
            left_px,
            right_px,
            reference,
        };
        method
            .observe(&sample)
            .map_err(|e| format!("{}: {e}", self.kind.name()))
    }

    /// Where to command the tip, rover frame, m, so that it is seen at `reference`; `near` are
    /// joint angles close to the answer, rad.
    ///
    /// # Errors
    /// [`MethodError`] when the method has no answer there.
    pub fn command(
        &self,
        reference: &Reference,
        near: &[f64],
    ) -> Result<Vector3<f64>, MethodError> {
        match &self.running {
            None => Ok(reference.tip_in_rover),
            Some((_, method)) => method.command(reference, near),
        }
    }

    /// What the method corrects at the target, as a constant error: with it the contact motion
    /// ends where the method would put the tip.
    ///
    /// # Errors
    /// As [`Self::command`].
    pub fn at_target(&self, near: &[f64]) -> Result<Compensation, MethodError> {
        let command = self.command(&self.target, near)?;
        Ok(Compensation::constant(
            (self.target.tip_in_rover - command).into(),
        ))
    }
}

/// The observed point on the last link, m, and its pixels in both images.
fn seen_point(
    robot: &Robot,
    cameras: &StereoPair,
    sighting: &Sighting,
) -> Result<(Vector3<f64>, Vector2<f64>, Vector2<f64>), String> {
    match &sighting.seen {
        Seen::Position { point_in_link, .. } => {
            Ok((*point_in_link, sighting.left_px, sighting.right_px))
        }
        Seen::Pose { tip_in_rover, .. } => {
            let pixel = |camera: &rover_cameras::Camera| {
                camera
                    .project(tip_in_rover)
                    .map_err(|e| format!("the seen tip does not project: {e}"))
            };
            let (left_px, right_px) = (pixel(&cameras.left)?, pixel(&cameras.right)?);
            Ok((robot.tool.tip_in_link, left_px, right_px))
        }
    }
}
