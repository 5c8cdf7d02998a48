//! Cost on page and terminal.

use super::Shown;
use crate::cost::{Cost, SIGHTINGS};
use std::fmt::Write;

impl Shown for Cost {
    const NAME: &'static str = "cost";
    const TITLE: &'static str = "What a cycle costs";

    fn verdict(&self) -> String {
        Cost::verdict(self)
    }

    fn lines(&self) -> String {
        let mut out = String::from("  us a cycle with so many sightings\n");
        for m in &self.methods {
            let _ = write!(out, "  {:<24}", m.name);
            for c in &m.cycles {
                let _ = write!(out, " {:>3}: {:>8.2}", c.sightings, c.cycle_us);
            }
            out += "\n";
        }

        out
    }

    fn section(&self) -> String {
        let mut rows = String::new();
        for m in &self.methods {
            let _ = write!(rows, "<tr><td class=\"text\">{}</td>", m.name);
            for n in SIGHTINGS {
                // A method without an answer for so few sightings has no cost there.
                let _ = match m.cycles.iter().find(|c| c.sightings == n) {
                    Some(c) => write!(
                        rows,
                        "<td>{:.2}</td><td>{:.3}</td>",
                        c.cycle_us, c.flight_ms
                    ),
                    None => write!(rows, "<td>–</td><td>–</td>"),
                };
            }
            let bytes = m.cycles.last().map_or(0, |c| c.state_bytes);
            let _ = write!(rows, "<td>{bytes}</td></tr>");
        }
        let groups: String = SIGHTINGS
            .iter()
            .map(|n| {
                let plural = if *n == 1 { "" } else { "s" };
                format!("<th class=\"group\" colspan=\"2\">{n} sighting{plural}</th>")
            })
            .collect();
        let pairs = "<th>here, us</th><th>flight, ms</th>".repeat(SIGHTINGS.len());
        let most = SIGHTINGS.last().copied().unwrap_or(0);
        format!(
            "<p>Time of one cycle on this machine with so many sightings, and on a 200 MHz \
         radiation-hardened processor that is assumed to be {:.0} times slower: 15 by its clock, 4 \
         because it does at best one floating-point operation per cycle, without vector unit and \
         with small caches. The factor is an assumption, not a measurement. \
         hips_limited fits before the approach; its cycles are without a fit.</p>\
         <div class=\"scroll\"><table><tr><th class=\"text\" rowspan=\"2\">method</th>{groups}\
         <th rowspan=\"2\">bytes kept<br>with {most}</th></tr><tr>{pairs}</tr>{rows}</table></div>",
            self.flight_factor
        )
    }
}
