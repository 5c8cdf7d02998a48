//! Table 1 on page and terminal.

use super::{Shown, table::Table};
use crate::table1::{Row, Table1};
use rover_page::{
    BLUE, GREEN, ORANGE,
    plot::{Marks, Plot, Series},
};

impl Shown for Table1 {
    const NAME: &'static str = "table1";
    const TITLE: &'static str = "Table 1: the vector taken at the target";

    fn verdict(&self) -> String {
        Table1::verdict(self)
    }

    fn lines(&self) -> String {
        let trials: usize = self.rows.iter().map(|r| r.targets * r.trials).sum();
        format!(
            "{}  {trials} trials in {:.1} ms on {} thread(s)\n",
            table(self).text(),
            self.compute_ms,
            self.threads
        )
    }

    fn section(&self) -> String {
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
            "<div class=\"charts\">{}</div>{}<p>Computed in {:.1} ms on {} thread(s), seed {}.</p>",
            plot.svg(),
            table(self).html(),
            self.compute_ms,
            self.threads,
            self.seed
        )
    }
}

fn table(study: &Table1) -> Table<'_, Row> {
    Table::of(&study.rows)
        .column("errors, one sigma", |r| {
            format!("{} deg, {} mm", r.angle_deg, r.length_mm)
        })
        .column("before: paper, mm", |r| format!("{:.1}", r.paper_before_mm))
        .column("here, mm", |r| format!("{:.1}", r.before_mm))
        .column("after: paper, mm", |r| format!("{:.1}", r.paper_after_mm))
        .column("here, mm", |r| format!("{:.2}", r.after_mm))
        .column("here, 95 %, mm", |r| format!("{:.2}", r.after_p95_mm))
        .column("second, mm", |r| format!("{:.3}", r.after_two_mm))
        .column("third, mm", |r| format!("{:.4}", r.after_three_mm))
        .column("targets x draws", |r| {
            format!("{} x {}", r.targets, r.trials)
        })
}
