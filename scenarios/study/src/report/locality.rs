//! Locality on page and terminal.

use super::{Shown, open_loop_mm, table::Table};
use crate::locality::{Locality, LocalityPoint, Reference};
use rover_page::{
    BLUE, GREEN, ORANGE,
    plot::{Marks, Plot, Series},
};

/// What the paper says of locality, and what it must mean.
const SENTENCE: &str = "The paper: \u{201c}In order to achieve .5mm positioning accuracy, the error \
    vector can be calculated as far as 16cm away from the target.\u{201d} Its own table 1 has \
    1.2 mm for the same errors with the vector taken at the target itself.";
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
             seed {}; orange: 16 cm with the 0.5 mm that the paper prints and the 5 mm that it must \
             mean; green: the field with 0.3 mm of noise on each vector. The tool points straight down everywhere. The field is made from six vectors \
             seen on a bent way of about 30 cm to the reference place; beside it from six on the \
             last straight 12 cm. The last column is the share of predictions whose stated 95 % \
             ellipsoid held the true vector.</p>",
            table(self).html(),
            self.trials,
            self.seed
        )
    }
}

fn table(study: &Locality) -> Table<'_, Reference> {
    Table::of(&study.references)
        .column("vector taken at", |r| r.name.to_owned())
        .column("open loop, mm", |r| {
            open_loop_mm(r.points.iter().map(|p| p.open_loop_mm))
        })
        .column("slope, mm/m", |r| format!("{:.1}", r.slope_mm_per_m))
        .column("intercept, mm", |r| format!("{:.2}", r.intercept_mm))
        .column("r2", |r| format!("{:.3}", r.r2))
        .column("at 16 cm, mm", |r| format!("{:.1}", r.error_at_16cm_mm))
        .column("5 mm at", |r| {
            let at = r.five_mm_at_m.map(|m| format!("{:.0} cm", m * 100.0));
            at.unwrap_or("–".to_owned())
        })
        .column("field, mm/m", |r| format!("{:.1}", r.field_slope_mm_per_m))
        .column("with noise, mm/m", |r| {
            format!("{:.1}", r.field_noisy_slope_mm_per_m)
        })
        .column("straight way, mm/m", |r| {
            format!("{:.1}", r.field_straight_slope_mm_per_m)
        })
        .column("bound held", |r| {
            format!("{:.0} %", r.field_noisy_coverage * 100.0)
        })
}

/// One reference place as a plot: every target, the fitted line, the field, the open loop.
fn scatter(r: &Reference) -> String {
    let points = |of: fn(&LocalityPoint) -> f64| {
        r.points
            .iter()
            .map(|p| (p.distance_m * 100.0, of(p)))
            .collect()
    };
    let far = r.points.last().map_or(0.0, |p| p.distance_m);
    let line = |x: f64| (x * 100.0, r.intercept_mm + r.slope_mm_per_m * x);
    Plot {
        title: r.name,
        x_label: "distance from where the vector was taken, cm",
        y_label: "mm",
        whole_x: false,
        from_zero: true,
        series: vec![
            Series {
                name: "one vector",
                colour: BLUE,
                points: points(|p| p.error_mm),
                marks: Marks::Dots,
            },
            Series {
                name: "its line",
                colour: BLUE,
                points: vec![line(0.0), line(far)],
                marks: Marks::Line,
            },
            Series {
                name: "field",
                colour: GREEN,
                points: points(|p| p.field_noisy_mm),
                marks: Marks::Dots,
            },
            Series {
                name: "paper: 0.5, 5 mm",
                colour: ORANGE,
                points: vec![(16.0, 0.5), (16.0, 5.0)],
                marks: Marks::Dots,
            },
        ],
    }
    .svg()
}
