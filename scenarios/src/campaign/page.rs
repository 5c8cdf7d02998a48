//! A campaign as one self-contained page.

use super::{Record, Summary, summary::Spread};
use crate::report::Outcome;
use rover_page::{
    BLUE, ORANGE, document, escape,
    plot::{Marks, Plot, Series},
    section,
};
use std::fmt::Write;

/// The page of a campaign; `records` in the order of their seeds.
pub fn page(summary: &Summary, records: &[Record]) -> String {
    let mut body = format!(
        "<header><h1>Campaign {}</h1><p class=\"lead\">{} of {} runs, seeds from {}</p></header>\n",
        escape(&summary.scenario),
        summary.all.runs,
        summary.planned,
        summary.first_seed
    );
    body += &section("Outcome", &outcome(summary));
    body += &section("Distributions", &distributions(records));
    body += &section("What ended runs", &faults(summary));
    body += &section("Where the time goes", &times(summary));
    body += &section("Runs", &runs(records));
    let footer = format!("rover {}", env!("CARGO_PKG_VERSION"));
    document(&format!("Campaign {}", summary.scenario), &body, &footer)
}

fn table(head: &[&str], rows: impl IntoIterator<Item = Vec<String>>) -> String {
    let mut out = "<div class=\"scroll\"><table><thead><tr>".to_owned();
    for cell in head {
        let _ = write!(out, "<th>{cell}</th>");
    }
    out += "</tr></thead><tbody>";
    for row in rows {
        out += "<tr>";
        for cell in row {
            let _ = write!(out, "<td>{}</td>", escape(&cell));
        }
        out += "</tr>";
    }
    out + "</tbody></table></div>"
}

fn spread(spread: Option<Spread>, digits: usize) -> String {
    spread.map_or("–".into(), |s| {
        format!(
            "{:.digits$} / {:.digits$} / {:.digits$}",
            s.median, s.p95, s.max
        )
    })
}

fn outcome(summary: &Summary) -> String {
    let rows = std::iter::once(&summary.all)
        .chain(&summary.groups)
        .map(|g| {
            let [low, high] = g.success_interval_95;
            vec![
                if g.name.is_empty() {
                    "all".into()
                } else {
                    g.name.clone()
                },
                format!("{} of {}", g.placed, g.runs),
                format!(
                    "{:.1} % ({:.1} to {:.1})",
                    g.success_rate * 100.0,
                    low * 100.0,
                    high * 100.0
                ),
                g.aborted.to_string(),
                g.failed.to_string(),
                spread(g.lateral_error_mm, 2),
                spread(g.open_loop_lateral_error_mm, 1),
                format!("{} of {}", g.predicted_held, g.placed),
                g.silent_false_locks.len().to_string(),
            ]
        });
    table(
        &[
            "runs",
            "placed",
            "success (95 % interval)",
            "aborted",
            "failed",
            "lateral error, mm (median / 95 % / max)",
            "open loop, mm",
            "within prediction",
            "silent false locks",
        ],
        rows,
    )
}

/// Share of the values up to each value.
fn cumulative(values: impl Iterator<Item = f64>) -> Vec<(f64, f64)> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    let n = values.len() as f64;
    let share = |i: usize| (i + 1) as f64 / n * 100.0;
    values
        .iter()
        .enumerate()
        .map(|(i, &v)| (v, share(i)))
        .collect()
}

fn distributions(records: &[Record]) -> String {
    let truth = || {
        records
            .iter()
            .filter_map(|r| r.report.as_ref())
            .filter(|r| r.outcome == Outcome::Placed)
            .filter_map(|r| r.truth.as_ref())
    };
    let plot = |title, x_label, name, colour, points| {
        Plot {
            title,
            x_label,
            y_label: "% of runs",
            whole_x: false,
            from_zero: true,
            series: vec![Series {
                name,
                colour,
                points,
                marks: Marks::Line,
            }],
        }
        .svg()
    };
    let lateral = cumulative(truth().filter_map(|t| t.lateral_error_mm));
    let open = cumulative(truth().filter_map(|t| t.open_loop_lateral_error_mm));
    let wall = cumulative(records.iter().map(|r| r.wall_s));
    format!(
        "<div class=\"charts\">{}{}{}</div>",
        plot("Lateral error of the placed", "mm", "placed", BLUE, lateral),
        plot("On kinematics alone", "mm", "open loop", ORANGE, open),
        plot("Wall time of a run", "s", "wall", BLUE, wall)
    )
}

fn faults(summary: &Summary) -> String {
    if summary.faults.is_empty() {
        return "<p>Nothing did.</p>".into();
    }
    let most = summary.faults.iter().map(|f| f.seeds.len()).max();
    let scale = 600.0 / most.unwrap_or(1) as f64;
    let mut out = format!(
        "<svg class=\"timeline\" viewBox=\"0 0 960 {}\" role=\"img\">",
        summary.faults.len() * 28 + 8
    );
    for (i, fault) in summary.faults.iter().enumerate() {
        let y = i * 28 + 4;
        let width = fault.seeds.len() as f64 * scale;
        let _ = write!(
            out,
            "<text x=\"250\" y=\"{}\" text-anchor=\"end\" class=\"phase\">{}</text>\
             <rect x=\"260\" y=\"{y}\" width=\"{width:.1}\" height=\"20\" rx=\"3\" \
             class=\"bar failed\"/><text x=\"{:.1}\" y=\"{}\">{}</text>",
            y + 15,
            escape(&fault.name),
            268.0 + width,
            y + 15,
            fault.seeds.len()
        );
    }
    out + "</svg>"
}

fn times(summary: &Summary) -> String {
    let speed = summary.speed.map_or(String::new(), |speed| {
        format!("<p>Simulated time passes {speed:.1} times as fast as the clock's.</p>")
    });
    let rows = summary.phases.iter().map(|p| {
        vec![
            p.name.clone(),
            p.sim_s.count.to_string(),
            spread(Some(p.sim_s), 2),
            spread(Some(p.wall_s), 2),
        ]
    });
    let head = [
        "phase",
        "runs",
        "simulated, s (median / 95 % / max)",
        "wall, s (median / 95 % / max)",
    ];
    speed + &table(&head, rows)
}

fn runs(records: &[Record]) -> String {
    let rows = records.iter().map(|record| {
        let report = record.report.as_ref();
        let truth = report.and_then(|r| r.truth.as_ref());
        let mm = |v: Option<f64>| v.map_or("–".into(), |v| format!("{v:.2}"));
        let varied: Vec<String> = record
            .varied
            .iter()
            .map(|(path, value)| format!("{path} = {value}"))
            .collect();
        vec![
            record.seed.to_string(),
            match report.map(|r| r.outcome) {
                Some(Outcome::Placed) => "placed".into(),
                Some(Outcome::Aborted) => "aborted".into(),
                None => "failed".into(),
            },
            mm(truth.and_then(|t| t.lateral_error_mm)),
            mm(report.and_then(|r| r.servo.as_ref().map(|s| s.predicted_error_mm))),
            format!("{:.1}", record.wall_s),
            report
                .and_then(|r| r.reason.clone())
                .or_else(|| record.failure.clone())
                .unwrap_or_default(),
            varied.join(", "),
        ]
    });
    let head = [
        "seed",
        "outcome",
        "lateral, mm",
        "predicted, mm",
        "wall, s",
        "reason",
        "drawn",
    ];
    table(&head, rows)
}
