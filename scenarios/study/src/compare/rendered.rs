//! Images of the testbed, the servo's detector and the servo's loop: each method as a scenario would
//! run it, without the time that motions take.

use super::{Case, LOOKS, Outcome, Outcomes, by_trial, distance_m};
use crate::{
    StudyError,
    draws::{Draws, key},
    testbed::{Drawn, PAIR, Testbed, single_looks},
};
use nalgebra::{Unit, Vector3};
use rover_epec_servo::{estimator::EstimatorRules, place::error_model, survey::is_visible};
use rover_geometry::{Direction, Rover};
use rover_messages::{placement::Observation, planning::ToolPose, target::Target};
use rover_methods::Kind;
use rover_sim::IntrinsicsError;

/// The degraded pair: focal length as a fraction, principal point in px, one sigma.
const DEGRADED: IntrinsicsError = IntrinsicsError {
    focal_fraction: 0.03,
    principal_point_px: 3.0,
};
/// Tilt of the target's normal from the vertical, per axis, one sigma, rad.
const TILT: f64 = 0.1;
/// Places tried for a target that is seen from start to end.
const MOST_PLACES: u32 = 2000;

/// What is common to all methods and blind parts of a trial.
struct Trial {
    drawn: Drawn,
    at: Vector3<f64>,
    normal: Unit<Vector3<f64>>,
    target: Target,
}

impl Trial {
    fn draw(bed: &Testbed, seed: u64, trial: u64) -> Result<Self, StudyError> {
        let failed = |e: String| StudyError::Testbed(e);
        let mut drawn = bed.draw(key(seed, &[6, trial]))?;
        let pair = bed.robot.pair(PAIR).map_err(|e| failed(e.to_string()))?;
        let model = error_model(&bed.robot);
        let start = drawn.start()?;
        let mut draws = Draws::new(seed, &[7, trial]);
        for _ in 0..MOST_PLACES {
            let at = Vector3::new(
                draws.between(0.44, 0.62),
                draws.between(-0.15, 0.15),
                draws.between(0.15, 0.32),
            );
            let tilted = Vector3::new(TILT * draws.normal(), TILT * draws.normal(), 1.0);
            let normal = Unit::new_normalize(tilted);
            let sees = |distance: f64| {
                let pose = ToolPose {
                    tip_m: (at + normal.into_inner() * distance).into(),
                    axis: Direction::<Rover>::from(-normal),
                };
                is_visible(&bed.robot, &model, &pair.cameras, &pose, &start)
            };
            if !(sees(0.0) && sees(super::START_M)) {
                continue;
            }
            if let Ok(target) = drawn.target(&at, &normal) {
                return Ok(Self {
                    drawn,
                    at,
                    normal,
                    target,
                });
            }
        }
        Err(StudyError::NoTrials {
            what: "compare: no target is seen from start to end",
        })
    }

    fn place(&mut self, kind: Kind, case: Case, occlusion_cm: u32) -> Option<Outcome> {
        let stations = (0..LOOKS).map(|k| distance_m(k, occlusion_cm));
        let observation = match case {
            Case::ImagesPlate => Observation::Pose,
            _ => Observation::Position,
        };
        let goal = single_looks(&self.target, (kind, observation), stations.collect());
        // What the detector finds counts: with wrong lenses no sighting agrees with a filter
        // that takes them for right, and the methods shall be compared, not the filter.
        let rules = EstimatorRules {
            gate_per_row: f64::INFINITY,
            ..EstimatorRules::default()
        };
        let placed = self.drawn.place(&goal, rules).ok()?;
        let tip = self.drawn.true_tip(&placed.joints_rad).ok()?;
        let cycle_us = placed.computing_us / f64::from(placed.cycles.max(1));
        let times_us = (cycle_us, placed.computing_us);
        Outcome::of(&(tip - self.at), &self.normal, times_us)
    }
}

/// Runs one case.
///
/// # Errors
/// [`StudyError`].
pub fn outcomes(
    seed: u64,
    trials: usize,
    case: Case,
    occlusions_cm: &[u32],
) -> Result<Vec<Outcomes>, StudyError> {
    let intrinsics = match case {
        Case::ImagesDegraded => DEGRADED,
        _ => IntrinsicsError::default(),
    };
    let bed = Testbed::bluestreak(intrinsics)?;
    by_trial(
        trials,
        occlusions_cm,
        |trial| Trial::draw(&bed, seed, trial as u64),
        |trial, kind, occlusion_cm| trial.place(kind, case, occlusion_cm),
    )
}
