//! One approach from designation to hand-over, as a sequence of stops.

mod finish;
mod ground;
mod look;
mod near;

use crate::anchor::TrackRules;
use crate::budget::{Budget, Standpoint};
use crate::drive::{DriveRules, next_movement, straight};
use crate::egomotion::Landmark;
use crate::filter::{Motion, TargetEstimate};
use crate::hardware::{Frame, Hardware, Light, fault};
use crate::obstacles::PlanarPose;
use crate::report::sigma_mm;
use crate::service::unfit;
use crate::shade::Shade;
use crate::track::Tracker;
use finish::Finish;
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector2, Vector3};
use near::NearStep;
use rover_geometry::Point;
use rover_messages::{
    Fault,
    approach::{ApproachActivity, ApproachStop, DriveToFeedback, DriveToGoal, DriveToResult},
    mobility::{DriveArc, DriveResult, DriveStop, WheelsState},
    status::work,
};
use rover_robot::{MastDescription, MobilityDescription, Robot};
use std::{collections::BTreeMap, sync::Arc};

/// Range at which the base pose is chosen, m along the ground.
const NEAR_M: f64 = 3.2;
/// Distance from the target that is aimed at before, m.
const STANDOFF_M: f64 = 1.1;
/// Most stops if the goal does not say.
const MAX_STOPS_N: u32 = 60;
/// Movements back from where no way is clear, in one approach.
const RETREATS_N: u32 = 3;
/// Way back from where no way is clear or a wheel stalled, m.
const RETREAT_M: f64 = 0.4;
/// Times that a wheel may stall in one approach.
const STALLS_N: u32 = 3;

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
        let budget = Budget::designated(surface, &standpoint(&now, &wheels), &goal.lost_m2);
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
            let stuck = std::mem::take(&mut self.stuck);
            if !stuck {
                self.look_ahead().await?;
            }
            let arcs = if stuck {
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

/// Where a frame's left image was taken.
fn standpoint<'a>(frame: &'a Frame, wheels: &WheelsState) -> Standpoint<'a> {
    Standpoint {
        camera: &frame.view.cameras.left,
        site_from_rover: wheels.pose.site_from_rover().isometry.rotation,
    }
}

fn wheels_of(frame: &Frame) -> Result<WheelsState, Fault> {
    frame.frame.images.wheels.clone().ok_or_else(|| {
        fault(
            "no_odometry",
            "the frame carries no odometry: the hardware has no wheels",
        )
    })
}
