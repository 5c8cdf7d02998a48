//! The approach as a strip of pictures, the tracking in plots, the error by source.

use super::{
    PageError,
    picture::{Mark, Overlay, figure},
};
use crate::{evidence::Evidence, report::RunReport};
use rover_page::{
    BLUE, ORANGE, PURPLE, YELLOW, escape,
    plot::{Marks, Plot, Series},
    section,
};
use std::fmt::Write;

/// Pictures in the strip; of more stops than that, evenly spaced ones are shown.
const STRIP_N: usize = 8;

/// The section about the way to the target; empty if the robot did not drive.
pub(super) fn approach(report: &RunReport, evidence: &Evidence) -> Result<String, PageError> {
    let mut out = String::new();
    let views = evidence.chase_views.iter().zip([
        "The rover where the target was named",
        "The rover where the approach ended",
    ]);
    let mut figures = String::new();
    for (view, caption) in views {
        figures += &figure(view, &Overlay::default(), caption)?;
    }
    if !figures.is_empty() {
        let _ = write!(out, "<div class=\"pair\">{figures}</div>");
    }
    let stops = &evidence.stops;
    let mut figures = String::new();
    let shown = stops.len().min(STRIP_N);
    for i in 0..shown {
        let n = if shown > 1 {
            i * (stops.len() - 1) / (shown - 1)
        } else {
            0
        };
        let stop = &stops[n];
        let overlay = Overlay {
            marks: vec![Mark::cross(stop.pixel_px, ORANGE, "")],
            path: vec![],
        };
        let score = stop
            .score
            .map_or_else(String::new, |s| format!(", correlation {s:.2}"));
        let caption = format!("Stop {}, {:.2} m{score}", n + 1, stop.range_m);
        figures += &figure(&stop.image, &overlay, &caption)?;
    }
    if let Some((image, expected)) = &evidence.lost {
        let mark = |pixel: &[f64; 2]| Mark::ring(*pixel, YELLOW, "expected");
        let overlay = Overlay {
            marks: expected.iter().map(mark).collect(),
            path: vec![],
        };
        figures += &figure(image, &overlay, "Where the approach ended")?;
    }
    if !figures.is_empty() {
        let _ = write!(out, "<div class=\"strip\">{figures}</div>");
    }
    if let Some(a) = &report.approach {
        let at = |f: &dyn Fn(&crate::report::StopReport) -> f64| {
            a.stops
                .iter()
                .map(|s| (s.range_m, f(s)))
                .collect::<Vec<_>>()
        };
        let charts = [
            Plot {
                title: "Correlation with the anchor",
                x_label: "distance, m",
                y_label: "correlation",
                whole_x: false,
                from_zero: false,
                series: vec![Series {
                    name: "correlation",
                    colour: BLUE,
                    points: at(&|s| s.score),
                    marks: Marks::Joined,
                }],
            },
            Plot {
                title: "Uncertainty of the target, one sigma of the worst axis",
                x_label: "distance, m",
                y_label: "mm",
                whole_x: false,
                from_zero: true,
                series: vec![Series {
                    name: "sigma",
                    colour: PURPLE,
                    points: at(&|s| s.sigma_mm.iter().fold(0.0, |m, x| m.max(*x))),
                    marks: Marks::Joined,
                }],
            },
        ]
        .map(|plot| plot.svg())
        .concat();
        let _ = write!(
            out,
            "<p>{:.2} m driven in {} stops; handed over from the mast to the pair <b>{}</b> within \
             {:.2} px of the place that geometry predicts. Before the drive the error along the \
             surface was forecast to stay below <b>{:.0} mm</b> (95 %).</p>\
             <div class=\"charts\">{charts}</div>",
            a.driven_m,
            a.stops.len(),
            escape(&a.target.pair),
            a.handover_px,
            a.forecast_mm,
        );
        for earlier in &a.earlier {
            let [x, y, _] = earlier.position_m;
            let _ = write!(
                out,
                "<p>Left again: base pose at {x:.2}, {y:.2} m of the site frame, heading {:.0} deg: \
                 {}.</p>",
                earlier.heading_rad.to_degrees(),
                escape(&earlier.reason)
            );
        }
        out += &base(a);
        out += &budget(report, a);
    }
    if out.is_empty() {
        return Ok(out);
    }
    Ok(section("Approach", &out))
}

fn base(a: &crate::report::ApproachReport) -> String {
    let refused = a
        .refused
        .iter()
        .map(|(why, n)| format!("{} {n}", escape(&why.replace('_', " "))))
        .collect::<Vec<_>>()
        .join(", ");
    let figures = a
        .base
        .iter()
        .map(|(name, x)| format!("{} {x:.3}", escape(&name.replace('_', " "))))
        .collect::<Vec<_>>()
        .join(", ");
    format!(
        "<p>Base pose: {} candidates{}{refused}. Where the rover stands: {figures}.</p>",
        a.candidates_n,
        if refused.is_empty() {
            ""
        } else {
            ", refused: "
        },
    )
}

fn budget(report: &RunReport, a: &crate::report::ApproachReport) -> String {
    let mut rows = String::new();
    let mut row = |source: &str, predicted: Option<f64>, found: Option<f64>| {
        let mm = |v: Option<f64>| v.map_or("–".to_owned(), |v| format!("{v:.2}"));
        let _ = write!(
            rows,
            "<tr><td class=\"text\">{source}</td><td>{}</td><td>{}</td></tr>",
            mm(predicted),
            mm(found)
        );
    };
    let predicted = |name: &str| a.budget_mm.get(name).copied();
    let found = report.truth.as_ref().map(|t| t.sources).unwrap_or_default();
    let tracking = predicted("tracking").zip(predicted("relief"));
    row("designation", predicted("designation"), None);
    row(
        "tracking",
        tracking.map(|(t, r)| t.hypot(r)),
        found.tracking_mm,
    );
    row("handover", predicted("handover"), found.handover_mm);
    row("stereo", predicted("stereo"), found.stereo_mm);
    row("servo", None, found.servo_mm);
    row("contact", None, found.contact_mm);
    let whole = report.truth.as_ref().and_then(|t| t.lateral_error_mm);
    row("all together", None, whole);
    format!(
        "<table><tr><th class=\"text\">source of the error along the surface</th>\
         <th>predicted, one sigma, mm</th><th>true, mm</th></tr>{rows}</table>"
    )
}
