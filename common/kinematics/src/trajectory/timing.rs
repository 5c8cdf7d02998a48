//! From way-points to a trajectory within the limits of the joints.

use super::profile::{Bounds, Profile};
use super::spline::{Path, distance};
use super::{JointTrajectory, TrajectoryError, TrajectoryPoint};
use crate::arm::Arm;

/// Way-points nearer than this are one, radians.
const SAME_RAD: f64 = 1e-9;
/// Grid points of the speed profile of one stretch.
const NODES: usize = 200;
/// Knots over which the acceleration is ramped.
const RAMP_KNOTS: f64 = 5.0;

/// How way-points become a trajectory.
#[derive(Clone, Debug, PartialEq)]
pub struct TimingOptions {
    /// Factor on rate and acceleration limits, above 0 and at most 1.
    pub speed_scale: f64,
    /// Largest spacing of the trajectory's points, seconds.
    pub knot_s: f64,
    /// How far the path may bulge from the straight lines between way-points, radians in joint
    /// space; where it would be more, the arm stops at a way-point instead.
    pub path_tolerance_rad: f64,
    /// Turn of the path at a way-point (radians, in joint space) beyond which the arm stops there.
    pub corner_rad: f64,
    /// Largest speed of the tool point, m/s; needs `path_lengths_m`.
    pub max_tool_speed_m_s: Option<f64>,
    /// Length of the tool point's path up to each way-point, metres, not decreasing, one per
    /// way-point.
    pub path_lengths_m: Option<Vec<f64>>,
}

impl Default for TimingOptions {
    fn default() -> Self {
        Self {
            speed_scale: 1.0,
            knot_s: 0.02,
            path_tolerance_rad: 0.01,
            corner_rad: 0.35,
            max_tool_speed_m_s: None,
            path_lengths_m: None,
        }
    }
}

/// [`through_with`] with default options but for the speed scale (above 0 and at most 1).
///
/// # Errors
/// As [`through_with`].
pub fn through(
    arm: &Arm,
    waypoints: &[Vec<f64>],
    speed_scale: f64,
) -> Result<JointTrajectory, TrajectoryError> {
    through_with(
        arm,
        waypoints,
        &TimingOptions {
            speed_scale,
            ..TimingOptions::default()
        },
    )
}

/// A trajectory through `waypoints` (joint angles, radians; two or more), from rest to rest, all
/// joints together, within position, rate and acceleration limits at every instant.
///
/// Between two way-points the joints move in proportion (a straight line in joint space) with
/// ramped acceleration. Through more way-points the path is a cubic spline as long as it turns
/// gently and stays within `path_tolerance_rad` of the straight lines; at sharper corners the arm
/// comes to rest. The speed along the path is as high as rates, accelerations and the tool speed
/// allow at each place, apart from the ramps.
///
/// # Errors
/// [`TrajectoryError`] for fewer than two way-points, one that does not fit the arm or its
/// limits, or options out of range.
pub fn through_with(
    arm: &Arm,
    waypoints: &[Vec<f64>],
    options: &TimingOptions,
) -> Result<JointTrajectory, TrajectoryError> {
    check(arm, waypoints, options)?;
    let bounds: Vec<Bounds> = arm
        .limits()
        .iter()
        .map(|l| Bounds {
            rate: l.max_rate_rad_s * options.speed_scale,
            acceleration: l.max_acceleration_rad_s2 * options.speed_scale,
        })
        .collect();
    let mut kept: Vec<usize> = vec![0];
    for i in 1..waypoints.len() {
        if distance(&waypoints[i], &waypoints[kept[kept.len() - 1]]) > SAME_RAD {
            kept.push(i);
        }
    }
    let mut trajectory = JointTrajectory {
        points: vec![resting(0.0, &waypoints[0])],
    };
    if kept.len() < 2 {
        trajectory
            .points
            .push(resting(options.knot_s, &waypoints[0]));
        return Ok(trajectory);
    }
    for stretch in stretches(arm, waypoints, &kept, options) {
        append(&mut trajectory, &stretch, &bounds, options);
    }
    trajectory.validate(arm)?;
    Ok(trajectory)
}

fn resting(t_s: f64, q: &[f64]) -> TrajectoryPoint {
    TrajectoryPoint {
        t_s,
        q_rad: q.to_vec(),
        qd_rad_s: vec![0.0; q.len()],
    }
}

fn check(
    arm: &Arm,
    waypoints: &[Vec<f64>],
    options: &TimingOptions,
) -> Result<(), TrajectoryError> {
    let found = waypoints.len();
    if found < 2 {
        return Err(TrajectoryError::TooFew {
            what: "way-points",
            expected: 2,
            found,
        });
    }
    for (index, q) in waypoints.iter().enumerate() {
        arm.check_limits(q)
            .map_err(|source| TrajectoryError::WayPoint { index, source })?;
    }
    let scale = options.speed_scale;
    if !(scale > 0.0 && scale <= 1.0) {
        let expected = "above 0 and at most 1";
        return Err(TrajectoryError::BadOption {
            what: "speed_scale",
            value: scale,
            expected,
        });
    }
    for (what, value) in [
        ("knot_s", options.knot_s),
        ("path_tolerance_rad", options.path_tolerance_rad),
        ("corner_rad", options.corner_rad),
        (
            "max_tool_speed_m_s",
            options.max_tool_speed_m_s.unwrap_or(1.0),
        ),
    ] {
        if !(value.is_finite() && value > 0.0) {
            return Err(TrajectoryError::BadOption {
                what,
                value,
                expected: "positive",
            });
        }
    }
    let lengths = options.path_lengths_m.as_deref();
    if let Some(lengths) = lengths {
        if lengths.len() != found {
            let value = lengths.len() as f64;
            let expected = "one length per way-point";
            return Err(TrajectoryError::BadOption {
                what: "path_lengths_m",
                value,
                expected,
            });
        }
        if let Some(pair) = lengths
            .windows(2)
            .find(|p| !(p[1] >= p[0] && p[1].is_finite()))
        {
            let expected = "finite lengths that do not decrease";
            let value = pair[1];
            return Err(TrajectoryError::BadOption {
                what: "path_lengths_m",
                value,
                expected,
            });
        }
    } else if let Some(value) = options.max_tool_speed_m_s {
        let expected = "path_lengths_m beside it";
        return Err(TrajectoryError::BadOption {
            what: "max_tool_speed_m_s",
            value,
            expected,
        });
    }
    Ok(())
}

/// A part of the path between two stops.
struct Stretch {
    path: Path,
    /// Length of the tool's path per unit of the parameter, in each segment.
    tool_rates: Vec<f64>,
    last: Vec<f64>,
}

/// The angle by which the path turns at `b`, radians.
fn turn(a: &[f64], b: &[f64], c: &[f64]) -> f64 {
    let (before, after) = (distance(a, b), distance(b, c));
    let (mut difference, mut sum) = (0.0, 0.0);
    for j in 0..b.len() {
        let (u, v) = ((b[j] - a[j]) / before, (c[j] - b[j]) / after);
        difference += (u - v) * (u - v);
        sum += (u + v) * (u + v);
    }
    2.0 * difference.sqrt().atan2(sum.sqrt())
}

/// Splits the kept way-points into stretches that one spline may serve.
fn stretches(
    arm: &Arm,
    waypoints: &[Vec<f64>],
    kept: &[usize],
    options: &TimingOptions,
) -> Vec<Stretch> {
    let at = |i: usize| &waypoints[kept[i]];
    let last = kept.len() - 1;
    let mut stops: Vec<usize> = vec![0];
    stops.extend((1..last).filter(|&i| turn(at(i - 1), at(i), at(i + 1)) > options.corner_rad));
    stops.push(last);
    let mut done = Vec::new();
    let mut start = 0;
    let mut pending: Vec<usize> = stops[1..].iter().rev().copied().collect();
    while let Some(end) = pending.pop() {
        let points: Vec<Vec<f64>> = (start..=end).map(|i| at(i).clone()).collect();
        let path = Path::new(&points);
        let limits = |j: usize| (arm.limits()[j].lower_rad, arm.limits()[j].upper_rad);
        // The segment that strays most, if any strays too far.
        let mut worst: Option<(f64, usize)> = None;
        for segment in 0..end - start {
            let (off, out) = path.excursion(segment, limits);
            let excess = (off / options.path_tolerance_rad).max(if out > 0.0 { 2.0 } else { 0.0 });
            if excess > 1.0 && worst.is_none_or(|(w, _)| excess > w) {
                worst = Some((excess, start + segment));
            }
        }
        if let Some((_, segment)) = worst
            && end - start > 1
        {
            // Stop at that end of it where the path turns more.
            let sharpness = |i: usize| {
                if i > start && i < end {
                    turn(at(i - 1), at(i), at(i + 1))
                } else {
                    -1.0
                }
            };
            let stop = if sharpness(segment) >= sharpness(segment + 1) {
                segment
            } else {
                segment + 1
            };
            pending.push(end);
            pending.push(stop);
            continue;
        }
        let knots = path.knots();
        let tool_rates = match &options.path_lengths_m {
            None => vec![0.0; end - start],
            Some(lengths) => (start..end)
                .map(|i| {
                    let tool = lengths[kept[i + 1]] - lengths[kept[i]];
                    tool / (knots[i - start + 1] - knots[i - start])
                })
                .collect(),
        };
        done.push(Stretch {
            path,
            tool_rates,
            last: at(end).clone(),
        });
        start = end;
    }
    done
}

/// Appends the motion along one stretch, slowed where sampling it in cubics asks for that.
fn append(
    trajectory: &mut JointTrajectory,
    stretch: &Stretch,
    bounds: &[Bounds],
    options: &TimingOptions,
) {
    let ceiling = |s: f64| match options.max_tool_speed_m_s {
        None => f64::INFINITY,
        Some(limit) => {
            // Both segments at a way-point count.
            let knots = stretch.path.knots();
            let last = stretch.tool_rates.len() - 1;
            let after = knots
                .partition_point(|k| *k <= s)
                .saturating_sub(1)
                .min(last);
            let before = knots
                .partition_point(|k| *k < s)
                .saturating_sub(1)
                .min(last);
            limit / stretch.tool_rates[after].max(stretch.tool_rates[before])
        }
    };
    let window = RAMP_KNOTS * options.knot_s;
    let profile = Profile::new(&stretch.path, bounds, ceiling, NODES, window);
    let offset = trajectory.duration_s();
    let mut slower = 1.0;
    for _ in 0..8 {
        let motion = sampled(stretch, &profile, slower, options.knot_s);
        let ratio = overload(&motion, bounds);
        if ratio <= 1.0 {
            join(trajectory, motion, offset);
            return;
        }
        slower *= ratio * (1.0 + 1e-9);
    }
    // Stretching time is linear in the rates and quadratic in the accelerations, so the loop
    // ends after two or three rounds; what is left goes to the caller's validation.
    join(
        trajectory,
        sampled(stretch, &profile, slower, options.knot_s),
        offset,
    );
}

fn join(trajectory: &mut JointTrajectory, motion: JointTrajectory, offset: f64) {
    trajectory
        .points
        .extend(motion.points.into_iter().skip(1).map(|mut p| {
            p.t_s += offset;
            p
        }));
}

/// The motion along a stretch with time stretched by `slower`, at even knots from 0.
fn sampled(stretch: &Stretch, profile: &Profile, slower: f64, knot_s: f64) -> JointTrajectory {
    let duration = profile.duration() * slower;
    let count = (duration / knot_s).ceil().max(2.0) as usize;
    let step = duration / count as f64;
    let first = stretch.path.at(0.0).q;
    let mut points = vec![resting(0.0, &first)];
    for i in 1..count {
        let t_s = step * i as f64;
        let (s, speed) = profile.at(t_s / slower);
        let place = stretch.path.at(s);
        let qd_rad_s = place
            .slope
            .iter()
            .map(|slope| slope * speed / slower)
            .collect();
        points.push(TrajectoryPoint {
            t_s,
            q_rad: place.q,
            qd_rad_s,
        });
    }
    points.push(resting(duration, &stretch.last));
    JointTrajectory { points }
}

/// By what factor time has to be stretched for the cubics to keep within `bounds`.
fn overload(motion: &JointTrajectory, bounds: &[Bounds]) -> f64 {
    let mut ratio: f64 = 0.0;
    for index in 0..motion.points.len() - 1 {
        for (piece, limit) in motion.pieces(index).zip(bounds) {
            let (first, last) = piece.accelerations();
            let acceleration = first.abs().max(last.abs()) / limit.acceleration;
            ratio = ratio
                .max(piece.extreme_rate().abs() / limit.rate)
                .max(acceleration.sqrt());
        }
    }
    ratio
}
