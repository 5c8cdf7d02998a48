//! Lines in space to Denavit-Hartenberg rows.
//!
//! With all joints at zero the joint axes are lines. Row `i` leads from a frame whose z axis is line
//! `i` to one whose z axis is line `i + 1`, along their common normal: a turn about z onto the normal
//! (its angle is the joint's offset), a shift to its foot, a shift along it, and a twist about it.
//! Parallel lines have many normals; the one through the origin is taken. Nearly parallel ones have
//! theirs far away: there the row leads to the point where the next line meets the xy plane, and a
//! turn about y after the twist makes up for the direction (Hayati and Mirmirani 1985).

use nalgebra::{Isometry3, Translation3, Unit, UnitQuaternion, Vector3};
use rover_kinematics::{DhRow, Tool};

/// Sine of the angle between lines below which they are parallel: what rounding leaves.
const PARALLEL: f64 = 1e-14;
/// Sine of the angle between lines below which the foot of their normal is looked at.
const NEARLY_PARALLEL: f64 = 0.1;
/// Lengths below this are rounding, m.
const NOTHING_M: f64 = 1e-14;

/// A joint's axis with all joints at zero, frame of the base link.
#[derive(Clone, Copy, Debug)]
pub(super) struct Line {
    pub point: Vector3<f64>,
    pub direction: Vector3<f64>,
}

/// The rows of an arm.
pub(super) struct Rows {
    pub rows: Vec<DhRow>,
    pub tilts_rad: Vec<f64>,
    /// The frame in which the rows start, frame of the base link.
    pub base_from_arm_base: Isometry3<f64>,
    /// The last link's frame with all joints at zero, frame of the base link.
    pub base_from_last: Isometry3<f64>,
}

/// The rows that lead along `lines`. The last row ends on its own line with a twist of a quarter turn.
pub(super) fn rows(lines: &[Line]) -> Rows {
    let base_from_arm_base = lines.first().map_or(Isometry3::identity(), start);
    let mut frame = base_from_arm_base;
    let (mut rows, mut tilts_rad) = (Vec::new(), Vec::new());
    for next in lines.iter().skip(1).map(Some).chain([None]) {
        let (row, tilt) = match next {
            Some(next) => row_to(&Line {
                point: frame.inverse_transform_vector(&(next.point - frame.translation.vector)),
                direction: frame.inverse_transform_vector(&next.direction),
            }),
            // Of the twists that an end may have this one is that of a turret, which has a closed form.
            None => (
                DhRow {
                    a_m: 0.0,
                    alpha_rad: std::f64::consts::FRAC_PI_2,
                    d_m: 0.0,
                    theta_offset_rad: 0.0,
                },
                0.0,
            ),
        };
        frame *= pose(&row, tilt);
        rows.push(row);
        tilts_rad.push(tilt);
    }
    Rows {
        rows,
        tilts_rad,
        base_from_arm_base,
        base_from_last: frame,
    }
}

/// A frame whose z axis is the line, as near to the base link's as can be.
fn start(line: &Line) -> Isometry3<f64> {
    let z = line.direction;
    let foot = line.point - z * line.point.dot(&z);
    let tidy = |x: f64| if x.abs() < NOTHING_M { 0.0 } else { x };
    Tool {
        tip_in_link: foot.map(tidy),
        axis_in_link: Unit::new_normalize(z),
    }
    .frame()
}

/// The row from the z axis to a line given in its frame, and the tilt that follows.
fn row_to(line: &Line) -> (DhRow, f64) {
    let (p, v) = (line.point, line.direction);
    let sine = v.x.hypot(v.y);
    if sine >= NEARLY_PARALLEL {
        return (along_normal(&p, &v, sine), 0.0);
    }
    // Where the line meets the xy plane.
    let meets = p - v * (p.z / v.z);
    let a_m = meets.x.hypot(meets.y);
    if sine > PARALLEL && a_m < NOTHING_M {
        return (along_normal(&p, &v, sine), 0.0);
    }
    let offset = if a_m < NOTHING_M {
        0.0
    } else {
        meets.y.atan2(meets.x)
    };
    let mut row = DhRow {
        a_m: if a_m < NOTHING_M { 0.0 } else { a_m },
        alpha_rad: if v.z > 0.0 { 0.0 } else { std::f64::consts::PI },
        d_m: 0.0,
        theta_offset_rad: offset,
    };
    if sine <= PARALLEL {
        return (row, 0.0);
    }
    let (s, c) = offset.sin_cos();
    let along_x = c * v.x + s * v.y;
    let along_y = c * v.y - s * v.x;
    row.alpha_rad = (-along_y).atan2(v.z);
    (row, along_x.atan2(along_y.hypot(v.z)))
}

/// The row along the common normal; `sine` is that of the angle between the lines.
fn along_normal(p: &Vector3<f64>, v: &Vector3<f64>, sine: f64) -> DhRow {
    let mut normal = Vector3::new(-v.y, v.x, 0.0) / sine;
    let t = -(p.x * v.x + p.y * v.y) / (sine * sine);
    let mut a_m = normal.dot(p);
    let mut alpha_rad = sine.atan2(v.z);
    // The normal may point either way: outwards, or where the lines meet, to the nearer side.
    let is_backward = if a_m.abs() < NOTHING_M {
        a_m = 0.0;
        normal.x < -1e-12
    } else {
        a_m < 0.0
    };
    if is_backward {
        (normal, a_m, alpha_rad) = (-normal, -a_m, -alpha_rad);
    }
    let d_m = p.z + t * v.z;
    DhRow {
        a_m,
        alpha_rad,
        d_m: if d_m.abs() < NOTHING_M { 0.0 } else { d_m },
        theta_offset_rad: normal.y.atan2(normal.x),
    }
}

/// `Rz(theta_offset) Tz(d) Tx(a) Rx(alpha) Ry(tilt)`.
fn pose(row: &DhRow, tilt: f64) -> Isometry3<f64> {
    let about = UnitQuaternion::from_axis_angle;
    let turn = about(&Vector3::z_axis(), row.theta_offset_rad);
    let along = turn * Vector3::new(row.a_m, 0.0, row.d_m);
    let twist = about(&Vector3::x_axis(), row.alpha_rad) * about(&Vector3::y_axis(), tilt);
    Isometry3::from_parts(Translation3::from(along), turn * twist)
}
