//! Correction of a closed-form posture on the true rows.
//!
//! The closed form takes the twists for multiples of pi/2, which flight tables write to six
//! decimals. Newton steps make up for that: residual from the true rows, derivative from the
//! equations of the closed form, whose structure is triangular, so that a step costs little more
//! than the residual; sines and cosines are turned along instead of being computed again. Next
//! to a singularity the closed form itself is iterated instead, on a shifted goal.

use super::closed_form::{PARALLEL, Posture, Solver};
use super::{Branch, Wrist};
use crate::arm::Link;
use crate::trig::sin_cos;
use nalgebra::Vector3;
use std::ops::{Add, Mul, Sub};

/// Residual at which polishing stops, metres and radians.
const POLISHED: f64 = 4e-15;
/// Residual at which a step that no longer helps is not missed, metres and radians.
const GOOD: f64 = 1e-12;
/// Residual that a branch must reach to be returned, metres and radians.
const ACCEPTED: f64 = 1e-9;
/// How much less than last time the residual may shrink without anyone looking.
const SAFETY: f64 = 1e3;
/// Angles about the z axes, or the distance that remains, metres.
type Polished = Result<[f64; 5], f64>;

/// Largest change of a joint that still counts as a correction, radians.
const SMALL_RAD: f64 = 1e-3;

/// One number for each of the two elbows, which the compiler treats together.
#[derive(Clone, Copy)]
struct Pair([f64; 2]);

macro_rules! pairwise {
    ($($trait:ident $method:ident $op:tt;)*) => {$(
        impl $trait for Pair {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Self([self.0[0] $op other.0[0], self.0[1] $op other.0[1]])
            }
        }
        impl $trait<f64> for Pair {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: f64) -> Self {
                Self([self.0[0] $op other, self.0[1] $op other])
            }
        }
    )*};
}
pairwise! {
    Add add +;
    Sub sub -;
    Mul mul *;
}

/// A vector for each of the two elbows.
#[derive(Clone, Copy)]
struct Vectors {
    x: Pair,
    y: Pair,
    z: Pair,
}

impl Vectors {
    #[inline(always)]
    fn from_to(from: Self, to: &Vector3<f64>) -> Self {
        let minus = |a: Pair, b: f64| Pair([b - a.0[0], b - a.0[1]]);
        Self {
            x: minus(from.x, to.x),
            y: minus(from.y, to.y),
            z: minus(from.z, to.z),
        }
    }

    #[inline(always)]
    fn amax(&self, lane: usize) -> f64 {
        let [x, y, z] = [self.x, self.y, self.z].map(|v| v.0[lane].abs());
        // A sum keeps what is not a number; a maximum would lose it.
        if (x + y + z).is_finite() {
            x.max(y).max(z)
        } else {
            f64::INFINITY
        }
    }

    fn lane(&self, lane: usize) -> Vector3<f64> {
        Vector3::new(self.x.0[lane], self.y.0[lane], self.z.0[lane])
    }
}

/// How far the correction of one posture has come.
#[derive(Clone, Copy, PartialEq)]
enum State {
    Running,
    Done,
    Irregular,
}

impl Solver<'_> {
    /// Tool point and axis by the given rows, for given sines and cosines.
    #[inline(always)]
    fn placed(
        &self,
        links: &[Link; 5],
        sine: &[Pair; 5],
        cosine: &[Pair; 5],
    ) -> (Vectors, Vectors) {
        let both = |v: &Vector3<f64>| Vectors {
            x: Pair([v.x; 2]),
            y: Pair([v.y; 2]),
            z: Pair([v.z; 2]),
        };
        let (mut p, mut v) = (both(&self.tool.tip_in_link), both(&self.axis_in_link));
        for joint in (0..5).rev() {
            let link = &links[joint];
            let (sa, ca) = (link.sin_alpha, link.cos_alpha);
            let (s, c) = (sine[joint], cosine[joint]);
            let (x, y) = (p.x + link.a, p.y * ca - p.z * sa);
            p = Vectors {
                x: c * x - s * y,
                y: s * x + c * y,
                z: p.y * sa + p.z * ca + link.d,
            };
            let y = v.y * ca - v.z * sa;
            v = Vectors {
                x: c * v.x - s * y,
                y: s * v.x + c * y,
                z: v.y * sa + v.z * ca,
            };
        }
        (p, v)
    }

    /// The angles about the z axes of the postures of both elbows after correction on the true
    /// rows; `Err` with the distance that remains. Both must have the same side and hand.
    pub fn polish(&self, postures: &[Posture; 2], branches: &[Branch; 2]) -> [Polished; 2] {
        let [first, second] = postures;
        let zip = |a: &[f64; 5], b: &[f64; 5]| std::array::from_fn(|i| Pair([a[i], b[i]]));
        let mut theta: [Pair; 5] = zip(&first.theta, &second.theta);
        let mut sine: [Pair; 5] = zip(&first.sine, &second.sine);
        let mut cosine: [Pair; 5] = zip(&first.cosine, &second.cosine);
        let mut before = [f64::INFINITY; 2];
        let start = |p: &Posture| {
            if p.is_irregular {
                State::Irregular
            } else {
                State::Running
            }
        };
        let mut state = [start(first), start(second)];
        for _ in 0..6 {
            if !state.contains(&State::Running) {
                break;
            }
            let (tip, pointing) = self.placed(self.links, &sine, &cosine);
            let dp = Vectors::from_to(tip, &self.point);
            let da = Vectors::from_to(pointing, &self.axis);
            let error = [0, 1].map(|lane| dp.amax(lane).max(da.amax(lane)));
            let change = self.step(postures, dp, da);
            for lane in 0..2 {
                if state[lane] != State::Running {
                    continue;
                }
                let largest = change.iter().fold(0.0, |m: f64, d| m.max(d.0[lane].abs()));
                if error[lane] <= POLISHED {
                    state[lane] = State::Done;
                } else if error[lane] >= 0.25 * before[lane] {
                    // It no longer gets better: as good as can be, or none of it any good.
                    let is_good = before[lane] < GOOD;
                    state[lane] = if is_good {
                        State::Done
                    } else {
                        State::Irregular
                    };
                } else if largest >= SMALL_RAD {
                    state[lane] = State::Irregular;
                }
            }
            let running = state.map(|s| if s == State::Running { 1.0 } else { 0.0 });
            for joint in 0..5 {
                let d = change[joint] * Pair(running);
                let (s, c) = (sine[joint], cosine[joint]);
                let square = d * d;
                let turn = d - d * square * (1.0 / 6.0);
                let versine = square * 0.5 - square * square * (1.0 / 24.0);
                theta[joint] = theta[joint] + d;
                sine[joint] = s + (c * turn - s * versine);
                cosine[joint] = c - (s * turn + c * versine);
            }
            for lane in 0..2 {
                // The derivative is kept, so the residual shrinks by about the same factor each
                // time.
                let (error, last) = (error[lane], before[lane]);
                if last.is_finite() && SAFETY * error * error <= POLISHED * last {
                    state[lane] = State::Done;
                }
                before[lane] = error;
            }
        }
        [0, 1].map(|lane| match state[lane] {
            State::Done => Ok(theta.map(|t| t.0[lane])),
            _ => self.rescue(&postures[lane], branches[lane]),
        })
    }

    /// One Newton step along the linearised closed form: the changes of the angles.
    #[inline(always)]
    fn step(&self, postures: &[Posture; 2], dp: Vectors, da: Vectors) -> [Pair; 5] {
        let f = self.family;
        let [first, second] = postures;
        let pair = |pick: fn(&Posture) -> f64| Pair([pick(first), pick(second)]);
        let (side, hand) = (&first.side, &first.hand);
        let ((ur, uz), c1, s1) = (hand.u, side.c1, side.s1);
        let length = self.turret.length;
        let dw = Vectors {
            x: dp.x - da.x * length,
            y: dp.y - da.y * length,
            z: dp.z - da.z * length,
        };
        let turn = (dw.y * c1 - dw.x * s1) * (1.0 / side.forward);
        let axis_m = da.x * s1 - da.y * c1 + turn * (hand.sin_psi * ur);
        let axis_r = da.x * c1 + da.y * s1 - turn * (f.roll * hand.cos_psi);
        let psi = (axis_r * ur + da.z * uz) * hand.cos_psi - axis_m * (f.roll * hand.sin_psi);
        let phi = (da.z * ur - axis_r * uz) * (1.0 / hand.sin_psi);
        let x = dw.x * c1 + dw.y * s1 - turn * f.sideways + phi * (self.normal * ur);
        let z = dw.z + phi * (self.normal * uz);
        let scale = Pair([1.0 / first.area, 1.0 / second.area]);
        let phi2 = (pair(|p| p.fore.0) * x + pair(|p| p.fore.1) * z) * scale;
        let phi23 = (pair(|p| p.upper.0) * x + pair(|p| p.upper.1) * z) * scale * -1.0;
        [
            turn,
            phi2 * f.bend,
            (phi23 - phi2) * f.bend,
            (phi - phi23) * f.bend,
            psi,
        ]
    }

    /// Next to a singularity the linearisation fails, but the closed form does not: it is solved
    /// again for a goal shifted by the difference of the exact family and the true rows. The shift
    /// changes by the tiny deviation of the rows times the change of the angles, so this contracts.
    #[cold]
    #[inline(never)]
    fn rescue(&self, start: &Posture, branch: Branch) -> Polished {
        let is_free = start.hand.sin_psi == 0.0;
        let mut theta = start.theta;
        let mut best = (f64::INFINITY, f64::INFINITY, theta);
        for _ in 0..40 {
            let mut padded = [0.0; 6];
            padded[..5].copy_from_slice(&theta);
            let ([sine @ .., _], [cosine @ .., _]) = sin_cos(&padded, 5);
            let (sine, cosine) = (sine.map(|s| Pair([s; 2])), cosine.map(|c| Pair([c; 2])));
            let placed = |links| {
                let (tip, pointing) = self.placed(links, &sine, &cosine);
                (tip.lane(0), pointing.lane(0))
            };
            let (tip, pointing) = placed(self.links);
            let (exact_tip, exact_pointing) = placed(&self.family.exact);
            let axis_error = (self.axis - pointing).amax();
            let mut error = (self.point - tip).amax();
            if !is_free {
                error = error.max(axis_error);
            }
            if error < best.0 {
                best = (error, axis_error, theta);
            }
            if error <= POLISHED {
                break;
            }
            let point = self.point + (exact_tip - tip);
            let axis = if is_free {
                exact_pointing
            } else {
                (self.axis + (exact_pointing - pointing)).normalize()
            };
            let w = point - axis * self.turret.length;
            let Ok(side) = self.side(branch.shoulder, &w, 0.0) else {
                break;
            };
            let mut hand = if is_free {
                start.hand
            } else {
                self.hand(&side, &axis)
            };
            if !is_free && branch.wrist == Wrist::Negative {
                hand = hand.flipped();
            }
            let Ok(plane) = self.plane(&side, &hand, 0.0) else {
                break;
            };
            theta = self.posture(&side, &hand, &plane, branch.elbow).theta;
        }
        let axis_allowed = if is_free { PARALLEL } else { ACCEPTED };
        if best.0 <= ACCEPTED && best.1 <= axis_allowed {
            Ok(best.2)
        } else {
            Err(best.0)
        }
    }
}
