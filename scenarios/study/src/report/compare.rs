//! The comparison of methods on page and terminal.

use super::{Shown, mm};
use crate::compare::{Case, Cell, Comparison, OCCLUSIONS_CM};
use rover_page::{
    BLUE, GREEN, ORANGE, PURPLE, escape,
    plot::{Marks, Plot, Series},
};
use std::fmt::Write;

impl Shown for Comparison {
    const NAME: &'static str = "compare";
    const TITLE: &'static str = "The methods against each other";

    fn verdict(&self) -> String {
        Comparison::verdict(self)
    }

    fn lines(&self) -> String {
        let mut out = String::new();
        for case in Case::ALL {
            let lines = cells(self, case);
            if lines.is_empty() {
                continue;
            }
            let of = lines.first().and_then(|l| l.1.first()).map_or(0, |c| c.of);
            let _ = writeln!(
                out,
                "  {}; median error of {of} in mm, blind for {OCCLUSIONS_CM:?} cm",
                case.name()
            );
            for (name, cells) in lines {
                let medians: Vec<String> = cells
                    .iter()
                    .map(|c| format!("{:>7}", mm(c.median_mm)))
                    .collect();
                let _ = writeln!(
                    out,
                    "  {name:<24}{}   {:>2} images  {:>8.1} us a cycle",
                    medians.concat(),
                    cells.first().map_or(0, |c| c.images),
                    cells.first().map_or(0.0, |c| c.cycle_us)
                );
            }
            for loss in self.losses(case) {
                let _ = writeln!(out, "    {loss}");
            }
        }
        out
    }

    fn section(&self) -> String {
        let mut out = format!("<p>{SET_UP} Seed {}.</p>", self.seed);
        for case in Case::ALL {
            let lines = cells(self, case);
            if lines.is_empty() {
                continue;
            }
            let losses = self.losses(case).into_iter();
            let losses: String = losses.map(|l| format!("<li>{}</li>", escape(&l))).collect();
            let note = if case.is_rendered() {
                format!("<p>{IMAGES}</p>")
            } else {
                String::new()
            };
            let _ = write!(
                out,
                "<h3>{}</h3>{note}<ul>{losses}</ul><div class=\"charts\">{}</div>{}",
                case.name(),
                plot(case, &lines),
                table(&lines)
            );
        }
        out
    }
}

const SET_UP: &str = "Six looks on a straight approach of 25 cm, the last part blind; 1 deg and 2.5 \
    mm. Unless a heading says images, pixels come from the true geometry with 0.05 px of noise on \
    target and fiducial, without image borders, contact or droop. In brackets: the median that an \
    independent program found beforehand in the same set-up. A dash: more trials failed than the \
    number allows. Computing times are of this machine.";
const IMAGES: &str = "Rendered images of the testbed, drooping arm; the servo's own detector and \
    loop, so the time of a cycle contains the search for the fiducial. The target is a fiducial of \
    the same kind, found in images too. With the pose of the plate the servo's epec and \
    epec_field correct the tool's direction as well; all other methods see the tip's position \
    alone. The predicted error refuses nothing here.";

/// A line per method, and two columns per blind part.
fn table(lines: &[Line]) -> String {
    let mut rows = String::new();
    for (name, cells) in lines {
        let Some(first) = cells.first() else { continue };
        let _ = write!(rows, "<tr><td class=\"text\">{name}</td>");
        for c in cells {
            let independent = c
                .independent_mm
                .map_or(String::new(), |m| format!(" ({m})"));
            let _ = write!(
                rows,
                "<td>{}{independent}</td><td>{}</td>",
                mm(c.median_mm),
                mm(c.p95_mm)
            );
        }
        let placed: usize = cells.iter().map(|c| c.placed).sum();
        let of: usize = cells.iter().map(|c| c.of).sum();
        let _ = write!(
            rows,
            "<td>{}</td><td>{:.1}</td><td>{:.0}</td><td>{placed}/{of}</td>\
             <td class=\"text note\">{}</td></tr>",
            first.images, first.cycle_us, first.placement_us, first.needs
        );
    }
    let head: String = lines
        .first()
        .map(|l| l.1.iter())
        .into_iter()
        .flatten()
        .map(|c| format!("<th>blind {} cm, mm</th><th>95 %</th>", c.occlusion_cm))
        .collect();
    format!(
        "<div class=\"scroll\"><table><tr><th class=\"text\">method</th>{head}<th>images</th>\
         <th>us a cycle</th><th>us a placement</th><th>placed</th>\
         <th class=\"text\" style=\"min-width:18rem\">needs to know</th></tr>{rows}</table></div>"
    )
}

fn plot(case: Case, lines: &[Line]) -> String {
    let drawn = [
        ("epec", "EPEC", BLUE),
        ("epec_field", "field", GREEN),
        ("hips_approach", "HIPS", ORANGE),
        ("camera_space", "CSM", PURPLE),
    ];
    let series = drawn
        .into_iter()
        .map(|(name, label, colour)| Series {
            name: label,
            colour,
            points: lines
                .iter()
                .filter(|l| l.0 == name)
                .flat_map(|l| &l.1)
                .filter_map(|c| Some((f64::from(c.occlusion_cm), c.median_mm?)))
                .collect(),
            marks: Marks::Joined,
        })
        .collect();
    Plot {
        title: case.name(),
        x_label: "blind for the last, cm",
        y_label: "mm",
        whole_x: false,
        from_zero: true,
        series,
    }
    .svg()
}

/// A method's name and its cells.
type Line<'a> = (&'static str, Vec<&'a Cell>);

/// The medians of one case, a line per method and a column per blind part.
fn cells(comparison: &Comparison, case: Case) -> Vec<Line<'_>> {
    let mut lines: Vec<Line<'_>> = Vec::new();
    for cell in comparison.methods.iter().filter(|c| c.case == case) {
        match lines.iter_mut().find(|l| l.0 == cell.name) {
            Some(line) => line.1.push(cell),
            None => lines.push((cell.name, vec![cell])),
        }
    }
    lines
}
