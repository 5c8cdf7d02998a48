//! The imaging service on the network: `imaging/<pair>/capture`, `.../left` and `.../right` for
//! every camera pair of the robot, and `.../recall` for the last frames again; `.../panorama` and
//! its picture `.../mosaic` for pairs on the mast.

use crate::{SERVICE, attach_models, panorama};
use rover_bus::{BusError, Peer, PictureStream};
use rover_messages::{
    Fault,
    imaging::{CaptureRequest, FrameReference, ImageData, RawPair, StereoFrame},
    keys,
    mobility::{PointFeedback, PointGoal, PointResult},
    panorama::{Panorama, PanoramaRequest, PanoramaView},
    status::work,
};
use rover_robot::{CameraMount, CameraPairDescription, Robot};
use rover_service::{Service, ServiceShell};
use rover_vision::{Image8, encode_png};
use std::{
    collections::VecDeque,
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

/// Wall-clock limit for one exposure.
const GRAB_LIMIT: Duration = Duration::from_secs(60);

/// Frames of each pair that can be recalled.
const KEPT_FRAMES: usize = 8;

/// Starts the service on `peer`; it lives as long as the returned value.
///
/// # Errors
/// [`BusError`] when a key cannot be declared or the name is taken.
pub async fn serve(peer: &Peer, robot: Arc<Robot>) -> Result<Service, BusError> {
    let shell = ServiceShell::new(peer, &robot, SERVICE).await?;
    let mut served = Vec::new();
    for pair in &robot.description().cameras {
        let desk = Arc::new(Desk {
            peer: peer.clone(),
            shell: shell.clone(),
            left: peer
                .picture_stream(&keys::imaging_picture(&pair.name, "left"))
                .await?,
            right: peer
                .picture_stream(&keys::imaging_picture(&pair.name, "right"))
                .await?,
            mosaic: peer
                .picture_stream(&keys::imaging_picture(&pair.name, "mosaic"))
                .await?,
            robot: robot.clone(),
            pair: pair.clone(),
            kept: Mutex::default(),
        });
        if pair.mount == CameraMount::Mast {
            let desk = desk.clone();
            let key = keys::imaging_panorama(&pair.name);
            let panorama = peer.serve(&key, move |request: PanoramaRequest| {
                let desk = desk.clone();
                async move { desk.panorama(request).await }
            });
            served.push(panorama.await?);
        }
        let recalling = desk.clone();
        let key = keys::imaging_recall(&pair.name);
        let recall = peer.serve(&key, move |reference: FrameReference| {
            let desk = recalling.clone();
            async move { desk.recall(&reference) }
        });
        served.push(recall.await?);
        let key = keys::imaging_capture(&pair.name);
        let capture = peer.serve(&key, move |request: CaptureRequest| {
            let desk = desk.clone();
            async move { desk.capture(request).await }
        });
        served.push(capture.await?);
    }
    shell.start(served).await
}

struct Desk {
    peer: Peer,
    shell: ServiceShell,
    robot: Arc<Robot>,
    pair: CameraPairDescription,
    /// The last frames with their exposures.
    kept: Mutex<VecDeque<(u32, StereoFrame)>>,
    left: PictureStream,
    right: PictureStream,
    mosaic: PictureStream,
}

impl Desk {
    async fn capture(&self, request: CaptureRequest) -> Result<StereoFrame, Fault> {
        let _activity = self.shell.activity("capturing");
        self.shell.answered(self.captured(request).await, "frames")
    }

    fn keep(&self, exposure_n: u32, frame: &StereoFrame) {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        kept.retain(|(n, f)| (*n, f.images.step) != (exposure_n, frame.images.step));
        if kept.len() == KEPT_FRAMES {
            kept.pop_front();
        }
        kept.push_back((exposure_n, frame.clone()));
    }

    fn recall(&self, reference: &FrameReference) -> Result<StereoFrame, Fault> {
        let kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        let found = kept
            .iter()
            .find(|(n, f)| (*n, f.images.step) == (reference.exposure_n, reference.step))
            .filter(|_| reference.pair == self.pair.name)
            .map(|(_, f)| f.clone());
        let known: Vec<String> = kept
            .iter()
            .map(|(n, f)| format!("{}/{n}", f.images.step))
            .collect();
        drop(kept);
        let answer = found.ok_or_else(|| {
            let message = format!(
                "no frame of the pair `{}` with step {} and exposure {}; the last ones are \
                 (step/exposure): {}",
                reference.pair,
                reference.step,
                reference.exposure_n,
                known.join(", ")
            );
            Fault::new(SERVICE, "frame_forgotten", message)
        });
        self.shell.answered(answer, "recalls")
    }

    async fn captured(&self, request: CaptureRequest) -> Result<StereoFrame, Fault> {
        let key = keys::camera_grab(&self.pair.name);
        let images: RawPair = self
            .peer
            .ask(&key, &request, GRAB_LIMIT)
            .await
            .map_err(|e| e.into_fault(SERVICE))?;
        let frame = attach_models(images, &self.robot, &self.pair)?;
        self.keep(request.exposure_n, &frame);
        show(&self.left, &frame.images.left);
        show(&self.right, &frame.images.right);
        Ok(frame)
    }
}

impl Desk {
    async fn panorama(&self, request: PanoramaRequest) -> Result<Panorama, Fault> {
        let _activity = self.shell.activity("looking round");
        self.shell
            .answered(self.looked_round(request).await, "panoramas")
    }

    async fn looked_round(&self, request: PanoramaRequest) -> Result<Panorama, Fault> {
        let mast = self
            .robot
            .mast()
            .map_err(|e| Fault::new(SERVICE, "no_mast", e.to_string()))?;
        let stops = panorama::stops(&request, &self.pair.cameras.left, mast)?;
        let (mut views, mut pictures) = (Vec::new(), Vec::new());
        for [pan_rad, tilt_rad] in stops {
            let state = self.point(PointGoal { pan_rad, tilt_rad }).await?.state;
            let frame = self.captured(CaptureRequest::default()).await?;
            let left = frame.cameras.left.clone();
            pictures.push((left.clone(), frame.images.left));
            views.push(PanoramaView {
                frame: FrameReference {
                    pair: self.pair.name.clone(),
                    step: frame.images.step,
                    exposure_n: 0,
                },
                mast: state,
                left,
            });
        }
        let made = self.shell.timed(work::VISION, || {
            panorama::mosaic(&pictures, request.pixel_rad)
        })?;
        show(&self.mosaic, &made.image);
        Ok(Panorama {
            mosaic: made.image,
            azimuth_rad: made.azimuth_rad,
            elevation_rad: made.elevation_rad,
            pixel_rad: made.pixel_rad,
            eye_m: made.eye_m.into(),
            views,
        })
    }

    /// Points the mast; its heartbeats come from here.
    async fn point(&self, goal: PointGoal) -> Result<PointResult, Fault> {
        let command = self
            .peer
            .command::<_, PointFeedback, PointResult>(keys::MAST_POINT, &goal);
        let mut running = command.await.map_err(|e| e.into_fault(SERVICE))?;
        loop {
            let report = running.beat().await.map_err(|e| e.into_fault(SERVICE))?;
            if let Some(fault) = report.fault {
                return Err(fault);
            }
            if let Some(result) = report.result {
                return Ok(result);
            }
        }
    }
}

/// Publishes an image as a picture, encoded only if somebody looks.
fn show(stream: &PictureStream, image: &ImageData) {
    let image = Image8 {
        width_px: image.width_px,
        height_px: image.height_px,
        pixels: image.pixels.clone(),
    };
    let published = stream.publish("image/png", move || match encode_png(&image) {
        Ok(png) => png.into(),
        Err(error) => {
            tracing::warn!(%error, "an image could not be encoded");
            Arc::default()
        }
    });
    if let Err(error) = published {
        tracing::warn!(%error, "a picture could not be published");
    }
}
