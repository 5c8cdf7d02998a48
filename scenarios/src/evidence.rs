//! Pictures and numbers for a report, gathered while a mission runs. What cannot be had is left
//! out of the report and said on the log; it never ends a mission.

use rover_bus::{BusError, Peer};
use rover_messages::{
    Nothing,
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

/// An outside camera: where it stands and what it looks at, both seen from the instrument's tip,
/// and its horizontal field of view.
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

impl Evidence {
    pub(crate) async fn designated(&mut self, peer: &Peer, pair: &str, limit: Duration) {
        self.designation = kept("images", capture(peer, pair, limit).await);
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
            self.contact_view = kept("view", view(peer, &CLOSE, limit).await);
        }
    }

    pub(crate) async fn after_contact(&mut self, peer: &Peer, limit: Duration) {
        self.in_contact(peer, limit).await;
        self.scene_view = kept("view", view(peer, &WIDE, limit).await);
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

async fn view(peer: &Peer, from: &Outside, limit: Duration) -> Result<ImageData, BusError> {
    let truth: TruthState = peer.ask(keys::SIM_TRUTH_STATE, &Nothing {}, limit).await?;
    let tip = truth.tip_in_world_m;
    let at = |offset: [f64; 3]| [0, 1, 2].map(|i| tip[i] + offset[i]);
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
