//! Locality on page and terminal.

use super::Shown;
use crate::locality::{Locality, LocalityPoint, Reference};
use rover_page::{
    BLUE, GREEN, ORANGE,
    plot::{Marks, Plot, Series},
};
use std::fmt::Write;

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
        let mut out = String::from(
            "  vector taken at               slope   intercept   r2     at 16 cm   \
                    field   with noise\n",
        );
        for r in &self.references {
            let _ = writeln!(
                out,
                "  {:<28} {:>4.1} mm/m {:>5.2} mm   {:.3}  {:>4.1} mm  {:>4.1} mm/m {:>4.1} mm/m",
                r.name,
                r.slope_mm_per_m,
                r.intercept_mm,
                r.r2,
                r.error_at_16cm_mm,
                r.field_slope_mm_per_m,
                r.field_noisy_slope_mm_per_m
            );
        }

        out
    }

    fn section(&self) -> String {
        let mut rows = String::new();
        let mut charts = String::new();
        for r in &self.references {
            charts += &scatter(r);
            let open_loop: f64 =
                r.points.iter().map(|p| p.open_loop_mm).sum::<f64>() / r.points.len().max(1) as f64;
            let five = r
                .five_mm_at_m
                .map_or("–".to_owned(), |m| format!("{:.0} cm", m * 100.0));
            let _ = write!(
                rows,
                "<tr><td class=\"text\">{}</td><td>{:.1}</td><td>{:.1}</td><td>{:.2}</td><td>{:.3}</td>\
             <td>{:.1}</td><td>{five}</td><td>{:.1}</td><td>{:.1}</td><td>{:.0} %</td></tr>",
                r.name,
                open_loop,
                r.slope_mm_per_m,
                r.intercept_mm,
                r.r2,
                r.error_at_16cm_mm,
                r.field_slope_mm_per_m,
                r.field_noisy_slope_mm_per_m,
                r.field_noisy_coverage * 100.0
            );
        }
        format!(
            "<p>{SENTENCE}</p><div class=\"charts\">{charts}</div><div class=\"scroll\"><table><tr>\
         <th class=\"text\">vector taken at</th><th>open loop, mm</th><th>slope, mm/m</th>\
         <th>intercept, mm</th><th>r2</th><th>at 16 cm, mm</th><th>5 mm at</th><th>field, mm/m</th>\
         <th>with noise, mm/m</th><th>95 % bound held</th></tr>{rows}</table></div>\
         <p>1 deg and 2.5 mm, {} draws, seed {}; the tool points straight down everywhere. The field \
         is made from six vectors seen on a bent way of about 30 cm to the reference place.</p>",
            self.trials, self.seed
        )
    }
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
                name: "field, 0.3 mm noise",
                colour: GREEN,
                points: points(|p| p.field_noisy_mm),
                marks: Marks::Dots,
            },
            Series {
                name: "paper: 16 cm, read 5 mm",
                colour: ORANGE,
                points: vec![(16.0, 5.0)],
                marks: Marks::Dots,
            },
        ],
    }
    .svg()
}
