//! What is left at the place where the vector was taken itself, taken apart by switching error
//! sources off one at a time.

use super::{
    down,
    robot::{BY_MARK, Seen, look, mark_error_mm, seed, tip_error_mm},
};
use crate::{StudyConfig, StudyError, statistics::mean, testbed::Testbed};
use nalgebra::Vector3;
use rayon::prelude::*;
use rover_compensation::Compensation;
use rover_messages::{Fault, target::Target};
use rover_sim::{IntrinsicsError, SimulationDescription};
use serde::Serialize;

/// Mean errors at the place where the vector was taken, in one setting.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AtReference {
    /// What is switched off.
    pub setting: &'static str,
    /// The mark without correction, mm.
    pub open_loop_mm: f64,
    /// The mark with its vector, taken with the mark at the place, mm.
    pub mark_mm: f64,
    /// The mark with a second vector, taken where the first one brought it, mm.
    pub mark_second_mm: f64,
    /// The mark with its vector taken with the tip at the place, and so the mark 9 cm away, mm.
    pub mark_from_tip_mm: f64,
    /// The tip with the mark's vector, mm.
    pub tip_mm: f64,
    /// The tip with the vector of the plate's pose, mm.
    pub plate_mm: f64,
    /// Robots that reached it.
    pub robots: usize,
}

/// How the vectors of a setting are seen.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Sight {
    /// In pictures.
    Pictures,
    /// By calculation: the true arm through the true mount.
    Exact,
}

/// A setting: its name, what is taken out of the simulated world, how vectors are seen.
type Setting = (&'static str, fn(&mut SimulationDescription), Sight);

fn no_droop(world: &mut SimulationDescription) {
    world.truth.droop = false;
}

fn exact_lenses(world: &mut SimulationDescription) {
    world.truth.intrinsics = IntrinsicsError::default();
}

fn no_noise(world: &mut SimulationDescription) {
    world.image.read_noise_dn = 0.0;
    world.image.electrons_per_dn = 0.0;
}

fn exact_arm_and_mount(world: &mut SimulationDescription) {
    world.truth.angle_deg = 0.0;
    world.truth.length_mm = 0.0;
}

/// Names of settings that the verdict speaks of.
pub(super) const EVERYTHING: &str = "everything";
pub(super) const NO_DROOP: &str = "no droop";
pub(super) const EXACT_LENSES: &str = "cameras' intrinsics exact";
pub(super) const NO_NOISE: &str = "pictures without noise";
pub(super) const EXACT_SIGHT: &str = "sight exact, no pictures";

const SETTINGS: [Setting; 6] = [
    (EVERYTHING, |_| {}, Sight::Pictures),
    (NO_DROOP, no_droop, Sight::Pictures),
    (EXACT_LENSES, exact_lenses, Sight::Pictures),
    (NO_NOISE, no_noise, Sight::Pictures),
    (EXACT_SIGHT, |_| {}, Sight::Exact),
    ("arm and mount exact", exact_arm_and_mount, Sight::Pictures),
];

/// Errors at one place, mm, in the order of [`AtReference`].
type Errors = [f64; 6];

/// Runs all settings at `place` (rover frame, m).
///
/// # Errors
/// [`StudyError`]; [`StudyError::NoTrials`] when no robot reached the place in a setting.
pub(super) fn at_reference(
    config: &StudyConfig,
    bed: &Testbed,
    place: &Vector3<f64>,
) -> Result<Vec<AtReference>, StudyError> {
    SETTINGS
        .iter()
        .map(|(setting, change, sight)| {
            let bed = bed.altered(change);
            let robots: Vec<Option<Errors>> = (0..config.trials)
                .into_par_iter()
                .map(|trial| one_robot(&bed, place, *sight, seed(config, trial as u64)))
                .collect::<Result<_, _>>()?;
            let robots: Vec<Errors> = robots.into_iter().flatten().collect();
            if robots.is_empty() {
                return Err(StudyError::NoTrials { what: "experiment" });
            }
            let averaged = |i: usize| mean(&robots.iter().map(|r| r[i]).collect::<Vec<_>>());
            Ok(AtReference {
                setting,
                open_loop_mm: averaged(0),
                mark_mm: averaged(1),
                mark_second_mm: averaged(2),
                mark_from_tip_mm: averaged(3),
                tip_mm: averaged(4),
                plate_mm: averaged(5),
                robots: robots.len(),
            })
        })
        .collect()
}

/// The target as designated, and the vectors: the mark's, its second one, the mark's with the tip
/// at the place, the plate's.
type Vectors = (Target, [Compensation; 4]);

fn one_robot(
    bed: &Testbed,
    place: &Vector3<f64>,
    sight: Sight,
    seed: u64,
) -> Result<Option<Errors>, StudyError> {
    let mut robot = bed.draw(seed)?;
    let near = robot.start()?;
    let vectors = match sight {
        Sight::Pictures => in_pictures(&mut robot, place),
        Sight::Exact => {
            let target = robot.exact_target(place, &-down());
            robot
                .exact_vectors(&target)
                .map(|vectors| (target, vectors))
        }
    };
    // A fiducial that was not found: this robot is in no mean.
    let Ok((target, [mark, second, tip, plate])) = vectors else {
        return Ok(None);
    };
    let of_mark = |c: &Compensation| mark_error_mm(&robot, c, &target, place, &near);
    let of_tip = |c: &Compensation| tip_error_mm(&robot, c, &target, place, &near);
    let errors = [
        of_mark(&Compensation::none())?,
        of_mark(&mark)?,
        of_mark(&second)?,
        of_mark(&tip)?,
        of_tip(&tip)?,
        of_tip(&plate)?,
    ];
    let mut out = [0.0; 6];
    for (out, error) in out.iter_mut().zip(errors) {
        let Some(error) = error else { return Ok(None) };
        *out = error;
    }
    Ok(Some(out))
}

fn in_pictures(robot: &mut crate::testbed::Drawn, place: &Vector3<f64>) -> Result<Vectors, Fault> {
    let target = robot.target(place, &-down())?;
    let Seen { mark, tip, plate } = Seen::at(robot, &target)?;
    let under_mark = robot.under_mark(&target)?;
    let second = look(robot, &under_mark, BY_MARK, vec![0.0, 0.0])?;
    Ok((target, [mark, second, tip, plate]))
}
