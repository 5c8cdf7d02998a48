//! How an error grows with the distance from where the vector was taken: what the studies of
//! figures 6 and 7 have in common.

use super::{StudyError, statistics::Line};
use serde::Serialize;

/// Distances that the straight line is fitted to, m.
const FITTED_M: (f64, f64) = (0.02, 0.40);
/// The distance of the paper's sentence, m.
pub const SENTENCE_M: f64 = 0.16;

/// The straight line of the errors between 2 and 40 cm.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Growth {
    /// Slope of the error of one vector, mm/m.
    pub slope_mm_per_m: f64,
    /// The line's value at no distance, mm.
    pub intercept_mm: f64,
    /// Share of the variance that the line explains.
    pub r2: f64,
    /// The line's value at 16 cm, mm.
    pub error_at_16cm_mm: f64,
}

impl Growth {
    /// The line through errors (mm) at distances (m).
    ///
    /// # Errors
    /// [`StudyError::NoTrials`] for fewer than three distances in the fitted range.
    pub fn of(
        errors: impl Iterator<Item = (f64, f64)>,
        what: &'static str,
    ) -> Result<Self, StudyError> {
        let fitted: Vec<(f64, f64)> = errors
            .filter(|(distance_m, _)| (FITTED_M.0..=FITTED_M.1).contains(distance_m))
            .collect();
        let line = Line::fit(&fitted).ok_or(StudyError::NoTrials { what })?;
        Ok(Self {
            slope_mm_per_m: line.slope,
            intercept_mm: line.intercept,
            r2: line.r2,
            error_at_16cm_mm: line.at(SENTENCE_M),
        })
    }

    /// Distance at which the line reaches an error, m; none if it never does.
    pub fn reaches_m(&self, error_mm: f64) -> Option<f64> {
        let at = (error_mm - self.intercept_mm) / self.slope_mm_per_m;
        (at.is_finite() && at > 0.0).then_some(at)
    }
}

/// Smallest and largest of some numbers.
pub(crate) fn range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), x| {
        (a.min(x), b.max(x))
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn only_the_middle_distances_are_fitted_and_the_line_is_read_off() {
        let on_line = [0.05, 0.1, 0.2, 0.3].map(|x| (x, 1.0 + 30.0 * x));
        let outside = [(0.0, 9.0), (0.5, 0.0)];
        let growth = Growth::of(on_line.into_iter().chain(outside), "test").unwrap();
        assert!((growth.slope_mm_per_m - 30.0).abs() < 1e-9);
        assert!((growth.error_at_16cm_mm - 5.8).abs() < 1e-9);
        assert!((growth.reaches_m(4.0).unwrap() - 0.1).abs() < 1e-9);
        assert!(growth.reaches_m(0.5).is_none());
        assert!(Growth::of(outside.into_iter(), "test").is_err());
    }
}
