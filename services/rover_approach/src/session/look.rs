//! A look from a stop: what moved, where the target is now, and what to do when it is not found.

use super::{Session, standpoint, wheels_of};
use crate::egomotion::{Egomotion, EgomotionRules, egomotion};
use crate::filter::Motion;
use crate::fix::{Fix, Refusal};
use crate::hardware::{Frame, fault};
use crate::report::{sighting, sigma_mm, worst_sigma_mm};
use crate::view::View;
use nalgebra::Vector3;
use rover_messages::{
    Fault,
    approach::{ApproachStop, SeenMotion, Sighting},
    mobility::WheelsState,
    status::work,
};

/// What the prediction of a pixel may be off besides, px.
const UNKNOWN_PX: f64 = 1.0;

/// Stops in a row at which the target may be missed.
const MISSES_N: u32 = 1;

/// The same while the rover's own body or the edge of its shadow passes over it, or landmarks tell
/// the way.
const LONG_MISSES_N: u32 = 5;

/// Largest uncertainty with which a missed target is carried on by odometry, mm, one sigma.
const MISSED_SIGMA_MM: f64 = 120.0;

/// A part of the rover that comes so near to the line of sight hides the target, m.
const HIDING_M: f64 = 0.01;

impl Session<'_> {
    /// After a motion: where is the target now, and is it known well enough?
    pub(super) async fn look(&mut self, motion: &Motion, near: bool) -> Result<(), Fault> {
        self.track(motion, near).await?;
        let worst = worst_sigma_mm(&self.estimate.covariance_m2);
        if let Some(limit) = self.goal.limits.max_sigma_mm
            && near
            && worst > limit
        {
            return Err(fault(
                "target_uncertain",
                format!("the target is uncertain by {worst:.1} mm, limit {limit} mm"),
            )
            .with("sigma_mm", worst));
        }
        Ok(())
    }

    /// Points the mast at the target, takes an image, finds the target; another image of the same
    /// stop after a refusal.
    async fn track(&mut self, odometry: &Motion, near: bool) -> Result<(), Fault> {
        let last = self.estimate;
        self.estimate = last.predicted(odometry);
        self.point_at(&self.estimate.position_m.clone()).await?;
        let pointing_rad = self.mast.quality.pointing_deg.to_radians();
        let mount_rad = self.mast.quality.angle_deg.to_radians();
        let mut sightings = Vec::new();
        for exposure_n in 0..2 {
            let frame = self
                .hardware
                .capture(&self.goal.target.pair, exposure_n)
                .await?;
            let wheels = wheels_of(&frame)?;
            let camera = &frame.view.cameras.left;
            let eye = camera.model.cahv()[0];
            let expected = odometry.seen_from(eye, mount_rad, pointing_rad);
            let seen = self.seen_motion(&frame, &expected);
            let motion = seen.map_or(expected, |seen| seen.motion);
            self.estimate = last.predicted(&motion);
            let spread = self
                .estimate
                .pixel_covariance(camera, UNKNOWN_PX)
                .ok_or_else(|| fault("target_lost", "the target is behind the camera"))?;
            let predicted_px = self.tracker.predicted_pixel(camera, &motion.now_from_last);
            let found = if self.shade.hides(&self.estimate.position_m, eye, HIDING_M) {
                Err(Refusal::hidden())
            } else {
                self.hardware.shell.timed(work::VISION, || {
                    self.tracker
                        .update(&frame.view, &motion.now_from_last, &spread, near)
                })
            };
            sightings.push(sighting(
                &frame.reference,
                predicted_px,
                &spread,
                self.tracker.rules().search_sigma,
                &found,
                exposure_n > 0,
            ));
            let fix = match found {
                Ok(fix) => fix,
                Err(refusal) if exposure_n > 0 => {
                    return self.missed(&motion, sightings, (frame, wheels, seen), &refusal);
                }
                Err(_) => continue,
            };
            self.estimate
                .update(&fix.surface.plane.point, &fix.surface.covariance_m2)
                .map_err(|e| fault("target_lost", e.to_string()))?;
            // what the tracked pixel says counts; the filter is for the prediction
            self.estimate.position_m = fix.surface.plane.point;
            self.budget.tracked(&fix, &standpoint(&frame, &wheels));
            (self.now, self.wheels) = (frame, wheels);
            self.remember_ground();
            self.record(sightings, seen, &fix);
            return Ok(());
        }
        Err(fault("target_lost", "no image was accepted"))
    }

    /// The motion since the last stop as the pictures tell it, if they do.
    fn seen_motion(&self, frame: &Frame, odometry: &Motion) -> Option<Egomotion> {
        let views = [&*self.now.view, &*frame.view];
        let usable = |view: &View, place: &Vector3<f64>| {
            let eye = view.cameras.left.model.cahv()[0];
            let shadow = view.own_shadow.as_ref();
            !self.shade.hides(place, eye, HIDING_M)
                && !self.shade.touches(place, HIDING_M)
                && !shadow.is_some_and(|shadow| shadow.has_edge_at(place))
        };
        let rules = EgomotionRules::default();
        let seen = self.hardware.shell.timed(work::VISION, || {
            egomotion(views, &self.landmarks, odometry, usable, &rules)
        });
        seen.inspect_err(|reason| tracing::debug!(%reason, "odometry alone tells the motion"))
            .ok()
    }

    /// The target was not found in either image of a stop. While the position is still known well
    /// enough to search for it again, odometry carries it one stop further: a passing shadow or a
    /// blur of one place is no reason to give up, and the next stop must find the target.
    fn missed(
        &mut self,
        motion: &Motion,
        sightings: Vec<Sighting>,
        (frame, wheels, seen): (Frame, WheelsState, Option<Egomotion>),
        refusal: &Refusal,
    ) -> Result<(), Fault> {
        self.missed_n += 1;
        let range_m = self.estimate.position_m.xy().norm();
        let worst_mm = worst_sigma_mm(&self.estimate.covariance_m2);
        // Where landmarks tell the way, it is known as well as the target was.
        let most_n = if refusal.by_the_rover() || seen.is_some() {
            LONG_MISSES_N
        } else {
            MISSES_N
        };
        if self.missed_n > most_n || worst_mm > MISSED_SIGMA_MM {
            let [u_px, v_px] = sightings.last().map_or([0.0; 2], |s| s.predicted_px);
            return Err(fault("target_lost", refusal.to_string())
                .with("range_m", range_m)
                .with("sigma_mm", worst_mm)
                .with("predicted_u_px", u_px)
                .with("predicted_v_px", v_px));
        }
        self.tracker.coast(&motion.now_from_last);
        (self.now, self.wheels) = (frame, wheels);
        self.remember_ground();
        self.note_stop(sightings, seen);
        Ok(())
    }

    fn record(&mut self, sightings: Vec<Sighting>, seen: Option<Egomotion>, fix: &Fix) {
        self.missed_n = 0;
        self.note_stop(sightings, seen);
        self.tell_sighting(fix.pixel_px.into(), fix.score);
    }

    fn note_stop(&mut self, sightings: Vec<Sighting>, seen: Option<Egomotion>) {
        let stop_n = self.stops.len() as u32 + 1;
        self.stops.push(ApproachStop {
            stop_n,
            sim_time_s: self.now.frame.images.sim_time_s,
            pose: self.wheels.pose,
            range_m: self.estimate.position_m.xy().norm(),
            sightings,
            position_m: self.estimate.position_m.into(),
            sigma_mm: sigma_mm(&self.estimate.covariance_m2),
            slip: self.wheels.slip,
            seen_motion: seen.map(|seen| SeenMotion {
                agreeing_n: seen.agreeing_n as u32,
                found_n: seen.found_n as u32,
                rms_px: seen.rms_px,
            }),
        });
    }
}
