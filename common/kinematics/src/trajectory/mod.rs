//! Motions of the joints in time.

mod profile;
mod spline;
mod timing;

use crate::arm::{Arm, LIMIT_TOLERANCE_RAD};
use crate::rows::ArmError;
use serde::{Deserialize, Serialize};
pub use timing::{TimingOptions, through, through_with};

/// Part of a rate or acceleration limit by which rounding may exceed it.
const RELATIVE_TOLERANCE: f64 = 1e-6;

/// Where the joints are, and how fast, at one time.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq)]
#[serde(deny_unknown_fields)]
pub struct TrajectoryPoint {
    /// Time from the start of the motion, seconds.
    pub t_s: f64,
    /// Joint angles, radians.
    pub q_rad: Vec<f64>,
    /// Joint rates, rad/s.
    pub qd_rad_s: Vec<f64>,
}

/// A motion of all joints: cubic Hermite pieces between points of position and rate.
#[derive(Serialize, Deserialize, Clone, Debug, PartialEq)]
#[serde(deny_unknown_fields)]
pub struct JointTrajectory {
    /// The points, in the order of their times.
    pub points: Vec<TrajectoryPoint>,
}

/// Why a trajectory is refused or cannot be made. Points and joints count from 0.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum TrajectoryError {
    /// There is no point, or no way-point.
    #[error("{what}: needs at least {expected}, got {found}")]
    TooFew {
        /// What is missing.
        what: &'static str,
        /// Fewest that make sense.
        expected: usize,
        /// How many there are.
        found: usize,
    },
    /// A point does not have one value per joint.
    #[error("point {point}: {what} has {found} values, the arm has {expected} joints")]
    WrongLength {
        /// Which point.
        point: usize,
        /// Which of its fields.
        what: &'static str,
        /// Joints of the arm.
        expected: usize,
        /// Values found.
        found: usize,
    },
    /// A number is NaN or infinite.
    #[error("point {point}: {what} = {value} is not a finite number")]
    NotFinite {
        /// Which point.
        point: usize,
        /// Which of its fields.
        what: &'static str,
        /// The value.
        value: f64,
    },
    /// Times do not increase.
    #[error("point {point}: time {t_s} s does not come after {previous_s} s")]
    TimeNotIncreasing {
        /// Which point.
        point: usize,
        /// Its time, seconds.
        t_s: f64,
        /// The time of the point before, seconds.
        previous_s: f64,
    },
    /// A joint leaves its limits at or after a point (before the next).
    #[error("point {point}: joint[{joint}] {quantity} {value:.6} breaks its limit {limit:.6}")]
    Limit {
        /// The point at which the piece begins that breaks the limit.
        point: usize,
        /// The joint.
        joint: usize,
        /// What is too large.
        quantity: Quantity,
        /// Its value, radians, rad/s or rad/s^2.
        value: f64,
        /// The limit broken, same unit.
        limit: f64,
    },
    /// An option is out of range.
    #[error("{what} = {value}, expected {expected}")]
    BadOption {
        /// Which option.
        what: &'static str,
        /// Its value.
        value: f64,
        /// What would be right.
        expected: &'static str,
    },
    /// A way-point does not fit the arm or breaks a joint limit.
    #[error("way-point {index}: {source}")]
    WayPoint {
        /// Which way-point.
        index: usize,
        /// What is wrong with it.
        source: ArmError,
    },
}

/// A limited quantity of a joint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// Joint angle, radians.
    Position,
    /// Joint rate, rad/s.
    Rate,
    /// Joint acceleration, rad/s^2.
    Acceleration,
}

impl std::fmt::Display for Quantity {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Position => "position (rad)",
            Self::Rate => "rate (rad/s)",
            Self::Acceleration => "acceleration (rad/s^2)",
        })
    }
}

/// One joint between two points: the cubic with given ends.
#[derive(Clone, Copy)]
pub(crate) struct Piece {
    pub start: f64,
    pub end: f64,
    pub start_rate: f64,
    pub end_rate: f64,
    pub duration: f64,
}

impl Piece {
    /// Angle at `x` seconds into the piece.
    pub fn position(&self, x: f64) -> f64 {
        let u = x / self.duration;
        let v = 1.0 - u;
        let (s, e) = (
            self.start_rate * self.duration,
            self.end_rate * self.duration,
        );
        v * v * ((1.0 + 2.0 * u) * self.start + u * s)
            + u * u * ((1.0 + 2.0 * v) * self.end - v * e)
    }

    /// Mean rate over the piece.
    fn mean_rate(&self) -> f64 {
        (self.end - self.start) / self.duration
    }

    /// Rate at `x` seconds into the piece.
    pub fn rate(&self, x: f64) -> f64 {
        let u = x / self.duration;
        let v = 1.0 - u;
        6.0 * u * v * self.mean_rate()
            + v * (1.0 - 3.0 * u) * self.start_rate
            + u * (3.0 * u - 2.0) * self.end_rate
    }

    /// Acceleration at the start and the end; in between it is linear.
    pub fn accelerations(&self) -> (f64, f64) {
        let (m, s, e) = (self.mean_rate(), self.start_rate, self.end_rate);
        (
            (6.0 * m - 4.0 * s - 2.0 * e) / self.duration,
            (2.0 * s + 4.0 * e - 6.0 * m) / self.duration,
        )
    }

    /// The rate of largest magnitude.
    pub fn extreme_rate(&self) -> f64 {
        let (first, last) = self.accelerations();
        let mut extreme = if self.start_rate.abs() >= self.end_rate.abs() {
            self.start_rate
        } else {
            self.end_rate
        };
        if first * last < 0.0 {
            let inside = self.rate(self.duration * first / (first - last));
            if inside.abs() > extreme.abs() {
                extreme = inside;
            }
        }
        extreme
    }

    /// The smallest and the largest angle.
    pub fn range(&self) -> (f64, f64) {
        let (mut low, mut high) = (self.start.min(self.end), self.start.max(self.end));
        let (first, last) = self.accelerations();
        // rate = start_rate + first x + curve x^2
        let curve = 0.5 * (last - first) / self.duration;
        let mut consider = |x: f64| {
            if x > 0.0 && x < self.duration {
                let q = self.position(x);
                low = low.min(q);
                high = high.max(q);
            }
        };
        let discriminant = first * first - 4.0 * curve * self.start_rate;
        if discriminant >= 0.0 {
            let sum = -0.5 * (first + discriminant.sqrt().copysign(first));
            if curve != 0.0 {
                consider(sum / curve);
            }
            if sum != 0.0 {
                consider(self.start_rate / sum);
            }
        }
        (low, high)
    }
}

impl JointTrajectory {
    /// Time of the last point, seconds; zero without points.
    pub fn duration_s(&self) -> f64 {
        self.points.last().map_or(0.0, |p| p.t_s)
    }

    /// Joint angles (radians) and rates (rad/s) at `t_s`: cubic Hermite between the points.
    /// Before the first and after the last point the joints rest there. A time that is NaN gives
    /// NaN; a trajectory without points gives empty vectors ([`Self::validate`] refuses both).
    pub fn sample(&self, t_s: f64) -> (Vec<f64>, Vec<f64>) {
        let (Some(first), Some(last)) = (self.points.first(), self.points.last()) else {
            return (Vec::new(), Vec::new());
        };
        let resting = |p: &TrajectoryPoint| (p.q_rad.clone(), vec![0.0; p.q_rad.len()]);
        if t_s < first.t_s {
            return resting(first);
        }
        if t_s > last.t_s {
            return resting(last);
        }
        if t_s.is_nan() {
            return (vec![t_s; first.q_rad.len()], vec![t_s; first.q_rad.len()]);
        }
        let after = self.points.partition_point(|p| p.t_s <= t_s);
        if after == self.points.len() {
            return (last.q_rad.clone(), last.qd_rad_s.clone());
        }
        let x = t_s - self.points[after - 1].t_s;
        self.pieces(after - 1)
            .map(|piece| (piece.position(x), piece.rate(x)))
            .unzip()
    }

    /// The cubics of all joints between point `index` and the next.
    pub(crate) fn pieces(&self, index: usize) -> impl Iterator<Item = Piece> + '_ {
        let (a, b) = (&self.points[index], &self.points[index + 1]);
        let ends = a.q_rad.iter().zip(&b.q_rad);
        let rates = a.qd_rad_s.iter().zip(&b.qd_rad_s);
        ends.zip(rates)
            .map(|((&start, &end), (&start_rate, &end_rate))| Piece {
                start,
                end,
                start_rate,
                end_rate,
                duration: b.t_s - a.t_s,
            })
    }

    /// Whether `arm` may execute this: at least one point, one finite value per joint, finite and
    /// increasing times from 0 on, and position, rate and acceleration of every joint within its
    /// limits at every instant (not only at the points). Rates and accelerations may exceed their
    /// limits by a millionth.
    ///
    /// # Errors
    /// The first [`TrajectoryError`] in order of time, naming point, joint, value and limit.
    pub fn validate(&self, arm: &Arm) -> Result<(), TrajectoryError> {
        if self.points.is_empty() {
            return Err(TrajectoryError::TooFew {
                what: "trajectory points",
                expected: 1,
                found: 0,
            });
        }
        let mut previous_s: Option<f64> = None;
        for (point, p) in self.points.iter().enumerate() {
            check_shape(point, p, arm.joint_count())?;
            let is_late = previous_s.is_none_or(|before| p.t_s > before);
            if !is_late || p.t_s < 0.0 {
                let previous_s = previous_s.unwrap_or(0.0);
                return Err(TrajectoryError::TimeNotIncreasing {
                    point,
                    t_s: p.t_s,
                    previous_s,
                });
            }
            previous_s = Some(p.t_s);
        }
        for (point, p) in self.points.iter().enumerate() {
            self.check_point(arm, point, p)?;
            if point + 1 < self.points.len() {
                self.check_piece(arm, point)?;
            }
        }
        Ok(())
    }

    fn check_point(
        &self,
        arm: &Arm,
        point: usize,
        p: &TrajectoryPoint,
    ) -> Result<(), TrajectoryError> {
        for (joint, l) in arm.limits().iter().enumerate() {
            check_position(point, joint, p.q_rad[joint], l.lower_rad, l.upper_rad)?;
            let value = p.qd_rad_s[joint];
            check(point, joint, Quantity::Rate, value, l.max_rate_rad_s)?;
        }
        Ok(())
    }

    fn check_piece(&self, arm: &Arm, point: usize) -> Result<(), TrajectoryError> {
        for (joint, (piece, l)) in self.pieces(point).zip(arm.limits()).enumerate() {
            let (low, high) = piece.range();
            check_position(point, joint, low, l.lower_rad, l.upper_rad)?;
            check_position(point, joint, high, l.lower_rad, l.upper_rad)?;
            check(
                point,
                joint,
                Quantity::Rate,
                piece.extreme_rate(),
                l.max_rate_rad_s,
            )?;
            let (first, last) = piece.accelerations();
            let limit = l.max_acceleration_rad_s2;
            check(point, joint, Quantity::Acceleration, first, limit)?;
            check(point, joint, Quantity::Acceleration, last, limit)?;
        }
        Ok(())
    }
}

fn check_shape(point: usize, p: &TrajectoryPoint, expected: usize) -> Result<(), TrajectoryError> {
    if !p.t_s.is_finite() {
        return Err(TrajectoryError::NotFinite {
            point,
            what: "t_s",
            value: p.t_s,
        });
    }
    for (what, values) in [("q_rad", &p.q_rad), ("qd_rad_s", &p.qd_rad_s)] {
        if values.len() != expected {
            let found = values.len();
            return Err(TrajectoryError::WrongLength {
                point,
                what,
                expected,
                found,
            });
        }
        if let Some(&value) = values.iter().find(|v| !v.is_finite()) {
            return Err(TrajectoryError::NotFinite { point, what, value });
        }
    }
    Ok(())
}

fn check_position(
    point: usize,
    joint: usize,
    value: f64,
    lower: f64,
    upper: f64,
) -> Result<(), TrajectoryError> {
    let limit = if value < lower - LIMIT_TOLERANCE_RAD {
        lower
    } else if value > upper + LIMIT_TOLERANCE_RAD {
        upper
    } else {
        return Ok(());
    };
    Err(TrajectoryError::Limit {
        point,
        joint,
        quantity: Quantity::Position,
        value,
        limit,
    })
}

fn check(
    point: usize,
    joint: usize,
    quantity: Quantity,
    value: f64,
    limit: f64,
) -> Result<(), TrajectoryError> {
    if value.abs() <= limit * (1.0 + RELATIVE_TOLERANCE) {
        return Ok(());
    }
    Err(TrajectoryError::Limit {
        point,
        joint,
        quantity,
        value,
        limit: limit.copysign(value),
    })
}

#[cfg(test)]
mod tests;
