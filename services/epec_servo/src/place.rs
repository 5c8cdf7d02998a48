//! The placement loop as decisions without a network (paper, section 3): look, update the error
//! vector, correct the goal, move; repeat while approaching; go on with what is known when the
//! fiducial is hidden, as long as the predicted error allows it.

use crate::{
    driven::Driven,
    estimator::{Estimator, EstimatorError, EstimatorRules, Seen},
    observe::{SearchWindow, Sighting, look},
    refusal::{compensation_fault, estimator_fault, fault, method_fault},
    survey::{LEAST_FOUND, Survey},
};
use nalgebra::{Isometry3, Matrix3, Translation3, Unit, UnitQuaternion, Vector3};
use rover_compensation::ErrorModel;
use rover_geometry::{Direction, Rover};
use rover_messages::{
    Fault,
    imaging::StereoFrame,
    placement::{Look, Method, PlaceGoal, PlaceResult},
    planning::{PlanGoal, PlanRequest, ToolPose},
};
use rover_robot::Robot;
use std::sync::Arc;

/// A look that contradicts all that is known may be a false detection; this many in a row mean
/// that what is known is wrong.
const MAX_INCONSISTENT_LOOKS: u32 = 3;
/// At the standoff a correction that is larger than this share of the one before does not
/// converge; noise may do that once, so two in a row end the placement.
const CONVERGENCE_RATIO: f64 = 0.8;
/// Fraction of the arm's rate and acceleration limits that the servo uses.
const SPEED_FRACTION: f64 = 0.8;

/// What the loop wants next.
#[derive(Clone, Debug, PartialEq)]
pub enum Step {
    /// Move the arm; then ask again.
    Move(PlanRequest),
    /// Move the arm if the planner finds a way; if not, that pose is left out. Then ask again.
    Try(PlanRequest),
    /// Take a stereo frame with the target's pair and call [`Placement::look`]; then ask again.
    Look,
    /// The tip is at the standoff.
    Done(PlaceResult),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Start,
    Surveying,
    Arrived,
    Looked,
}

/// One placement.
#[derive(Debug)]
pub struct Placement {
    robot: Arc<Robot>,
    goal: PlaceGoal,
    estimator: Estimator,
    /// The method, where it is not one of the estimator's own.
    driven: Option<Driven>,
    survey: Survey,
    station: usize,
    phase: Phase,
    looks: Vec<Look>,
    corrections: Vec<f64>,
    inconsistent: u32,
}

/// The believed robot's error model.
pub fn error_model(robot: &Robot) -> ErrorModel {
    ErrorModel {
        arm: robot.arm.clone(),
        tool: robot.tool.clone(),
        rover_from_arm_base: robot.rover_from_arm_base.isometry,
        mount_centre_in_rover: robot.mount_centre(),
    }
}

impl Placement {
    /// A placement that has not moved yet.
    pub fn new(robot: Arc<Robot>, goal: PlaceGoal, rules: EstimatorRules) -> Self {
        let quality = robot.description().model_quality;
        let estimator = Estimator::new(
            error_model(&robot),
            goal.method,
            quality.angle_deg.to_radians(),
            quality.length_mm * 1e-3,
            rules,
        );
        let driven = match goal.method {
            Method::Kinematic | Method::Epec | Method::EpecField => None,
            other => Some(Driven::new(
                other,
                &goal.target.position_m.coords,
                &goal.target.normal.unit,
            )),
        };
        Self {
            robot,
            driven,
            survey: Survey::new(goal.method.initial_poses()),
            goal,
            estimator,
            station: 0,
            phase: Phase::Start,
            looks: Vec::new(),
            corrections: Vec::new(),
            inconsistent: 0,
        }
    }

    /// Distance of the present station from the target, m.
    pub fn station_m(&self) -> f64 {
        self.goal.stations_m[self.station]
    }

    /// Believed distance of the tip from the target at joint angles `q`, m.
    ///
    /// # Errors
    /// Fault `internal` for joint angles that do not fit the arm.
    pub fn distance_m(&self, q: &[f64]) -> Result<f64, Fault> {
        let model = self.estimator.model();
        let (error, _) = model
            .error_at(&self.estimator.compensation(), q)
            .map_err(|e| compensation_fault(&e))?;
        Ok((self.tip(q)? + error - self.goal.target.position_m.coords).norm())
    }

    /// What to do next, with the arm at rest at joint angles `q`.
    ///
    /// # Errors
    /// A fault that names what makes the placement impossible; the arm should then be taken back
    /// to the first station.
    pub fn next(&mut self, q: &[f64]) -> Result<Step, Fault> {
        match self.phase {
            Phase::Surveying => Ok(Step::Look),
            Phase::Start => {
                if let Some(pose) = self.next_survey_pose(q)? {
                    self.phase = Phase::Surveying;
                    let visible_to = Some(self.goal.target.pair.clone());
                    let mut request = self.request(PlanGoal::Tool { pose, visible_to });
                    request.contact_radius_m = 0.0;
                    return Ok(Step::Try(request));
                }
                self.phase = Phase::Arrived;
                let pose = self.command(q)?;
                let visible_to = Some(self.goal.target.pair.clone());
                Ok(Step::Move(
                    self.request(PlanGoal::Tool { pose, visible_to }),
                ))
            }
            Phase::Arrived if self.goal.method.looks_on_approach() => Ok(Step::Look),
            Phase::Arrived | Phase::Looked => self.advance(q),
        }
    }

    /// The pose of the last [`Step::Try`] is left out.
    pub fn leave_out(&mut self) {
        self.phase = Phase::Start;
    }

    fn next_survey_pose(&mut self, q: &[f64]) -> Result<Option<ToolPose>, Fault> {
        let target = &self.goal.target;
        let pair = self
            .robot
            .pair(&target.pair)
            .map_err(|e| fault("unknown_camera_pair", e.to_string()))?;
        let model = self.estimator.model();
        let next = self
            .survey
            .next(&self.robot, model, &pair.cameras, target, q);
        if next.is_none() && !self.survey.is_enough() {
            return Err(fault(
                "too_few_initial_looks",
                format!(
                    "{} wants the fiducial seen at {} poses before the approach; found at {}, \
                     expected at least {LEAST_FOUND}; last look: {}",
                    self.goal.method.name(),
                    self.goal.method.initial_poses(),
                    self.survey.found(),
                    self.last_reason()
                ),
            ));
        }
        Ok(next)
    }

    fn last_reason(&self) -> String {
        self.looks
            .last()
            .and_then(|l| l.reason.clone())
            .unwrap_or_default()
    }

    fn advance(&mut self, q: &[f64]) -> Result<Step, Fault> {
        let found = self.phase == Phase::Looked && self.looks.last().is_some_and(|l| l.found);
        if self.station + 1 < self.goal.stations_m.len() {
            if !found {
                self.check_predicted_error(q)?;
            }
            self.station += 1;
            self.phase = Phase::Arrived;
            let pose = self.command(q)?;
            return Ok(Step::Move(self.request(PlanGoal::Straight(vec![pose]))));
        }
        let predicted_error_m = self.check_predicted_error(q)?;
        let pose = self.command(q)?;
        let correction = (pose.tip_m.coords - self.tip(q)?).norm();
        let converged = found && correction <= self.goal.tolerance_m;
        // Without a look at the standoff there is nothing to correct by.
        if converged || !found || self.corrections.len() >= self.goal.max_corrections_n as usize {
            return Ok(Step::Done(PlaceResult {
                looks: self.looks.clone(),
                converged,
                standoff_m: self.station_m(),
                predicted_error_m,
                compensation: self.estimator.compensation(),
            }));
        }
        self.check_convergence(correction, predicted_error_m)?;
        self.corrections.push(correction);
        self.phase = Phase::Arrived;
        Ok(Step::Move(self.request(PlanGoal::Straight(vec![pose]))))
    }

    /// Corrections that do not shrink mean that the fiducial is not where the model's errors put
    /// it, unless they are no larger than the error that is predicted anyway: then they are noise.
    fn check_convergence(&self, correction: f64, predicted_error_m: f64) -> Result<(), Fault> {
        let [.., before, last] = self.corrections[..] else {
            return Ok(());
        };
        let growing = last > CONVERGENCE_RATIO * before && correction > CONVERGENCE_RATIO * last;
        if !growing || correction <= predicted_error_m {
            return Ok(());
        }
        Err(fault(
            "not_converging",
            format!(
                "corrections at the standoff do not shrink: {:.2}, {:.2}, {:.2} mm, expected each \
                 below {CONVERGENCE_RATIO} of the one before or within the predicted {:.2} mm",
                before * 1e3,
                last * 1e3,
                correction * 1e3,
                predicted_error_m * 1e3
            ),
        )
        .with("correction_mm", correction * 1e3))
    }

    /// Takes in a stereo frame exposed with the arm at rest at joint angles `q`.
    ///
    /// # Errors
    /// `fiducial_inconsistent` when several looks in a row contradict all that is known. A
    /// fiducial that is merely not found is no error: it is noted in the returned look.
    pub fn look(&mut self, q: &[f64], frame: &StereoFrame) -> Result<Look, Fault> {
        let is_survey = self.phase == Phase::Surveying;
        let kinematic = self
            .estimator
            .model()
            .rover_from_link(q)
            .map_err(|e| compensation_fault(&e.into()))?;
        let station_m = if is_survey {
            let tip = kinematic.transform_point(&self.robot.tool.tip_in_link.into());
            self.normal()
                .dot(&(tip.coords - self.goal.target.position_m.coords))
        } else {
            self.station_m()
        };
        self.phase = if is_survey {
            Phase::Start
        } else {
            Phase::Looked
        };
        let (predicted, window) = self.predicted_link(q, &kinematic)?;
        let outcome = look(
            &self.robot,
            frame,
            self.goal.observation,
            &predicted,
            &kinematic,
            window,
        )
        .and_then(|sighting| {
            self.take_in(q, frame, &sighting, is_survey)
                .map(|()| sighting)
        });
        if is_survey && outcome.is_ok() {
            self.survey.count();
        }
        let vector = |v: Vector3<f64>| -> [f64; 3] { v.into() };
        let look = Look {
            sim_time_s: frame.images.sim_time_s,
            step: frame.images.step,
            station_m,
            found: outcome.is_ok(),
            reason: outcome.as_ref().err().cloned(),
            error_vector_m: outcome
                .as_ref()
                .ok()
                .map(|s| vector(position_error(&s.seen, &kinematic, self))),
            rotation_error_rad: outcome.as_ref().ok().and_then(|s| match s.seen {
                Seen::Pose { rotation_error, .. } => Some(vector(rotation_error)),
                Seen::Position { .. } => None,
            }),
            left_px: outcome.as_ref().ok().map(|s| s.left_px.into()),
            right_px: outcome.as_ref().ok().map(|s| s.right_px.into()),
            rms_px: outcome.as_ref().ok().and_then(|s| s.rms_px),
            predicted_error_m: self.predicted_error(q)?,
        };
        self.looks.push(look.clone());
        if self.inconsistent >= MAX_INCONSISTENT_LOOKS {
            return Err(fault(
                "fiducial_inconsistent",
                format!(
                    "{} looks in a row contradict the prediction: {}; is the stated model quality \
                     ({} deg, {} mm) right?",
                    self.inconsistent,
                    look.reason.unwrap_or_default(),
                    self.robot.description().model_quality.angle_deg,
                    self.robot.description().model_quality.length_mm
                ),
            ));
        }
        Ok(look)
    }

    /// The way back to the first station, for leaving after a fault.
    ///
    /// # Errors
    /// As [`Placement::next`].
    pub fn retreat(&mut self, q: &[f64]) -> Result<PlanRequest, Fault> {
        self.station = 0;
        let pose = self.command(q)?;
        Ok(self.request(PlanGoal::Straight(vec![pose])))
    }

    /// The filter judges every sighting; what it accepts goes to the method.
    fn take_in(
        &mut self,
        q: &[f64],
        frame: &StereoFrame,
        sighting: &Sighting,
        is_survey: bool,
    ) -> Result<(), String> {
        if let Err(error) = self.estimator.observe(q, &sighting.seen) {
            if matches!(error, EstimatorError::Inconsistent { .. }) {
                self.inconsistent += 1;
            }
            return Err(error.to_string());
        }
        self.inconsistent = 0;
        let station_m = self.station_m();
        if let Some(driven) = &mut self.driven {
            let reference = (!is_survey).then(|| driven.reference(station_m));
            driven.observe(&self.robot, &frame.cameras, q, sighting, reference)?;
            let at_target = driven.at_target(q).map_err(|e| e.to_string())?;
            self.estimator.adopt(at_target);
        }
        Ok(())
    }

    /// The last link's pose with the filter's best estimate of its error, and the window that
    /// its uncertainty asks for.
    fn predicted_link(
        &self,
        q: &[f64],
        kinematic: &Isometry3<f64>,
    ) -> Result<(Isometry3<f64>, SearchWindow), Fault> {
        let (error, covariance) = self.estimator.predict(q).map_err(|e| estimator_fault(&e))?;
        let tip_in_link = self.robot.tool.tip_in_link;
        let tip = kinematic.transform_point(&tip_in_link.into()).coords;
        let rotation = UnitQuaternion::from_scaled_axis(error.fixed_rows::<3>(3).into_owned())
            * kinematic.rotation;
        let seen_tip = tip + error.fixed_rows::<3>(0);
        let translation = Translation3::from(seen_tip - rotation * tip_in_link);
        let largest = |m: Matrix3<f64>| m.symmetric_eigenvalues().max().max(0.0).sqrt();
        let sigma_m = largest(covariance.fixed_view::<3, 3>(0, 0).into_owned());
        Ok((
            Isometry3::from_parts(translation, rotation),
            SearchWindow { sigma_m },
        ))
    }

    fn tip(&self, q: &[f64]) -> Result<Vector3<f64>, Fault> {
        let pose = self
            .estimator
            .model()
            .rover_from_link(q)
            .map_err(|e| compensation_fault(&e.into()))?;
        Ok(pose
            .transform_point(&self.robot.tool.tip_in_link.into())
            .coords)
    }

    fn normal(&self) -> Unit<Vector3<f64>> {
        self.goal.target.normal.unit
    }

    /// The pose to command so that the tip is seen at the present station.
    fn command(&self, q: &[f64]) -> Result<ToolPose, Fault> {
        let normal = self.normal();
        if let Some(driven) = &self.driven {
            let reference = driven.reference(self.station_m());
            let tip = driven
                .command(&reference, q)
                .map_err(|e| method_fault(self.goal.method, &e))?;
            return Ok(ToolPose {
                tip_m: tip.into(),
                axis: Direction::<Rover>::from(reference.axis_in_rover),
            });
        }
        let reference = self.goal.target.position_m.coords + normal.into_inner() * self.station_m();
        let solved = self
            .estimator
            .model()
            .solve(&self.estimator.compensation(), &reference, &-normal, q)
            .map_err(|e| compensation_fault(&e))?;
        Ok(ToolPose {
            tip_m: solved.tip_in_rover.into(),
            axis: Direction::<Rover>::from(solved.axis_in_rover),
        })
    }

    fn request(&self, goal: PlanGoal) -> PlanRequest {
        PlanRequest {
            start_rad: None,
            goal,
            speed_fraction: SPEED_FRACTION,
            max_tip_speed_m_s: None,
            contact_radius_m: self.station_m(),
        }
    }

    /// The predicted error of a placement on the target, taken at the target's own configuration.
    fn predicted_error(&self, q: &[f64]) -> Result<f64, Fault> {
        let target = &self.goal.target;
        let normal = self.normal();
        let at_target = self
            .estimator
            .model()
            .solve(
                &self.estimator.compensation(),
                &target.position_m.coords,
                &-normal,
                q,
            )
            .map_err(|e| compensation_fault(&e))?;
        let covariance = Matrix3::from_fn(|i, j| target.covariance_m2[i][j]);
        self.estimator
            .predicted_lateral_error(&at_target.joints_rad, &normal, &covariance)
            .map_err(|e| estimator_fault(&e))
    }

    fn check_predicted_error(&self, q: &[f64]) -> Result<f64, Fault> {
        let predicted = self.predicted_error(q)?;
        let limit = self.goal.max_predicted_error_m;
        if self.goal.method == Method::Kinematic || predicted <= limit {
            return Ok(predicted);
        }
        let why = self.last_reason();
        let name = if self.estimator.has_seen() {
            "predicted_error_too_large"
        } else {
            "fiducial_lost"
        };
        Err(fault(
            name,
            format!(
                "the tip's lateral error at the target would be up to {:.1} mm (95 %), expected at \
                 most {:.1} mm; last look: {why}",
                predicted * 1e3,
                limit * 1e3
            ),
        )
        .with("predicted_error_mm", predicted * 1e3)
        .with("limit_mm", limit * 1e3)
        .with("station_mm", self.station_m() * 1e3))
    }
}

/// Seen minus predicted position of the tip; where only a mark was seen, of that mark, which is
/// the paper's vector.
fn position_error(seen: &Seen, kinematic: &Isometry3<f64>, placement: &Placement) -> Vector3<f64> {
    match seen {
        Seen::Pose { tip_in_rover, .. } => {
            let tip = placement.robot.tool.tip_in_link;
            tip_in_rover - kinematic.transform_point(&tip.into()).coords
        }
        Seen::Position {
            point_in_link,
            seen_in_rover,
            ..
        } => seen_in_rover - kinematic.transform_point(&(*point_in_link).into()).coords,
    }
}
