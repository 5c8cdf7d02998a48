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

/// Residual at which polishing stops, metres and radians.
const POLISHED: f64 = 4e-15;
/// Residual at which a step that no longer helps is not missed, metres and radians.
const GOOD: f64 = 1e-12;
/// Residual that a branch must reach to be returned, metres and radians.
const ACCEPTED: f64 = 1e-9;
/// How much less than last time the residual may shrink without anyone looking.
const SAFETY: f64 = 1e3;
/// Largest change of a joint that still counts as a correction, radians.
const SMALL_RAD: f64 = 1e-3;
impl Solver<'_> {
    /// Tool point and axis by the given rows, for given sines and cosines.
    #[inline(always)]
    fn placed(
        &self,
        links: &[Link; 5],
        sine: &[f64; 5],
        cosine: &[f64; 5],
    ) -> (Vector3<f64>, Vector3<f64>) {
        let (mut p, mut v) = (self.tool.tip_in_link, self.axis_in_link);
        for joint in (0..5).rev() {
            let link = &links[joint];
            let (s, c) = (sine[joint], cosine[joint]);
            let (x, y) = (p.x + link.a, link.cos_alpha * p.y - link.sin_alpha * p.z);
            let z = link.sin_alpha * p.y + link.cos_alpha * p.z + link.d;
            p = Vector3::new(c * x - s * y, s * x + c * y, z);
            let y = link.cos_alpha * v.y - link.sin_alpha * v.z;
            let z = link.sin_alpha * v.y + link.cos_alpha * v.z;
            v = Vector3::new(c * v.x - s * y, s * v.x + c * y, z);
        }
        (p, v)
    }

    /// The angles about the z axes after correction on the true rows; `Err` with the distance
    /// that remains.
    pub fn polish(&self, p: &Posture, branch: Branch) -> Result<[f64; 5], f64> {
        let (mut theta, mut sine, mut cosine) = (p.theta, p.sine, p.cosine);
        let mut before = f64::INFINITY;
        let rounds = if p.is_irregular { 0 } else { 6 };
        for _ in 0..rounds {
            let (tip, pointing) = self.placed(self.links, &sine, &cosine);
            let (dp, da) = (self.point - tip, self.axis - pointing);
            let error = dp.amax().max(da.amax());
            if error <= POLISHED {
                return Ok(theta);
            }
            if error.is_nan() || error >= 0.25 * before {
                if before < GOOD {
                    return Ok(theta);
                }
                break;
            }
            let change = self.step(p, &dp, &da);
            // A change that is not a number is not small either.
            let is_correction = change.iter().all(|d| d.abs() < SMALL_RAD);
            if !is_correction {
                break;
            }
            for (angle, d) in theta.iter_mut().zip(&change) {
                *angle += d;
            }
            // The derivative is kept, so the residual shrinks by about the same factor each time.
            if before.is_finite() && SAFETY * error * error <= POLISHED * before {
                return Ok(theta);
            }
            before = error;
            for joint in 0..5 {
                let d = change[joint];
                let (s, c) = (sine[joint], cosine[joint]);
                let square = d * d;
                let turn = d - d * square * (1.0 / 6.0);
                let versine = square * (0.5 - square * (1.0 / 24.0));
                sine[joint] = s + (c * turn - s * versine);
                cosine[joint] = c - (s * turn + c * versine);
            }
        }
        self.rescue(p, branch)
    }

    /// One Newton step along the linearised closed form: the changes of the angles.
    #[inline(always)]
    fn step(&self, p: &Posture, dp: &Vector3<f64>, da: &Vector3<f64>) -> [f64; 5] {
        let f = self.family;
        let (side, hand) = (&p.side, &p.hand);
        let (u, c1, s1) = (hand.u, side.c1, side.s1);
        let dw = dp - da * self.turret.length;
        let turn = -(dw.x * s1 - dw.y * c1) * side.over_forward;
        let axis_m = da.x * s1 - da.y * c1 + hand.sin_psi * u.0 * turn;
        let axis_r = da.x * c1 + da.y * s1 - f.roll * hand.cos_psi * turn;
        let psi = hand.cos_psi * (u.0 * axis_r + u.1 * da.z) - f.roll * hand.sin_psi * axis_m;
        let phi = (u.0 * da.z - u.1 * axis_r) * hand.over_sin_psi;
        let x = dw.x * c1 + dw.y * s1 - f.sideways * turn + self.normal * u.0 * phi;
        let z = dw.z + self.normal * u.1 * phi;
        let scale = 1.0 / p.area;
        let phi2 = (p.fore.0 * x + p.fore.1 * z) * scale;
        let phi23 = -(p.upper.0 * x + p.upper.1 * z) * scale;
        [
            turn,
            f.bend * phi2,
            f.bend * (phi23 - phi2),
            f.bend * (phi - phi23),
            psi,
        ]
    }

    /// Next to a singularity the linearisation fails, but the closed form does not: it is solved
    /// again for a goal shifted by the difference of the exact family and the true rows. The shift
    /// changes by the tiny deviation of the rows times the change of the angles, so this contracts.
    #[cold]
    #[inline(never)]
    fn rescue(&self, start: &Posture, branch: Branch) -> Result<[f64; 5], f64> {
        let is_free = start.hand.sin_psi == 0.0;
        let mut theta = start.theta;
        let mut best = (f64::INFINITY, f64::INFINITY, theta);
        for _ in 0..40 {
            let mut padded = [0.0; 6];
            padded[..5].copy_from_slice(&theta);
            let ([sine @ .., _], [cosine @ .., _]) = sin_cos(&padded, 5);
            let (tip, pointing) = self.placed(self.links, &sine, &cosine);
            let (exact_tip, exact_pointing) = self.placed(&self.family.exact, &sine, &cosine);
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
            let margin = self.plane_margin(&side, &hand);
            let Ok(plane) = self.plane(&side, &hand, margin, 0.0) else {
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
