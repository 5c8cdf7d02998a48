//! What the experiment says, from its own numbers.

use super::{
    AtReference, Experiment, Reference,
    sources::{EVERYTHING, EXACT_LENSES, EXACT_SIGHT, NO_DROOP, NO_NOISE},
};
use crate::{growth::range, statistics::mean};

impl Experiment {
    fn at(&self, setting: &str) -> Option<&AtReference> {
        self.at_reference.iter().find(|a| a.setting == setting)
    }

    /// What the study says, from its own numbers.
    pub fn verdict(&self) -> String {
        let over = |of: &dyn Fn(&Reference) -> f64| range(self.references.iter().map(of));
        let points = || self.references.iter().flat_map(|r| &r.points);
        let open = mean(&points().map(|p| p.open_loop_mm).collect::<Vec<_>>());
        let worse = points().filter(|p| p.error_mm > p.open_loop_mm).count();
        let (low, high) = over(&|r| r.vector.slope_mm_per_m);
        let (theory_low, theory_high) = over(&|r| r.predicted_slope_mm_per_m);
        let (exact_low, exact_high) = over(&|r| r.exact_slope_mm_per_m);
        let (r2, _) = over(&|r| r.vector.r2);
        let (near, far) = over(&|r| r.vector.error_at_16cm_mm);
        let (_, field) = over(&|r| r.field_slope_mm_per_m / r.tip_slope_mm_per_m);
        let steeper = self
            .references
            .iter()
            .filter(|r| r.vector.slope_mm_per_m > r.predicted_slope_mm_per_m)
            .count();
        format!(
            "As in the paper's figure 7 the error without correction is much the same everywhere \
             ({open:.1} mm on average), and with a vector taken elsewhere it grows linearly with \
             the distance: by {low:.0} to {high:.0} mm per metre (the line explains at least \
             {:.0} % of the variance), where the numeric study predicts {theory_low:.0} to \
             {theory_high:.0}; it is steeper than predicted at {steeper} of {} places (the paper: \
             slightly steeper). With sight that has no error it would grow by {exact_low:.0} to \
             {exact_high:.0}; the rest comes from the wrong intrinsics, whose error in range \
             differs from place to place, as the paper supposes. At 16 cm the error is {near:.1} \
             to {far:.1} mm. Correction was worse than none at {worse} of {} targets. The tip's \
             error with the field made from six looks on a straight 12 cm grows at most \
             {field:.2} times as fast as with one vector.",
            r2 * 100.0,
            self.references.len(),
            points().count(),
        )
    }

    /// What is left of the mark's error at the place where the vector was taken, and why.
    pub fn of_the_mark(&self) -> String {
        let mark = |name| self.at(name).map_or(f64::NAN, |a| a.mark_mm);
        let (Some(all), Some(exact)) = (self.at(EVERYTHING), self.at(EXACT_SIGHT)) else {
            return String::new();
        };
        format!(
            "At the first place itself one vector leaves {:.2} of {:.1} mm. Most of that is the \
             rule's own: with sight that has no error at all it leaves {:.2} mm, because the \
             vector is not quite the same where it brings the arm ({:.0} % of the way). A second \
             vector, taken there, leaves {:.2} mm, with exact sight {:.2} mm; the difference is \
             what pictures, lenses and droop add. One at a time: without droop the first vector \
             leaves {:.2} mm, with exact intrinsics {:.2} mm, without noise in the pictures \
             {:.2} mm.",
            all.mark_mm,
            all.open_loop_mm,
            exact.mark_mm,
            100.0 * exact.mark_mm / exact.open_loop_mm,
            all.mark_second_mm,
            exact.mark_second_mm,
            mark(NO_DROOP),
            mark(EXACT_LENSES),
            mark(NO_NOISE),
        )
    }

    /// What that means for the instrument's tip.
    pub fn of_the_tip(&self) -> String {
        let (Some(all), Some(lenses)) = (self.at(EVERYTHING), self.at(EXACT_LENSES)) else {
            return String::new();
        };
        format!(
            "The instrument's tip is 9 cm from the mark. With the tip at the place the mark is \
             seen that far away, and its vector then leaves {:.1} mm of the mark's error: that is \
             distance, not noise. It leaves {:.1} mm of the tip's, because the direction of the \
             tool is not corrected. The pose of the plate, which shows that direction, leaves \
             {:.1} mm, with exact intrinsics {:.1} mm: its range comes from the plate's size, too, \
             so that the cameras' errors are not the same for target and fiducial.",
            all.mark_from_tip_mm, all.tip_mm, all.plate_mm, lenses.plate_mm,
        )
    }
}
