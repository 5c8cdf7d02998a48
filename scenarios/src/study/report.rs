//! The studies as JSON, as lines for a terminal, and as one self-contained page.

use super::{
    compare::{Case, Cell, Comparison, OCCLUSIONS_CM},
    cost::Cost,
    locality::{Locality, Reference},
    table1::Table1,
};
use crate::html::{
    BLUE, GREEN, ORANGE, PURPLE, document, escape,
    plot::{Marks, Plot, Series},
};
use serde::Serialize;
use std::fmt::Write;

/// What the paper says of locality, and what it must mean.
const SENTENCE: &str = "The paper: \u{201c}In order to achieve .5mm positioning accuracy, the error \
    vector can be calculated as far as 16cm away from the target.\u{201d} Its own table 1 has \
    1.2 mm for the same errors with the vector taken at the target itself.";
/// What cannot be known.
const UNKNOWN: &str = "The paper published neither the arm's Denavit-Hartenberg table, nor the \
    cameras' position, nor the targets or the parametrisation of the mount's rotation. Here: the \
    flight arm of the Mars Exploration Rover with its 0.1306 m tool, cameras 0.3 m above the arm's \
    base, targets that fill x 0.35 to 0.66, y \u{b1}0.34, z -0.33 to 0.57 m of the arm's base \
    (z down), the mount's rotation as a rotation vector about the cameras' centre.";

/// The studies that were run.
#[derive(Clone, Debug, Default, Serialize)]
pub struct StudyReport {
    #[serde(skip)]
    together: bool,
    /// Seed of all draws.
    pub seed: u64,
    /// The paper's table 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub table1: Option<Table1>,
    /// The paper's figure 6.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub locality: Option<Locality>,
    /// The methods against each other.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub compare: Option<Comparison>,
    /// What a cycle costs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cost: Option<Cost>,
}

impl StudyReport {
    /// An empty report; `together` keeps each study under its name in the JSON even if there is
    /// only one.
    pub fn new(seed: u64, together: bool) -> Self {
        Self {
            seed,
            together,
            ..Self::default()
        }
    }

    /// The JSON: a single study's own fields, or all studies by name.
    ///
    /// # Errors
    /// [`serde_json::Error`] never, for finite numbers.
    pub fn to_json(&self) -> Result<String, serde_json::Error> {
        let mut value = serde_json::to_value(self)?;
        if !self.together
            && let Some(fields) = value.as_object_mut()
        {
            fields.remove("seed");
            if let Some(only) = fields.iter_mut().next() {
                value = only.1.take();
            }
        }
        serde_json::to_string_pretty(&value).map(|t| t + "\n")
    }

    /// A few lines for a terminal.
    pub fn summary(&self) -> String {
        let mut out = format!("seed {}\n", self.seed);
        if let Some(table) = &self.table1 {
            out += "table1\n  errors (1 sigma)   before: paper, here   after: paper, here   95 %   \
                    second   mm\n";
            for r in &table.rows {
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
            let trials: usize = table.rows.iter().map(|r| r.targets * r.trials).sum();
            let _ = writeln!(
                out,
                "  {trials} trials in {:.1} ms on {} thread(s)\n  {}",
                table.compute_ms,
                table.threads,
                table.verdict()
            );
        }
        if let Some(locality) = &self.locality {
            out += "locality\n  vector taken at               slope   intercept   r2     at 16 cm   \
                    field   with noise\n";
            for r in &locality.references {
                let _ = writeln!(
                    out,
                    "  {:<28} {:>4.1} mm/m {:>5.2} mm   {:.3}  {:>4.1} mm  {:>4.1} mm/m {:>4.1} mm/m",
                    r.name,
                    r.slope_mm_per_m,
                    r.intercept_mm,
                    r.r2,
                    r.error_at_16cm_mm,
                    r.field_slope_mm_per_m,
                    r.field_noisy_slope_mm_per_m
                );
            }
            let _ = writeln!(out, "  {}", locality.verdict());
        }
        if let Some(comparison) = &self.compare {
            out += &compare_lines(comparison);
        }
        if let Some(cost) = &self.cost {
            out += "cost\n  us a cycle with so many sightings\n";
            for m in &cost.methods {
                let _ = write!(out, "  {:<24}", m.name);
                for c in &m.cycles {
                    let _ = write!(out, " {:>3}: {:>8.1}", c.sightings, c.cycle_us);
                }
                out += "\n";
            }
            let _ = writeln!(out, "  {}", cost.verdict());
        }
        out
    }

    /// The page.
    pub fn page(&self) -> String {
        let mut contents = String::new();
        let mut sections = String::new();
        let mut add = |id: &str, title: &str, content: String| {
            let _ = write!(contents, "<li><a href=\"#{id}\">{title}</a></li>");
            let _ = write!(
                sections,
                "<section id=\"{id}\"><h2>{title}</h2>\n{content}\n</section>\n"
            );
        };
        if let Some(table) = &self.table1 {
            add(
                "table1",
                "Table 1: the vector taken at the target",
                table1(table),
            );
        }
        if let Some(locality) = &self.locality {
            add(
                "locality",
                "Figure 6: the vector taken elsewhere",
                locality_section(locality),
            );
        }
        if let Some(comparison) = &self.compare {
            add(
                "compare",
                "The methods against each other",
                compare_section(comparison),
            );
        }
        if let Some(cost) = &self.cost {
            add("cost", "What a cycle costs", cost_section(cost));
        }
        add(
            "unknown",
            "What a re-run cannot know",
            format!("<p>{}</p>", escape(UNKNOWN)),
        );
        let title = "The paper's analysis, carried out again";
        let body = format!(
            "<header><h1>{title}</h1><p class=\"lead\">Vision-based end-effector position error \
             compensation: sections 5 and 6 of the paper, every number beside ours.</p></header>\n\
             <section><h2>Contents</h2><ul>{contents}</ul></section>\n{sections}"
        );
        let footer = format!(
            "rover {} · seed <b>{}</b>",
            env!("CARGO_PKG_VERSION"),
            self.seed
        );
        document(title, &body, &footer)
    }
}

fn verdict(text: &str) -> String {
    format!("<p><b>Verdict.</b> {}</p>", escape(text))
}

fn table1(table: &Table1) -> String {
    let mut rows = String::new();
    for r in &table.rows {
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
    let stages = |of: &dyn Fn(&super::table1::Row) -> Vec<f64>, i: usize| -> Vec<(f64, f64)> {
        let values = table.rows.get(i).map(of).unwrap_or_default();
        values
            .into_iter()
            .enumerate()
            .map(|(k, mm)| (k as f64, mm.log10()))
            .collect()
    };
    let ours =
        |r: &super::table1::Row| vec![r.before_mm, r.after_mm, r.after_two_mm, r.after_three_mm];
    let paper = |r: &super::table1::Row| vec![r.paper_before_mm, r.paper_after_mm];
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
        "{}<div class=\"charts\">{}</div><div class=\"scroll\"><table><tr><th class=\"text\">errors, \
         one sigma</th><th>before: paper, mm</th><th>here</th><th>after: paper, mm</th><th>here</th>\
         <th>here, 95 %</th><th>second</th><th>third</th><th>targets x draws</th></tr>{rows}</table>\
         </div><p>Computed in {:.1} ms on {} thread(s), seed {}.</p>",
        verdict(&table.verdict()),
        plot.svg(),
        table.compute_ms,
        table.threads,
        table.seed
    )
}

/// One reference place as a plot: every target, the fitted line, the field, the open loop.
fn scatter(r: &Reference) -> String {
    let points = |of: fn(&super::locality::LocalityPoint) -> f64| {
        r.points
            .iter()
            .map(|p| (p.distance_m * 100.0, of(p)))
            .collect()
    };
    let far = r.points.last().map_or(0.0, |p| p.distance_m);
    let line = |x: f64| (x * 100.0, r.intercept_mm + r.slope_mm_per_m * x);
    Plot {
        title: r.name,
        x_label: "distance from where the vector was taken, cm",
        y_label: "mm",
        whole_x: false,
        from_zero: true,
        series: vec![
            Series {
                name: "one vector",
                colour: BLUE,
                points: points(|p| p.error_mm),
                marks: Marks::Dots,
            },
            Series {
                name: "its line",
                colour: BLUE,
                points: vec![line(0.0), line(far)],
                marks: Marks::Line,
            },
            Series {
                name: "field, 0.3 mm noise",
                colour: GREEN,
                points: points(|p| p.field_noisy_mm),
                marks: Marks::Dots,
            },
            Series {
                name: "paper: 16 cm, read 5 mm",
                colour: ORANGE,
                points: vec![(16.0, 5.0)],
                marks: Marks::Dots,
            },
        ],
    }
    .svg()
}

fn locality_section(locality: &Locality) -> String {
    let mut rows = String::new();
    let mut charts = String::new();
    for r in &locality.references {
        charts += &scatter(r);
        let open_loop: f64 =
            r.points.iter().map(|p| p.open_loop_mm).sum::<f64>() / r.points.len().max(1) as f64;
        let five = r
            .five_mm_at_m
            .map_or("–".to_owned(), |m| format!("{:.0} cm", m * 100.0));
        let _ = write!(
            rows,
            "<tr><td class=\"text\">{}</td><td>{:.1}</td><td>{:.1}</td><td>{:.2}</td><td>{:.3}</td>\
             <td>{:.1}</td><td>{five}</td><td>{:.1}</td><td>{:.1}</td><td>{:.0} %</td></tr>",
            r.name,
            open_loop,
            r.slope_mm_per_m,
            r.intercept_mm,
            r.r2,
            r.error_at_16cm_mm,
            r.field_slope_mm_per_m,
            r.field_noisy_slope_mm_per_m,
            r.field_noisy_coverage * 100.0
        );
    }
    format!(
        "{}<p>{SENTENCE}</p><div class=\"charts\">{charts}</div><div class=\"scroll\"><table><tr>\
         <th class=\"text\">vector taken at</th><th>open loop, mm</th><th>slope, mm/m</th>\
         <th>intercept, mm</th><th>r2</th><th>at 16 cm, mm</th><th>5 mm at</th><th>field, mm/m</th>\
         <th>with noise, mm/m</th><th>95 % bound held</th></tr>{rows}</table></div>\
         <p>1 deg and 2.5 mm, {} draws, seed {}; the tool points straight down everywhere. The field \
         is made from six vectors seen on a bent way of about 30 cm to the reference place.</p>",
        verdict(&locality.verdict()),
        locality.trials,
        locality.seed
    )
}

/// A number of millimetres, or that too many trials failed.
fn mm(x: Option<f64>) -> String {
    x.map_or("–".to_owned(), |x| format!("{x:.2}"))
}

/// The medians of one case, a line per method and a column per blind part.
fn cells(comparison: &Comparison, case: Case) -> Vec<(&'static str, Vec<&Cell>)> {
    let mut lines: Vec<(&'static str, Vec<&Cell>)> = Vec::new();
    for cell in comparison.methods.iter().filter(|c| c.case == case) {
        match lines.iter_mut().find(|l| l.0 == cell.name) {
            Some(line) => line.1.push(cell),
            None => lines.push((cell.name, vec![cell])),
        }
    }
    lines
}

fn compare_lines(comparison: &Comparison) -> String {
    let mut out = String::from("compare\n");
    for case in Case::ALL {
        let lines = cells(comparison, case);
        if lines.is_empty() {
            continue;
        }
        let _ = writeln!(
            out,
            "  {}; median error in mm, blind for {OCCLUSIONS_CM:?} cm",
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
    }
    let _ = writeln!(out, "  {}", comparison.verdict());
    out
}

fn compare_section(comparison: &Comparison) -> String {
    let mut out = verdict(&comparison.verdict());
    let _ = write!(
        out,
        "<p>Six looks on a straight approach of 25 cm, the last part blind; 1 deg and 2.5 mm, \
         0.05 px of noise on target and fiducial; {}; seed {}. In brackets: the median that an \
         independent program found beforehand in the same set-up. A dash: more trials failed than \
         the number allows. Computing times are of this machine. Not in it: image borders, contact, \
         droop.</p>",
        comparison.source, comparison.seed
    );
    for case in Case::ALL {
        let lines = cells(comparison, case);
        if lines.is_empty() {
            continue;
        }
        let mut rows = String::new();
        for (name, cells) in &lines {
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
        let plot = Plot {
            title: case.name(),
            x_label: "blind for the last, cm",
            y_label: "median, mm",
            whole_x: false,
            from_zero: true,
            series,
        };
        let _ = write!(
            out,
            "<h3>{}</h3><div class=\"charts\">{}</div><div class=\"scroll\"><table><tr>\
             <th class=\"text\">method</th>{head}<th>images</th><th>us a cycle</th>\
             <th>us a placement</th><th>placed</th><th class=\"text\">needs to know</th></tr>{rows}\
             </table></div>",
            case.name(),
            plot.svg()
        );
    }
    out
}

fn cost_section(cost: &Cost) -> String {
    let mut rows = String::new();
    let mut head = String::new();
    for (i, m) in cost.methods.iter().enumerate() {
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
        "{}<p>Time of one cycle on this machine with so many sightings, and on a 200 MHz \
         radiation-hardened processor that is assumed to be {:.0} times slower: 15 by its clock, 4 \
         because it does at best one floating-point operation per cycle, without vector unit and \
         with small caches. The factor is an assumption, not a measurement.</p>\
         <div class=\"scroll\"><table><tr><th class=\"text\">method</th>{head}<th>bytes kept</th></tr>\
         {rows}</table></div>",
        verdict(&cost.verdict()),
        cost.flight_factor
    )
}
