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
        format!(
            "{}  {} trials in {:.1} ms on {}\n",
            table(self).text(),
            self.trials(),
            self.compute_ms,
            threads(self.threads)
        )
    }

    fn section(&self) -> String {
        let ours = |r: &Row| vec![r.before_mm, r.after_mm, r.after_two_mm, r.after_three_mm];
        let paper = |r: &Row| vec![r.paper_before_mm, r.paper_after_mm];
        let levels = [
            ("0.5\u{b0} 1 mm", BLUE),
            ("1\u{b0} 1 mm", ORANGE),
            ("1\u{b0} 2.5 mm", GREEN),
        ];
        let series = |marks: Marks, stages: &dyn Fn(&Row) -> Vec<f64>| -> Vec<Series> {
            let rows = self.rows.iter().zip(levels);
            rows.map(|(row, (name, colour))| Series {
                name: if marks == Marks::Rings { "" } else { name },
                colour,
                points: stages(row)
                    .into_iter()
                    .enumerate()
                    .map(|(k, mm)| (k as f64, mm))
                    .collect(),
                marks,
            })
            .collect()
        };
        let mut all = series(Marks::Joined, &ours);
        all.extend(series(Marks::Rings, &paper));
        let plot = Plot {
            title: "Mean error (rings: the paper)",
            x_label: "corrections",
            y_label: "mm",
            whole_x: true,
            from_zero: false,
            series: all,
        };
        format!(
            "<div class=\"charts\">{}</div>{}<p>The paper stops after one correction. All {} trials \
             computed in {:.1} ms on {}, seed {}.</p>",
            plot.svg_in_decades(),
            table(self).html(),
            self.trials(),
            self.compute_ms,
            threads(self.threads),
            self.seed
        )
    }
}

fn threads(count: usize) -> String {
    match count {
        1 => "one thread".to_owned(),
        n => format!("{n} threads"),
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
        .column("after two, mm", |r| format!("{:.3}", r.after_two_mm))
        .column("after three, mm", |r| format!("{:.4}", r.after_three_mm))
        .column("targets x draws", |r| {
            format!("{} x {}", r.targets, r.trials)
        })
}
