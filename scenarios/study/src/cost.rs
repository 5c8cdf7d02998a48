//! Computing and memory of one cycle of each method against the number of sightings it has (the
//! paper's section 6: "of particular interest is classification of the computational efficiency").

use super::{StudyConfig, StudyError, compare, statistics::quantile};
use rover_methods::Kind;
use serde::Serialize;
use std::{sync::Arc, time::Instant};

/// Numbers of sightings.
pub const SIGHTINGS: [usize; 5] = [1, 6, 12, 24, 48];
/// Repetitions of every measurement.
pub const TRIALS: usize = 25;
/// How much slower a 200 MHz radiation-hardened processor is taken to be than a core of this
/// machine: its clock against about 3 GHz, a factor 15, times a factor 4 for one floating-point
/// operation per cycle at best, no vector unit and small caches.
pub const FLIGHT_FACTOR: f64 = 60.0;

/// The study's result.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Cost {
    /// Seed of the sightings.
    pub seed: u64,
    /// Assumed ratio of a flight processor's time to this machine's.
    pub flight_factor: f64,
    /// One entry per method.
    pub methods: Vec<MethodCost>,
}

/// One method.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MethodCost {
    /// The method.
    pub name: &'static str,
    /// Per number of sightings, where the method has an answer.
    pub cycles: Vec<CycleCost>,
}

/// One cycle: take in the last sighting, give the next command.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct CycleCost {
    /// Sightings with the last one.
    pub sightings: usize,
    /// Time on this machine, median, us.
    pub cycle_us: f64,
    /// The same scaled to a 200 MHz flight processor, ms.
    pub flight_ms: f64,
    /// What the method keeps until the next cycle, bytes.
    pub state_bytes: usize,
}

/// Runs the study, on one thread.
///
/// # Errors
/// [`StudyError`].
pub fn cost(config: &StudyConfig) -> Result<Cost, StudyError> {
    let most = SIGHTINGS.iter().copied().max().unwrap_or(1);
    let (setup, target, samples) = compare::sightings(config.seed, most)?;
    let near = samples
        .last()
        .map(|s| s.joints_rad.clone())
        .unwrap_or_default();
    let mut methods = Vec::new();
    for kind in Kind::ALL {
        let mut cycles = Vec::new();
        for sightings in SIGHTINGS {
            let mut times = Vec::with_capacity(config.trials);
            let mut state_bytes = 0;
            let mut before = kind.start(Arc::clone(&setup), target.clone());
            let (last, first) = samples[..sightings]
                .split_last()
                .ok_or(StudyError::NoTrials { what: "cost" })?;
            // A fit to few sightings on a short way may have no answer; then it has no cost.
            let mut answers = first.iter().all(|s| before.observe(s).is_ok());
            for _ in 0..config.trials {
                let mut method = before.duplicate();
                let started = Instant::now();
                answers &= method.observe(last).is_ok();
                let command = method.command(&target, &near);
                times.push(started.elapsed().as_secs_f64() * 1e6);
                answers &= std::hint::black_box(command).is_ok();
                state_bytes = method.state_bytes();
            }
            if !answers {
                continue;
            }
            let cycle_us = quantile(&mut times, 0.5);
            cycles.push(CycleCost {
                sightings,
                cycle_us,
                flight_ms: cycle_us * FLIGHT_FACTOR * 1e-3,
                state_bytes,
            });
        }
        methods.push(MethodCost {
            name: kind.name(),
            cycles,
        });
    }
    Ok(Cost {
        seed: config.seed,
        flight_factor: FLIGHT_FACTOR,
        methods,
    })
}

impl Cost {
    fn at(&self, kind: Kind, sightings: usize) -> Option<CycleCost> {
        let method = self.methods.iter().find(|m| m.name == kind.name())?;
        method
            .cycles
            .iter()
            .find(|c| c.sightings == sightings)
            .copied()
    }

    /// What the study says, from its own numbers.
    pub fn verdict(&self) -> String {
        let of = |kind| self.at(kind, 6);
        let Some(epec) = of(Kind::Epec) else {
            return "The cost of EPEC itself was not measured.".into();
        };
        let others: Vec<String> = [
            Kind::EpecField,
            Kind::HipsApproach,
            Kind::CameraSpace,
            Kind::KinematicCalibration,
        ]
        .into_iter()
        .filter_map(|kind| {
            let c = of(kind)?;
            let ratio = c.cycle_us / epec.cycle_us;
            Some(format!(
                "{} takes {ratio:.0} times as much ({:.1} us, {:.2} ms in flight)",
                kind.name(),
                c.cycle_us,
                c.flight_ms
            ))
        })
        .collect();
        format!(
            "A cycle of EPEC with six sightings takes {:.2} us here, {:.3} ms on the assumed 200 \
             MHz processor ({:.0} times slower), keeps {} bytes and does not grow with the number \
             of sightings. With the same six sightings {}. Finding the fiducial in the images costs every method \
             the same and is not in these numbers.",
            epec.cycle_us,
            epec.flight_ms,
            self.flight_factor,
            epec.state_bytes,
            others.join("; ")
        )
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_last_vector_keeps_the_same_few_bytes_and_fits_keep_their_sightings() {
        let cost = cost(&StudyConfig::new(1, 1, None)).unwrap();
        assert_eq!(cost.methods.len(), Kind::ALL.len());
        let bytes = |kind, n| cost.at(kind, n).unwrap().state_bytes;
        assert_eq!(bytes(Kind::Epec, 1), bytes(Kind::Epec, 48));
        assert!(bytes(Kind::EpecField, 6) == bytes(Kind::EpecField, 48));
        assert!(bytes(Kind::HipsApproach, 48) > bytes(Kind::HipsApproach, 6));
    }
}
