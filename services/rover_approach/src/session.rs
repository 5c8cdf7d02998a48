//! One approach from designation to hand-over, as a sequence of stops.

mod finish;
mod ground;
mod near;

use crate::anchor::TrackRules;
use crate::drive::{DriveRules, next_movement, straight};
use crate::egomotion::{Egomotion, EgomotionRules, Landmark, egomotion};
use crate::filter::{Motion, TargetEstimate};
use crate::fix::{Fix, Refusal};
use crate::hardware::{Frame, Hardware, Light, fault};
use crate::obstacles::PlanarPose;
use crate::report::{Budget, sighting, sigma_mm};
use crate::service::unfit;
use crate::shade::Shade;
use crate::track::Tracker;
use crate::view::View;
use finish::Finish;
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector2, Vector3};
use near::NearStep;
use rover_geometry::Point;
use rover_messages::{
    Fault,
    approach::{
        ApproachActivity, ApproachStop, DriveToFeedback, DriveToGoal, DriveToResult, SeenMotion,
        Sighting,
    },
    mobility::{DriveArc, DriveResult, DriveStop, WheelsState},
    status::work,
};
use rover_robot::{MastDescription, MobilityDescription, Robot};
use std::{collections::BTreeMap, sync::Arc};

/// Range at which the base pose is chosen, m along the ground.
const NEAR_M: f64 = 3.2;
/// Distance from the target that is aimed at before, m.
const STANDOFF_M: f64 = 1.1;
/// A part of the rover that comes so near to the line of sight hides the target, m.
const HIDING_M: f64 = 0.01;
/// Most stops if the goal does not say.
const MAX_STOPS_N: u32 = 60;
/// Movements back from where no way is clear, in one approach.
const RETREATS_N: u32 = 3;
/// Way back from where no way is clear or a wheel stalled, m.
const RETREAT_M: f64 = 0.4;
/// Times that a wheel may stall in one approach.
const STALLS_N: u32 = 3;
/// What the prediction of a pixel may be off besides, px.
const UNKNOWN_PX: f64 = 1.0;
/// Stops in a row at which the target may be missed.
const MISSES_N: u32 = 1;
/// The same while the rover's own body or the edge of its shadow passes over it, or landmarks tell
/// the way.
const LONG_MISSES_N: u32 = 5;
/// Largest uncertainty with which a missed target is carried on by odometry, mm, one sigma.
const MISSED_SIGMA_MM: f64 = 120.0;

pub(crate) struct Session<'a> {
    hardware: Hardware<'a>,
    goal: &'a DriveToGoal,
    robot: &'a Robot,
    mast: &'a MastDescription,
    mobility: &'a MobilityDescription,
    rules: DriveRules,
    tracker: Tracker,
    estimate: TargetEstimate,
    now: Frame,
    wheels: WheelsState,
    /// What the left image of `now` shows of the ground.
    landmarks: Vec<Landmark>,
    /// Points of the last frames, site frame, m.
    ground: Vec<Vec<Vector3<f64>>>,
    stops: Vec<ApproachStop>,
    budget: Budget,
    /// Told before the drive, mm.
    forecast_mm: f64,
    driven_m: f64,
    spot_offset_m: Option<Vector3<f64>>,
    near_moves_n: u32,
    /// Movements back from where no way was clear.
    retreats_n: u32,
    /// Movements that ended because a wheel stalled, and whether the last one did.
    stalls_n: u32,
    stuck: bool,
    shade: Arc<Shade>,
    /// Stops in a row at which the target was not found.
    missed_n: u32,
    /// The base pose that is driven to, site frame.
    aim: Option<PlanarPose>,
    /// Base poses that were reached and do not serve, site frame.
    spent: Vec<PlanarPose>,
    /// Candidates of the last choice of a base pose, and how many were refused why.
    candidates: (u32, BTreeMap<String, u32>),
    /// The target's normal as the body cameras saw it, site frame.
    normal_in_site: Option<Vector3<f64>>,
    /// Base poses chosen anew after a look of the body cameras.
    second_choices_n: u32,
}

impl<'a> Session<'a> {
    /// Drives to the goal's target.
    pub async fn run(
        mut hardware: Hardware<'a>,
        robot: &'a Robot,
        goal: &'a DriveToGoal,
    ) -> Result<DriveToResult, Fault> {
        let mobility = robot.mobility().map_err(|e| unfit(&e))?;
        let mast = robot.mast().map_err(|e| unfit(&e))?;
        let pair = robot.pair(&goal.target.pair).map_err(|e| unfit(&e))?;
        let stowed_rad = hardware.joints_rad().await?;
        let shade = Arc::new(Shade::of(robot, &stowed_rad));
        hardware.light = sun_of(goal).map(|sun_in_site| Light {
            shade: Arc::clone(&shade),
            sun_in_site,
        });
        let now = hardware.recall(&goal.anchor).await?;
        let wheels = wheels_of(&now)?;
        let pixel = Vector2::from(goal.target.pixel_px);
        let range_m = [pair.range_min_m, 1.5 * pair.range_max_m];
        let view = Arc::clone(&now.view);
        let tracker = hardware
            .shell
            .timed(work::VISION, || {
                Tracker::designate(view, pixel, range_m, TrackRules::default())
            })
            .map_err(|e| fault("target_not_trackable", e.to_string()))?;
        let (_, surface) = tracker.target();
        let estimate = TargetEstimate::new(surface.plane.point, surface.covariance_m2)
            .map_err(|e| fault("target_not_trackable", e.to_string()))?;
        let mut rules = DriveRules::of(mobility);
        if let Some(step) = goal.limits.step_fraction {
            rules.step_fraction = step;
        }
        if let Some(slope) = goal.limits.max_slope_rad {
            rules.max_slope_rad = slope;
        }
        let focal_px = now.view.cameras.left.model.cahv()[2].norm();
        let budget = Budget::designated(surface, focal_px);
        let mut session = Self {
            hardware,
            goal,
            robot,
            mast,
            mobility,
            rules,
            forecast_mm: budget.forecast_mm(),
            budget,
            tracker,
            estimate,
            now,
            wheels,
            landmarks: Vec::new(),
            ground: Vec::new(),
            stops: Vec::new(),
            driven_m: 0.0,
            spot_offset_m: None,
            near_moves_n: 0,
            retreats_n: 0,
            stalls_n: 0,
            stuck: false,
            shade,
            missed_n: 0,
            aim: None,
            spent: Vec::new(),
            candidates: (0, BTreeMap::new()),
            normal_in_site: None,
            second_choices_n: 0,
        };
        session.approach().await
    }

    async fn approach(&mut self) -> Result<DriveToResult, Fault> {
        self.remember_ground();
        loop {
            let range_m = self.estimate.position_m.xy().norm();
            self.tell(ApproachActivity::Planning);
            self.look_ahead().await?;
            let arcs = if std::mem::take(&mut self.stuck) {
                self.aim = None;
                vec![straight(-RETREAT_M).arc]
            } else if range_m > NEAR_M {
                let shell = self.hardware.shell;
                vec![shell.timed(work::PLANNING, || self.far_movement(range_m))?]
            } else {
                let shell = self.hardware.shell;
                match shell.timed(work::PLANNING, || self.near_movement())? {
                    NearStep::Move(arcs) => {
                        self.near_moves_n += 1;
                        arcs
                    }
                    NearStep::Stay(serving) => match self.finish(serving).await? {
                        Finish::Reached(result) => return Ok(*result),
                        Finish::Otherwise => continue,
                    },
                }
            };
            let limit = self.goal.limits.max_stops_n.unwrap_or(MAX_STOPS_N);
            if self.stops.len() as u32 >= limit {
                return Err(fault("too_many_stops", format!("{limit} stops made")));
            }
            self.tell(ApproachActivity::Driving);
            let mut motion: Option<Motion> = None;
            for arc in arcs {
                let done = self.hardware.drive(arc, self.goal.limits.max_slip).await?;
                let next = self.driven(&done)?;
                motion = Some(motion.map_or(next, |before| before.then(&next)));
                if self.stuck {
                    break;
                }
            }
            if let Some(motion) = motion {
                self.look(&motion, range_m <= NEAR_M).await?;
            }
        }
    }

    /// An arc towards a place in front of the target.
    fn far_movement(&mut self, range_m: f64) -> Result<DriveArc, Fault> {
        let level = self.level_from_rover();
        let target = (level * Point3::from(self.estimate.position_m)).coords.xy();
        let goal = target * (1.0 - STANDOFF_M / target.norm());
        let map = self.map();
        let blocked = match next_movement(&goal, range_m, &map, self.mobility, &self.rules) {
            Ok(movement) => return Ok(movement.arc),
            Err(blocked) => blocked,
        };
        // From farther back an arc may lead around what is in the way.
        if self.retreats_n < RETREATS_N
            && let Some(movement) = self.backwards(&map)
        {
            self.retreats_n += 1;
            return Ok(movement.arc);
        }
        Err(fault("path_blocked", blocked.to_string()).with("range_m", range_m))
    }

    /// The motion that a movement was, if everything stayed within its limits.
    fn driven(&mut self, done: &DriveResult) -> Result<Motion, Fault> {
        let way = match done.before_from_after().isometry.translation.vector.norm() {
            way if way.is_finite() => way,
            other => return Err(fault("bad_odometry", format!("a way of {other} m"))),
        };
        self.driven_m += way;
        if let Some(stop) = &done.stop_reason {
            let name = match stop {
                DriveStop::Slip { .. } => "slip",
                DriveStop::Tilt { .. } => "tilt",
                DriveStop::Stalled { .. } => "stalled",
                _ => "drive_stopped",
            };
            let again = matches!(stop, DriveStop::Stalled { .. }) && self.stalls_n < STALLS_N;
            if again {
                self.stalls_n += 1;
                self.stuck = true;
            } else {
                return Err(fault(name, format!("the drive ended early: {stop}"))
                    .with("slip", done.state.slip));
            }
        }
        if let Some(limit) = self.goal.limits.max_distance_m
            && self.driven_m > limit
        {
            return Err(fault(
                "too_far",
                format!("driven {:.2} m, limit {limit:.2} m", self.driven_m),
            ));
        }
        let now_from_last = done.before_from_after().isometry.inverse();
        Ok(Motion::from_drive(
            now_from_last,
            &done.covariance,
            done.state.tilt_sigma_rad,
        ))
    }

    /// After a motion: where is the target now, and is it known well enough?
    async fn look(&mut self, motion: &Motion, near: bool) -> Result<(), Fault> {
        self.track(motion, near).await?;
        let sigma = sigma_mm(&self.estimate.covariance_m2);
        let worst = sigma.iter().fold(0.0_f64, |m, s| m.max(*s));
        if let Some(limit) = self.goal.limits.max_sigma_mm
            && near
            && worst > limit
        {
            return Err(fault(
                "target_uncertain",
                format!("the target is uncertain by {worst:.1} mm, limit {limit} mm"),
            )
            .with("sigma_mm", worst));
        }
        Ok(())
    }

    /// Points the mast at the target, takes an image, finds the target; another image of the same
    /// stop after a refusal.
    async fn track(&mut self, odometry: &Motion, near: bool) -> Result<(), Fault> {
        let last = self.estimate;
        self.estimate = last.predicted(odometry);
        self.point_at(&self.estimate.position_m.clone()).await?;
        let pointing_rad = self.mast.quality.pointing_deg.to_radians();
        let mount_rad = self.mast.quality.angle_deg.to_radians();
        let mut sightings = Vec::new();
        for exposure_n in 0..2 {
            let frame = self
                .hardware
                .capture(&self.goal.target.pair, exposure_n)
                .await?;
            let wheels = wheels_of(&frame)?;
            let camera = &frame.view.cameras.left;
            let focal_px = camera.model.cahv()[2].norm();
            let eye = camera.model.cahv()[0];
            let expected = odometry.seen_from(eye, mount_rad, pointing_rad);
            let seen = self.seen_motion(&frame, &expected);
            let motion = seen.map_or(expected, |seen| seen.motion);
            self.estimate = last.predicted(&motion);
            let spread = self
                .estimate
                .pixel_covariance(camera, UNKNOWN_PX)
                .ok_or_else(|| fault("target_lost", "the target is behind the camera"))?;
            let predicted_px = self.tracker.predicted_pixel(camera, &motion.now_from_last);
            let found = if self.shade.hides(&self.estimate.position_m, eye, HIDING_M) {
                Err(Refusal::hidden())
            } else {
                self.hardware.shell.timed(work::VISION, || {
                    self.tracker
                        .update(&frame.view, &motion.now_from_last, &spread, near)
                })
            };
            sightings.push(sighting(
                &frame.reference,
                predicted_px,
                &spread,
                self.tracker.rules().search_sigma,
                &found,
                exposure_n > 0,
            ));
            let fix = match found {
                Ok(fix) => fix,
                Err(refusal) if exposure_n > 0 => {
                    return self.missed(&motion, sightings, (frame, wheels, seen), &refusal);
                }
                Err(_) => continue,
            };
            self.estimate
                .update(&fix.surface.plane.point, &fix.surface.covariance_m2)
                .map_err(|e| fault("target_lost", e.to_string()))?;
            // what the tracked pixel says counts; the filter is for the prediction
            self.estimate.position_m = fix.surface.plane.point;
            self.budget.tracked(&fix, focal_px);
            (self.now, self.wheels) = (frame, wheels);
            self.remember_ground();
            self.record(sightings, seen, &fix);
            return Ok(());
        }
        Err(fault("target_lost", "no image was accepted"))
    }

    /// The motion since the last stop as the pictures tell it, if they do.
    fn seen_motion(&self, frame: &Frame, odometry: &Motion) -> Option<Egomotion> {
        let views = [&*self.now.view, &*frame.view];
        let usable = |view: &View, place: &Vector3<f64>| {
            let eye = view.cameras.left.model.cahv()[0];
            let shadow = view.own_shadow.as_ref();
            !self.shade.hides(place, eye, HIDING_M)
                && !self.shade.touches(place, HIDING_M)
                && !shadow.is_some_and(|shadow| shadow.has_edge_at(place))
        };
        let rules = EgomotionRules::default();
        let seen = self.hardware.shell.timed(work::VISION, || {
            egomotion(views, &self.landmarks, odometry, usable, &rules)
        });
        seen.inspect_err(|reason| tracing::debug!(%reason, "odometry alone tells the motion"))
            .ok()
    }

    /// The target was not found in either image of a stop. While the position is still known well
    /// enough to search for it again, odometry carries it one stop further: a passing shadow or a
    /// blur of one place is no reason to give up, and the next stop must find the target.
    fn missed(
        &mut self,
        motion: &Motion,
        sightings: Vec<Sighting>,
        (frame, wheels, seen): (Frame, WheelsState, Option<Egomotion>),
        refusal: &Refusal,
    ) -> Result<(), Fault> {
        self.missed_n += 1;
        let range_m = self.estimate.position_m.xy().norm();
        let worst_mm = sigma_mm(&self.estimate.covariance_m2)
            .iter()
            .fold(0.0_f64, |m, s| m.max(*s));
        // Where landmarks tell the way, it is known as well as the target was.
        let most_n = if refusal.by_the_rover() || seen.is_some() {
            LONG_MISSES_N
        } else {
            MISSES_N
        };
        if self.missed_n > most_n || worst_mm > MISSED_SIGMA_MM {
            let [u_px, v_px] = sightings.last().map_or([0.0; 2], |s| s.predicted_px);
            return Err(fault("target_lost", refusal.to_string())
                .with("range_m", range_m)
                .with("sigma_mm", worst_mm)
                .with("predicted_u_px", u_px)
                .with("predicted_v_px", v_px));
        }
        self.tracker.coast(&motion.now_from_last);
        (self.now, self.wheels) = (frame, wheels);
        self.remember_ground();
        self.note_stop(sightings, seen);
        Ok(())
    }

    fn record(&mut self, sightings: Vec<Sighting>, seen: Option<Egomotion>, fix: &Fix) {
        self.missed_n = 0;
        self.note_stop(sightings, seen);
        self.tell_sighting(fix.pixel_px.into(), fix.score);
    }

    fn note_stop(&mut self, sightings: Vec<Sighting>, seen: Option<Egomotion>) {
        let stop_n = self.stops.len() as u32 + 1;
        self.stops.push(ApproachStop {
            stop_n,
            sim_time_s: self.now.frame.images.sim_time_s,
            pose: self.wheels.pose,
            range_m: self.estimate.position_m.xy().norm(),
            sightings,
            position_m: self.estimate.position_m.into(),
            sigma_mm: sigma_mm(&self.estimate.covariance_m2),
            slip: self.wheels.slip,
            seen_motion: seen.map(|seen| SeenMotion {
                agreeing_n: seen.agreeing_n as u32,
                found_n: seen.found_n as u32,
                rms_px: seen.rms_px,
            }),
        });
    }

    async fn point_at(&self, place: &Vector3<f64>) -> Result<(), Fault> {
        let angles = self.mast.angles_towards(&Point::from(*place));
        let [pan, tilt] = angles.ok_or_else(|| {
            fault(
                "target_lost",
                "the target is too near to the mast to look at",
            )
        })?;
        let within = |x: f64, limits: [f64; 2]| x.clamp(limits[0], limits[1]);
        let [pan_rad, tilt_rad] = [
            within(pan, self.mast.pan_rad),
            within(tilt, self.mast.tilt_rad),
        ];
        self.hardware.point(pan_rad, tilt_rad).await
    }

    /// The rover frame without roll and pitch, from the rover frame.
    fn level_from_rover(&self) -> Isometry3<f64> {
        let pose = &self.wheels.pose;
        UnitQuaternion::from_euler_angles(pose.roll_rad, pose.pitch_rad, 0.0).into_isometry()
    }

    /// Unit vector towards the sun in the levelled rover frame, if it is known and above the
    /// horizon.
    fn sun_in_level(&self) -> Option<Vector3<f64>> {
        let turn = UnitQuaternion::from_euler_angles(0.0, 0.0, -self.wheels.pose.heading_rad);
        sun_of(self.goal).map(|sun| turn * sun)
    }

    fn tell(&self, activity: ApproachActivity) {
        self.hardware.context.feedback(self.feedback(activity));
    }

    /// The target was found in the present image.
    fn tell_sighting(&self, pixel_px: [f64; 2], score: f64) {
        self.hardware.context.feedback(DriveToFeedback {
            frame: Some(self.now.reference.clone()),
            pixel_px: Some(pixel_px),
            score: Some(score),
            ..self.feedback(ApproachActivity::Tracking)
        });
    }

    fn feedback(&self, activity: ApproachActivity) -> DriveToFeedback {
        DriveToFeedback {
            activity,
            stop_n: self.stops.len() as u32,
            range_m: self.estimate.position_m.xy().norm(),
            frame: None,
            pixel_px: None,
            sigma_mm: sigma_mm(&self.estimate.covariance_m2),
            score: None,
            forecast_mm: Some(self.forecast_mm),
        }
    }
}

/// A rotation as a transform.
trait IntoIsometry {
    fn into_isometry(self) -> Isometry3<f64>;
}

impl IntoIsometry for UnitQuaternion<f64> {
    fn into_isometry(self) -> Isometry3<f64> {
        Isometry3::from_parts(nalgebra::Translation3::identity(), self)
    }
}

/// Unit vector towards the sun in the site frame, if it is known and above the horizon.
fn sun_of(goal: &DriveToGoal) -> Option<Vector3<f64>> {
    let sun = Vector3::from(goal.sun_in_site?).try_normalize(1e-9)?;
    (sun.z > 0.0).then_some(sun)
}

fn wheels_of(frame: &Frame) -> Result<WheelsState, Fault> {
    frame.frame.images.wheels.clone().ok_or_else(|| {
        fault(
            "no_odometry",
            "the frame carries no odometry: the hardware has no wheels",
        )
    })
}
