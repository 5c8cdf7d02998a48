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
//! The twists of the rows are only nearly multiples of pi/2, so every branch is then corrected on
//! the true rows: see [`super::polish`]. [`super::branches`] goes through them.

use super::family::{Family, TurretTool};
use super::{AxisGoal, Constraint, Elbow, IkError, Shoulder};
use crate::arm::{Arm, Link};
use crate::tool::Tool;
use crate::trig::{atan2, sin_cos};
use nalgebra::Vector3;
use std::f64::consts::PI;

/// Sine of `psi` below which the axis counts as parallel to the bending axis.
pub(super) const PARALLEL: f64 = 1e-6;
/// Distance from the first axis at which joint 0 is free, metres.
const ON_AXIS_M: f64 = 1e-9;

/// What is chosen where the goal leaves it free: the angles of `near`, the plane angle plus a turn.
#[derive(Clone, Copy)]
pub(super) struct Preferred<'a> {
    pub near: &'a [f64],
    pub turn_rad: f64,
}

/// A broken edge of reach.
pub(super) type Edge = (Constraint, f64);

/// A choice of joint 0.
#[derive(Clone, Copy)]
pub(super) struct Side {
    pub theta1: f64,
    pub s1: f64,
    pub c1: f64,
    /// `w.r` and `w.z`.
    pub forward: f64,
    pub height: f64,
    /// `1 / forward`.
    pub over_forward: f64,
    /// How uncertain `forward` is before polishing, metres.
    pub blur: f64,
    /// Whether it was moved off the edge of reach.
    pub is_moved: bool,
}

/// A choice of the last joint and the plane angle.
#[derive(Clone, Copy)]
pub(super) struct Hand {
    pub psi: f64,
    pub sin_psi: f64,
    pub cos_psi: f64,
    /// `1 / sin_psi`.
    pub over_sin_psi: f64,
    pub phi: f64,
    /// `u` along `r` and `z`.
    pub u: (f64, f64),
}

/// The plane arm between shoulder and wrist, but for the side of the elbow.
#[derive(Clone, Copy)]
pub(super) struct Plane {
    /// The wrist from the shoulder, along `r` and `z`.
    pub x: f64,
    pub z: f64,
    /// One over the square of its distance; 0 where that is next to nothing.
    pub over_square: f64,
    /// Direction of the wrist, and angle between it and the upper arm.
    pub direction: f64,
    pub interior: f64,
    /// Magnitude of `phi3`, its sine and cosine.
    pub bent: f64,
    pub sine: f64,
    pub cosine: f64,
    /// Whether it was moved off the edge of reach.
    pub is_moved: bool,
}

/// A choice of everything, with what the derivative needs.
pub(super) struct Posture {
    pub side: Side,
    pub hand: Hand,
    /// Angles about the z axes, their sines and cosines.
    pub theta: [f64; 5],
    pub sine: [f64; 5],
    pub cosine: [f64; 5],
    /// Upper arm and forearm along `r` and `z`.
    pub upper: (f64, f64),
    pub fore: (f64, f64),
    /// `a2 a3 sin(phi3)`.
    pub area: f64,
    /// Whether the derivative says nothing: the plane angle is free, or the posture was moved off
    /// an edge of reach, so that its sines and cosines do not fit together.
    pub is_irregular: bool,
}

pub(super) struct Solver<'a> {
    pub links: &'a [Link; 5],
    pub tool: &'a Tool,
    pub point: Vector3<f64>,
    /// The goal's axis and the tool's in its link, of unit length to rounding.
    pub axis: Vector3<f64>,
    pub axis_in_link: Vector3<f64>,
    pub family: &'a Family,
    pub turret: TurretTool,
    /// The offsets along `n`: the turret's and the tip's along the last y.
    pub normal: f64,
    /// How far beyond an edge of reach a branch is still tried, metres.
    pub margin: f64,
    pub preferred: Option<Preferred<'a>>,
}

impl<'a> Solver<'a> {
    pub fn new(
        arm: &'a Arm,
        tool: &'a Tool,
        goal: &'a AxisGoal,
        preferred: Option<Preferred<'a>>,
    ) -> Result<Self, IkError> {
        let family = arm
            .family
            .as_ref()
            .map_err(|m| IkError::NotThisFamily(m.clone()))?;
        let turret = family.tool(tool).map_err(IkError::NotThisFamily)?;
        // Rounding, and the rows not being quite of the family, may put a goal on the edge of
        // reach a hair beyond it. The true rows decide when the branch is polished.
        let tip = turret.length.abs() + turret.along_y.abs();
        let margin = 1e-12 + 2.0 * family.skew * (family.length + tip);
        let normal = family.roll * (family.turret + family.face * turret.along_y);
        let links = arm.links.first_chunk().ok_or(IkError::NotFinite)?;
        Ok(Self {
            links,
            tool,
            point: goal.point,
            axis: goal.axis.normalize(),
            axis_in_link: tool.axis_in_link.normalize(),
            family,
            turret,
            normal,
            margin,
            preferred,
        })
    }

    /// Joint 0 for the wrist in front or behind. `slack_min` is the least distance from the edge
    /// of reach that is assumed.
    pub fn side(&self, shoulder: Shoulder, w: &Vector3<f64>, slack_min: f64) -> Result<Side, Edge> {
        let offset = self.family.sideways;
        let square = w.x * w.x + w.y * w.y;
        let rho = square.sqrt();
        let slack = rho - offset.abs();
        if slack < -self.margin {
            return Err((Constraint::ShoulderOffset, -slack));
        }
        let is_back = shoulder == Shoulder::Back;
        if rho < ON_AXIS_M {
            let theta1 = self
                .preferred
                .map_or(0.0, |p| p.near[0] + self.family.offsets[0]);
            let theta1 = if is_back { theta1 + PI } else { theta1 };
            let ([s1, _], [c1, _]) = sin_cos(&[theta1, 0.0], 1);
            return Ok(Side {
                theta1,
                s1,
                c1,
                forward: 0.0,
                height: w.z,
                over_forward: f64::INFINITY,
                blur: 0.0,
                is_moved: false,
            });
        }
        let along = (slack.max(slack_min) * (rho + offset.abs())).sqrt();
        let forward = if is_back { -along } else { along };
        let c1 = (forward * w.x - offset * w.y) / square;
        let s1 = (forward * w.y + offset * w.x) / square;
        let blur = 2.0 * self.margin * rho / along.max(1e-9);
        Ok(Side {
            theta1: atan2(s1, c1),
            s1,
            c1,
            forward,
            height: w.z,
            over_forward: 1.0 / forward,
            blur,
            is_moved: slack < slack_min,
        })
    }

    /// The last joint and the plane angle with the wrist as it is; [`Hand::flipped`] is the other.
    pub fn hand(&self, side: &Side, a: &Vector3<f64>) -> Hand {
        let along_m = a.x * side.s1 - a.y * side.c1;
        let along_r = a.x * side.c1 + a.y * side.s1;
        // A little more than nothing, so that the division below is defined.
        let sine = (along_r * along_r + a.z * a.z).sqrt().max(1e-300);
        let cosine = self.family.roll * along_m;
        let over = 1.0 / sine;
        Hand {
            psi: atan2(sine, cosine),
            sin_psi: sine,
            cos_psi: cosine,
            over_sin_psi: over,
            phi: atan2(a.z, along_r),
            u: (along_r * over, a.z * over),
        }
    }

    /// The hand where the axis is parallel to the bending axis and the plane angle is free.
    pub fn free_hand(&self, side: &Side, hand: &Hand) -> Result<Hand, Edge> {
        let hint = self.preferred.map(|p| {
            let sum = (1..4)
                .map(|i| p.near[i] + self.family.offsets[i])
                .sum::<f64>();
            self.family.bend * sum + p.turn_rad
        });
        let phi = free_plane_angle(self.family, self.shoulder(side), self.normal, hint)?;
        let ([s, _], [c, _]) = sin_cos(&[phi, 0.0], 1);
        Ok(Hand {
            sin_psi: 0.0,
            over_sin_psi: f64::INFINITY,
            phi,
            u: (c, s),
            ..*hand
        })
    }

    /// `w` from the shoulder, along `r` and `z`.
    fn shoulder(&self, side: &Side) -> (f64, f64) {
        (
            side.forward - self.family.reach,
            side.height - self.family.height,
        )
    }

    /// How far beyond the plane arm's edges a branch is still tried, metres: what the rows lack
    /// turns joint 0, and with it the plane angle, the more the nearer both are to singular.
    pub fn plane_margin(&self, side: &Side, hand: &Hand) -> f64 {
        let turn = self.margin + side.blur * side.over_forward.abs().min(1e3);
        let plane_angle = (turn * hand.over_sin_psi.abs().min(1e12)).min(2.0);
        self.margin + side.blur + self.normal.abs() * plane_angle
    }

    /// The plane arm, tried up to `margin` beyond its edges (see [`Self::plane_margin`]);
    /// `slack_min` as in [`Self::side`].
    pub fn plane(
        &self,
        side: &Side,
        hand: &Hand,
        margin: f64,
        slack_min: f64,
    ) -> Result<Plane, Edge> {
        let f = self.family;
        let (x0, z0) = self.shoulder(side);
        let (x, z) = (x0 + self.normal * hand.u.1, z0 - self.normal * hand.u.0);
        let square = x * x + z * z;
        let distance = square.sqrt();
        let (longest, shortest) = f.span();
        let (beyond, within) = (longest - distance, distance - shortest);
        if beyond < -margin {
            return Err((Constraint::ArmExtended, -beyond));
        }
        if within < -margin {
            return Err((Constraint::ArmFolded, -within));
        }
        let is_moved = beyond.min(within) < slack_min;
        let (beyond, within) = (beyond.max(slack_min), within.max(slack_min));
        let cosine = (square - f.upper * f.upper - f.fore * f.fore) * f.over_twice;
        // Heron's form: exact near the straight and the folded arm.
        let heron = beyond * (longest + distance) * within * (distance + shortest);
        let sine = heron.sqrt() * f.over_twice.abs();
        let interior = atan2(f.fore * sine, f.upper + f.fore * cosine);
        Ok(Plane {
            x,
            z,
            over_square: if square > 1e-18 { 1.0 / square } else { 0.0 },
            direction: atan2(z, x),
            interior,
            bent: atan2(sine, cosine),
            sine,
            cosine,
            is_moved,
        })
    }

    pub fn posture(&self, side: &Side, hand: &Hand, plane: &Plane, elbow: Elbow) -> Posture {
        let f = self.family;
        let (x, z) = (plane.x, plane.z);
        // The branch is the sign of a2 a3 sin(phi3), that is of the bend as it is seen.
        let seen = if elbow == Elbow::Positive { 1.0 } else { -1.0 };
        let sign = seen * (f.upper * f.fore).signum();
        let (phi2, phi3) = (plane.direction - sign * plane.interior, sign * plane.bent);
        let straight = f.upper + f.fore * plane.cosine;
        let across = f.fore * sign * plane.sine;
        let upper = if plane.over_square > 0.0 {
            let scale = f.upper * plane.over_square;
            (
                (x * straight + z * across) * scale,
                (z * straight - x * across) * scale,
            )
        } else {
            let ([s, _], [c, _]) = sin_cos(&[phi2, 0.0], 1);
            (f.upper * c, f.upper * s)
        };
        let fore = (x - upper.0, z - upper.1);
        let (theta2, theta3) = (f.bend * phi2, f.bend * phi3);
        let theta4 = f.bend * hand.phi - theta2 - theta3;
        let theta5 = hand.psi - self.turret.ahead;
        // Sines and cosines follow without any angle; phi4 = phi - (phi2 + phi3).
        let (ahead_sine, ahead_cosine) = self.turret.ahead_sin_cos;
        let (u, bend) = (hand.u, f.bend);
        Posture {
            side: *side,
            hand: *hand,
            theta: [side.theta1, theta2, theta3, theta4, theta5],
            sine: [
                side.s1,
                bend * upper.1 * f.over_upper,
                bend * sign * plane.sine,
                bend * (u.1 * fore.0 - u.0 * fore.1) * f.over_fore,
                hand.sin_psi * ahead_cosine - hand.cos_psi * ahead_sine,
            ],
            cosine: [
                side.c1,
                upper.0 * f.over_upper,
                plane.cosine,
                (u.0 * fore.0 + u.1 * fore.1) * f.over_fore,
                hand.cos_psi * ahead_cosine + hand.sin_psi * ahead_sine,
            ],
            upper,
            fore,
            area: f.upper * across,
            is_irregular: side.is_moved || plane.is_moved || hand.sin_psi == 0.0,
        }
    }
}

impl Hand {
    /// The same axis with the wrist flipped.
    pub fn flipped(&self) -> Self {
        Self {
            psi: -self.psi,
            sin_psi: -self.sin_psi,
            cos_psi: self.cos_psi,
            over_sin_psi: -self.over_sin_psi,
            phi: self.phi + PI,
            u: (-self.u.0, -self.u.1),
        }
    }
}

impl Posture {
    /// The edge of reach to which this posture is closest.
    pub fn nearest_edge(&self) -> Constraint {
        let (upper, fore) = (self.upper, self.fore);
        if self.side.forward.abs() < 1e-2 {
            Constraint::ShoulderOffset
        } else if upper.0 * fore.0 + upper.1 * fore.1 > 0.0 {
            Constraint::ArmExtended
        } else {
            Constraint::ArmFolded
        }
    }
}

/// The plane angle where the goal leaves it free. The wrist then lies anywhere on a circle of
/// radius `|normal|` about `(x0, z0)`, at the distance
/// `R^2 = R0^2 + normal^2 + 2 normal R0 cos(phi - phi0)` from the shoulder. With a hint: the
/// nearest angle that the two links reach; without: the one that bends the elbow to a right
/// angle, or nearest to it.
fn free_plane_angle(
    f: &Family,
    (x0, z0): (f64, f64),
    normal: f64,
    hint: Option<f64>,
) -> Result<f64, Edge> {
    let (longest, shortest) = f.span();
    let centre = x0.hypot(z0);
    if centre - normal.abs() > longest {
        return Err((Constraint::ArmExtended, centre - normal.abs() - longest));
    }
    if centre + normal.abs() < shortest {
        return Err((Constraint::ArmFolded, shortest - centre - normal.abs()));
    }
    let scale = 2.0 * normal * centre;
    if scale.abs() < 1e-12 {
        return Ok(hint.unwrap_or(0.0));
    }
    let base = atan2(x0, -z0);
    let cosine = |distance: f64| {
        let square = distance * distance - centre * centre - normal * normal;
        (square / scale).clamp(-1.0, 1.0)
    };
    Ok(match hint {
        None => base + cosine(f.upper.hypot(f.fore)).acos(),
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
