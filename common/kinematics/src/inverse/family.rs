//! The family of arms that has a closed form, recognised from the rows and the tool.

use crate::arm::Link;
use crate::rows::DhRow;
use crate::tool::Tool;
use crate::trig::atan2;
use std::f64::consts::FRAC_PI_2;
use std::fmt;

/// How far a twist may be from a multiple of pi/2, radians: flight tables write 1.570796.
const TWIST_TOLERANCE_RAD: f64 = 1e-5;
/// How far a length that has to vanish may be from zero, metres.
const LENGTH_TOLERANCE_M: f64 = 1e-9;
/// How far the tool's axis and tip may be out of place (1, metres).
const TOOL_TOLERANCE: f64 = 1e-9;

/// The property that an arm or a tool lacks for the closed form.
#[derive(Clone, Debug, PartialEq)]
pub struct FamilyMismatch {
    /// Which property.
    pub parameter: &'static str,
    /// The joint it belongs to, from 0; `None` for the tool and for the number of joints.
    pub joint: Option<usize>,
    /// The value found.
    pub value: f64,
    /// What the family asks for.
    pub expected: &'static str,
}

impl fmt::Display for FamilyMismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(joint) = self.joint {
            write!(f, "joint[{joint}] ")?;
        }
        write!(
            f,
            "{} = {}, expected {}",
            self.parameter, self.value, self.expected
        )
    }
}

/// An arm of the family of the Mars Exploration Rover arm: a first joint, three parallel ones,
/// and a turret. Twists (+-pi/2, 0, 0, +-pi/2, +-pi/2); `a` of the last two rows zero.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Family {
    /// `d` of the first row.
    pub height: f64,
    /// `a` of the first row.
    pub reach: f64,
    /// `a` of the second row.
    pub upper: f64,
    /// `a` of the third row.
    pub fore: f64,
    /// `1 / upper`, `1 / fore` and `1 / (2 upper fore)`.
    pub over_upper: f64,
    pub over_fore: f64,
    pub over_twice: f64,
    /// `d` of rows 1 to 3, along the bending axis `m = (s1, -c1, 0)`.
    pub sideways: f64,
    /// `d` of the last row.
    pub turret: f64,
    /// Sign of the first twist: the sense in which joints 1 to 3 count.
    pub bend: f64,
    /// Minus the product of the signs of the first and fourth twist.
    pub roll: f64,
    /// Sign of the last twist.
    pub face: f64,
    /// Offsets of the joint angles.
    pub offsets: [f64; 5],
    /// The rows with the twists that the family has exactly.
    pub exact: [Link; 5],
    /// Sum of the twists' deviations from the exact family, radians.
    pub skew: f64,
    /// Sum of all lengths of the rows, metres.
    pub length: f64,
}

/// A tool of the family: axis square to the last link's y, tip on the axis but for a part along y.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct TurretTool {
    /// Length along the axis.
    pub length: f64,
    /// Part of the tip along the last link's y.
    pub along_y: f64,
    /// Angle by which the axis is ahead of the last joint.
    pub ahead: f64,
    /// Its sine and cosine.
    pub ahead_sin_cos: (f64, f64),
}

impl Family {
    pub(crate) fn of(rows: &[DhRow], tilts_rad: &[f64]) -> Result<Self, FamilyMismatch> {
        let miss = |parameter, joint, value, expected| {
            Err(FamilyMismatch {
                parameter,
                joint,
                value,
                expected,
            })
        };
        if rows.len() != 5 {
            return miss("number of joints", None, rows.len() as f64, "5");
        }
        if let Some(joint) = tilts_rad.iter().position(|t| *t != 0.0) {
            return miss("tilt_rad", Some(joint), tilts_rad[joint], "0");
        }
        for joint in [0, 3, 4] {
            let alpha = rows[joint].alpha_rad;
            if (alpha.abs() - FRAC_PI_2).abs() > TWIST_TOLERANCE_RAD {
                return miss("alpha_rad", Some(joint), alpha, "pi/2 or -pi/2 within 1e-5");
            }
        }
        for joint in [1, 2] {
            let alpha = rows[joint].alpha_rad;
            if alpha.abs() > TWIST_TOLERANCE_RAD {
                return miss("alpha_rad", Some(joint), alpha, "0 within 1e-5");
            }
            if rows[joint].a_m.abs() < 1e-6 {
                return miss(
                    "a_m",
                    Some(joint),
                    rows[joint].a_m,
                    "a length that is not zero",
                );
            }
        }
        for joint in [3, 4] {
            if rows[joint].a_m.abs() > LENGTH_TOLERANCE_M {
                return miss("a_m", Some(joint), rows[joint].a_m, "0 within 1e-9");
            }
        }
        let sign = |joint: usize| rows[joint].alpha_rad.signum();
        let square = [FRAC_PI_2, 0.0, 0.0, FRAC_PI_2, FRAC_PI_2];
        let skew: f64 = rows
            .iter()
            .zip(square)
            .map(|(r, s)| (r.alpha_rad.abs() - s).abs())
            .sum();
        let length: f64 = rows.iter().map(|r| r.a_m.abs() + r.d_m.abs()).sum();
        Ok(Self {
            height: rows[0].d_m,
            reach: rows[0].a_m,
            upper: rows[1].a_m,
            fore: rows[2].a_m,
            over_upper: 1.0 / rows[1].a_m,
            over_fore: 1.0 / rows[2].a_m,
            over_twice: 1.0 / (2.0 * rows[1].a_m * rows[2].a_m),
            sideways: sign(0) * (rows[1].d_m + rows[2].d_m + rows[3].d_m),
            turret: rows[4].d_m,
            bend: sign(0),
            roll: -sign(0) * sign(3),
            face: sign(4),
            offsets: std::array::from_fn(|i| rows[i].theta_offset_rad),
            exact: std::array::from_fn(|i| Link {
                a: rows[i].a_m,
                d: rows[i].d_m,
                offset: rows[i].theta_offset_rad,
                sin_alpha: if square[i] == 0.0 { 0.0 } else { sign(i) },
                cos_alpha: if square[i] == 0.0 { 1.0 } else { 0.0 },
            }),
            skew,
            length,
        })
    }

    /// Longest and shortest distance between shoulder and wrist, metres.
    #[inline]
    pub(crate) fn span(&self) -> (f64, f64) {
        let (sum, difference) = (
            (self.upper + self.fore).abs(),
            (self.upper - self.fore).abs(),
        );
        (sum.max(difference), sum.min(difference))
    }

    /// The tool in the terms of the family.
    pub(crate) fn tool(&self, tool: &Tool) -> Result<TurretTool, FamilyMismatch> {
        let (axis, tip) = (tool.axis_in_link.normalize(), tool.tip_in_link);
        if axis.y.abs() > TOOL_TOLERANCE {
            return Err(FamilyMismatch {
                parameter: "y of the tool's axis",
                joint: None,
                value: axis.y,
                expected: "0 within 1e-9",
            });
        }
        let beside = tip.z * axis.x - tip.x * axis.z;
        if beside.abs() > TOOL_TOLERANCE {
            return Err(FamilyMismatch {
                parameter: "distance in x-z of the tip from the axis through the link's origin",
                joint: None,
                value: beside,
                expected: "0 within 1e-9 m",
            });
        }
        Ok(TurretTool {
            length: tip.x * axis.x + tip.z * axis.z,
            along_y: tip.y,
            ahead: atan2(axis.x, self.face * axis.z),
            ahead_sin_cos: (axis.x, self.face * axis.z),
        })
    }
}
