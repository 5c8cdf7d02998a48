//! The next movement: an arc or a turn towards a goal, clear of slopes and rocks.

use crate::obstacles::{GroundMap, Hazard, PlanarPose};
use nalgebra::Vector2;
use rover_messages::mobility::DriveArc;
use rover_robot::MobilityDescription;

/// How movements are chosen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DriveRules {
    /// Longest movement as a fraction of the range to the target.
    pub step_fraction: f64,
    /// Longest movement, m.
    pub max_step_m: f64,
    /// Shortest movement that is worth while, m.
    pub min_step_m: f64,
    /// Curvatures tried on each side.
    pub curvatures_n: u32,
    /// Distance between checks along the way, m.
    pub check_m: f64,
    /// Beyond this angle to the goal the rover turns in place first, rad.
    pub turn_first_rad: f64,
    /// Largest turn at once near the target, rad: more would show it from another side than it is
    /// known from.
    pub max_turn_rad: f64,
    /// Steepest ground, rad.
    pub max_slope_rad: f64,
}

impl DriveRules {
    /// The rules for a rover.
    #[must_use]
    pub fn of(mobility: &MobilityDescription) -> Self {
        Self {
            step_fraction: 0.18,
            max_step_m: 1.0,
            min_step_m: 0.02,
            curvatures_n: 8,
            check_m: 0.1,
            turn_first_rad: 0.5,
            max_turn_rad: 0.35,
            max_slope_rad: mobility.limits.slope_rad,
        }
    }
}

/// A movement and where it ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Movement {
    /// What the wheels shall do.
    pub arc: DriveArc,
    /// Pose after it, in the rover frame before it.
    pub end: PlanarPose,
}

/// No way leads on.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("none of {tried_n} movements is clear; straight on, {distance_m:.2} m ahead: {straight}")]
pub struct Blocked {
    /// Movements tried.
    pub tried_n: u32,
    /// Where the straight way ends, m.
    pub distance_m: f64,
    /// What lies there.
    pub straight: Hazard,
}

/// Pose after an arc of `length_m` with `curvature` from the origin.
#[must_use]
pub fn after_arc(length_m: f64, curvature_1_m: f64) -> PlanarPose {
    let angle = curvature_1_m * length_m;
    let (along, across) = if angle.abs() < 1e-9 {
        (1.0, angle / 2.0)
    } else {
        (angle.sin() / angle, (1.0 - angle.cos()) / angle)
    };
    PlanarPose {
        x_m: length_m * along,
        y_m: length_m * across,
        heading_rad: angle,
    }
}

/// The next movement towards `goal` (a place in the rover frame), with the target `range_m` away.
/// A turn in place comes first when the goal lies too far to a side; else the arc, of those that
/// are clear, that ends where the goal is nearest and best ahead.
///
/// # Errors
/// [`Blocked`] when no arc is clear for half a step.
pub fn next_movement(
    goal: &Vector2<f64>,
    range_m: f64,
    map: &GroundMap,
    mobility: &MobilityDescription,
    rules: &DriveRules,
) -> Result<Movement, Blocked> {
    let bearing = goal.y.atan2(goal.x);
    if bearing.abs() > rules.turn_first_rad {
        return Ok(turn(bearing));
    }
    let longest = (rules.step_fraction * range_m)
        .min(rules.max_step_m)
        .max(rules.min_step_m);
    let length = longest.min(goal.norm()).max(rules.min_step_m);
    // an arc through the goal has this curvature
    let through = 2.0 * goal.y / goal.norm_squared().max(1e-6);
    let most = mobility.limits.curvature_1_m;
    let n = rules.curvatures_n;
    let mut curvatures = vec![through.clamp(-most, most)];
    for k in 0..=n {
        let c = most * f64::from(k) / f64::from(n);
        curvatures.extend([c, -c]);
    }
    let mut best: Option<(f64, Movement)> = None;
    let mut straight = None;
    for &curvature in &curvatures {
        let (clear_m, hazard) = clear_length(curvature, length, map, mobility, rules);
        if curvature == 0.0 {
            straight = hazard.or(straight);
        }
        if clear_m < (0.5 * length).max(rules.min_step_m) {
            continue;
        }
        let end = after_arc(clear_m, curvature);
        let rest = end.local(goal);
        let aside = if rest.norm() > 0.1 {
            rest.y.atan2(rest.x).abs()
        } else {
            0.0
        };
        let cost = rest.norm() + 0.4 * aside + 0.02 * curvature.abs();
        if best.is_none_or(|(least, _)| cost < least - 1e-12) {
            let arc = DriveArc::Arc {
                length_m: clear_m,
                curvature_1_m: curvature,
            };
            best = Some((cost, Movement { arc, end }));
        }
    }
    best.map(|(_, movement)| movement).ok_or(Blocked {
        tried_n: curvatures.len() as u32,
        distance_m: length,
        straight: straight.unwrap_or(Hazard::Obstacle {
            found_m: 0.0,
            limit_m: 0.0,
        }),
    })
}

/// The next movements to stand at `pose`: turn towards it, drive straight (backwards if it lies
/// behind) at most `step_m`, turn to its heading. They end where more than one largest turn would
/// be made at once. `None` if the way is not clear, or the pose is reached.
#[must_use]
pub fn towards_pose(
    pose: &PlanarPose,
    step_m: f64,
    map: &GroundMap,
    mobility: &MobilityDescription,
    rules: &DriveRules,
) -> Option<Vec<Movement>> {
    /// Smaller angles are not worth a turn of their own.
    const AIM_RAD: f64 = 0.06;
    const HEADING_RAD: f64 = 0.02;
    /// Nearer to the place than this only the heading is mended, m.
    const NEAR_M: f64 = 0.08;
    let most = rules.max_turn_rad;
    let place = Vector2::new(pose.x_m, pose.y_m);
    let distance = place.norm();
    if distance <= NEAR_M {
        let angle = pose.heading_rad.clamp(-most, most);
        return (angle.abs() > HEADING_RAD).then(|| vec![turn(angle)]);
    }
    // the whole way must be clear, though only its beginning is driven
    if hazard_on_the_way(pose, map, mobility, rules).is_some() {
        return None;
    }
    let (aim, sign) = aim_of(&place);
    let mut way = Vec::new();
    let mut turned = 0.0;
    if aim.abs() > AIM_RAD {
        turned = aim.clamp(-most, most);
        way.push(turn(turned));
        if turned != aim {
            return Some(way);
        }
    }
    way.push(straight(sign * distance.min(step_m)));
    let rest = pose.heading_rad - turned;
    let all = (turned + rest).abs().max(turned.abs());
    if distance <= step_m && rest.abs() > HEADING_RAD && rest.abs() <= most && all <= most {
        way.push(turn(rest));
    }
    Some(way)
}

/// The first hazard on the straight way to a pose, and how far away it is, m.
#[must_use]
pub fn hazard_on_the_way(
    pose: &PlanarPose,
    map: &GroundMap,
    mobility: &MobilityDescription,
    rules: &DriveRules,
) -> Option<(f64, Hazard)> {
    let place = Vector2::new(pose.x_m, pose.y_m);
    let distance = place.norm();
    let heading_rad = aim_of(&place).0;
    let steps = (distance / rules.check_m).ceil().max(1.0) as u32;
    (1..=steps).find_map(|k| {
        let part = f64::from(k) / f64::from(steps);
        let at = PlanarPose {
            x_m: place.x * part,
            y_m: place.y * part,
            heading_rad,
        };
        let standing = map.standing(&at, mobility, rules.max_slope_rad);
        standing.err().map(|hazard| (distance * part, hazard))
    })
}

/// Heading in which a place is driven to, and 1 for forwards or -1 for backwards.
pub(crate) fn aim_of(place: &Vector2<f64>) -> (f64, f64) {
    let bearing = place.y.atan2(place.x);
    if bearing.abs() <= std::f64::consts::FRAC_PI_2 {
        (bearing, 1.0)
    } else {
        (bearing - std::f64::consts::PI.copysign(bearing), -1.0)
    }
}

/// A straight movement, backwards where the length is negative.
#[must_use]
pub fn straight(length_m: f64) -> Movement {
    Movement {
        arc: DriveArc::Arc {
            length_m,
            curvature_1_m: 0.0,
        },
        end: after_arc(length_m, 0.0),
    }
}

/// A turn in place.
#[must_use]
pub fn turn(angle_rad: f64) -> Movement {
    Movement {
        arc: DriveArc::Turn { angle_rad },
        end: PlanarPose {
            x_m: 0.0,
            y_m: 0.0,
            heading_rad: angle_rad,
        },
    }
}

/// How far an arc is clear, and what ends it. Where the rover stands now it has proved that it can
/// stand, so a hazard counts only if it is not already met at the start.
fn clear_length(
    curvature: f64,
    length_m: f64,
    map: &GroundMap,
    mobility: &MobilityDescription,
    rules: &DriveRules,
) -> (f64, Option<Hazard>) {
    let steps = (length_m / rules.check_m).ceil().max(1.0) as u32;
    let mut clear = 0.0;
    for k in 1..=steps {
        let at = length_m * f64::from(k) / f64::from(steps);
        match map.standing(&after_arc(at, curvature), mobility, rules.max_slope_rad) {
            Ok(_) => clear = at,
            Err(hazard) => return (clear, Some(hazard)),
        }
    }
    (clear, None)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use crate::obstacles::tests::{ground, mobility};

    fn next(goal: [f64; 2], map: &GroundMap) -> Result<Movement, Blocked> {
        let mobility = mobility();
        let rules = DriveRules::of(&mobility);
        next_movement(&goal.into(), goal[0].hypot(goal[1]), map, &mobility, &rules)
    }

    #[test]
    fn an_arc_ends_where_small_steps_lead() {
        for (length, curvature) in [(1.0, 0.8), (-0.7, 0.5), (0.9, 0.0), (0.5, -0.3)] {
            let mut pose = PlanarPose {
                x_m: 0.0,
                y_m: 0.0,
                heading_rad: 0.0,
            };
            let n = 20_000;
            for _ in 0..n {
                let ds = length / f64::from(n);
                let middle = pose.heading_rad + 0.5 * curvature * ds;
                pose.x_m += ds * middle.cos();
                pose.y_m += ds * middle.sin();
                pose.heading_rad += curvature * ds;
            }
            let end = after_arc(length, curvature);
            assert!((end.x_m - pose.x_m).abs() < 1e-8 && (end.y_m - pose.y_m).abs() < 1e-8);
        }
    }

    #[test]
    fn on_open_ground_the_rover_heads_for_its_goal() {
        let open = ground(|_, _| 0.0);
        let m = next([5.0, 0.0], &open).unwrap();
        let straight = |arc: &DriveArc| {
            matches!(*arc, DriveArc::Arc { length_m, curvature_1_m }
            if (length_m - 0.9).abs() < 1e-9 && curvature_1_m == 0.0)
        };
        assert!(straight(&m.arc), "{m:?}");
        let m = next([4.0, 1.0], &open).unwrap();
        assert!(m.end.local(&Vector2::new(4.0, 1.0)).norm() < 4.12 - 0.6);
        let m = next([1.0, -3.0], &open).unwrap();
        assert!(matches!(m.arc, DriveArc::Turn { angle_rad } if angle_rad < -1.0));
    }

    #[test]
    fn a_wall_stops() {
        let wall = ground(|x, _| if (0.7..0.9).contains(&x) { 0.5 } else { 0.0 });
        let blocked = next([5.0, 0.0], &wall).unwrap_err();
        assert_eq!(blocked.tried_n, 19);
    }
}
