//! The way to the target, and where its error comes from.

use nalgebra::Vector3;
use rover_messages::{
    Fault,
    approach::{BasePose, DriveToResult},
    simulation::{Score, TruePlace, TruthState},
};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The way to the target.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ApproachReport {
    /// Way of the wheels, m.
    pub driven_m: f64,
    /// Every stop.
    pub stops: Vec<StopReport>,
    /// Error along the surface that was forecast before the drive, 95 %, mm.
    pub forecast_mm: f64,
    /// The target in the left mast image, as it was handed over, px.
    pub tracked_px: [f64; 2],
    /// Distance between the pixel that geometry predicts in the body pair and the matched one, px.
    pub handover_px: f64,
    /// Where the instrument is placed instead of the designated target, if it is: rover frame, mm.
    pub spot_offset_mm: Option<[f64; 3]>,
    /// Predicted error along the surface by source, one sigma, mm.
    pub budget_mm: BTreeMap<String, f64>,
    /// Figures of the base pose; names carry their unit.
    pub base: BTreeMap<String, f64>,
    /// Base poses looked at.
    pub candidates_n: u32,
    /// What refused base poses, and how many each.
    pub refused: BTreeMap<String, u32>,
    /// Base poses from which the placement failed, in order.
    #[serde(default)]
    pub earlier: Vec<EarlierBase>,
    /// The target in the pair that the arm works with.
    pub target: super::TargetReport,
}

/// A base pose that was left again.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EarlierBase {
    /// Where the rover stood, site frame, m.
    pub position_m: [f64; 3],
    /// Its heading, rad.
    pub heading_rad: f64,
    /// Why the placement failed from there: `name: message`.
    pub reason: String,
}

/// One stop.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StopReport {
    /// Believed distance along the ground, m.
    pub range_m: f64,
    /// Correlation of the accepted match, 0 to 1.
    pub score: f64,
    /// How it was found.
    pub method: String,
    /// Looks for the target at this stop.
    pub looks_n: u32,
    /// Standard deviations of the target along the rover axes, mm.
    pub sigma_mm: [f64; 3],
    /// Slip estimated on the way to this stop.
    pub slip: f64,
    /// What the pictures told of the motion to this stop; `null` where odometry alone did.
    #[serde(default)]
    pub seen_motion: Option<rover_messages::approach::SeenMotion>,
}

/// The true lateral error of the placement by source, in the plane of the true normal at the
/// designated point, mm. Sources that were not reached are `null`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ErrorSources {
    /// From the designated point to what the tracked mast pixel shows.
    pub tracking_mm: Option<f64>,
    /// From there to what the body pixel shows.
    pub handover_mm: Option<f64>,
    /// From there to the believed target, camera mount error removed.
    pub stereo_mm: Option<f64>,
    /// From there to the tip at the end of the servo.
    pub servo_mm: Option<f64>,
    /// From there to the contact.
    pub contact_mm: Option<f64>,
}

/// True places met on the way, for [`ErrorSources`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Waypoints {
    /// What the tracked mast pixel shows at the handover.
    pub tracked: Option<TruePlace>,
    /// What the body pixel shows.
    pub handed_over: Option<TruePlace>,
    /// The tip at the end of the servo, world frame, m.
    pub standoff_tip_m: Option<[f64; 3]>,
}

impl Waypoints {
    /// Notes where the tip is at the end of the servo.
    pub fn at_standoff(&mut self, truth: &TruthState) {
        self.standoff_tip_m = Some(truth.tip_in_world_m);
    }

    /// The sources of a placement's error.
    pub fn sources(&self, score: &Score) -> ErrorSources {
        let normal = Vector3::from(score.normal_in_world);
        let lateral_mm = |from: Option<[f64; 3]>, to: Option<[f64; 3]>| {
            let d = Vector3::from(to?) - Vector3::from(from?);
            Some((d - normal * d.dot(&normal)).norm() * 1e3)
        };
        let designated = Some(score.target_in_world_m);
        let tracked = self.tracked.map(|p| p.point_in_world_m);
        let handed_over = self.handed_over.map(|p| p.point_in_world_m);
        let believed = Some(score.believed_in_world_m);
        // Without an approach the arm works with the pair in which the target was named.
        let seen = handed_over.or(designated);
        ErrorSources {
            tracking_mm: lateral_mm(designated, tracked),
            handover_mm: lateral_mm(tracked, handed_over),
            stereo_mm: lateral_mm(seen, believed),
            servo_mm: lateral_mm(believed, self.standoff_tip_m),
            contact_mm: lateral_mm(self.standoff_tip_m, score.contact_in_world_m),
        }
    }
}

impl ApproachReport {
    /// The report of an approach, with the base poses tried in vain.
    pub(crate) fn new(r: &DriveToResult, earlier: &[(BasePose, Fault)]) -> Self {
        let left = |(base, fault): &(BasePose, Fault)| EarlierBase {
            position_m: base.pose.position_m.coords.into(),
            heading_rad: base.pose.heading_rad,
            reason: format!("{}: {}", fault.name, fault.message),
        };
        let stop = |s: &rover_messages::approach::ApproachStop| {
            let accepted = s.sightings.iter().rev().find(|x| x.pixel_px.is_some());
            StopReport {
                range_m: s.range_m,
                score: accepted.map_or(0.0, |x| x.score),
                method: accepted.map_or_else(String::new, |x| x.method.clone()),
                looks_n: s.sightings.len() as u32,
                sigma_mm: s.sigma_mm,
                slip: s.slip,
                seen_motion: s.seen_motion.clone(),
            }
        };
        let share = |s: &rover_messages::approach::ErrorShare| (s.source.clone(), s.sigma_mm);
        Self {
            driven_m: r.driven_m,
            stops: r.stops.iter().map(stop).collect(),
            forecast_mm: r.forecast_mm,
            tracked_px: r.tracked_px,
            handover_px: r.handover_px,
            spot_offset_mm: r.spot_offset_m.map(|d| d.map(|x| x * 1e3)),
            budget_mm: r.budget.iter().map(share).collect(),
            base: r.base.quality.clone(),
            candidates_n: r.base.candidates_n,
            refused: r.base.refused.clone(),
            earlier: earlier.iter().map(left).collect(),
            target: (&r.target).into(),
        }
    }

    /// One line for a person.
    pub(super) fn summary(&self) -> String {
        let looks: u32 = self.stops.iter().map(|s| s.looks_n).sum();
        let spot = self.spot_offset_mm.map_or_else(String::new, |d| {
            format!(", another spot {:.0} mm away", Vector3::from(d).norm())
        });
        let earlier = match self.earlier.len() {
            0 => String::new(),
            n => format!(", {n} base poses in vain"),
        };
        format!(
            "{:.2} m in {} stops, {looks} looks, handed over {:.1} px from where the mounts put it{spot}{earlier}",
            self.driven_m,
            self.stops.len(),
            self.handover_px
        )
    }
}
