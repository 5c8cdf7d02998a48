//! One robot before its cameras: what it learns at the reference places, and where that takes it.

use super::down;
use crate::{
    StudyConfig, StudyError,
    testbed::{Drawn, Testbed, single_looks},
};
use nalgebra::Vector3;
use rover_compensation::Compensation;
use rover_epec_servo::estimator::EstimatorRules;
use rover_messages::{
    Fault,
    placement::{Method, Observation},
    target::Target,
};

/// Looks of the field, and how far above the reference place the first one is, m.
const LOOKS: usize = 6;
const APPROACH_M: f64 = 0.12;

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

/// Vectors seen in pictures taken at a place.
pub(super) struct Seen {
    /// The mark's vector, the mark at the place.
    pub(super) mark: Compensation,
    /// The mark's vector, the tip at the place.
    pub(super) tip: Compensation,
    /// The plate's pose, the tip at the place.
    pub(super) plate: Compensation,
}

/// What was learnt at a reference place.
struct Learnt {
    seen: Seen,
    /// The mark's vector, the mark at the place, if sight had no error.
    exact: Compensation,
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
    by: (Method, Observation),
    stations_m: Vec<f64>,
) -> Result<Compensation, Fault> {
    let goal = single_looks(target, by, stations_m);
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

/// The paper's way to look, and the plate's.
pub(super) const BY_MARK: (Method, Observation) = (Method::Epec, Observation::Position);
const BY_PLATE: (Method, Observation) = (Method::Epec, Observation::Pose);

impl Seen {
    /// Takes the pictures.
    pub(super) fn at(robot: &mut Drawn, target: &Target) -> Result<Self, Fault> {
        let under_mark = robot.under_mark(target)?;
        Ok(Self {
            mark: look(robot, &under_mark, BY_MARK, vec![0.0])?,
            tip: look(robot, target, BY_MARK, vec![0.0])?,
            plate: look(robot, target, BY_PLATE, vec![0.0])?,
        })
    }
}

fn learn(robot: &mut Drawn, place: &Vector3<f64>, target: &Target) -> Result<Learnt, Fault> {
    let [exact, ..] = robot.exact_vectors(&robot.exact_target(place, &-down()))?;
    let by_field = (Method::EpecField, Observation::Position);
    Ok(Learnt {
        exact,
        seen: Seen::at(robot, target)?,
        field: look(robot, target, by_field, way_down(LOOKS))?,
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
        of_mark(&learnt.seen.mark)?,
        mark_error_mm(robot, &learnt.exact, &exact_target, at, near)?,
        of_mark(&Compensation::none())?,
        of_tip(&learnt.seen.tip)?,
        of_tip(&learnt.seen.plate)?,
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
