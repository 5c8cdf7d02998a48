//! Straight motions in joint space, checked along their whole length.
//!
//! From a configuration with some slack the joints may move on until a pair of bodies can have
//! used it up at the speed with which they approach each other at most; there the distances are
//! computed anew (conservative advancement). So no obstacle is stepped over, apart from
//! [`MIN_ADVANCE_M`] by which a margin may be undercut between two looks.

use crate::collision::{CollisionModel, ContactZone, Pair, Proximity};
use crate::terrain_map::TerrainMap;
use rover_kinematics::ArmError;

/// Bodies move at least this far towards each other from one look to the next, m.
pub(crate) const MIN_ADVANCE_M: f64 = 0.001;
/// How far the terrain is looked for beyond the largest margin, m.
const LOOK_M: f64 = 0.2;
/// What a motion that starts too near may come nearer still, m.
const GRACE_M: f64 = 0.001;

/// The robot and what surrounds it.
#[derive(Clone, Copy)]
pub(crate) struct Scene<'a> {
    pub model: &'a CollisionModel,
    pub terrain: Option<&'a TerrainMap>,
    pub zone: Option<&'a ContactZone>,
}

/// Why a motion is not possible.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Blocked {
    /// Joint angles at which the distance is too small, rad.
    pub q: Vec<f64>,
    /// The bodies and their distance.
    pub proximity: Proximity,
}

/// The outcome of a check: `Err` for joint angles that do not fit the arm.
pub(crate) type Checked = Result<Result<(), Blocked>, ArmError>;

/// Pairs that are nearer than required at the start of a motion. They may stay so but must not
/// come nearer, until they have once kept their distance.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Leaving {
    floors: Vec<(Pair, f64)>,
}

impl Leaving {
    /// What is too near at joint angles `q` (rad).
    pub fn from(scene: &Scene, q: &[f64]) -> Result<Self, ArmError> {
        let mut floors = Vec::new();
        scene.visit(q, 0.0, |p| {
            if p.distance_m < p.required_m {
                floors.push((p.pair, p.distance_m - GRACE_M));
            }
        })?;
        Ok(Self { floors })
    }

    /// Whether nothing is too near any more.
    pub fn is_done(&self) -> bool {
        self.floors.is_empty()
    }

    /// The distance that a pair has to keep now; moves the floor up behind it.
    fn required_m(&mut self, p: &Proximity) -> f64 {
        let Some(i) = self.floors.iter().position(|(pair, _)| *pair == p.pair) else {
            return p.required_m;
        };
        if p.distance_m >= p.required_m {
            self.floors.remove(i);
            return p.required_m;
        }
        let floor = &mut self.floors[i].1;
        *floor = floor.max(p.distance_m - 2.0 * GRACE_M);
        floor.min(p.required_m)
    }
}

impl Scene<'_> {
    /// Every pair that matters at joint angles `q` (rad); terrain up to `beyond_m` further away
    /// than the largest margin.
    pub fn visit(
        &self,
        q: &[f64],
        beyond_m: f64,
        visit: impl FnMut(Proximity),
    ) -> Result<(), ArmError> {
        let placed = self.model.place(q)?;
        let look_m = self.model.largest_margin_m() + beyond_m;
        self.model
            .visit(&placed, self.terrain, self.zone, look_m, visit);
        Ok(())
    }

    /// Whether the arm may be at joint angles `q` (rad).
    pub fn check_configuration(&self, q: &[f64]) -> Checked {
        let mut worst: Option<Proximity> = None;
        self.visit(q, 0.0, |p| {
            let slack = p.distance_m - p.required_m;
            if slack < 0.0 && worst.is_none_or(|w| slack < w.distance_m - w.required_m) {
                worst = Some(p);
            }
        })?;
        Ok(worst.map_or(Ok(()), |proximity| {
            Err(Blocked {
                q: q.to_vec(),
                proximity,
            })
        }))
    }

    /// Whether the arm may move straight from `from` to `to` (joint angles, rad).
    pub fn check_leg(&self, from: &[f64], to: &[f64], leaving: &mut Leaving) -> Checked {
        let motion: Vec<f64> = to.iter().zip(from).map(|(b, a)| b - a).collect();
        let unseen = LOOK_M / self.model.displacement_m(&motion).max(1e-12);
        let mut t = 0.0;
        loop {
            let q: Vec<f64> = from.iter().zip(&motion).map(|(a, d)| a + d * t).collect();
            let mut step = if self.terrain.is_some() { unseen } else { 1.0 };
            let mut worst: Option<Proximity> = None;
            self.visit(&q, LOOK_M, |mut p| {
                p.required_m = leaving.required_m(&p);
                let slack = p.distance_m - p.required_m;
                if slack < 0.0 && worst.is_none_or(|w| slack < w.distance_m - w.required_m) {
                    worst = Some(p);
                }
                let speed = self.model.approach_speed(p.pair, &motion);
                if speed > 0.0 {
                    step = step.min(slack.max(MIN_ADVANCE_M) / speed);
                }
            })?;
            if let Some(proximity) = worst {
                return Ok(Err(Blocked { q, proximity }));
            }
            if t >= 1.0 {
                return Ok(Ok(()));
            }
            t = (t + step).min(1.0);
        }
    }

    /// Whether the arm may move straight from each of `path` to the next (joint angles, rad).
    pub fn check_path(&self, path: &[Vec<f64>], leaving: &mut Leaving) -> Checked {
        for leg in path.windows(2) {
            if let Err(blocked) = self.check_leg(&leg[0], &leg[1], leaving)? {
                return Ok(Err(blocked));
            }
        }
        Ok(Ok(()))
    }
}
