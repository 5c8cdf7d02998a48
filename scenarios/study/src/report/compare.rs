//! The comparison of methods on page and terminal.

use super::{Shown, mm};
use crate::compare::{Case, Cell, Comparison, OCCLUSIONS_CM, is_better};
use rover_methods::Kind;
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
        let mut out = format!(
            "<p>{SET_UP} Seed {}.</p>{}{}",
            self.seed,
            methods(self),
            poses(self)
        );
        for case in Case::ALL {
            let lines = cells(self, case);
            let Some(of) = lines.first().and_then(|l| l.1.first()).map(|c| c.of) else {
                continue;
            };
            let losses = self.losses(case).into_iter();
            let losses: String = losses.map(|l| format!("<li>{}</li>", escape(&l))).collect();
            let note = if case.is_rendered() {
                format!("<p>{IMAGES}</p>")
            } else {
                String::new()
            };
            let _ = write!(
                out,
                "<h3>{}, {of} trials</h3>{note}<div class=\"charts\">{}<ul>{losses}</ul></div>{}",
                capitalised(case.name()),
                plot(&lines),
                table(case, &lines)
            );
        }
        out
    }
}

const SET_UP: &str = "Six looks on a straight approach of 25 cm, the last part blind; 1 deg and 2.5 \
    mm. Unless a heading says images, pixels come from the true geometry with 0.05 px of noise on \
    target and fiducial, without image borders, contact or droop. Errors are those of the true tip \
    against the true target, all three components. In brackets: the median that an independent \
    program found beforehand. Bold: better than EPEC by more than 2 %. A dash: more trials failed \
    than the number allows. Computing times are of this machine, while it ran all trials on all its \
    cores.";
const IMAGES: &str = "Rendered images of the testbed, drooping arm; the servo\u{2019}s own detector \
    and loop, so the times contain the search for the fiducial and the servo\u{2019}s prediction of \
    its error (for kinematics, which takes no image of the arm, that alone). The target is a \
    fiducial of the same kind, found in images too. With the pose of the plate the servo\u{2019}s \
    epec and epec_field correct the tool\u{2019}s direction as well; all other methods see the \
    tip\u{2019}s position alone. The predicted error refuses nothing here.";

/// The methods in words, once for all cases.
fn methods(comparison: &Comparison) -> String {
    let mut rows = String::new();
    let mut seen: Vec<&str> = Vec::new();
    for c in &comparison.methods {
        if seen.contains(&c.name) {
            continue;
        }
        seen.push(c.name);
        let _ = write!(
            rows,
            "<tr><td class=\"text\">{}</td><td class=\"text\">{}</td><td class=\"text note\">{}\
             </td><td>{}</td></tr>",
            c.name,
            escape(c.title),
            escape(c.needs),
            c.images
        );
    }
    format!(
        "<div class=\"scroll\"><table><tr><th class=\"text\">name</th><th class=\"text\">method\
         </th><th class=\"text\">needs to know</th><th>image pairs</th></tr>{rows}</table></div>"
    )
}

/// Where the independent program differs, and what of its set-up is not known.
fn poses(comparison: &Comparison) -> String {
    let outside = comparison.disagreements();
    let mut rows = String::new();
    for (c, here, there) in &outside {
        let _ = write!(
            rows,
            "<tr><td class=\"text\">{}</td><td class=\"text\">{}, blind {} cm</td><td>{here:.2}\
             </td><td>{there:.2}</td></tr>",
            c.name,
            c.case.name(),
            c.occlusion_cm
        );
    }
    if !rows.is_empty() {
        rows = format!(
            "<div class=\"scroll\"><table><tr><th class=\"text\">more than 20 % apart</th>\
             <th class=\"text\">case</th><th>here, mm</th><th>independent, mm</th></tr>{rows}\
             </table></div>"
        );
    }
    format!("<p style=\"margin-top:16px\">{POSES}</p>{rows}")
}

const POSES: &str = "Methods with 12 or 18 image pairs look at 12 poses before the approach. The \
    independent program states how widely its poses are spread in three directions (119, 70 and 45 \
    mm rms) and that none is nearer to the target than 10 cm, but neither these directions nor \
    where the middle is; both were chosen here among some thirty so that these methods agree with \
    it. They matter: with a lens that the models do not know the limited HIPS ends 4 to 14 mm from \
    the target, depending on which part of the lens the poses show, and the linear camera-space \
    method extrapolates the better the nearer they are.";

fn capitalised(text: &str) -> String {
    let mut rest = text.chars();
    let first = rest.next().map(|c| c.to_uppercase().to_string());
    first.unwrap_or_default() + rest.as_str()
}

/// A line per method, and two columns per blind part.
fn table(case: Case, lines: &[Line]) -> String {
    let epec: Vec<Option<f64>> = lines
        .iter()
        .find(|l| l.0 == Kind::Epec.name())
        .map(|l| l.1.iter().map(|c| c.median_mm).collect())
        .unwrap_or_default();
    let time = |us: f64| {
        if case.is_rendered() {
            format!("{:.1}", us * 1e-3)
        } else {
            format!("{us:.1}")
        }
    };
    let mut rows = String::new();
    for (name, cells) in lines {
        let Some(first) = cells.first() else { continue };
        let _ = write!(rows, "<tr><td class=\"text\">{name}</td>");
        for (i, c) in cells.iter().enumerate() {
            let better = match (c.median_mm, epec.get(i).copied().flatten()) {
                (Some(median), Some(epec)) => is_better(median, epec),
                _ => false,
            };
            let median = mm(c.median_mm);
            let median = if better {
                format!("<b>{median}</b>")
            } else {
                median
            };
            let independent = c
                .independent_mm
                .map_or(String::new(), |m| format!(" ({m})"));
            let _ = write!(
                rows,
                "<td>{median}{independent}</td><td>{}</td>",
                mm(c.p95_mm)
            );
        }
        let placed: usize = cells.iter().map(|c| c.placed).sum();
        let of: usize = cells.iter().map(|c| c.of).sum();
        let cycle = if first.images == 0 {
            "–".to_owned()
        } else {
            time(first.cycle_us)
        };
        let _ = write!(
            rows,
            "<td>{}</td><td>{cycle}</td><td>{}</td><td>{placed}/{of}</td></tr>",
            first.images,
            time(first.placement_us),
        );
    }
    let cells = || lines.first().map(|l| l.1.iter()).into_iter().flatten();
    let blind: String = cells()
        .map(|c| match c.occlusion_cm {
            0 => "<th class=\"group\" colspan=\"2\">seen to the end</th>".to_owned(),
            cm => format!("<th class=\"group\" colspan=\"2\">blind for {cm} cm</th>"),
        })
        .collect();
    let pairs = "<th>median, mm</th><th>95 %</th>".repeat(cells().count());
    let unit = if case.is_rendered() { "ms" } else { "us" };
    format!(
        "<div class=\"scroll\"><table><tr><th class=\"text\" rowspan=\"2\">method</th>{blind}\
         <th class=\"group\">image</th><th class=\"group\" colspan=\"2\">computing, {unit}</th>\
         <th rowspan=\"2\">placed</th></tr><tr>{pairs}<th>pairs</th><th>a cycle</th>\
         <th>all</th></tr>{rows}</table></div>"
    )
}

fn plot(lines: &[Line]) -> String {
    let drawn = [
        ("epec", "EPEC", BLUE),
        ("epec_field", "field", GREEN),
        ("hips_approach", "HIPS, approach alone", ORANGE),
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
        title: "median error",
        x_label: "length of the blind last part, cm",
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
