//! Cost on page and terminal.

use super::Shown;
use crate::cost::Cost;
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
                let _ = write!(out, " {:>3}: {:>8.1}", c.sightings, c.cycle_us);
            }
            out += "\n";
        }

        out
    }

    fn section(&self) -> String {
        let mut rows = String::new();
        let mut head = String::new();
        for (i, m) in self.methods.iter().enumerate() {
            let _ = write!(rows, "<tr><td class=\"text\">{}</td>", m.name);
            for c in &m.cycles {
                if i == 0 {
                    let _ = write!(head, "<th>{}: us</th><th>flight, ms</th>", c.sightings);
                }
                let _ = write!(
                    rows,
                    "<td>{:.2}</td><td>{:.3}</td>",
                    c.cycle_us, c.flight_ms
                );
            }
            let bytes = m.cycles.last().map_or(0, |c| c.state_bytes);
            let _ = write!(rows, "<td>{bytes}</td></tr>");
        }
        format!(
            "<p>Time of one cycle on this machine with so many sightings, and on a 200 MHz \
         radiation-hardened processor that is assumed to be {:.0} times slower: 15 by its clock, 4 \
         because it does at best one floating-point operation per cycle, without vector unit and \
         with small caches. The factor is an assumption, not a measurement.</p>\
         <div class=\"scroll\"><table><tr><th class=\"text\">method</th>{head}<th>bytes kept</th></tr>\
         {rows}</table></div>",
            self.flight_factor
        )
    }
}
