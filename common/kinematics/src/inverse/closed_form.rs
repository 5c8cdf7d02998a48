//! The closed form for the family of the Mars Exploration Rover arm.
//!
//! With `r = (c1, s1, 0)`, the bending axis `m = (s1, -c1, 0)`, `u` the direction of the plane
//! angle `phi = phi2 + phi3 + phi4` in the plane of `r` and `z`, `n = m x u`, tool axis `a`, and
//! `w = point - length a`:
//!
//! ```text
//! w = r (a1 + a2 C2 + a3 C23) + z (d1 + a2 S2 + a3 S23) + D m + E n
//! a = sin(psi) u + k cos(psi) m
//! ```
//!
//! where `D` sums the offsets along the bending axis, `E` those along `n`, `k = +-1` and `psi` is
//! the last joint's angle ahead of the tool. `n`, `r` and `z` are square to `m`, so `w.m = D`
//! gives joint 0 twice; `a.m` then gives `psi` twice and with it `u` and `phi`; what remains is a
//! plane arm of two links with its elbow to either side.
//!
//! The twists of the rows are only nearly multiples of pi/2. Each branch is therefore corrected
//! by Newton steps: residual from the true rows, derivative from the equations above, whose
//! structure is triangular, so that a step costs little more than the residual.

use super::family::{Family, TurretTool};
use super::numeric;
use super::{AxisGoal, Branch, Constraint, Elbow, IkError, Shoulder, Wrist, is_usable};
use crate::arm::{Arm, PADDED};
use crate::tool::Tool;
use crate::trig::sin_cos;
use nalgebra::Vector3;
use std::f64::consts::PI;

/// Sine of `psi` below which the axis counts as parallel to the bending axis.
const PARALLEL: f64 = 1e-6;
/// Sine of the elbow, and cosine at the shoulder, below which two branches count as one.
const COINCIDENT: f64 = 1e-7;
/// Residual at which polishing stops, metres and radians.
const POLISHED: f64 = 4e-15;
/// Residual that a branch must reach to be returned, metres and radians.
const ACCEPTED: f64 = 1e-11;

/// Where a free plane angle shall be: that of `near`, plus a turn.
#[derive(Clone, Copy)]
pub(crate) struct Preferred<'a> {
    pub near: &'a [f64],
    pub turn_rad: f64,
}

/// The least violation seen so far.
struct Reach {
    least: Option<(f64, Constraint)>,
}

impl Reach {
    fn fails(&mut self, constraint: Constraint, by_m: f64) {
        if self.least.is_none_or(|(least, _)| by_m < least) {
            self.least = Some((by_m, constraint));
        }
    }
}

/// One branch: joint angles about the z axes, and the linearisation at them.
struct Posture {
    theta: [f64; PADDED],
    c1: f64,
    s1: f64,
    /// `w.r`.
    forward: f64,
    /// `u` along `r` and `z`.
    u: (f64, f64),
    sin_psi: f64,
    cos_psi: f64,
    /// Upper arm and forearm along `r` and `z`.
    upper: (f64, f64),
    fore: (f64, f64),
    /// `a2 a3 sin(phi3)`.
    area: f64,
}

/// Calls `found` with joint angles, branch and singularity of every posture that meets `goal`.
pub(crate) fn solve(
    arm: &Arm,
    tool: &Tool,
    goal: &AxisGoal,
    preferred: Option<Preferred<'_>>,
    mut found: impl FnMut(&[f64], Branch, bool),
) -> Result<(), IkError> {
    let family = arm
        .family
        .as_ref()
        .map_err(|m| IkError::NotThisFamily(m.clone()))?;
    if !is_usable(tool, goal) {
        return Err(IkError::NotFinite);
    }
    let turret = family.tool(tool).map_err(IkError::NotThisFamily)?;
    let solver = Solver {
        arm,
        tool,
        goal,
        family,
        turret,
    };
    let mut reach = Reach { least: None };
    let mut any = false;
    solver.run(preferred, &mut reach, &mut |joints, branch, singular| {
        any = true;
        found(joints, branch, singular);
    });
    match (any, reach.least) {
        (true, _) => Ok(()),
        (false, Some((by_m, constraint))) => Err(IkError::OutOfReach { constraint, by_m }),
        (false, None) => Err(IkError::NotFinite),
    }
}

/// The branch of given joint angles.
pub(crate) fn branch_of(arm: &Arm, tool: &Tool, q: &[f64]) -> Result<Branch, IkError> {
    let family = arm
        .family
        .as_ref()
        .map_err(|m| IkError::NotThisFamily(m.clone()))?;
    let turret = family.tool(tool).map_err(IkError::NotThisFamily)?;
    let theta = arm.angles(q)?;
    let goal = AxisGoal::at(arm, tool, q)?;
    let w = goal.point - goal.axis.into_inner() * turret.length;
    let ([s1, sin_psi, sin_elbow, _], [c1, ..]) = sin_cos(
        &[
            theta[0],
            theta[4] + turret.ahead,
            family.bend * theta[2],
            0.0,
        ],
        3,
    );
    let elbow = sin_elbow * (family.upper * family.fore).signum();
    Ok(Branch {
        shoulder: if w.x * c1 + w.y * s1 >= 0.0 {
            Shoulder::Front
        } else {
            Shoulder::Back
        },
        wrist: if sin_psi >= 0.0 {
            Wrist::Positive
        } else {
            Wrist::Negative
        },
        elbow: if elbow >= 0.0 {
            Elbow::Positive
        } else {
            Elbow::Negative
        },
    })
}

struct Solver<'a> {
    arm: &'a Arm,
    tool: &'a Tool,
    goal: &'a AxisGoal,
    family: &'a Family,
    turret: TurretTool,
}

impl Solver<'_> {
    fn run(
        &self,
        preferred: Option<Preferred<'_>>,
        reach: &mut Reach,
        found: &mut impl FnMut(&[f64], Branch, bool),
    ) {
        let f = self.family;
        let w = self.goal.point - self.goal.axis.into_inner() * self.turret.length;
        let side = f.sideways;
        let square = w.x * w.x + w.y * w.y;
        let rho = square.sqrt();
        let slack = rho - side.abs();
        // Rounding may put a goal on the limit a hair beyond it.
        if slack < -1e-12 {
            reach.fails(Constraint::ShoulderOffset, -slack);
            return;
        }
        let along = (slack.max(0.0) * (rho + side.abs())).sqrt();
        let is_on_axis = rho < 1e-9;
        let shoulder_is_singular = is_on_axis || along < COINCIDENT * rho;
        for (shoulder, forward) in [(Shoulder::Front, along), (Shoulder::Back, -along)] {
            if shoulder == Shoulder::Back && along < COINCIDENT * rho {
                continue;
            }
            let (s1, c1, theta1) = if is_on_axis {
                // Above the first axis joint 0 is free: that of `near`, or zero.
                let theta1 = preferred.map_or(0.0, |p| p.near[0] + f.offsets[0]);
                let turned = if shoulder == Shoulder::Back {
                    theta1 + PI
                } else {
                    theta1
                };
                let (s, c) = sin_cos(&[turned, 0.0], 1);
                (s[0], c[0], turned)
            } else {
                let c1 = (forward * w.x - side * w.y) / square;
                let s1 = (forward * w.y + side * w.x) / square;
                (s1, c1, s1.atan2(c1))
            };
            self.wrists(
                Side {
                    shoulder,
                    forward,
                    s1,
                    c1,
                    theta1,
                    height: w.z,
                },
                shoulder_is_singular,
                preferred,
                reach,
                found,
            );
        }
    }

    fn wrists(
        &self,
        side: Side,
        is_singular: bool,
        preferred: Option<Preferred<'_>>,
        reach: &mut Reach,
        found: &mut impl FnMut(&[f64], Branch, bool),
    ) {
        let f = self.family;
        let a = self.goal.axis.into_inner();
        let along_m = a.x * side.s1 - a.y * side.c1;
        let along_r = a.x * side.c1 + a.y * side.s1;
        let sine = (along_r * along_r + a.z * a.z).sqrt();
        let cos_psi = f.roll * along_m;
        // The part of w along n: the turret's offset and the tip's along the last y.
        let normal = f.roll * (f.turret + f.face * self.turret.along_y);
        let x0 = side.forward - f.reach;
        let z0 = side.height - f.height;
        let psi = sine.atan2(cos_psi);
        if sine < PARALLEL {
            let hint = preferred.map(|p| {
                let sum = (1..4).map(|i| p.near[i] + f.offsets[i]).sum::<f64>();
                f.bend * sum + p.turn_rad
            });
            let Some(phi) = free_plane_angle(f, x0, z0, normal, hint, reach) else {
                return;
            };
            let (s, c) = sin_cos(&[phi, 0.0], 1);
            let wrist = WristAngles {
                wrist: Wrist::Positive,
                psi,
                sin_psi: 0.0,
                cos_psi: cos_psi.signum(),
                phi,
                u: (c[0], s[0]),
            };
            self.elbows(&side, &wrist, (x0, z0, normal), true, reach, found);
            return;
        }
        let phi = a.z.atan2(along_r);
        for wrist in [Wrist::Positive, Wrist::Negative] {
            let sign = if wrist == Wrist::Positive { 1.0 } else { -1.0 };
            let wrist = WristAngles {
                wrist,
                psi: sign * psi,
                sin_psi: sign * sine,
                cos_psi,
                phi: if sign > 0.0 { phi } else { phi + PI },
                u: (sign * along_r / sine, sign * a.z / sine),
            };
            self.elbows(&side, &wrist, (x0, z0, normal), is_singular, reach, found);
        }
    }

    fn elbows(
        &self,
        side: &Side,
        wrist: &WristAngles,
        (x0, z0, normal): (f64, f64, f64),
        is_singular: bool,
        reach: &mut Reach,
        found: &mut impl FnMut(&[f64], Branch, bool),
    ) {
        let f = self.family;
        let x = x0 + normal * wrist.u.1;
        let z = z0 - normal * wrist.u.0;
        let square = x * x + z * z;
        let distance = square.sqrt();
        let (sum, difference) = ((f.upper + f.fore).abs(), (f.upper - f.fore).abs());
        let (longest, shortest) = (sum.max(difference), sum.min(difference));
        let (beyond, within) = (longest - distance, distance - shortest);
        if beyond < -1e-12 {
            reach.fails(Constraint::ArmExtended, -beyond);
            return;
        }
        if within < -1e-12 {
            reach.fails(Constraint::ArmFolded, -within);
            return;
        }
        let twice = 2.0 * f.upper * f.fore;
        let cos_elbow = (square - f.upper * f.upper - f.fore * f.fore) / twice;
        // Heron's form: exact near the straight and the folded arm.
        let heron =
            beyond.max(0.0) * (longest + distance) * within.max(0.0) * (distance + shortest);
        let sin_elbow = heron.sqrt() / twice.abs();
        let elbow_is_singular = sin_elbow < COINCIDENT;
        let direction = z.atan2(x);
        let interior = (f.fore * sin_elbow).atan2(f.upper + f.fore * cos_elbow);
        let bent = sin_elbow.atan2(cos_elbow);
        for elbow in [Elbow::Positive, Elbow::Negative] {
            // The branch is the sign of a2 a3 sin(phi3), that is of the bend as it is seen.
            let seen = if elbow == Elbow::Positive { 1.0 } else { -1.0 };
            if seen < 0.0 && elbow_is_singular {
                continue;
            }
            let sign = seen * twice.signum();
            let (phi2, phi3) = (direction - sign * interior, sign * bent);
            let s3 = sign * sin_elbow;
            let straight = f.upper + f.fore * cos_elbow;
            let upper = if square > 1e-18 {
                let c2 = (x * straight + z * f.fore * s3) / square;
                let s2 = (z * straight - x * f.fore * s3) / square;
                (f.upper * c2, f.upper * s2)
            } else {
                let (s, c) = sin_cos(&[phi2, 0.0], 1);
                (f.upper * c[0], f.upper * s[0])
            };
            let posture = Posture {
                theta: [
                    side.theta1,
                    f.bend * phi2,
                    f.bend * phi3,
                    f.bend * (wrist.phi - phi2 - phi3),
                    wrist.psi - self.turret.ahead,
                    0.0,
                    0.0,
                    0.0,
                ],
                c1: side.c1,
                s1: side.s1,
                forward: side.forward,
                u: wrist.u,
                sin_psi: wrist.sin_psi,
                cos_psi: wrist.cos_psi,
                upper,
                fore: (x - upper.0, z - upper.1),
                area: 0.5 * twice * s3,
            };
            let branch = Branch {
                shoulder: side.shoulder,
                wrist: wrist.wrist,
                elbow,
            };
            let is_singular = is_singular || elbow_is_singular;
            match self.polish(&posture, normal, is_singular) {
                Ok(joints) => found(&joints, branch, is_singular),
                Err(by_m) => reach.fails(Constraint::ArmExtended, by_m),
            }
        }
    }

    /// Tool point and axis by the true rows.
    #[inline]
    fn tool_at(&self, theta: &[f64; PADDED]) -> (Vector3<f64>, Vector3<f64>) {
        let (sine, cosine) = sin_cos(theta, 5);
        let (mut p, mut v) = (self.tool.tip_in_link, self.tool.axis_in_link.into_inner());
        for joint in (0..5).rev() {
            let link = &self.arm.links[joint];
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

    /// The joint angles after correction on the true rows; `Err` with the distance that remains.
    fn polish(&self, p: &Posture, normal: f64, is_singular: bool) -> Result<[f64; 5], f64> {
        let mut theta = p.theta;
        let axis = self.goal.axis.into_inner();
        let mut before = f64::INFINITY;
        for _ in 0..6 {
            let (tip, pointing) = self.tool_at(&theta);
            let (dp, da) = (self.goal.point - tip, axis - pointing);
            let error = dp.amax().max(da.amax());
            if error <= POLISHED || (error >= 0.25 * before && before < ACCEPTED) {
                return Ok(self.joints(&theta));
            }
            if error >= before {
                break;
            }
            before = error;
            self.step(p, normal, &dp, &da, &mut theta);
        }
        self.rescue(&theta, is_singular)
    }

    /// One Newton step along the linearised closed form.
    #[inline]
    fn step(
        &self,
        p: &Posture,
        normal: f64,
        dp: &Vector3<f64>,
        da: &Vector3<f64>,
        theta: &mut [f64; PADDED],
    ) {
        let f = self.family;
        let dw = dp - da * self.turret.length;
        let turn = if p.forward.abs() > 1e-9 {
            -(dw.x * p.s1 - dw.y * p.c1) / p.forward
        } else {
            0.0
        };
        let axis_m = da.x * p.s1 - da.y * p.c1 + p.sin_psi * p.u.0 * turn;
        let axis_r = da.x * p.c1 + da.y * p.s1 - f.roll * p.cos_psi * turn;
        let psi = p.cos_psi * (p.u.0 * axis_r + p.u.1 * da.z) - f.roll * p.sin_psi * axis_m;
        let phi = if p.sin_psi == 0.0 {
            0.0
        } else {
            (p.u.0 * da.z - p.u.1 * axis_r) / p.sin_psi
        };
        let x = dw.x * p.c1 + dw.y * p.s1 - f.sideways * turn + normal * p.u.0 * phi;
        let z = dw.z + normal * p.u.1 * phi;
        let (phi2, phi23) = if p.area.abs() > 1e-12 {
            (
                (p.fore.0 * x + p.fore.1 * z) / p.area,
                -(p.upper.0 * x + p.upper.1 * z) / p.area,
            )
        } else {
            (0.0, 0.0)
        };
        theta[0] += turn;
        theta[1] += f.bend * phi2;
        theta[2] += f.bend * (phi23 - phi2);
        theta[3] += f.bend * (phi - phi23);
        theta[4] += psi;
    }

    /// Next to a singularity the triangular step fails; damped least squares does not.
    #[cold]
    fn rescue(&self, theta: &[f64; PADDED], is_singular: bool) -> Result<[f64; 5], f64> {
        let start = self.joints(theta);
        let end = numeric::refine(self.arm, self.tool, self.goal, &start);
        let axis_allowed = if is_singular { PARALLEL } else { 1e-9 };
        if end.position_error_m <= 1e-9 && end.axis_error_rad <= axis_allowed {
            let mut joints = [0.0; 5];
            joints.copy_from_slice(&end.q[..5]);
            Ok(joints)
        } else {
            Err(end.position_error_m)
        }
    }

    #[inline]
    fn joints(&self, theta: &[f64; PADDED]) -> [f64; 5] {
        std::array::from_fn(|i| theta[i] - self.family.offsets[i])
    }
}

/// A choice of joint 0.
struct Side {
    shoulder: Shoulder,
    forward: f64,
    s1: f64,
    c1: f64,
    theta1: f64,
    height: f64,
}

/// A choice of the last joint and the plane angle.
struct WristAngles {
    wrist: Wrist,
    psi: f64,
    sin_psi: f64,
    cos_psi: f64,
    phi: f64,
    u: (f64, f64),
}

/// The plane angle where the goal leaves it free. The wrist then lies anywhere on a circle of
/// radius `|normal|` about `(x0, z0)`, at the distance
/// `R^2 = R0^2 + normal^2 + 2 normal R0 cos(phi - phi0)` from the shoulder. With a hint: the
/// nearest angle that the two links reach; without: the one that bends the elbow to a right angle,
/// or nearest to it. `None`, and the violation noted, when no angle is in reach.
fn free_plane_angle(
    f: &Family,
    x0: f64,
    z0: f64,
    normal: f64,
    hint: Option<f64>,
    reach: &mut Reach,
) -> Option<f64> {
    let (sum, difference) = ((f.upper + f.fore).abs(), (f.upper - f.fore).abs());
    let (longest, shortest) = (sum.max(difference), sum.min(difference));
    let centre = x0.hypot(z0);
    if centre - normal.abs() > longest {
        reach.fails(Constraint::ArmExtended, centre - normal.abs() - longest);
        return None;
    }
    if centre + normal.abs() < shortest {
        reach.fails(Constraint::ArmFolded, shortest - centre - normal.abs());
        return None;
    }
    let scale = 2.0 * normal * centre;
    if scale.abs() < 1e-12 {
        return Some(hint.unwrap_or(0.0));
    }
    let base = x0.atan2(-z0);
    let cosine = |distance: f64| {
        let square = distance * distance - centre * centre - normal * normal;
        (square / scale).clamp(-1.0, 1.0)
    };
    let right_angle = f.upper.hypot(f.fore);
    Some(match hint {
        None => base + cosine(right_angle).acos(),
        Some(hint) => {
            let (one, other) = (cosine(longest), cosine(shortest));
            let wanted = (hint - base).cos();
            let allowed = wanted.clamp(one.min(other), one.max(other));
            if allowed == wanted {
                hint
            } else {
                base + allowed.acos().copysign((hint - base).sin())
            }
        }
    })
}
