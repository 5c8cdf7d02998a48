//! The paper's experiment (section 5, *Experimental Results*, figure 7) with pictures: vectors taken
//! from images of the arm at one place, targets designated in images all over the workspace, the
//! arm sent to each with and without correction, its true place measured.
//!
//! As in the numeric study the point that is measured is the one that is tracked: the fiducial's
//! mark, which stands at the reference place when its vector is taken. What that means for the
//! instrument's tip, 9 cm from the mark, stands beside it; [`sources`] takes what is left at the
//! reference place itself apart.

mod robot;
mod sources;
mod verdict;

pub use sources::AtReference;

use super::{
    StudyConfig, StudyError,
    growth::Growth,
    locality::{self, locality},
    statistics::mean,
    testbed::{PAIR, Testbed},
};
use nalgebra::{Unit, Vector3};
use rayon::prelude::*;
use robot::{Errors, one_robot};
use rover_epec_servo::survey::is_visible;
use rover_geometry::{Direction, Rover};
use rover_messages::planning::ToolPose;
use rover_sim::IntrinsicsError;
use serde::Serialize;

/// Robots that are drawn.
pub const TRIALS: usize = 20;
/// Draws of the numeric study whose slope is drawn in.
const THEORY_TRIALS: usize = 60;
/// Calibrated cameras are never exact; the paper names that as what steepens the slope.
const INTRINSICS: IntrinsicsError = IntrinsicsError {
    focal_fraction: 1e-3,
    principal_point_px: 0.3,
};

/// The study's result.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Experiment {
    /// Seed of all draws.
    pub seed: u64,
    /// Robots drawn.
    pub trials: usize,
    /// Error of one camera's intrinsics, one sigma: focal length (fraction), principal point (px).
    pub intrinsics: (f64, f64),
    /// One entry per place where the vector was taken.
    pub references: Vec<Reference>,
    /// What is left at the first of these places itself, with error sources taken away.
    pub at_reference: Vec<AtReference>,
}

/// One place where the vector was taken.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Reference {
    /// Which place.
    pub name: &'static str,
    /// Where, rover frame, m.
    pub position_m: [f64; 3],
    /// The targets, by distance.
    pub points: Vec<ExperimentPoint>,
    /// The mark's error with one vector against distance.
    #[serde(flatten)]
    pub vector: Growth,
    /// Mean error of the mark at the place itself, mm.
    pub at_reference_mm: f64,
    /// Slope of the error of one vector if sight had no error, mm/m.
    pub exact_slope_mm_per_m: f64,
    /// Slope of the tip's error with the field made from looks at the mark, mm/m.
    pub field_slope_mm_per_m: f64,
    /// Slope of the tip's error with the vector of the mark, mm/m.
    pub tip_slope_mm_per_m: f64,
    /// That line's value at no distance, mm.
    pub tip_intercept_mm: f64,
    /// The same with the vector of the plate's pose, mm/m.
    pub plate_slope_mm_per_m: f64,
    /// That line's value at no distance, mm.
    pub plate_intercept_mm: f64,
    /// Slope that the numeric study of locality predicts, mm/m.
    pub predicted_slope_mm_per_m: f64,
    /// The value at no distance of that study's line, mm.
    pub predicted_intercept_mm: f64,
    /// Robots whose fiducial was found at the reference place.
    pub robots: usize,
}

/// One target, averaged over the robots.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ExperimentPoint {
    /// Distance from where the vector was taken, m.
    pub distance_m: f64,
    /// Mean error of the mark with its vector, mm.
    pub error_mm: f64,
    /// The same if sight had no error, mm.
    pub exact_mm: f64,
    /// Mean error of the mark without correction, mm.
    pub open_loop_mm: f64,
    /// Mean error of the tip with the mark's vector, mm.
    pub tip_mm: f64,
    /// Mean error of the tip with the vector of the plate's pose, mm.
    pub plate_mm: f64,
    /// Mean error of the tip with the field made from looks at the mark, mm.
    pub field_mm: f64,
    /// Robots that reached it.
    pub robots: usize,
}

/// The paper's three places, rover frame, in the order of the numeric study.
fn wanted() -> [Vector3<f64>; 3] {
    [
        // The middle of what arm and cameras share.
        Vector3::new(0.55, 0.0, 0.28),
        // On the axis of the pair, which looks 45 degrees down from 0.9 m.
        Vector3::new(0.56, 0.0, 0.34),
        Vector3::new(0.68, 0.16, 0.20),
    ]
}

fn down() -> Unit<Vector3<f64>> {
    -Vector3::z_axis()
}

/// Targets of a lattice over the workspace that the arm reaches and the cameras see.
fn targets(bed: &Testbed) -> Result<Vec<Vector3<f64>>, StudyError> {
    let failed = |e: rover_robot::RobotError| StudyError::Testbed(e.to_string());
    let pair = bed.robot.pair(PAIR).map_err(failed)?;
    let ready = bed.robot.posture("ready").map_err(failed)?;
    let model = rover_epec_servo::place::error_model(&bed.robot);
    let model_of_mark = bed.model_of_mark()?;
    let mut found = Vec::new();
    for x in [0.44, 0.52, 0.60, 0.68] {
        for y in [-0.18, -0.06, 0.06, 0.18] {
            for z in [0.14, 0.24, 0.34, 0.44] {
                let at = Vector3::new(x, y, z);
                let pose = ToolPose {
                    tip_m: at.into(),
                    axis: Direction::<Rover>::from(down()),
                };
                // The target's own plate has to be seen as well as the arm's.
                let seen = [&pair.cameras.left, &pair.cameras.right]
                    .iter()
                    .all(|c| c.project_into_image(&at, 60.0).is_ok());
                // And the arm's plate, with the tip there and with its mark there.
                let arm_is_seen = [&model, &model_of_mark]
                    .iter()
                    .all(|m| is_visible(&bed.robot, m, &pair.cameras, &pose, ready));
                if seen && arm_is_seen {
                    found.push(at);
                }
            }
        }
    }
    Ok(found)
}

/// The nearest target to each wanted place.
fn places(targets: &[Vector3<f64>]) -> Result<Vec<Vector3<f64>>, StudyError> {
    wanted()
        .iter()
        .map(|w| {
            let nearest = targets
                .iter()
                .min_by(|a, b| (*a - w).norm().total_cmp(&(*b - w).norm()));
            nearest
                .copied()
                .ok_or(StudyError::NoTrials { what: "experiment" })
        })
        .collect()
}

/// Runs the study.
///
/// # Errors
/// [`StudyError`].
pub fn experiment(config: &StudyConfig) -> Result<Experiment, StudyError> {
    let bed = Testbed::bluestreak(INTRINSICS)?;
    let targets = targets(&bed)?;
    let places = places(&targets)?;
    let theory = locality(&config.with_trials(THEORY_TRIALS.min(3 * config.trials)))?;
    let pool = config.pool()?;
    let robots: Vec<Vec<Vec<Option<Errors>>>> = pool.install(|| {
        (0..config.trials)
            .into_par_iter()
            .map(|trial| one_robot(config, &bed, &places, &targets, trial as u64))
            .collect::<Result<_, _>>()
    })?;
    let references = places
        .iter()
        .zip(&theory.references)
        .enumerate()
        .map(|(index, (place, theory))| {
            let of_robots: Vec<&Vec<Option<Errors>>> = robots.iter().map(|r| &r[index]).collect();
            reference(place, theory, &targets, &of_robots)
        })
        .collect::<Result<_, _>>()?;
    let middle = places
        .first()
        .ok_or(StudyError::NoTrials { what: "experiment" })?;
    let at_reference = pool.install(|| sources::at_reference(config, &bed, middle))?;
    Ok(Experiment {
        seed: config.seed,
        trials: config.trials,
        intrinsics: (INTRINSICS.focal_fraction, INTRINSICS.principal_point_px),
        references,
        at_reference,
    })
}

fn reference(
    place: &Vector3<f64>,
    theory: &locality::Reference,
    targets: &[Vector3<f64>],
    robots: &[&Vec<Option<Errors>>],
) -> Result<Reference, StudyError> {
    let none = || StudyError::NoTrials { what: "experiment" };
    let mut points = Vec::new();
    for (i, at) in targets.iter().enumerate() {
        let errors: Vec<Errors> = robots.iter().filter_map(|r| r[i]).collect();
        if errors.is_empty() {
            continue;
        }
        let averaged = |of: fn(&Errors) -> f64| mean(&errors.iter().map(of).collect::<Vec<_>>());
        points.push(ExperimentPoint {
            distance_m: (at - place).norm(),
            error_mm: averaged(|e| e.mark),
            exact_mm: averaged(|e| e.exact),
            open_loop_mm: averaged(|e| e.open_loop),
            tip_mm: averaged(|e| e.tip),
            plate_mm: averaged(|e| e.plate),
            field_mm: averaged(|e| e.field),
            robots: errors.len(),
        });
    }
    points.sort_by(|a, b| a.distance_m.total_cmp(&b.distance_m));
    let growth = |of: fn(&ExperimentPoint) -> f64| {
        Growth::of(points.iter().map(|p| (p.distance_m, of(p))), "experiment")
    };
    let at_reference = points.first().filter(|p| p.distance_m < 1e-9);
    let tip = growth(|p| p.tip_mm)?;
    let plate = growth(|p| p.plate_mm)?;
    Ok(Reference {
        name: theory.name,
        position_m: (*place).into(),
        vector: growth(|p| p.error_mm)?,
        at_reference_mm: at_reference.ok_or_else(none)?.error_mm,
        exact_slope_mm_per_m: growth(|p| p.exact_mm)?.slope_mm_per_m,
        field_slope_mm_per_m: growth(|p| p.field_mm)?.slope_mm_per_m,
        tip_slope_mm_per_m: tip.slope_mm_per_m,
        tip_intercept_mm: tip.intercept_mm,
        plate_slope_mm_per_m: plate.slope_mm_per_m,
        plate_intercept_mm: plate.intercept_mm,
        predicted_slope_mm_per_m: theory.vector.slope_mm_per_m,
        predicted_intercept_mm: theory.vector.intercept_mm,
        robots: points.iter().map(|p| p.robots).max().unwrap_or(0),
        points,
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn targets_cover_the_workspace_and_the_places_are_among_them() {
        let bed = Testbed::bluestreak(IntrinsicsError::default()).unwrap();
        let targets = targets(&bed).unwrap();
        assert!(targets.len() >= 20, "{}", targets.len());
        let places = places(&targets).unwrap();
        assert!(places.iter().all(|p| targets.contains(p)));
        assert!((places[0] - places[2]).norm() > 0.1);
    }

    #[test]
    fn a_vector_from_images_corrects_most_where_it_was_taken() {
        let study = experiment(&StudyConfig::new(1, 1, None)).unwrap();
        assert_eq!(study.references.len(), 3);
        for r in &study.references {
            let near = r.points.first().unwrap();
            assert!(
                near.distance_m < 1e-9 && near.error_mm < 0.2 * near.open_loop_mm,
                "{}: {near:?}",
                r.name
            );
            let all = |of: fn(&ExperimentPoint) -> f64| {
                mean(&r.points.iter().map(of).collect::<Vec<_>>())
            };
            assert!(
                all(|p| p.error_mm) < 0.8 * all(|p| p.open_loop_mm),
                "{}",
                r.name
            );
        }
        // What remains at the place itself is the rule's own remainder: it is there with exact
        // sight, too, and a second vector takes it away but for what pictures and lenses add.
        let at = |name| {
            study
                .at_reference
                .iter()
                .find(|a| a.setting == name)
                .unwrap()
        };
        let (all, exact) = (at(sources::EVERYTHING), at(sources::EXACT_SIGHT));
        assert!(exact.mark_mm < 0.2 * exact.open_loop_mm, "{exact:?}");
        assert!(exact.mark_second_mm < 0.25, "{exact:?}");
        assert!(all.mark_second_mm < 0.8, "{all:?}");
        let lenses = at(sources::EXACT_LENSES);
        assert!((lenses.mark_mm - exact.mark_mm).abs() < 0.5, "{lenses:?}");
    }
}
