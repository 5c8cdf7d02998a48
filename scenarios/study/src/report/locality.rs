//! Locality on page and terminal.

use super::{Shown, distance, table::Table};
use crate::{
    growth::SENTENCE_M,
    locality::{Locality, Reference},
};
use rover_page::{
    GREEN, ORANGE, PURPLE,
    plot::{Marks, Series},
};

/// What the paper says of locality, and what it must mean.
const SENTENCE: &str = "The paper: \u{201c}In order to achieve .5mm positioning accuracy, the error \
    vector can be calculated as far as 16cm away from the target.\u{201d} That cannot be: for the \
    same errors its own table 1 has 1.2 mm with the vector taken at the target itself, at no \
    distance at all, and the error grows from there. With .5 cm, 5 mm, the sentence agrees with \
    table 1, with the shallow slope that the paper describes and, roughly, with this re-run, so \
    this is how it must read. (The paper gives no number for the slope; 5 mm at 16 cm from 1.2 mm \
    at none would be 24 mm/m.)";

impl Shown for Locality {
    const NAME: &'static str = "locality";
    const TITLE: &'static str = "Figure 6: the vector taken elsewhere";

    fn verdict(&self) -> String {
        Locality::verdict(self)
    }

    fn lines(&self) -> String {
        table(self).text()
    }

    fn section(&self) -> String {
        let charts: String = self.references.iter().map(scatter).collect();
        format!(
            "<p>{SENTENCE}</p><div class=\"charts\">{charts}</div>{}<p>1 deg and 2.5 mm, {} draws, \
             seed {}; every dot is a target, averaged over the draws. Rings: 16 cm with the 0.5 mm \
             that the paper prints (orange) and the 5 mm that it must mean (purple). Green: the \
             field with 0.3 mm of noise on each vector. The line is fitted between 2 and 40 cm; \
             \u{201c}from\u{201d} is its value at no distance. The tool points straight down \
             everywhere. The field is made from six vectors seen on a bent way of about 30 cm to \
             the reference place, every one in the cameras\u{2019} view; the way\u{2019}s shape was \
             chosen among some twenty. Beside it: from six on the last straight 12 cm. The last \
             column is the share of predictions, with noise, whose stated 95 % ellipsoid held the \
             true vector.</p>",
            table(self).html(),
            self.trials,
            self.seed
        )
    }
}

fn table(study: &Locality) -> Table<'_, Reference> {
    distance::rows(&study.references)
        .column("paper at 16 cm, mm", |_| "5 (prints .5)".to_owned())
        .column("5 mm at", |r| {
            let at = r.five_mm_at_m.map(|m| format!("{:.0} cm", m * 100.0));
            at.unwrap_or("–".to_owned())
        })
        .column("paper", |_| "16 cm".to_owned())
        .column("field, mm/m", |r| format!("{:.1}", r.field_slope_mm_per_m))
        .column("with noise, mm/m", |r| {
            format!("{:.1}", r.field_noisy_slope_mm_per_m)
        })
        .column("straight way, mm/m", |r| {
            format!("{:.1}", r.field_straight_slope_mm_per_m)
        })
        .column("ellipsoid held", |r| {
            format!("{:.0} %", r.field_noisy_coverage * 100.0)
        })
}

/// One reference place as a plot: every target, the fitted line, the field, the paper's sentence.
fn scatter(r: &Reference) -> String {
    let ring = |name, colour, mm| Series {
        name,
        colour,
        points: vec![(SENTENCE_M * 100.0, mm)],
        marks: Marks::Rings,
    };
    let others = vec![
        distance::dots(r, "field", GREEN, |p| p.field_noisy_mm),
        ring("printed", ORANGE, 0.5),
        ring("meant", PURPLE, 5.0),
    ];
    distance::plot(r, others)
}
