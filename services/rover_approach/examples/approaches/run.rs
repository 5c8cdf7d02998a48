//! One rendered approach.

use crate::scene::{AnyError, Kind, Stage, body_pair, mast_pair, pointing_error};
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rover_approach::filter::{OdometryModel, TargetEstimate};
use rover_approach::first_ray::{FirstRayRules, first_ray};
use rover_approach::handover::{HandoverRules, hand_over};
use rover_approach::{anchor::TrackRules, track::Tracker};
use std::sync::Arc;

/// How a run goes.
pub struct RunRules {
    pub step_fraction: f64,
    pub end_m: f64,
    pub track: TrackRules,
    pub odometry: OdometryModel,
    pub pointing_rad: f64,
    pub mount_rad: f64,
    pub mount_m: f64,
}

impl Default for RunRules {
    fn default() -> Self {
        Self {
            step_fraction: 0.15,
            end_m: 0.75,
            track: TrackRules::default(),
            odometry: OdometryModel::default(),
            pointing_rad: 0.05_f64.to_radians(),
            mount_rad: 0.1_f64.to_radians(),
            mount_m: 0.002,
        }
    }
}

pub struct Handed {
    /// Hand-over's own error against the surface point of the tracked mast pixel, px.
    pub own_px: f64,
    pub geometric_px: f64,
    pub surface_mm: f64,
    pub space_mm: f64,
    pub sigma_mm: f64,
}

pub struct Tracked {
    pub surface_mm: f64,
    pub first_ray_mm: Option<f64>,
    pub decided_mm: f64,
    pub handed: Option<Handed>,
    pub not_handed: Option<String>,
}

pub struct Outcome {
    pub range_m: f64,
    pub refused: Option<String>,
    pub tracked: Option<Tracked>,
    pub stops: usize,
    pub trace: Vec<[f64; 5]>,
}

impl Outcome {
    pub fn json(&self, class: &str, seed: u64) -> String {
        let t = self.tracked.as_ref();
        let h = t.and_then(|t| t.handed.as_ref());
        serde_json::json!({
            "class": class, "seed": seed, "stops": self.stops, "range_m": self.range_m,
            "refused": self.refused,
            "tracked_mm": t.map(|t| t.surface_mm),
            "first_ray_mm": t.and_then(|t| t.first_ray_mm),
            "decided_mm": t.map(|t| t.decided_mm),
            "handover_px": h.map(|h| h.own_px),
            "geometric_px": h.map(|h| h.geometric_px),
            "handed_mm": h.map(|h| h.surface_mm),
            "handed_space_mm": h.map(|h| h.space_mm),
            "sigma_mm": h.map(|h| h.sigma_mm),
            "range_score_back_sigmas_error": self.trace,
        })
        .to_string()
    }
}

struct Noise(ChaCha8Rng);

impl Noise {
    fn draw(&mut self, sigma: f64) -> f64 {
        let x: f64 = StandardNormal.sample(&mut self.0);
        sigma * x
    }
    fn vector(&mut self, sigma: f64) -> Vector3<f64> {
        Vector3::from_fn(|_, _| self.draw(sigma))
    }
}

/// Planar pose and tilt.
#[derive(Clone, Copy)]
struct Pose {
    x: f64,
    y: f64,
    yaw: f64,
    roll: f64,
    pitch: f64,
}

impl Pose {
    fn isometry(&self) -> Isometry3<f64> {
        Isometry3::from_parts(
            Vector3::new(self.x, self.y, 0.0).into(),
            UnitQuaternion::from_euler_angles(self.roll, self.pitch, self.yaw),
        )
    }
    fn forward(&mut self, along: f64, across: f64) {
        let (s, c) = self.yaw.sin_cos();
        self.x += c * along - s * across;
        self.y += s * along + c * across;
    }
}

/// Drives from `range_m` to the target and hands it over.
pub fn approach(
    kind: Kind,
    range_m: f64,
    seed: u64,
    rules: &RunRules,
) -> Result<Outcome, AnyError> {
    let mut scene_rng = ChaCha8Rng::seed_from_u64(seed * 7919 + range_m as u64);
    let mut stage = Stage::new(kind, range_m, seed, &mut scene_rng)?;
    let mut noise = Noise(ChaCha8Rng::seed_from_u64(seed * 104_729 + 3));
    let model = &rules.odometry;
    let mount = Isometry3::from_parts(
        noise.vector(rules.mount_m).into(),
        UnitQuaternion::from_scaled_axis(noise.vector(rules.mount_rad)),
    );
    let still = Pose {
        x: 0.0,
        y: 0.0,
        yaw: 0.0,
        roll: 0.0,
        pitch: 0.0,
    };
    let (mut truth, mut belief) = (still, still);
    let in_frame =
        |pose: &Isometry3<f64>, p: &Vector3<f64>| (pose.inverse() * Point3::from(*p)).coords;

    // designation: the nearest whole pixel to the drawn point, and what that pixel truly sees
    let aim = stage.target + noise.vector(0.002 * range_m);
    let believed = mast_pair(&in_frame(&belief.isometry(), &aim), false);
    let true_pair = |believed: &rover_cameras::StereoPair, truth: &Pose, noise: &mut Noise| {
        believed.transformed(&(truth.isometry() * pointing_error(noise.vector(rules.pointing_rad))))
    };
    let cameras = true_pair(&believed, &truth, &mut noise);
    let designated = cameras.left.project(&stage.target)?.map(f64::round);
    let hit = stage
        .cast(&cameras.left, &designated)
        .ok_or("nothing at the designated pixel")?;
    let target = hit.point;
    let view = Arc::new(stage.take(&cameras, &believed)?);
    let mut outcome = Outcome {
        range_m,
        refused: None,
        tracked: None,
        stops: 0,
        trace: Vec::new(),
    };
    let mut tracker =
        match Tracker::designate(view.clone(), designated, [1.0, 25.0], rules.track.clone()) {
            Ok(tracker) => tracker,
            Err(e) => {
                outcome.refused = Some(format!("at designation: {e}"));
                return Ok(outcome);
            }
        };
    let surface = *tracker.target().1;
    let mut estimate = TargetEstimate::new(surface.plane.point, surface.covariance_m2)?;
    let mut last = (view, cameras);
    loop {
        let ground = estimate.position_m.xy().norm();
        outcome.range_m = ground;
        if ground <= rules.end_m + 0.02 {
            break;
        }
        let step = (rules.step_fraction * ground)
            .min(1.0)
            .min(ground - rules.end_m)
            .max(0.02);
        let before = belief.isometry();
        let turn = estimate.position_m.y.atan2(estimate.position_m.x);
        let heading_error = noise.draw(model.heading_rad_per_root_m * step.sqrt());
        belief.yaw += turn;
        truth.yaw += turn + heading_error;
        belief.forward(step, 0.0);
        truth.forward(
            step * (1.0 + noise.draw(model.along)),
            step * noise.draw(model.across),
        );
        truth.roll = noise.draw(2.0_f64.to_radians());
        truth.pitch = noise.draw(2.0_f64.to_radians());
        belief.roll = truth.roll + noise.draw(model.tilt_rad);
        belief.pitch = truth.pitch + noise.draw(model.tilt_rad);
        let motion = model.motion(&before, &belief.isometry());
        estimate = estimate.predicted(&motion);
        let whole = estimate.position_m.xy().norm() <= rules.end_m + 0.05;
        let believed = mast_pair(&estimate.position_m, whole);
        let cameras = true_pair(&believed, &truth, &mut noise);
        let view = Arc::new(stage.take(&cameras, &believed)?);
        let pointing_px = 1290.0 * rules.pointing_rad * 1.5;
        let spread = estimate
            .pixel_covariance(&believed.left, pointing_px)
            .ok_or("the target left the view")?;
        let last_stop = estimate.position_m.xy().norm() <= rules.end_m + 0.05;
        outcome.stops += 1;
        let fix = match tracker.update(&view, &motion.now_from_last, &spread, last_stop) {
            Ok(fix) => fix,
            Err(e) => {
                outcome.refused = Some(e.to_string());
                return Ok(outcome);
            }
        };
        let innovation = estimate.update(&fix.surface.plane.point, &fix.surface.covariance_m2)?;
        let error = stage
            .cast(&cameras.left, &fix.pixel_px)
            .map_or(f64::NAN, |h| (h.point - target).norm() * 1e3);
        outcome.trace.push([
            fix.surface.range_m,
            fix.score,
            fix.back_px,
            innovation.sigmas,
            error,
        ]);
        last = (view, cameras);
    }
    let (view, cameras) = last;
    let (pixel, surface) = tracker.target();
    let seen = stage
        .cast(&cameras.left, pixel)
        .ok_or("nothing under the tracked pixel")?;
    let surface_mm = (seen.point - target).norm() * 1e3;
    let near = first_ray(&tracker, &view, &FirstRayRules::default());
    let met = near.as_ref().ok().and_then(|near| {
        let seen = stage.cast(&cameras.left, &near.pixel_px)?;
        Some((seen.point - target).norm() * 1e3)
    });
    if std::env::var_os("APPROACH_DEBUG").is_some() {
        eprintln!("      tracked {surface_mm:.2} mm, first ray {met:?}: {near:?}");
    }
    let body_believed = body_pair();
    let body_true = body_believed.transformed(&(truth.isometry() * mount));
    let body = stage.take(&body_true, &body_believed)?;
    let mut tracked = Tracked {
        surface_mm,
        first_ray_mm: met,
        decided_mm: met.unwrap_or(surface_mm),
        handed: None,
        not_handed: None,
    };
    match hand_over(&view, pixel, surface, &body, &HandoverRules::default()) {
        Err(e) => tracked.not_handed = Some(e.to_string()),
        Ok(found) => {
            let exact = body_true.left.project(&seen.point)?;
            let at = stage.cast(&body_true.left, &found.pixel_px);
            // the body cameras' own frame carries the mount error in both
            let space = (truth.isometry() * mount) * Point3::from(found.surface.plane.point);
            tracked.handed = Some(Handed {
                own_px: (found.pixel_px - exact).norm(),
                geometric_px: (found.geometric_px - exact).norm(),
                surface_mm: at.map_or(f64::NAN, |h| (h.point - target).norm() * 1e3),
                space_mm: (space.coords - target).norm() * 1e3,
                sigma_mm: found.surface.covariance_m2.trace().sqrt() * 1e3,
            });
        }
    }
    outcome.tracked = Some(tracked);
    Ok(outcome)
}
