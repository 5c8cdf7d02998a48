//! Why a target could not be tracked or handed over.

/// Why there is no answer, with the numbers behind it.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum TrackError {
    /// Images and camera models do not belong together.
    #[error("view: {0}")]
    BadView(String),
    /// A number that cannot be worked with.
    #[error("{what} is {found}, expected {expected}")]
    BadInput {
        /// Which.
        what: String,
        /// Its value.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// The target's window leaves the image.
    #[error("the window of {columns} x {rows} px about ({u_px:.1}, {v_px:.1}) leaves the image")]
    OutsideImage {
        /// Pixel.
        u_px: f64,
        /// Pixel.
        v_px: f64,
        /// Width of the window.
        columns: usize,
        /// Height of the window.
        rows: usize,
    },
    /// No stereo match at the target, so no plane.
    #[error("no surface plane at ({u_px:.1}, {v_px:.1}): {reason}")]
    NoPlane {
        /// Pixel.
        u_px: f64,
        /// Pixel.
        v_px: f64,
        /// What the match said.
        reason: String,
    },
    /// Nothing in the search window looks like the target.
    #[error("best correlation {score:.3} in a search of {columns} x {rows} px, need {limit}")]
    LowScore {
        /// Best weighted correlation.
        score: f64,
        /// Least accepted.
        limit: f64,
        /// Width of the search.
        columns: usize,
        /// Height of the search.
        rows: usize,
    },
    /// The refinement ran away.
    #[error("the refinement left its bounds: {what} {found:.3}, limit {limit}")]
    Diverged {
        /// Which bound.
        what: &'static str,
        /// Value.
        found: f64,
        /// Bound.
        limit: f64,
    },
    /// Tracking back does not lead to where the target was.
    #[error("tracked back, the target is {distance_px:.2} px off, limit {limit_px}")]
    NotMutual {
        /// Distance, px.
        distance_px: f64,
        /// Limit, px.
        limit_px: f64,
    },
    /// The surface is seen edge on, from behind, or behind the camera.
    #[error("the target's surface cannot be seen from here")]
    NotVisible,
    /// A match in the other camera pair lies too far from where geometry puts it.
    #[error("the match lies {distance_px:.1} px from where geometry puts it, limit {limit_px}")]
    OffGeometry {
        /// Distance, px.
        distance_px: f64,
        /// Limit, px.
        limit_px: f64,
    },
    /// Two independent matches disagree.
    #[error(
        "matches from the left and the right mast camera differ by {distance_px:.2} px, limit \
             {limit_px}"
    )]
    SidesDisagree {
        /// Distance, px.
        distance_px: f64,
        /// Limit, px.
        limit_px: f64,
    },
    /// Another place of the search looks as much like the target.
    #[error(
        "correlation {score:.3}, and {second_score:.3} elsewhere in the search, need {margin} more"
    )]
    NotUnique {
        /// Best correlation of the search.
        score: f64,
        /// Best correlation elsewhere.
        second_score: f64,
        /// Least difference.
        margin: f64,
    },
    /// A match too far from where the target was expected.
    #[error(
        "the match lies {distance_px:.1} px from where it was expected, {sigmas:.1} standard deviations, limit {limit}"
    )]
    Unexpected {
        /// Distance, px.
        distance_px: f64,
        /// The same in standard deviations.
        sigmas: f64,
        /// Limit.
        limit: f64,
    },
    /// A part of the rover is in the line of sight.
    #[error("the rover's own body is between the camera and the target")]
    Hidden,
    /// The edge of the rover's own shadow lies on the template.
    #[error("the rover's own shadow leaves {:.0} % of the template, need {:.0} %", part * 100.0, limit * 100.0)]
    OwnShadow {
        /// Part of the template's weight that is lit alike in both pictures.
        part: f64,
        /// Least part.
        limit: f64,
    },
    /// The target's window holds something that one plane cannot describe.
    #[error("the surface about the target is no plane: correlation {score:.3}, need {limit}")]
    NotPlanar {
        /// Correlation of the stereo match over the template's window.
        score: f64,
        /// Least accepted.
        limit: f64,
    },
}
