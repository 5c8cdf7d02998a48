//! Table 1 on page and terminal.

use super::Shown;
use crate::table1::{Row, Table1};
use rover_page::{
    BLUE, GREEN, ORANGE,
    plot::{Marks, Plot, Series},
};
use std::fmt::Write;

impl Shown for Table1 {
    const NAME: &'static str = "table1";
    const TITLE: &'static str = "Table 1: the vector taken at the target";

    fn verdict(&self) -> String {
        Table1::verdict(self)
    }

    fn lines(&self) -> String {
        let mut out = String::from(
            "  errors (1 sigma)   before: paper, here   after: paper, here   95 %   \
                    second   mm\n",
        );
        for r in &self.rows {
            let _ = writeln!(
                out,
                "  {:.1} deg {:.1} mm     {:>9.1} {:>8.1}     {:>9.1} {:>8.2} {:>8.2} {:>8.3}",
                r.angle_deg,
                r.length_mm,
                r.paper_before_mm,
                r.before_mm,
                r.paper_after_mm,
                r.after_mm,
                r.after_p95_mm,
                r.after_two_mm
            );
        }
        let trials: usize = self.rows.iter().map(|r| r.targets * r.trials).sum();
        let _ = writeln!(
            out,
            "  {trials} trials in {:.1} ms on {} thread(s)",
            self.compute_ms, self.threads
        );

        out
    }

    fn section(&self) -> String {
        let mut rows = String::new();
        for r in &self.rows {
            let _ = write!(
                rows,
                "<tr><td class=\"text\">{} deg, {} mm</td><td>{}</td><td>{:.1}</td><td>{}</td>\
             <td>{:.2}</td><td>{:.2}</td><td>{:.3}</td><td>{:.4}</td><td>{} x {}</td></tr>",
                r.angle_deg,
                r.length_mm,
                r.paper_before_mm,
                r.before_mm,
                r.paper_after_mm,
                r.after_mm,
                r.after_p95_mm,
                r.after_two_mm,
                r.after_three_mm,
                r.targets,
                r.trials
            );
        }
        let stages = |of: &dyn Fn(&Row) -> Vec<f64>, i: usize| -> Vec<(f64, f64)> {
            let values = self.rows.get(i).map(of).unwrap_or_default();
            values
                .into_iter()
                .enumerate()
                .map(|(k, mm)| (k as f64, mm.log10()))
                .collect()
        };
        let ours = |r: &Row| vec![r.before_mm, r.after_mm, r.after_two_mm, r.after_three_mm];
        let paper = |r: &Row| vec![r.paper_before_mm, r.paper_after_mm];
        let series = |name, colour, points, marks| Series {
            name,
            colour,
            points,
            marks,
        };
        let plot = Plot {
            title: "Mean error after so many corrections (line: here, dots: paper)",
            x_label: "corrections",
            y_label: "log10 mm",
            whole_x: true,
            from_zero: false,
            series: vec![
                series("0.5\u{b0} 1 mm", BLUE, stages(&ours, 0), Marks::Line),
                series("1\u{b0} 1 mm", ORANGE, stages(&ours, 1), Marks::Line),
                series("1\u{b0} 2.5 mm", GREEN, stages(&ours, 2), Marks::Line),
                series("", BLUE, stages(&paper, 0), Marks::Dots),
                series("", ORANGE, stages(&paper, 1), Marks::Dots),
                series("", GREEN, stages(&paper, 2), Marks::Dots),
            ],
        };
        format!(
            "<div class=\"charts\">{}</div><div class=\"scroll\"><table><tr><th class=\"text\">errors, \
         one sigma</th><th>before: paper, mm</th><th>here</th><th>after: paper, mm</th><th>here</th>\
         <th>here, 95 %</th><th>second</th><th>third</th><th>targets x draws</th></tr>{rows}</table>\
         </div><p>Computed in {:.1} ms on {} thread(s), seed {}.</p>",
            plot.svg(),
            self.compute_ms,
            self.threads,
            self.seed
        )
    }
}
