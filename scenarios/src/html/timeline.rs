//! The phases of a run over simulated time.

use crate::report::Phase;
use rover_page::escape;
use std::{collections::BTreeMap, fmt::Write};

const WIDTH: f64 = 960.0;
const LEFT: f64 = 110.0;
const RIGHT: f64 = 210.0;
const ROW: f64 = 30.0;

/// One bar for each phase, the times in words beside it.
pub(super) fn timeline(phases: &[Phase]) -> String {
    let total: f64 = phases.iter().map(|p| p.sim_s).sum();
    let scale = (WIDTH - LEFT - RIGHT) / total.max(1e-9);
    let bottom = ROW * phases.len() as f64 + 6.0;
    let mut out = format!(
        "<svg class=\"timeline\" viewBox=\"0 0 {WIDTH} {}\" role=\"img\">",
        bottom + 30.0
    );
    let step = nice_step(total);
    let ticks = (total / step + 1e-9).floor().clamp(0.0, 100.0) as usize;
    for i in 0..=ticks {
        let t = i as f64 * step;
        let x = LEFT + t * scale;
        let _ = write!(
            out,
            "<line x1=\"{x:.1}\" x2=\"{x:.1}\" y1=\"0\" y2=\"{bottom}\" class=\"grid\"/>\
             <text x=\"{x:.1}\" y=\"{}\" text-anchor=\"middle\">{t} s</text>",
            bottom + 18.0
        );
    }
    let mut start = 0.0;
    for (i, phase) in phases.iter().enumerate() {
        let y = i as f64 * ROW + 4.0;
        let class = if phase.outcome == "done" {
            "bar"
        } else {
            "bar failed"
        };
        let outcome = if phase.outcome == "done" {
            String::new()
        } else {
            format!(" · {}", escape(&phase.outcome))
        };
        let _ = write!(
            out,
            "<text x=\"{}\" y=\"{}\" text-anchor=\"end\" class=\"phase\">{}</text>\
             <rect x=\"{:.1}\" y=\"{y}\" width=\"{:.1}\" height=\"{}\" rx=\"3\" class=\"{class}\"/>\
             <text x=\"{}\" y=\"{}\">{:.2} s, {:.2} s wall{outcome}</text>",
            LEFT - 10.0,
            y + 16.0,
            escape(&phase.name),
            LEFT + start * scale,
            (phase.sim_s * scale).max(3.0),
            ROW - 8.0,
            WIDTH - RIGHT + 14.0,
            y + 16.0,
            phase.sim_s,
            phase.wall_s,
        );
        start += phase.sim_s;
    }
    out + "</svg>"
}

/// Where the wall time went, in words.
pub(super) fn kinds(wall_by_kind_s: &BTreeMap<String, f64>) -> String {
    let total_s: f64 = wall_by_kind_s.values().sum();
    if total_s <= 0.0 {
        return String::new();
    }
    let kinds: Vec<String> = wall_by_kind_s
        .iter()
        .map(|(kind, s)| {
            let percent = 100.0 * s / total_s;
            format!("{} {s:.1} s ({percent:.0} %)", escape(kind))
        })
        .collect();
    format!(
        "<p>Wall time by kind of computing: {}. The bus has what the others leave.</p>",
        kinds.join(", ")
    )
}

fn nice_step(total_s: f64) -> f64 {
    let steps = [
        0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0,
    ];
    steps
        .into_iter()
        .find(|s| total_s / s <= 10.0)
        .unwrap_or(3600.0)
}
