//! The arm: forward kinematics of its rows.

use crate::inverse::family::{Family, FamilyMismatch};
use crate::rows::{ArmError, DhRow, JointLimits, finite};
use crate::trig::sin_cos;
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};

/// Fewest joints of an [`Arm`].
pub const MIN_JOINTS: usize = 4;
/// Most joints of an [`Arm`].
pub const MAX_JOINTS: usize = 7;
/// Rounding that a joint angle may exceed its limit by and still count as within it, radians.
pub const LIMIT_TOLERANCE_RAD: f64 = 1e-9;
/// `MAX_JOINTS` rounded up to the lanes of the sine kernel.
pub(crate) const PADDED: usize = 8;

/// Constants of one row, prepared for the kernels.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Link {
    pub a: f64,
    pub d: f64,
    pub offset: f64,
    pub sin_alpha: f64,
    pub cos_alpha: f64,
}

/// Sine and cosine of half a row's twist.
#[derive(Clone, Debug, PartialEq)]
struct HalfTwist {
    sine: f64,
    cosine: f64,
}

/// A serial arm of 4 to 7 revolute joints.
#[derive(Clone, Debug, PartialEq)]
pub struct Arm {
    rows: Vec<DhRow>,
    limits: Vec<JointLimits>,
    pub(crate) links: [Link; MAX_JOINTS],
    half_twists: [HalfTwist; MAX_JOINTS],
    /// One per joint, or none at all.
    tilts_rad: Vec<f64>,
    pub(crate) family: Result<Family, FamilyMismatch>,
    /// Bound of the distance of the last link's origin from the base, m.
    chain_m: f64,
}

/// Most sweeps over the points of a chain, and the gain below which one is the last, m.
const CHAIN_SWEEPS: usize = 200;
const CHAIN_GAIN_M: f64 = 1e-9;

/// A short chain of points on the axes from the base to the last link's origin, m. Any choice of
/// points bounds the reach; the best is approached one point at a time (the sum is convex).
fn chain_m(rows: &[DhRow], tilts_rad: &[f64]) -> f64 {
    let n = rows.len();
    // where the next axis passes, and which way, seen from an axis; the last link's origin is a
    // point, not an axis
    let links: Vec<(Vector3<f64>, Vector3<f64>)> = (0..n)
        .map(|i| {
            let (row, tilt) = (&rows[i], tilts_rad.get(i).copied().unwrap_or(0.0));
            let turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), row.alpha_rad)
                * UnitQuaternion::from_axis_angle(&Vector3::y_axis(), tilt);
            let along = if i + 1 < n { 1.0 } else { 0.0 };
            (
                Vector3::new(row.a_m, 0.0, row.d_m),
                turn * Vector3::z() * along,
            )
        })
        .collect();
    let mut places = vec![0.0; n + 1];
    let length = |places: &[f64]| {
        let links = links.iter().zip(places.windows(2));
        let links = links
            .map(|((at, along), place)| (at + along * place[1] - Vector3::z() * place[0]).norm());
        places[0].abs() + links.sum::<f64>()
    };
    let mut best = length(&places);
    for _ in 0..CHAIN_SWEEPS {
        for i in 0..n {
            // the foot on this axis of the point before, and its distance from it
            let (before, off_before) = if i == 0 {
                (0.0, 0.0)
            } else {
                let (at, along) = links[i - 1];
                let from_before = at - Vector3::z() * places[i - 1];
                let foot = -from_before.dot(&along);
                (foot, (from_before + along * foot).norm())
            };
            let (at, along) = links[i];
            let next = at + along * places[i + 1];
            let off_next = next.xy().norm();
            // the shortest way over a line crosses it in proportion to the distances
            let both = off_before + off_next;
            if both > 0.0 {
                places[i] = (before * off_next + next.z * off_before) / both;
            }
        }
        let now = length(&places);
        if best - now <= CHAIN_GAIN_M {
            return best.min(now);
        }
        best = now;
    }
    best
}

/// Axes and origins of all frames, `0..=n`, in the base frame.
pub(crate) struct Frames {
    pub count: usize,
    pub x: [Vector3<f64>; PADDED],
    pub z: [Vector3<f64>; PADDED],
    pub origin: [Vector3<f64>; PADDED],
}

impl Frames {
    /// The y axis of frame `i`.
    #[inline]
    pub fn y(&self, i: usize) -> Vector3<f64> {
        self.z[i].cross(&self.x[i])
    }

    /// A vector of the last link in the base frame.
    #[inline]
    pub fn rotate(&self, in_link: &Vector3<f64>) -> Vector3<f64> {
        let n = self.count;
        self.x[n] * in_link.x + self.y(n) * in_link.y + self.z[n] * in_link.z
    }
}

impl Arm {
    /// An arm from its rows and the limits of its joints, both from the base outwards.
    ///
    /// # Errors
    /// [`ArmError`] when there are not 4 to 7 rows, the lists differ in length, a number is not
    /// finite, a lower limit is not below its upper one, or a rate or acceleration is not
    /// positive.
    pub fn new(rows: Vec<DhRow>, limits: Vec<JointLimits>) -> Result<Self, ArmError> {
        Self::with_tilts(rows, Vec::new(), limits)
    }

    /// An arm whose rows are followed by a turn of `tilts_rad` about the new y axis:
    /// `Rz(theta + offset) Tz(d) Tx(a) Rx(alpha) Ry(tilt)`. This fifth number (Hayati and
    /// Mirmirani 1985) describes joints that are nearly but not quite parallel, whose common normal
    /// lies far away. No tilts at all, or one per row.
    ///
    /// # Errors
    /// As [`Arm::new`].
    pub fn with_tilts(
        rows: Vec<DhRow>,
        mut tilts_rad: Vec<f64>,
        limits: Vec<JointLimits>,
    ) -> Result<Self, ArmError> {
        let n = rows.len();
        if !(MIN_JOINTS..=MAX_JOINTS).contains(&n) {
            return Err(ArmError::JointCount { found: n });
        }
        if limits.len() != n {
            let found = limits.len();
            return Err(ArmError::WrongLength {
                what: "joint limits",
                expected: n,
                found,
            });
        }
        let column = |what, pick: fn(&DhRow) -> f64| {
            finite(what, &rows.iter().map(pick).collect::<Vec<_>>())
        };
        column("a_m", |r| r.a_m)?;
        column("alpha_rad", |r| r.alpha_rad)?;
        column("d_m", |r| r.d_m)?;
        column("theta_offset_rad", |r| r.theta_offset_rad)?;
        if !tilts_rad.is_empty() && tilts_rad.len() != n {
            let found = tilts_rad.len();
            return Err(ArmError::WrongLength {
                what: "tilts",
                expected: n,
                found,
            });
        }
        finite("tilt_rad", &tilts_rad)?;
        if tilts_rad.iter().all(|t| *t == 0.0) {
            tilts_rad.clear();
        }
        for (joint, l) in limits.iter().enumerate() {
            let bad = |what, value, expected| ArmError::BadLimit {
                joint,
                what,
                value,
                expected,
            };
            if !l.lower_rad.is_finite() {
                return Err(bad("lower_rad", l.lower_rad, "a finite angle"));
            }
            if !(l.upper_rad.is_finite() && l.upper_rad > l.lower_rad) {
                return Err(bad(
                    "upper_rad",
                    l.upper_rad,
                    "a finite angle above lower_rad",
                ));
            }
            if !(l.max_rate_rad_s.is_finite() && l.max_rate_rad_s > 0.0) {
                return Err(bad("max_rate_rad_s", l.max_rate_rad_s, "a positive rate"));
            }
            let acceleration = l.max_acceleration_rad_s2;
            if !(acceleration.is_finite() && acceleration > 0.0) {
                let expected = "a positive acceleration";
                return Err(bad("max_acceleration_rad_s2", acceleration, expected));
            }
        }
        let zero = DhRow {
            a_m: 0.0,
            alpha_rad: 0.0,
            d_m: 0.0,
            theta_offset_rad: 0.0,
        };
        let links = std::array::from_fn(|i| {
            let row = rows.get(i).unwrap_or(&zero);
            let ([sin_alpha, _], [cos_alpha, _]) = sin_cos(&[row.alpha_rad, 0.0], 1);
            Link {
                a: row.a_m,
                d: row.d_m,
                offset: row.theta_offset_rad,
                sin_alpha,
                cos_alpha,
            }
        });
        let half_twists = std::array::from_fn(|i| {
            let half = 0.5 * rows.get(i).unwrap_or(&zero).alpha_rad;
            let ([sine, _], [cosine, _]) = sin_cos(&[half, 0.0], 1);
            HalfTwist { sine, cosine }
        });
        let family = Family::of(&rows, &tilts_rad);
        let chain_m = chain_m(&rows, &tilts_rad);
        Ok(Self {
            rows,
            limits,
            links,
            half_twists,
            tilts_rad,
            family,
            chain_m,
        })
    }

    /// How many joints there are, 4 to 7.
    pub fn joint_count(&self) -> usize {
        self.rows.len()
    }

    /// The Denavit-Hartenberg rows, from the base outwards.
    pub fn rows(&self) -> &[DhRow] {
        &self.rows
    }

    /// The turns that follow the rows, radians, from the base outwards; none if all are zero.
    pub fn tilts_rad(&self) -> &[f64] {
        &self.tilts_rad
    }

    /// A distance that the tool point, this far from the last link's origin, never has from the
    /// base, metres.
    ///
    /// A point on a joint's axis is at a fixed distance from one on the next joint's, whatever the
    /// angles: the sum of such distances from the base outwards bounds the reach. The points are
    /// placed so that the sum is small, since axes that are nearly parallel meet far away.
    pub fn reach_m(&self, tip_m: f64) -> f64 {
        self.chain_m + tip_m
    }

    /// The joint limits, from the base outwards.
    pub fn limits(&self) -> &[JointLimits] {
        &self.limits
    }

    /// The angles about the z axes, `q + offset`, padded; refuses what is not `n` finite numbers.
    #[inline]
    pub(crate) fn angles(&self, q: &[f64]) -> Result<[f64; PADDED], ArmError> {
        let n = self.rows.len();
        if q.len() != n {
            let found = q.len();
            return Err(ArmError::WrongLength {
                what: "joint angles",
                expected: n,
                found,
            });
        }
        let mut angles = [0.0; PADDED];
        let mut magnitude = 0.0;
        for ((angle, q), link) in angles.iter_mut().zip(q).zip(&self.links) {
            *angle = q + link.offset;
            magnitude += angle.abs();
        }
        if !f64::is_finite(magnitude) {
            finite("joint angles", q)?;
        }
        Ok(angles)
    }

    /// The pose of the last link, `base_from_link`, at joint angles `q` (radians, one per joint).
    ///
    /// Built from the tip backwards: the translation passes through two plane rotations per
    /// joint, and the rotation is a product of quaternions, so nothing is normalised or
    /// converted at the end.
    ///
    /// # Errors
    /// [`ArmError`] when `q` has the wrong length or a value that is not finite.
    #[inline]
    pub fn forward(&self, q: &[f64]) -> Result<Isometry3<f64>, ArmError> {
        if !self.tilts_rad.is_empty() {
            return self.tilted_forward(q);
        }
        match q.len() {
            4 => self.forward_of::<4>(q),
            5 => self.forward_of::<5>(q),
            6 => self.forward_of::<6>(q),
            _ => self.forward_of::<7>(q),
        }
    }

    /// [`Self::forward`] for `N` joints, so that the compiler unrolls it.
    #[inline(always)]
    fn forward_of<const N: usize>(&self, q: &[f64]) -> Result<Isometry3<f64>, ArmError> {
        let mut halves = self.angles(q)?;
        for angle in &mut halves {
            *angle *= 0.5;
        }
        let (sine, cosine) = sin_cos(&halves, N);
        let (mut w, mut i, mut j, mut k) = (1.0, 0.0, 0.0, 0.0);
        let (mut x, mut y, mut z) = (0.0, 0.0, 0.0);
        for joint in (0..N).rev() {
            let (link, half) = (&self.links[joint], &self.half_twists[joint]);
            let (s, c) = (sine[joint], cosine[joint]);
            let (sin, cos) = (2.0 * s * c, 1.0 - 2.0 * s * s);
            let (x1, y1) = (x + link.a, link.cos_alpha * y - link.sin_alpha * z);
            z = link.sin_alpha * y + link.cos_alpha * z + link.d;
            x = cos * x1 - sin * y1;
            y = sin * x1 + cos * y1;
            let (lw, li) = (c * half.cosine, c * half.sine);
            let (lj, lk) = (s * half.sine, s * half.cosine);
            (w, i, j, k) = (
                (lw * w - li * i) - (lj * j + lk * k),
                (lw * i + li * w) + (lj * k - lk * j),
                (lw * j + lj * w) + (lk * i - li * k),
                (lw * k + lk * w) + (li * j - lj * i),
            );
        }
        Ok(Isometry3::from_parts(
            Translation3::new(x, y, z),
            UnitQuaternion::new_unchecked(Quaternion::new(w, i, j, k)),
        ))
    }

    /// [`Self::forward`] with tilts.
    #[cold]
    pub(crate) fn tilted_forward(&self, q: &[f64]) -> Result<Isometry3<f64>, ArmError> {
        Ok(self.link_poses(q)?[self.rows.len()])
    }

    /// [`Self::frames`] with tilts.
    #[cold]
    fn tilted_frames(&self, q: &[f64]) -> Result<Frames, ArmError> {
        let poses = self.link_poses(q)?;
        let mut frames = Frames {
            count: self.rows.len(),
            x: [Vector3::x(); PADDED],
            z: [Vector3::z(); PADDED],
            origin: [Vector3::zeros(); PADDED],
        };
        for (i, pose) in poses.iter().enumerate() {
            frames.x[i] = pose.rotation * Vector3::x();
            frames.z[i] = pose.rotation * Vector3::z();
            frames.origin[i] = pose.translation.vector;
        }
        Ok(frames)
    }

    /// The x axis of row `i` (from 0) before its tilt: the one it turns about by its twist.
    pub(crate) fn twist_axis(&self, frames: &Frames, i: usize) -> Vector3<f64> {
        match self.tilts_rad.get(i) {
            None => frames.x[i + 1],
            Some(tilt) => frames.x[i + 1] * tilt.cos() + frames.z[i + 1] * tilt.sin(),
        }
    }

    /// Axes and origins of all frames.
    #[inline]
    pub(crate) fn frames(&self, q: &[f64]) -> Result<Frames, ArmError> {
        if !self.tilts_rad.is_empty() {
            return self.tilted_frames(q);
        }
        let n = self.rows.len();
        let (sine, cosine) = sin_cos(&self.angles(q)?, n);
        let mut frames = Frames {
            count: n,
            x: [Vector3::x(); PADDED],
            z: [Vector3::z(); PADDED],
            origin: [Vector3::zeros(); PADDED],
        };
        let (mut x, mut y, mut z) = (Vector3::x(), Vector3::y(), Vector3::z());
        let mut origin = Vector3::zeros();
        for joint in 0..n {
            let link = &self.links[joint];
            let (s, c) = (sine[joint], cosine[joint]);
            let turned = y * c - x * s;
            x = x * c + y * s;
            origin += z * link.d + x * link.a;
            y = turned * link.cos_alpha + z * link.sin_alpha;
            z = z * link.cos_alpha - turned * link.sin_alpha;
            frames.x[joint + 1] = x;
            frames.z[joint + 1] = z;
            frames.origin[joint + 1] = origin;
        }
        Ok(frames)
    }

    /// The poses of all links, `base_from_link_i` for `i = 0..=n`; the first is the identity.
    ///
    /// # Errors
    /// As [`Arm::forward`].
    pub fn link_poses(&self, q: &[f64]) -> Result<Vec<Isometry3<f64>>, ArmError> {
        let n = self.rows.len();
        let mut halves = self.angles(q)?;
        for angle in &mut halves {
            *angle *= 0.5;
        }
        let (sine, cosine) = sin_cos(&halves, n);
        let mut poses = Vec::with_capacity(n + 1);
        let mut pose = Isometry3::identity();
        poses.push(pose);
        for joint in 0..n {
            let (link, half) = (&self.links[joint], &self.half_twists[joint]);
            let (s, c) = (sine[joint], cosine[joint]);
            let (sin, cos) = (2.0 * s * c, 1.0 - 2.0 * s * s);
            pose *= Isometry3::from_parts(
                Translation3::new(link.a * cos, link.a * sin, link.d),
                UnitQuaternion::new_unchecked(Quaternion::new(
                    c * half.cosine,
                    c * half.sine,
                    s * half.sine,
                    s * half.cosine,
                )),
            );
            if let Some(&tilt) = self.tilts_rad.get(joint) {
                pose.rotation *= UnitQuaternion::from_axis_angle(&Vector3::y_axis(), tilt);
            }
            poses.push(pose);
        }
        Ok(poses)
    }

    /// A point fixed to the last link (`point_in_link`, metres) in the base frame, metres.
    ///
    /// # Errors
    /// As [`Arm::forward`].
    pub fn point(&self, q: &[f64], point_in_link: &Vector3<f64>) -> Result<Vector3<f64>, ArmError> {
        let base_from_link = self.forward(q)?;
        Ok(base_from_link.rotation * point_in_link + base_from_link.translation.vector)
    }

    /// Whether every joint angle (radians) is within its limits, [`LIMIT_TOLERANCE_RAD`] allowed.
    ///
    /// # Errors
    /// [`ArmError::OutsideLimit`] for the first joint that is not, or as [`Arm::forward`].
    pub fn check_limits(&self, q: &[f64]) -> Result<(), ArmError> {
        self.angles(q)?;
        for (joint, (&value_rad, l)) in q.iter().zip(&self.limits).enumerate() {
            let (lower_rad, upper_rad) = (l.lower_rad, l.upper_rad);
            if value_rad < lower_rad - LIMIT_TOLERANCE_RAD
                || value_rad > upper_rad + LIMIT_TOLERANCE_RAD
            {
                return Err(ArmError::OutsideLimit {
                    joint,
                    value_rad,
                    lower_rad,
                    upper_rad,
                });
            }
        }
        Ok(())
    }

    /// The arm with model errors `e` added to its rows: four per joint in the order
    /// `[theta, d, a, alpha]` (radians, metres, metres, radians), from the base outwards.
    ///
    /// # Errors
    /// [`ArmError`] when `e` does not have `4 n` finite values.
    pub fn perturbed(&self, e: &[f64]) -> Result<Self, ArmError> {
        let expected = 4 * self.rows.len();
        if e.len() != expected {
            let found = e.len();
            return Err(ArmError::WrongLength {
                what: "model errors",
                expected,
                found,
            });
        }
        finite("model errors", e)?;
        let rows = self
            .rows
            .iter()
            .zip(e.chunks_exact(4))
            .map(|(row, e)| DhRow {
                theta_offset_rad: row.theta_offset_rad + e[0],
                d_m: row.d_m + e[1],
                a_m: row.a_m + e[2],
                alpha_rad: row.alpha_rad + e[3],
            })
            .collect();
        Self::with_tilts(rows, self.tilts_rad.clone(), self.limits.clone())
    }
}
