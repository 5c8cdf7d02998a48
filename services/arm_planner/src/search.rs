//! Search for a collision-free path in joint space: RRT-Connect (Kuffner and LaValle 2000), then
//! shortcuts. The random numbers come from a fixed seed, so the same question has the same answer.

use crate::leg::{Leaving, Scene};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rover_kinematics::{ArmError, JointLimits};

/// Seed of every search.
const SEED: u64 = 0x0a11_ce5e;
/// Samples after which the search gives up.
const MAX_SAMPLES: usize = 3000;
/// Longest edge of a tree: travel time of the slowest joint, s.
const STEP_S: f64 = 0.8;
/// Attempts to shorten the path.
const SHORTCUTS: usize = 200;

struct Tree {
    nodes: Vec<Vec<f64>>,
    parents: Vec<usize>,
}

/// What came of growing a tree towards a configuration.
enum Growth {
    Stuck,
    Nearer(usize),
    Reached(usize),
}

impl Tree {
    fn new(root: &[f64]) -> Self {
        Self {
            nodes: vec![root.to_vec()],
            parents: vec![0],
        }
    }

    fn nearest(&self, limits: &[JointLimits], q: &[f64]) -> usize {
        let mut best = (0, f64::INFINITY);
        for (i, node) in self.nodes.iter().enumerate() {
            let time = travel_time_s(limits, node, q);
            if time < best.1 {
                best = (i, time);
            }
        }
        best.0
    }

    /// One edge from node `from` towards `q`.
    fn extend(
        &mut self,
        scene: &Scene,
        limits: &[JointLimits],
        from: usize,
        q: &[f64],
    ) -> Result<Growth, ArmError> {
        let start = &self.nodes[from];
        let time = travel_time_s(limits, start, q);
        let part = (STEP_S / time).min(1.0);
        let to: Vec<f64> = if part < 1.0 {
            start
                .iter()
                .zip(q)
                .map(|(a, b)| a + (b - a) * part)
                .collect()
        } else {
            q.to_vec()
        };
        if scene
            .check_leg(start, &to, &mut Leaving::default())?
            .is_err()
        {
            return Ok(Growth::Stuck);
        }
        self.nodes.push(to);
        self.parents.push(from);
        let new = self.nodes.len() - 1;
        Ok(if part < 1.0 {
            Growth::Nearer(new)
        } else {
            Growth::Reached(new)
        })
    }

    /// From a node to the root.
    fn path(&self, mut node: usize) -> Vec<Vec<f64>> {
        let mut path = vec![self.nodes[node].clone()];
        while node != 0 {
            node = self.parents[node];
            path.push(self.nodes[node].clone());
        }
        path
    }
}

/// Seconds that the slowest joint needs from `a` to `b` at its full rate.
pub(crate) fn travel_time_s(limits: &[JointLimits], a: &[f64], b: &[f64]) -> f64 {
    let times = a
        .iter()
        .zip(b)
        .zip(limits)
        .map(|((a, b), l)| (a - b).abs() / l.max_rate_rad_s);
    times.fold(0.0, f64::max)
}

/// A path from `start` to `goal` (joint angles, rad; both free) of straight collision-free legs,
/// ends included, or `None` when none was found.
pub(crate) fn connect(
    scene: &Scene,
    start: &[f64],
    goal: &[f64],
) -> Result<Option<Vec<Vec<f64>>>, ArmError> {
    let limits = scene.model.robot().arm.limits();
    let mut random = ChaCha8Rng::seed_from_u64(SEED);
    let mut trees = [Tree::new(start), Tree::new(goal)];
    for sample in 0..MAX_SAMPLES {
        let q: Vec<f64> = limits
            .iter()
            .map(|l| random.random_range(l.lower_rad..=l.upper_rad))
            .collect();
        let (growing, other) = (sample % 2, 1 - sample % 2);
        let from = trees[growing].nearest(limits, &q);
        let (Growth::Nearer(new) | Growth::Reached(new)) =
            trees[growing].extend(scene, limits, from, &q)?
        else {
            continue;
        };
        let q = trees[growing].nodes[new].clone();
        let mut from = trees[other].nearest(limits, &q);
        loop {
            match trees[other].extend(scene, limits, from, &q)? {
                Growth::Stuck => break,
                Growth::Nearer(next) => from = next,
                Growth::Reached(met) => {
                    let ends = if growing == 0 { [new, met] } else { [met, new] };
                    let mut path = trees[0].path(ends[0]);
                    path.reverse();
                    path.extend(trees[1].path(ends[1]).into_iter().skip(1));
                    return shortened(scene, limits, path, &mut random).map(Some);
                }
            }
        }
    }
    Ok(None)
}

/// The path with detours between two of its points cut out where the straight way is free.
fn shortened(
    scene: &Scene,
    limits: &[JointLimits],
    mut path: Vec<Vec<f64>>,
    random: &mut ChaCha8Rng,
) -> Result<Vec<Vec<f64>>, ArmError> {
    let mut place = |path: &[Vec<f64>]| {
        let leg = random.random_range(0..path.len() - 1);
        let part: f64 = random.random_range(0.0..=1.0);
        let point: Vec<f64> = path[leg]
            .iter()
            .zip(&path[leg + 1])
            .map(|(a, b)| a + (b - a) * part)
            .collect();
        (leg, part, point)
    };
    for _ in 0..SHORTCUTS {
        if path.len() < 3 {
            break;
        }
        let (mut a, mut b) = (place(&path), place(&path));
        if (b.0, b.1) < (a.0, a.1) {
            std::mem::swap(&mut a, &mut b);
        }
        if a.0 == b.0 {
            continue;
        }
        let mut detour = vec![a.2.clone()];
        detour.extend_from_slice(&path[a.0 + 1..=b.0]);
        detour.push(b.2.clone());
        let length: f64 = detour
            .windows(2)
            .map(|l| travel_time_s(limits, &l[0], &l[1]))
            .sum();
        let direct = travel_time_s(limits, &a.2, &b.2);
        if direct < length * 0.999
            && scene
                .check_leg(&a.2, &b.2, &mut Leaving::default())?
                .is_ok()
        {
            path.splice(a.0 + 1..=b.0, [a.2, b.2]);
            path.dedup();
        }
    }
    // Points that the legs next to them do not need.
    let mut i = 1;
    while i + 1 < path.len() {
        if scene
            .check_leg(&path[i - 1], &path[i + 1], &mut Leaving::default())?
            .is_ok()
        {
            path.remove(i);
        } else {
            i += 1;
        }
    }
    Ok(path)
}
