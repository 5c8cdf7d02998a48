//! Pictures and numbers for a report, gathered while a mission runs. What cannot be had is left
//! out of the report and said on the log; it never ends a mission.

use rover_bus::{BusError, Peer};
use rover_messages::{
    Fault, Nothing,
    approach::DriveToFeedback,
    imaging::{CaptureRequest, ImageData, StereoFrame},
    keys,
    placement::Look,
    simulation::{Score, TruthState, View, ViewRequest},
    target::Target,
};
use std::time::Duration;

/// What a report shows besides the [`crate::report::RunReport`].
#[derive(Clone, Debug, Default)]
pub struct Evidence {
    /// The images in which the target was designated.
    pub designation: Option<StereoFrame>,
    /// The target as the approach found it again at its stops.
    pub stops: Vec<StopPicture>,
    /// The last image of an approach that failed, and where the target was expected in it, px.
    pub lost: Option<(ImageData, Option<[f64; 2]>)>,
    /// Outside views of the rover: where it set out from, and where it stands before the target.
    pub chase_views: Vec<ImageData>,
    /// The target in the pair that the arm works with.
    pub handed_over: Option<Target>,
    /// The images at the end of the servo.
    pub standoff: Option<StereoFrame>,
    /// Outside view of the instrument in contact, or where the contact motion ended.
    pub contact_view: Option<ImageData>,
    /// Outside view of the whole arm at the end of the contact motion.
    pub scene_view: Option<ImageData>,
    /// Looks at the fiducial.
    pub looks: Vec<Look>,
    /// The target.
    pub target: Option<Target>,
    /// The full score.
    pub score: Option<Score>,
}

/// The target in one image of the approach.
#[derive(Clone, Debug)]
pub struct StopPicture {
    /// The left image.
    pub image: ImageData,
    /// Where the target was found, px.
    pub pixel_px: [f64; 2],
    /// Believed distance along the ground, m.
    pub range_m: f64,
    /// Correlation of the match, 0 to 1.
    pub score: Option<f64>,
}

/// An outside camera: where it stands and what it looks at, both seen from the instrument's tip
/// (or, for the chase camera, from the rover frame's origin) along the rover's heading, and its
/// horizontal field of view.
struct Outside {
    eye_m: [f64; 3],
    look_at_m: [f64; 3],
    field_of_view_deg: f64,
}

/// The instrument, from the right and behind: the side that the sun and the fiducial are on.
const CLOSE: Outside = Outside {
    eye_m: [-0.20, -0.42, 0.16],
    look_at_m: [0.0, 0.0, 0.035],
    field_of_view_deg: 27.0,
};
/// The whole arm, from the front right.
const WIDE: Outside = Outside {
    eye_m: [0.75, -1.15, 0.55],
    look_at_m: [-0.14, 0.03, 0.06],
    field_of_view_deg: 40.0,
};

/// The whole rover, from behind and to the right.
const CHASE: Outside = Outside {
    eye_m: [-2.6, -1.9, 1.9],
    look_at_m: [0.7, 0.1, 0.4],
    field_of_view_deg: 50.0,
};

impl Evidence {
    /// Keeps the picture of a stop at which the target was found.
    pub(crate) async fn under_way(
        &mut self,
        peer: &Peer,
        feedback: &DriveToFeedback,
        limit: Duration,
    ) {
        if self.chase_views.is_empty() {
            self.chase(peer, limit).await;
        }
        let (Some(frame), Some(pixel_px)) = (&feedback.frame, feedback.pixel_px) else {
            return;
        };
        let key = keys::imaging_recall(&frame.pair);
        let recalled = peer.ask(&key, frame, limit);
        if let Some(frame) = kept::<StereoFrame>("image of a stop", recalled.await) {
            self.stops.push(StopPicture {
                image: frame.images.left,
                pixel_px,
                range_m: feedback.range_m,
                score: feedback.score,
            });
        }
    }

    /// Keeps what the tracking pair sees where an approach failed.
    pub(crate) async fn lost(&mut self, peer: &Peer, pair: &str, fault: &Fault, limit: Duration) {
        let detail = |name: &str| fault.details.get(name).copied();
        let expected = detail("predicted_u_px").zip(detail("predicted_v_px"));
        let frame = kept("image", capture(peer, pair, limit).await);
        self.lost = frame.map(|f| (f.images.left, expected.map(|(u, v)| [u, v])));
        self.chase(peer, limit).await;
    }

    pub(crate) async fn arrived(&mut self, peer: &Peer, limit: Duration) {
        self.chase(peer, limit).await;
    }

    async fn chase(&mut self, peer: &Peer, limit: Duration) {
        self.chase_views
            .extend(kept("view", view(peer, &CHASE, About::Rover, limit).await));
    }

    pub(crate) async fn at_standoff(&mut self, peer: &Peer, pair: &str, limit: Duration) {
        self.standoff = kept("images", capture(peer, pair, limit).await);
    }

    /// Keeps a look that is not yet known.
    pub(crate) fn look(&mut self, look: &Look) {
        if self.looks.last().is_none_or(|last| last.step != look.step) {
            self.looks.push(look.clone());
        }
    }

    pub(crate) async fn in_contact(&mut self, peer: &Peer, limit: Duration) {
        if self.contact_view.is_none() {
            self.contact_view = kept("view", view(peer, &CLOSE, About::Tip, limit).await);
        }
    }

    pub(crate) async fn after_contact(&mut self, peer: &Peer, limit: Duration) {
        self.in_contact(peer, limit).await;
        self.after_servo(peer, limit).await;
    }

    pub(crate) async fn after_servo(&mut self, peer: &Peer, limit: Duration) {
        self.scene_view = kept("view", view(peer, &WIDE, About::Tip, limit).await);
    }
}

fn kept<T>(what: &str, asked: Result<T, BusError>) -> Option<T> {
    asked
        .inspect_err(|error| tracing::warn!(%error, "{what} for the report could not be had"))
        .ok()
}

async fn capture(peer: &Peer, pair: &str, limit: Duration) -> Result<StereoFrame, BusError> {
    peer.ask(
        &keys::imaging_capture(pair),
        &CaptureRequest::default(),
        limit,
    )
    .await
}

/// What an outside camera is placed by.
#[derive(Clone, Copy, PartialEq)]
enum About {
    Tip,
    Rover,
}

async fn view(
    peer: &Peer,
    from: &Outside,
    about: About,
    limit: Duration,
) -> Result<ImageData, BusError> {
    let truth: TruthState = peer.ask(keys::SIM_TRUTH_STATE, &Nothing {}, limit).await?;
    let origin_m = match (about, &truth.rover) {
        (About::Rover, Some(rover)) => rover.position_m,
        _ => truth.tip_in_world_m,
    };
    let (sin, cos) = truth.rover.map_or(0.0, |rover| rover.rpy_rad[2]).sin_cos();
    let at = |[x, y, z]: [f64; 3]| {
        let turned = [cos * x - sin * y, sin * x + cos * y, z];
        [0, 1, 2].map(|i| origin_m[i] + turned[i])
    };
    let request = ViewRequest {
        eye_m: at(from.eye_m),
        look_at_m: at(from.look_at_m),
        width_px: 720,
        height_px: 540,
        field_of_view_deg: from.field_of_view_deg,
    };
    let view: View = peer.ask(keys::SIM_TRUTH_VIEW, &request, limit).await?;
    Ok(view.image)
}
