//! Mast, wheels and cameras on behalf of the approach: goals with heartbeats, frames by name.

use crate::own_shadow::OwnShadow;
use crate::shade::Shade;
use crate::view::View;
use nalgebra::Vector3;
use rover_bus::{BusError, GoalContext, Peer};
use rover_messages::{
    Fault, Wire,
    approach::DriveToFeedback,
    arm::ArmState,
    imaging::{CaptureRequest, FrameReference, StereoFrame},
    keys::{self, service::ROVER_APPROACH},
    mobility::{
        DriveArc, DriveFeedback, DriveGoal, DriveGuard, DriveResult, PointFeedback, PointGoal,
        PointResult,
    },
    status::work,
    target::{SelectRequest, Target},
};
use rover_service::{ServiceShell, frames::prepared, motion::interrupted};
use std::{sync::Arc, time::Duration};

/// Wall-clock limit for one answer.
const ANSWER_LIMIT: Duration = Duration::from_secs(60);

/// A fault of this service.
pub(crate) fn fault(name: &str, message: impl Into<String>) -> Fault {
    Fault::new(ROVER_APPROACH, name, message)
}

/// What moves and sees, commanded by one goal.
pub(crate) struct Hardware<'a> {
    pub peer: &'a Peer,
    pub context: &'a GoalContext<DriveToFeedback>,
    /// What casts the rover's own shadow, if the sun is known.
    pub light: Option<Light>,
    /// Counts the time that computing takes.
    pub shell: &'a ServiceShell,
}

/// The sun and what of the rover is in its way.
pub(crate) struct Light {
    pub shade: Arc<Shade>,
    /// Unit vector towards the sun, site frame.
    pub sun_in_site: Vector3<f64>,
}

/// A frame ready for matching.
#[derive(Clone)]
pub(crate) struct Frame {
    pub view: Arc<View>,
    pub frame: Arc<StereoFrame>,
    pub reference: FrameReference,
}

impl Hardware<'_> {
    /// Points the mast.
    pub async fn point(&self, pan_rad: f64, tilt_rad: f64) -> Result<(), Fault> {
        let goal = PointGoal { pan_rad, tilt_rad };
        self.command::<_, PointFeedback, PointResult>(keys::MAST_POINT, &goal, "mast_silent")
            .await
            .map(|_| ())
    }

    /// Drives one movement.
    pub async fn drive(&self, arc: DriveArc, max_slip: Option<f64>) -> Result<DriveResult, Fault> {
        let goal = DriveGoal {
            arc,
            speed_fraction: 1.0,
            guard: DriveGuard {
                max_slip,
                max_tilt_rad: None,
            },
        };
        self.command::<_, DriveFeedback, DriveResult>(keys::WHEELS_DRIVE, &goal, "wheels_silent")
            .await
    }

    /// Takes a stereo frame.
    pub async fn capture(&self, pair: &str, exposure_n: u32) -> Result<Frame, Fault> {
        let request = CaptureRequest { exposure_n };
        let frame: StereoFrame = self
            .peer
            .ask(&keys::imaging_capture(pair), &request, ANSWER_LIMIT)
            .await
            .map_err(|e| e.into_fault(ROVER_APPROACH))?;
        self.shell
            .timed(work::VISION, || self.ready(frame, exposure_n))
    }

    /// Where the arm is, rad.
    pub async fn joints_rad(&self) -> Result<Vec<f64>, Fault> {
        let state: ArmState = self
            .peer
            .latest(keys::ARM_STATE, ANSWER_LIMIT)
            .await
            .map_err(|e| e.into_fault(ROVER_APPROACH))?;
        Ok(state.joints_rad)
    }

    /// One of the last frames again.
    pub async fn recall(&self, reference: &FrameReference) -> Result<Frame, Fault> {
        let frame: StereoFrame = self
            .peer
            .ask(
                &keys::imaging_recall(&reference.pair),
                reference,
                ANSWER_LIMIT,
            )
            .await
            .map_err(|e| e.into_fault(ROVER_APPROACH))?;
        self.ready(frame, reference.exposure_n)
    }

    /// The target at a pixel, with normal, roughness and covariance.
    pub async fn select(&self, pair: &str, pixel_px: [f64; 2]) -> Result<Target, Fault> {
        let request = SelectRequest {
            pair: pair.into(),
            pixel_px,
        };
        self.peer
            .ask(keys::TARGET_SELECT, &request, ANSWER_LIMIT)
            .await
            .map_err(|e| e.into_fault(ROVER_APPROACH))
    }

    fn ready(&self, frame: StereoFrame, exposure_n: u32) -> Result<Frame, Fault> {
        let (left, right) = prepared(ROVER_APPROACH, &frame)?;
        let view = View::new(left, right, frame.cameras.clone())
            .map_err(|e| fault("bad_frame", e.to_string()))?
            .shadowed(self.own_shadow(&frame));
        Ok(Frame {
            view: Arc::new(view),
            reference: FrameReference {
                pair: frame.images.pair.clone(),
                step: frame.images.step,
                exposure_n,
            },
            frame: Arc::new(frame),
        })
    }

    fn own_shadow(&self, frame: &StereoFrame) -> Option<OwnShadow> {
        let light = self.light.as_ref()?;
        let pose = &frame.images.wheels.as_ref()?.pose;
        let rover_from_site = pose.site_from_rover().isometry.inverse();
        let sun = rover_from_site.rotation * light.sun_in_site;
        Some(OwnShadow::new(Arc::clone(&light.shade), sun))
    }

    /// Carries out a lockstep action; every heartbeat comes from this loop. An interruption of our
    /// own goal cancels it.
    async fn command<G, F, R>(&self, key: &str, goal: &G, silent: &str) -> Result<R, Fault>
    where
        G: Wire,
        F: Wire,
        R: Wire,
    {
        let lost = |error: BusError| match error {
            BusError::Fault(fault) => fault,
            other => fault(silent, other.to_string()),
        };
        let mut running = self
            .peer
            .command::<_, F, R>(key, goal)
            .await
            .map_err(lost)?;
        let mut interruption = None;
        loop {
            if interruption.is_none()
                && let Some(interrupt) = self.context.interrupted()
            {
                interruption = Some(interrupted(ROVER_APPROACH, &interrupt));
                running.cancel().await.map_err(lost)?;
            }
            match (running.beat().await, &interruption) {
                (Ok(report), _) => {
                    if let Some(fault) = report.fault {
                        return Err(interruption.unwrap_or(fault));
                    }
                    if let Some(result) = report.result {
                        return interruption.map_or(Ok(result), Err);
                    }
                }
                (Err(_), Some(fault)) => return Err(fault.clone()),
                (Err(error), None) => return Err(lost(error)),
            }
        }
    }
}
