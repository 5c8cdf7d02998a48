//! The last metres: which base pose to take, and the movement towards it.

use super::{RETREAT_M, RETREATS_N, Session};
use crate::base_pose::{BaseChoice, BaseRules, BaseTask, Serving, TargetSpot};
use crate::drive::{Movement, hazard_on_the_way, next_movement, straight, towards_pose};
use crate::hardware::fault;
use crate::obstacles::{GroundMap, PlanarPose};
use crate::service::unfit;
use crate::surface::measure_plane;
use nalgebra::{Vector2, Vector3};
use rover_geometry::tangent_basis;
use rover_messages::{
    Fault,
    mobility::{DriveArc, SitePose},
};
use std::sync::Arc;

/// Base poses to which a way around is looked for.
const AROUND_N: usize = 20;
/// A pose in which the arm works worse than in the best by no more than this is not left.
const GOOD_ENOUGH: f64 = 0.15;
/// Close enough to the chosen base pose: m, rad.
const ARRIVED: (f64, f64) = (0.08, 0.08);
/// Movements near the target after which any pose with room that serves is taken, and after which
/// none is made.
const PATIENCE_N: u32 = 10;
const LAST_MOVE_N: u32 = 25;
/// Farther from the target than this a turn may be larger in proportion, m: it shows the target
/// from as much of another side.
const NEAR_TURN_M: f64 = 1.2;

#[allow(clippy::large_enum_variant)] // one lives at a time
pub(super) enum NearStep {
    /// Movements one after the other, without a look between them.
    Move(Vec<DriveArc>),
    Stay(Serving),
}

impl Session<'_> {
    /// The movements to the best base pose that can be driven to, or the decision to stay.
    ///
    /// A base pose once chosen is kept while it serves: each look measures target and ground a
    /// little differently, and another pose would be the best one every time. One that was reached
    /// and does not serve is not chosen again, so that this comes to an end.
    pub(super) fn near_movement(&mut self) -> Result<NearStep, Fault> {
        let (_, surface) = self.tracker.target();
        let spot = TargetSpot {
            position_m: self.estimate.position_m,
            normal: self.seen_normal().unwrap_or(surface.plane.normal),
            around_m: self.surface_about(&self.estimate.position_m),
        };
        let map = self.map();
        let range_m = self.estimate.position_m.xy().norm();
        let mut rules = self.rules;
        rules.max_turn_rad *= (range_m / NEAR_TURN_M).max(1.0);
        let step_m = (rules.step_fraction * range_m).max(0.15);
        let seen = self.missed_n == 0;
        let here = self.served_from_here(&spot, &BaseRules::at_the_limit())?;
        let found = here
            .as_ref()
            .map_or_else(String::clone, |s| format!("score {:.2}", s.arm_score));
        tracing::debug!(aim = ?self.aim.map(|aim| self.in_level(&aim)), here = found, "near");
        if let Some(aim) = self.aim.take() {
            let pose = self.in_level(&aim);
            let is_there = Vector2::new(pose.x_m, pose.y_m).norm() <= ARRIVED.0
                && pose.heading_rad.abs() <= ARRIVED.1;
            if is_there {
                if let (Ok(serving), true) = (&here, seen) {
                    return Ok(NearStep::Stay(serving.clone()));
                }
                self.spent.push(aim);
            } else if let Some(way) = towards_pose(&pose, step_m, &map, self.mobility, &rules) {
                let limit = BaseRules::at_the_limit();
                let task = self.task(&limit)?;
                if task.judge(&pose, &self.levelled(&spot), &map).is_ok() {
                    self.aim = Some(aim);
                    return Ok(NearStep::Move(arcs(&way)));
                }
            }
        }
        let (spot, choice) = match self.choose(&spot, &map) {
            Ok(choice) => (spot, choice),
            Err(refusal) => self.other_spot(&map).ok_or(refusal)?,
        };
        let best_arm = choice.serving.iter().map(|s| s.arm_score);
        let best_arm = best_arm.fold(f64::NEG_INFINITY, f64::max);
        // To be stayed at without having been aimed at, a pose must have room, as one aimed at has.
        let roomy = self.served_from_here(&spot, &BaseRules::default())?;
        self.candidates = (choice.candidates_n, choice.refused.clone());
        if let (Ok(serving), true) = (roomy, seen)
            && (serving.arm_score >= best_arm - GOOD_ENOUGH || self.near_moves_n >= PATIENCE_N)
        {
            return Ok(NearStep::Stay(serving));
        }
        // the best first; the next ones are the second candidates if the way to it is blocked
        let poses = || choice.serving.iter().map(|serving| serving.pose);
        let straight = poses().find_map(|pose| {
            let way = towards_pose(&pose, step_m, &map, self.mobility, &rules)?;
            Some((pose, way))
        });
        // Where no straight way is clear an arc may lead around, or a way back to look again.
        let way = straight.or_else(|| {
            poses().take(AROUND_N).find_map(|pose| {
                let goal = Vector2::new(pose.x_m, pose.y_m);
                let arc = next_movement(&goal, range_m, &map, self.mobility, &rules);
                Some((pose, vec![arc.ok()?]))
            })
        });
        if let Some((pose, way)) = way
            && self.near_moves_n < LAST_MOVE_N
        {
            tracing::debug!(
                ?pose,
                best_arm,
                n = choice.serving.len(),
                "base pose chosen"
            );
            self.aim = Some(self.in_site(&pose));
            return Ok(NearStep::Move(arcs(&way)));
        }
        if self.retreats_n < RETREATS_N
            && let Some(back) = self.backwards(&map)
        {
            self.retreats_n += 1;
            return Ok(NearStep::Move(vec![back.arc]));
        }
        let reason = match here {
            Ok(serving) => return Ok(NearStep::Stay(serving)),
            Err(reason) => reason,
        };
        let n = choice.serving.len();
        let nearest = choice
            .serving
            .first()
            .and_then(|best| hazard_on_the_way(&best.pose, &map, self.mobility, &rules));
        let what = nearest.map_or_else(String::new, |(away_m, hazard)| {
            format!("; on the way to the best one, {away_m:.2} m away: {hazard}")
        });
        let message = format!(
            "no way is clear to any of {n} base poses{what}; where the rover stands: {reason}"
        );
        Err(fault("path_blocked", message).with("range_m", range_m))
    }

    fn choose(&self, spot: &TargetSpot, map: &GroundMap) -> Result<BaseChoice, Fault> {
        let levelled = self.levelled(spot);
        let chosen = |rules: &BaseRules| Ok(self.task(rules)?.choose(&levelled, map));
        let choice = match chosen(&BaseRules::default())? {
            Ok(choice) => Ok(choice),
            Err(_) => chosen(&BaseRules::at_the_limit())?,
        };
        choice.map_err(|none| {
            let mut found = fault("no_base_pose", none.to_string())
                .with("candidates_n", f64::from(none.candidates_n));
            for (name, n) in &none.refused {
                found = found.with(&format!("{name}_n"), f64::from(*n));
            }
            found
        })
    }

    /// Another spot within the goal's radius that some base pose serves; the tracker goes over to
    /// it.
    fn other_spot(&mut self, map: &GroundMap) -> Option<(TargetSpot, BaseChoice)> {
        let radius_m = self.goal.spot_radius_m;
        if radius_m <= 0.0 {
            return None;
        }
        let surface = *self.tracker.target().1;
        let plane = surface.plane;
        let unit = nalgebra::Unit::try_new(plane.normal, 1e-9)?;
        let (a, b) = tangent_basis(&unit);
        let view = Arc::clone(&self.now.view);
        let camera = &view.cameras.left;
        for part in [0.5, 1.0] {
            for k in 0..8 {
                let angle = f64::from(k) * std::f64::consts::FRAC_PI_4;
                let offset = (a * angle.cos() + b * angle.sin()) * (part * radius_m);
                let Ok(pixel) = camera.project(&(plane.point + offset)) else {
                    continue;
                };
                let range = surface.range_m;
                let rules = &self.tracker.rules().plane;
                let Ok(there) =
                    measure_plane(&view, &pixel, [0.7 * range, 1.4 * range], None, rules)
                else {
                    continue;
                };
                let spot = TargetSpot {
                    position_m: there.plane.point,
                    normal: there.plane.normal,
                    around_m: self.surface_about(&there.plane.point),
                };
                let moved = there.plane.point - plane.point;
                if moved.norm() > radius_m * 1.2 {
                    continue;
                }
                if let Ok(choice) = self.choose(&spot, map)
                    && self.tracker.move_to(&view, pixel).is_ok()
                {
                    self.estimate.position_m = there.plane.point;
                    self.spot_offset_m = Some(moved);
                    return Some((spot, choice));
                }
            }
        }
        None
    }

    /// How the arm serves a target, present rover frame, from where the rover stands, or the name
    /// of the condition that is not met.
    pub(super) fn served_from_here(
        &self,
        spot: &TargetSpot,
        rules: &BaseRules,
    ) -> Result<Result<Serving, String>, Fault> {
        let level = self.level_from_rover();
        let task = self.task(rules)?;
        let here = PlanarPose {
            x_m: 0.0,
            y_m: 0.0,
            heading_rad: 0.0,
        };
        Ok(if task.is_avoided(&here) {
            Err("tried_before".to_string())
        } else if task.shades(spot, &level.rotation.inverse()) {
            Err("own_shadow".to_string())
        } else {
            task.serve(spot)
        })
    }

    /// Places that the last picture shows about one, present rover frame.
    pub(super) fn surface_about(&self, place_m: &Vector3<f64>) -> Vec<Vector3<f64>> {
        /// The arm's last links reach no farther from the target, m.
        const ABOUT_M: f64 = 0.30;
        let points = self.landmarks.iter().map(|mark| mark.point_m);
        points.filter(|p| (p - place_m).norm() < ABOUT_M).collect()
    }

    /// The target's normal as the body cameras saw it, present rover frame.
    fn seen_normal(&self) -> Option<Vector3<f64>> {
        let rover_from_site = self.wheels.pose.site_from_rover().isometry.inverse();
        Some(rover_from_site.rotation * self.normal_in_site?)
    }

    /// A way back, if the ground behind is known to be clear.
    pub(super) fn backwards(&self, map: &GroundMap) -> Option<Movement> {
        let behind = PlanarPose {
            x_m: -RETREAT_M,
            y_m: 0.0,
            heading_rad: 0.0,
        };
        let slope = self.rules.max_slope_rad;
        let clear = map.standing(&behind, self.mobility, slope).is_ok();
        clear.then(|| straight(-RETREAT_M))
    }

    fn task<'r>(&'r self, rules: &'r BaseRules) -> Result<BaseTask<'r>, Fault> {
        Ok(BaseTask {
            robot: self.robot,
            mobility: self.mobility,
            body: self.robot.pair("body").map_err(|e| unfit(&e))?,
            rules,
            shade: &self.shade,
            sun: self.sun_in_level(),
            avoid: self
                .goal
                .avoid
                .iter()
                .map(planar)
                .chain(self.spent.iter().copied())
                .map(|p| self.in_level(&p))
                .collect(),
        })
    }

    fn levelled(&self, spot: &TargetSpot) -> TargetSpot {
        spot.moved(&self.level_from_rover())
    }

    /// Where the rover stands, site frame.
    pub(super) fn standing(&self) -> PlanarPose {
        planar(&self.wheels.pose)
    }

    fn in_site(&self, in_level: &PlanarPose) -> PlanarPose {
        let here = self.standing();
        let place = here.at(in_level.x_m, in_level.y_m);
        PlanarPose {
            x_m: place.x,
            y_m: place.y,
            heading_rad: here.heading_rad + in_level.heading_rad,
        }
    }

    fn in_level(&self, in_site: &PlanarPose) -> PlanarPose {
        let here = self.standing();
        let place = here.local(&Vector2::new(in_site.x_m, in_site.y_m));
        let turn = in_site.heading_rad - here.heading_rad;
        let whole = std::f64::consts::TAU;
        PlanarPose {
            x_m: place.x,
            y_m: place.y,
            heading_rad: turn - whole * (turn / whole).round(),
        }
    }
}

fn arcs(way: &[Movement]) -> Vec<DriveArc> {
    way.iter().map(|movement| movement.arc).collect()
}

fn planar(pose: &SitePose) -> PlanarPose {
    PlanarPose {
        x_m: pose.position_m.coords.x,
        y_m: pose.position_m.coords.y,
        heading_rad: pose.heading_rad,
    }
}
