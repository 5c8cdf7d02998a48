//! One robot before its cameras: what it learns at the reference places, and where that takes it.

use super::down;
use crate::{
    StudyConfig, StudyError,
    testbed::{Drawn, Testbed},
};
use nalgebra::Vector3;
use rover_compensation::Compensation;
use rover_epec_servo::estimator::EstimatorRules;
use rover_messages::{
    Fault,
    placement::{Method, Observation, PlaceGoal},
    target::Target,
};

/// Looks of the field, and how far above the reference place the first one is, m.
const LOOKS: usize = 6;
const APPROACH_M: f64 = 0.12;
/// Tolerance that ends the servo's loop with its first look at a station, m.
const ANY_M: f64 = 0.1;
/// No placement is refused for what is predicted of it.
const NO_LIMIT_M: f64 = 1.0;

/// Errors of one robot at one target, mm.
#[derive(Clone, Copy, Debug)]
pub(super) struct Errors {
    pub(super) mark: f64,
    pub(super) exact: f64,
    pub(super) open_loop: f64,
    pub(super) tip: f64,
    pub(super) plate: f64,
    pub(super) field: f64,
}

/// Seed of a robot of the study.
pub(super) fn seed(config: &StudyConfig, trial: u64) -> u64 {
    crate::draws::key(config.seed, &[9, trial])
}

/// What was learnt at a reference place.
struct Learnt {
    /// The mark's vector, the mark at the place.
    mark: Compensation,
    /// The same if sight had no error.
    exact: Compensation,
    /// The mark's vector, the tip at the place.
    tip: Compensation,
    /// The plate's pose, the tip at the place.
    plate: Compensation,
    /// Looks at the mark while the tip comes down on the place.
    field: Compensation,
}

/// Errors of one robot: for each reference place one entry per target; none where the fiducial was
/// not found or the corrected target is out of reach.
pub(super) fn one_robot(
    config: &StudyConfig,
    bed: &Testbed,
    places: &[Vector3<f64>],
    targets: &[Vector3<f64>],
    trial: u64,
) -> Result<Vec<Vec<Option<Errors>>>, StudyError> {
    let mut robot = bed.draw(seed(config, trial))?;
    let designated: Vec<Option<Target>> = targets
        .iter()
        .map(|at| robot.target(at, &-down()).ok())
        .collect();
    let start = robot.start()?;
    let mut out = Vec::with_capacity(places.len());
    for place in places {
        let here = targets.iter().position(|t| t == place);
        let reference = here.and_then(|i| designated[i].clone());
        let learnt = reference.and_then(|target| learn(&mut robot, place, &target).ok());
        robot.forget();
        let mut errors = vec![None; targets.len()];
        if let Some(learnt) = learnt {
            for ((error, target), at) in errors.iter_mut().zip(&designated).zip(targets) {
                if let Some(target) = target {
                    *error = measured(&robot, &learnt, target, at, &start)?;
                }
            }
        }
        out.push(errors);
    }
    Ok(out)
}

/// Heights above the target at which `looks` looks are taken on a straight way down.
fn way_down(looks: usize) -> Vec<f64> {
    let last = (looks.max(2) - 1) as f64;
    (0..looks)
        .map(|k| APPROACH_M * (1.0 - k as f64 / last))
        .collect()
}

/// What a method makes of looks at these heights above a target, m.
pub(super) fn look(
    robot: &mut Drawn,
    target: &Target,
    (method, observation): (Method, Observation),
    stations_m: Vec<f64>,
) -> Result<Compensation, Fault> {
    let goal = PlaceGoal {
        target: target.clone(),
        stations_m,
        method,
        observation,
        tolerance_m: ANY_M,
        max_corrections_n: 1,
        max_predicted_error_m: NO_LIMIT_M,
    };
    let placed = robot.place(&goal, EstimatorRules::default())?;
    if !placed.result.looks.iter().any(|l| l.found) {
        return Err(Fault::new(
            "study",
            "not_seen",
            "the fiducial was not found",
        ));
    }
    Ok(placed.result.compensation)
}

fn learn(robot: &mut Drawn, place: &Vector3<f64>, target: &Target) -> Result<Learnt, Fault> {
    let position = (Method::Epec, Observation::Position);
    let under_mark = robot.under_mark(target)?;
    let [exact, ..] = robot.exact_vectors(&robot.exact_target(place, &-down()))?;
    Ok(Learnt {
        exact,
        mark: look(robot, &under_mark, position, vec![0.0])?,
        tip: look(robot, target, position, vec![0.0])?,
        plate: look(robot, target, (Method::Epec, Observation::Pose), vec![0.0])?,
        field: look(
            robot,
            target,
            (Method::EpecField, Observation::Position),
            way_down(LOOKS),
        )?,
    })
}

/// Distance of the true tip from `at` with this compensation, mm; none if out of reach.
pub(super) fn tip_error_mm(
    robot: &Drawn,
    compensation: &Compensation,
    target: &Target,
    at: &Vector3<f64>,
    near: &[f64],
) -> Result<Option<f64>, StudyError> {
    match robot.corrected(compensation, target, near) {
        Ok(q) => Ok(Some((robot.true_tip(&q)? - at).norm() * 1e3)),
        Err(_) => Ok(None),
    }
}

/// Distance of the true mark from `at` with this compensation, mm; none if out of reach.
pub(super) fn mark_error_mm(
    robot: &Drawn,
    compensation: &Compensation,
    target: &Target,
    at: &Vector3<f64>,
    near: &[f64],
) -> Result<Option<f64>, StudyError> {
    let placed = robot.placed_mark(compensation, target, near)?;
    Ok(placed.map(|p| (p - at).norm() * 1e3))
}

fn measured(
    robot: &Drawn,
    learnt: &Learnt,
    target: &Target,
    at: &Vector3<f64>,
    near: &[f64],
) -> Result<Option<Errors>, StudyError> {
    let of_mark = |c: &Compensation| mark_error_mm(robot, c, target, at, near);
    let exact_target = robot.exact_target(at, &-down());
    let of_tip = |c: &Compensation| tip_error_mm(robot, c, target, at, near);
    let all = (
        of_mark(&learnt.mark)?,
        mark_error_mm(robot, &learnt.exact, &exact_target, at, near)?,
        of_mark(&Compensation::none())?,
        of_tip(&learnt.tip)?,
        of_tip(&learnt.plate)?,
        of_tip(&learnt.field)?,
    );
    Ok(match all {
        (Some(mark), Some(exact), Some(open_loop), Some(tip), Some(plate), Some(field)) => {
            Some(Errors {
                mark,
                exact,
                open_loop,
                tip,
                plate,
                field,
            })
        }
        _ => None,
    })
}
