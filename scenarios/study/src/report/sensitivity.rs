//! Sensitivity on page and terminal.

use super::Shown;
use crate::sensitivity::{ABOVE_M, COLUMNS, Sensitivity};
use rover_page::{BLUE, GREEN, ORANGE, escape};
use std::fmt::Write;

impl Shown for Sensitivity {
    const NAME: &'static str = "sensitivity";
    const TITLE: &'static str = "What each error source does to the final error";

    fn verdict(&self) -> String {
        Sensitivity::verdict(self)
    }

    fn lines(&self) -> String {
        let mut out = String::from(
            "  mm rms, by Jacobians | simulated\n  source                    one sigma            \
             ",
        );
        for (heading, _) in COLUMNS {
            let _ = write!(out, " {heading:>18}");
        }
        out += "\n";
        for r in &self.rows {
            let _ = write!(out, "  {:<25} {:<27}", r.name, r.sigma);
            for (_, of) in COLUMNS {
                let b = of(r);
                let both = format!("{:.3} | {:.3}", b.analytic_mm, b.simulated_mm);
                let _ = write!(out, " {both:>18}");
            }
            out += "\n";
        }
        out
    }

    fn section(&self) -> String {
        let head: String = COLUMNS
            .iter()
            .map(|(heading, _)| format!("<th class=\"group\" colspan=\"2\">{heading}</th>"))
            .collect();
        let mut rows = String::new();
        for r in &self.rows {
            let _ = write!(
                rows,
                "<tr><td class=\"text\" style=\"white-space:nowrap\">{}</td><td class=\"text note\">{}</td>",
                r.name,
                escape(&r.sigma)
            );
            for (_, of) in COLUMNS {
                let b = of(r);
                let _ = write!(
                    rows,
                    "<td>{:.3}</td><td>{:.3}</td>",
                    b.analytic_mm, b.simulated_mm
                );
            }
            rows += "</tr>";
        }
        let pair = "<th>Jac.</th><th>sim.</th>".repeat(COLUMNS.len());
        format!(
            "<p>The Bluestreak testbed, {} targets, {} draws each, seed {}; one source at a time, \
             millimetres rms of the true tip from the true target. The vector is seen at the target \
             or {:.0} cm above it, as the position of one mark (the paper's fiducial) or as the \
             pose of the plate. By Jacobians (Jac.), the difference of the error's derivative at the target \
             and where it was seen, and, for arm and mount, the part that is quadratic in the \
             errors; beside it simulated (sim.). Bars, logarithmic, simulated: orange before, blue with one mark and green with the \
             plate seen at the target; what is below a micrometre has no bar.</p>{}<div class=\"scroll\"><table><tr><th class=\"text\" rowspan=\"2\">source\
             </th><th class=\"text\" rowspan=\"2\">one sigma</th>{head}</tr><tr>{pair}</tr>{rows}\
             </table></div>",
            self.targets,
            self.trials,
            self.seed,
            ABOVE_M * 100.0,
            bars(self)
        )
    }
}

/// The simulated error of each source before and after as bars on a logarithmic scale.
fn bars(study: &Sensitivity) -> String {
    const LEFT: f64 = 190.0;
    const WIDTH: f64 = 520.0;
    const ROW: f64 = 40.0;
    // 1 micrometre to 100 mm.
    let at = |mm: f64| LEFT + WIDTH * ((mm.max(1e-3).log10() + 3.0) / 5.0).clamp(0.0, 1.0);
    let height = 40.0 + ROW * study.rows.len() as f64;
    let mut out = format!(
        "<svg class=\"plot\" style=\"max-width:46rem\" viewBox=\"0 0 {} {}\" role=\"img\">\
         <text x=\"{LEFT}\" y=\"16\" class=\"title\">error, mm rms</text>{}",
        LEFT + WIDTH + 20.0,
        height + 24.0,
        key(LEFT + 120.0)
    );
    for power in -3..=2 {
        let x = at(10f64.powi(power));
        let _ = write!(
            out,
            "<line x1=\"{x:.1}\" x2=\"{x:.1}\" y1=\"26\" y2=\"{height}\" class=\"grid\"/>\
             <text x=\"{x:.1}\" y=\"{}\" text-anchor=\"middle\">{}</text>",
            height + 16.0,
            10f64.powi(power)
        );
    }
    for (i, r) in study.rows.iter().enumerate() {
        let top = 34.0 + ROW * i as f64;
        let _ = write!(
            out,
            "<text x=\"{}\" y=\"{}\" text-anchor=\"end\">{}</text>",
            LEFT - 8.0,
            top + 18.0,
            r.name
        );
        for (k, (both, colour)) in [(r.before, ORANGE), (r.mark, BLUE), (r.plate, GREEN)]
            .into_iter()
            .enumerate()
        {
            let _ = write!(
                out,
                "<rect x=\"{LEFT}\" y=\"{}\" width=\"{:.1}\" height=\"8\" fill=\"{colour}\"/>",
                top + 9.0 * k as f64,
                at(both.simulated_mm) - LEFT
            );
        }
    }
    out + "</svg>"
}

/// What the colours of the bars are.
fn key(left: f64) -> String {
    let names = [("before", ORANGE), ("one mark", BLUE), ("plate", GREEN)];
    let mut out = String::new();
    for (i, (name, colour)) in names.into_iter().enumerate() {
        let x = left + 95.0 * i as f64;
        let _ = write!(
            out,
            "<rect x=\"{x}\" y=\"8\" width=\"12\" height=\"8\" fill=\"{colour}\"/>\
             <text x=\"{}\" y=\"16\">{name}</text>",
            x + 17.0
        );
    }
    out
}
