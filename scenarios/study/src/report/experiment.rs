//! The experiment on page and terminal.

use super::{Shown, distance, table::Table};
use crate::experiment::{AtReference, Experiment, Reference};
use rover_page::{GREEN, ORANGE, PURPLE, escape};

impl Shown for Experiment {
    const NAME: &'static str = "experiment";
    const TITLE: &'static str = "Figure 7: the experiment, with images";

    fn verdict(&self) -> String {
        Experiment::verdict(self)
    }

    fn lines(&self) -> String {
        format!(
            "{}{}{}  {} {}\n",
            of_mark(self).text(),
            of_tip(self).text(),
            sources(self).text(),
            self.of_the_mark(),
            self.of_the_tip()
        )
    }

    fn section(&self) -> String {
        let charts: String = self.references.iter().map(scatter).collect();
        format!(
            "<p>The Bluestreak testbed, drawn {} times with 1 deg and 2.5 mm; focal lengths wrong by \
             {} %, principal points by {} px (one sigma), the arm drooping under its own weight. \
             One stereo pair with the arm\u{2019}s mark at the reference place gives the vector. Each \
             target is a fiducial held there, found in a stereo pair; the arm\u{2019}s own mark is \
             then sent to it and its true place measured, as the paper\u{2019}s laser did (purple \
             without correction, blue with the vector; green: the tip with the field). Orange: the \
             slope that the numeric study of locality predicts, from the same value at no distance. \
             Seed {}.</p><p>The paper states no number for its figure 7. It says: without correction \
             \u{201c}essentially constant\u{201d}; with it a \u{201c}significant reduction\u{201d} as \
             far as 20 cm, a linear trend, and a slope \u{201c}slightly steeper than the predicted \
             theory\u{201d}.</p><div class=\"charts\">{charts}</div>{}<h3>At the place where the \
             vector was taken</h3><p>{}</p>{}<p>{SOURCES}</p><h3>The instrument\u{2019}s tip</h3>\
             <p>{}</p>{}",
            self.trials,
            self.intrinsics.0 * 100.0,
            self.intrinsics.1,
            self.seed,
            of_mark(self).html(),
            escape(&self.of_the_mark()),
            sources(self).html(),
            escape(&self.of_the_tip()),
            of_tip(self).html(),
        )
    }
}

const SOURCES: &str = "Means over the robots, mm, with one thing at a time taken away. The \
    mark\u{2019}s vector is taken with the mark there, the second one where the first brought it; \
    9 cm away: with the tip at the place.";

fn of_mark(study: &Experiment) -> Table<'_, Reference> {
    distance::rows(&study.references)
        .column("numeric study: slope, mm/m", |r| {
            format!("{:.1}", r.predicted_slope_mm_per_m)
        })
        .column("from, mm", |r| format!("{:.2}", r.predicted_intercept_mm))
        .column("slope with exact sight, mm/m", |r| {
            format!("{:.1}", r.exact_slope_mm_per_m)
        })
        .column("robots x targets", |r| {
            format!("{} x {}", r.robots, r.points.len())
        })
}

fn of_tip(study: &Experiment) -> Table<'_, Reference> {
    // A zero has no sign.
    let mm = |x: f64| format!("{:.1}", if x.abs() < 0.05 { 0.0 } else { x });
    Table::of(&study.references)
        .column("tip, vector taken at", |r| r.name.to_owned())
        .column("mark\u{2019}s vector: slope, mm/m", move |r| {
            mm(r.tip_slope_mm_per_m)
        })
        .column("from, mm", move |r| mm(r.tip_intercept_mm))
        .column("plate\u{2019}s pose: slope, mm/m", move |r| {
            mm(r.plate_slope_mm_per_m)
        })
        .column("from, mm", move |r| mm(r.plate_intercept_mm))
        .column("field: slope, mm/m", move |r| mm(r.field_slope_mm_per_m))
}

fn sources(study: &Experiment) -> Table<'_, AtReference> {
    let mm = |x: f64| format!("{x:.2}");
    Table::of(&study.at_reference)
        .column("at the first place, mm", |a| a.setting.to_owned())
        .column("open loop", |a| format!("{:.1}", a.open_loop_mm))
        .column("mark", move |a| mm(a.mark_mm))
        .column("second vector", move |a| mm(a.mark_second_mm))
        .column("mark, 9 cm away", move |a| mm(a.mark_from_tip_mm))
        .column("tip, mark\u{2019}s vector", move |a| mm(a.tip_mm))
        .column("tip, plate\u{2019}s pose", move |a| mm(a.plate_mm))
        .column("robots", |a| a.robots.to_string())
}

/// One reference place as a plot.
fn scatter(r: &Reference) -> String {
    let predicted = (r.vector.intercept_mm, r.predicted_slope_mm_per_m);
    let others = vec![
        distance::dots(r, "none", PURPLE, |p| p.open_loop_mm),
        distance::line(r, "predicted", ORANGE, predicted),
        distance::dots(r, "tip, field", GREEN, |p| p.field_mm),
    ];
    distance::plot(r, others)
}
