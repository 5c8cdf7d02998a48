//! From the choice of a target to standing before it.

use super::{Mission, RUNNER, Record, act, unless};
use crate::report::Waypoints;
use nalgebra::Vector3;
use rover_geometry::Point;
use rover_messages::{
    Fault,
    approach::{DriveToFeedback, DriveToGoal, DriveToResult},
    imaging::{CaptureRequest, FrameReference, StereoFrame},
    keys::{
        self,
        service::{ARM_PLANNER, EPEC_SERVO},
    },
    mobility::{PointFeedback, PointGoal, PointResult},
    simulation::{DesignateRequest, Pick, PickRequest, TruePlace},
    target::{SelectRequest, Target},
};

/// The posture in which the rover drives.
const STOWED: &str = "stow";

/// Whether a placement that ended so may succeed from another base pose: nothing was broken or
/// interrupted, but arm, ground and cameras did not go together where the rover stood.
fn may_go_elsewhere(fault: &Fault) -> bool {
    const OF_THE_PLACE: [&str; 11] = [
        "axis_infeasible",
        "branch_change",
        "corrected_pose_out_of_reach",
        "fiducial_lost",
        "fiducial_not_visible",
        "joint_limit",
        "no_collision_free_path",
        "no_solution",
        "not_converging",
        "predicted_error_too_large",
        "target_out_of_reach",
    ];
    [ARM_PLANNER, EPEC_SERVO].contains(&fault.service.as_str())
        && OF_THE_PLACE.contains(&fault.name.as_str())
}

impl Mission<'_> {
    /// Has the target selected: the scenario's pixel, or one that the simulator picks as a person
    /// would. Returns the target and the image in which it was named.
    pub(super) async fn designate(&mut self) -> Result<(Target, FrameReference), Fault> {
        let started = self.begin("designate");
        let designated = self.designated().await;
        let (target, frame) = self.end(started, designated).await?;
        self.observer.target(&target);
        let anchor = FrameReference {
            pair: frame.images.pair.clone(),
            step: frame.images.step,
            exposure_n: 0,
        };
        if let Some(evidence) = &mut self.evidence {
            evidence.designation = Some(frame);
        }
        Ok((target, anchor))
    }

    async fn designated(&mut self) -> Result<(Target, StereoFrame), Fault> {
        let choice = &self.scenario.target;
        let pair = choice.pair.clone();
        if let Some([pan, tilt]) = choice.mast_deg {
            self.point([pan.to_radians(), tilt.to_radians()]).await?;
        }
        let pixel_px = match (choice.pixel_px, choice.pick_request()) {
            (Some(pixel_px), _) => pixel_px,
            (None, Some(request)) => self.picked(&request).await?,
            (None, None) => {
                let message = "the scenario has neither target.pixel_px nor target.pick";
                return Err(Fault::new(RUNNER, "no_target", message));
            }
        };
        // Nothing moves until the selection, so this is the image that it is made in.
        let capture = CaptureRequest::default();
        let frame: StereoFrame = self.ask(&keys::imaging_capture(&pair), &capture).await?;
        if self.scenario.approach.is_some() && self.is_simulated().await {
            let pair = pair.clone();
            let request = DesignateRequest { pair, pixel_px };
            self.ask::<_, TruePlace>(keys::SIM_TRUTH_DESIGNATE, &request)
                .await?;
        }
        let request = SelectRequest { pair, pixel_px };
        let target = self.ask(keys::TARGET_SELECT, &request).await?;
        Ok((target, frame))
    }

    /// The pixel of a place that the simulator picks, after the mast was turned to it.
    async fn picked(&mut self, request: &PickRequest) -> Result<[f64; 2], Fault> {
        let pick: Pick = self.ask(keys::SIM_TRUTH_PICK, request).await?;
        if let Some(mast_rad) = pick.mast_rad {
            self.point(mast_rad).await?;
        }
        let pick: Pick = self.ask(keys::SIM_TRUTH_PICK, request).await?;
        let out_of_view = || {
            let message = format!("the pair `{}` does not see the place picked", request.pair);
            Fault::new(RUNNER, "no_target", message)
        };
        let [u, v] = pick.pixel_px.ok_or_else(out_of_view)?;
        // People name whole pixels.
        Ok([u.round(), v.round()])
    }

    async fn point(&mut self, [pan_rad, tilt_rad]: [f64; 2]) -> Result<(), Fault> {
        let goal = PointGoal { pan_rad, tilt_rad };
        let limit = self.scenario.limits.action();
        act::<_, PointFeedback, PointResult>(
            self.peer,
            &self.abort,
            limit,
            keys::MAST_POINT,
            &goal,
            async |_| (),
        )
        .await
        .map(|_| ())
    }

    /// Drives to the target and places the instrument; where the arm cannot serve
    /// it from the base pose after all, from another one.
    pub(super) async fn place_from_somewhere(
        &mut self,
        record: &mut Record,
        mut goal: DriveToGoal,
        most_n: u32,
    ) -> Result<(), Fault> {
        let mut driven_m = 0.0;
        let mut forecast_mm = None;
        loop {
            let mut reached = self.drive_to(goal.clone()).await?;
            // What a person was told before anything moved.
            reached.forecast_mm = *forecast_mm.get_or_insert(reached.forecast_mm);
            if let Some(limit_m) = &mut goal.limits.max_distance_m {
                *limit_m = (*limit_m - reached.driven_m).max(0.0);
            }
            driven_m += reached.driven_m;
            reached.driven_m = driven_m;
            record.approach = Some(reached.clone());
            record.waypoints = self.waypoints(&reached).await?;
            let Err(fault) = self.place_from_here(record, &reached.target).await else {
                return Ok(());
            };
            record.earlier.push((reached.base.clone(), fault.clone()));
            if !may_go_elsewhere(&fault) || record.earlier.len() as u32 >= most_n {
                return Err(fault);
            }
            tracing::info!(%fault, "another base pose is tried");
            self.take_up(STOWED).await?;
            goal.avoid.push(reached.base.pose);
            goal.lost_m2 = reached.lost_m2;
            goal.target.pixel_px = reached.tracked_px;
            goal.anchor = reached.tracked_in;
            if let Some(stop) = reached.stops.last() {
                goal.target.position_m = Point::from(Vector3::from(stop.position_m));
            }
        }
    }

    /// Drives to the target and has it handed over to the pair that the arm works with.
    pub(super) async fn drive_to(&mut self, goal: DriveToGoal) -> Result<DriveToResult, Fault> {
        let started = self.begin("approach");
        let (observer, evidence) = (&mut *self.observer, &mut self.evidence);
        let (peer, limits) = (self.peer, &self.scenario.limits);
        let reached = act(
            peer,
            &self.abort,
            limits.action(),
            keys::APPROACH_DRIVE_TO,
            &goal,
            async |feedback: &DriveToFeedback| {
                observer.approach(feedback);
                if let Some(evidence) = evidence.as_mut() {
                    evidence.under_way(peer, feedback, limits.question()).await;
                }
            },
        )
        .await;
        if let (Err(fault), Some(evidence)) = (&reached, &mut self.evidence) {
            let pair = &goal.target.pair;
            evidence.lost(peer, pair, fault, limits.question()).await;
        }
        let reached: DriveToResult = self.end(started, reached).await?;
        if let Some(evidence) = &mut self.evidence {
            evidence.arrived(peer, limits.question()).await;
            evidence.handed_over = Some(reached.target.clone());
        }
        Ok(reached)
    }

    /// What the pixels at the handover really show; the simulator's privilege.
    pub(super) async fn waypoints(&self, reached: &DriveToResult) -> Result<Waypoints, Fault> {
        let mut waypoints = Waypoints::default();
        if self.is_simulated().await {
            let from = DesignateRequest {
                pair: self.scenario.target.pair.clone(),
                pixel_px: reached.tracked_px,
            };
            let to = DesignateRequest {
                pair: reached.target.pair.clone(),
                pixel_px: reached.target.pixel_px,
            };
            waypoints.tracked = Some(self.ask(keys::SIM_TRUTH_DESIGNATE, &from).await?);
            waypoints.handed_over = Some(self.ask(keys::SIM_TRUTH_DESIGNATE, &to).await?);
        }
        Ok(waypoints)
    }

    pub(super) async fn is_simulated(&self) -> bool {
        let hardware = keys::service::HARDWARE;
        self.peer.is_present(hardware).await.unwrap_or(false)
    }

    /// One question, given up when the run is aborted.
    pub(super) async fn ask<Q, A>(&self, key: &str, question: &Q) -> Result<A, Fault>
    where
        Q: rover_messages::Wire,
        A: rover_messages::Wire,
    {
        let limit = self.scenario.limits.question();
        unless(&self.abort, self.peer.ask(key, question, limit)).await
    }
}
