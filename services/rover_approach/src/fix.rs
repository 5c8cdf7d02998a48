//! What came of looking for the target at a stop: a fix, or a refusal with every attempt's reason.

use crate::error::TrackError;
use crate::surface::StereoPlane;
use nalgebra::Vector2;

/// How a fix was obtained.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Attempt {
    /// Translation, then affine.
    Affine,
    /// Translation only.
    Translation,
    /// With the anchor before the last one.
    PreviousAnchor,
    /// With the target as it was found at the last stop: an anchor that would not have been made
    /// yet, because every one adds its error.
    LastStop,
}

/// The target found again.
#[derive(Clone, Debug)]
pub struct Fix {
    /// Pixel in the left image.
    pub pixel_px: Vector2<f64>,
    /// Surface there, from stereo.
    pub surface: StereoPlane,
    /// Weighted correlation with the anchor.
    pub score: f64,
    /// Best correlation elsewhere in the search.
    pub second_score: f64,
    /// How far tracking back ends from the anchor pixel, anchor px.
    pub back_px: f64,
    /// Distance from the prediction, px.
    pub innovation_px: Vector2<f64>,
    /// That distance in standard deviations of the prediction.
    pub innovation_sigma: f64,
    /// Standard deviation of the pixel, px.
    pub sigma_px: f64,
    /// What succeeded.
    pub attempt: Attempt,
    /// Whether the target was anchored anew here.
    pub anchored: bool,
    /// Move of the hit by the relief correction, px.
    pub relief_px: Vector2<f64>,
}

/// A stop at which the target was not found: every attempt with its reason.
#[derive(Clone, Debug, PartialEq)]
pub struct Refusal {
    /// Attempts in order.
    pub attempts: Vec<(Attempt, TrackError)>,
}

impl std::fmt::Display for Refusal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        for (i, (attempt, error)) in self.attempts.iter().enumerate() {
            let separator = if i == 0 { "" } else { "; " };
            let name = match attempt {
                Attempt::Affine => "affine",
                Attempt::Translation => "translation only",
                Attempt::PreviousAnchor => "previous anchor",
                Attempt::LastStop => "last stop",
            };
            write!(f, "{separator}{name}: {error}")?;
        }
        Ok(())
    }
}

impl Refusal {
    /// Of a target that the rover itself hides: nothing was attempted, because what is seen there
    /// is not the target.
    #[must_use]
    pub fn hidden() -> Self {
        Self {
            attempts: vec![(Attempt::Affine, TrackError::Hidden)],
        }
    }

    /// Whether the rover's own body or shadow was in the way of an attempt.
    #[must_use]
    pub fn by_the_rover(&self) -> bool {
        self.attempts
            .iter()
            .any(|(_, e)| matches!(e, TrackError::OwnShadow { .. } | TrackError::Hidden))
    }
}

impl std::error::Error for Refusal {}
