//! Line plots with axes, as SVG.

use std::fmt::Write;

const WIDTH: f64 = 460.0;
const HEIGHT: f64 = 270.0;
const LEFT: f64 = 52.0;
const RIGHT: f64 = 14.0;
const TOP: f64 = 48.0;
const BOTTOM: f64 = 40.0;

/// One line.
pub struct Series {
    /// What it is called.
    pub name: &'static str,
    /// CSS colour.
    pub colour: &'static str,
    /// x and y.
    pub points: Vec<(f64, f64)>,
    /// How its points are drawn.
    pub marks: Marks,
}

/// How the points of a series are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Marks {
    /// Dots joined by a line.
    Joined,
    /// Dots alone.
    Dots,
    /// The line alone.
    Line,
    /// Open circles, for values of others.
    Rings,
}

/// Some lines over common axes.
pub struct Plot {
    /// Title.
    pub title: &'static str,
    /// What x is, with its unit.
    pub x_label: &'static str,
    /// What y is, with its unit.
    pub y_label: &'static str,
    /// Ticks of x at whole numbers only.
    pub whole_x: bool,
    /// The y axis begins at zero.
    pub from_zero: bool,
    /// The lines.
    pub series: Vec<Series>,
}

/// A linear axis in picture coordinates.
struct Axis {
    low: f64,
    high: f64,
    at_low: f64,
    at_high: f64,
    ticks: Vec<f64>,
    digits: usize,
}

impl Axis {
    fn new(low: f64, high: f64, at_low: f64, at_high: f64, ticks_n: f64, whole: bool) -> Self {
        let raw = ((high - low) / ticks_n).max(1e-12);
        let magnitude = 10f64.powf(raw.log10().floor());
        let factor = [1.0, 2.0, 2.5, 5.0, 10.0]
            .into_iter()
            .find(|f| f * magnitude >= raw * 0.999)
            .unwrap_or(10.0);
        let mut step = factor * magnitude;
        if whole {
            step = step.round().max(1.0);
        }
        let first = (low / step - 1e-9).ceil();
        let last = (high / step + 1e-9).floor();
        let count = (last - first).clamp(0.0, 50.0) as usize;
        let ticks = (0..=count).map(|i| (first + i as f64) * step).collect();
        let digits = (0..4).find(|d| {
            let scaled = step * 10f64.powi(*d);
            (scaled - scaled.round()).abs() < 1e-6
        });
        Self {
            low,
            high,
            at_low,
            at_high,
            ticks,
            digits: digits.unwrap_or(4) as usize,
        }
    }

    fn at(&self, x: f64) -> f64 {
        self.at_low + (x - self.low) / (self.high - self.low) * (self.at_high - self.at_low)
    }

    /// A tick's number; a zero has no sign. On an axis of decades the tick is the power of ten.
    fn text(&self, x: f64, decades: bool) -> String {
        if decades {
            return format!("{}", 10f64.powi(x.round() as i32));
        }
        let x = if x.abs() < 1e-9 { 0.0 } else { x };
        format!("{x:.0$}", self.digits)
    }
}

impl Series {
    /// One point as this series shows it; nothing where the line is all.
    fn mark(&self, u: f64, v: f64) -> String {
        let (radius, style) = match self.marks {
            Marks::Line => return String::new(),
            Marks::Joined => (3.2, format!("fill=\"{}\"", self.colour)),
            Marks::Dots => (2.2, format!("fill=\"{}\"", self.colour)),
            Marks::Rings => (
                5.0,
                format!(
                    "fill=\"none\" stroke=\"{}\" stroke-width=\"2\"",
                    self.colour
                ),
            ),
        };
        format!("<circle cx=\"{u:.1}\" cy=\"{v:.1}\" r=\"{radius}\" {style}/>")
    }

    /// Its sign in the legend, `left` of its name.
    fn key(&self, left: f64) -> String {
        if matches!(self.marks, Marks::Dots | Marks::Rings) {
            let series = Self {
                name: self.name,
                colour: self.colour,
                points: Vec::new(),
                marks: if self.marks == Marks::Dots {
                    Marks::Joined
                } else {
                    Marks::Rings
                },
            };
            return series.mark(left + 6.0, 32.0);
        }
        format!(
            "<line x1=\"{left}\" x2=\"{}\" y1=\"32\" y2=\"32\" stroke=\"{}\" \
             stroke-width=\"2\"/>{}",
            left + 12.0,
            self.colour,
            self.mark(left + 6.0, 32.0)
        )
    }
}

impl Plot {
    /// The plot; without points it says so.
    pub fn svg(&self) -> String {
        self.drawn(false)
    }

    /// The plot with a logarithmic y axis; points that are not above zero are left out.
    pub fn svg_in_decades(&self) -> String {
        let in_decades = |s: &Series| Series {
            points: s
                .points
                .iter()
                .filter(|p| p.1 > 0.0)
                .map(|p| (p.0, p.1.log10()))
                .collect(),
            ..*s
        };
        Self {
            series: self.series.iter().map(in_decades).collect(),
            from_zero: false,
            ..*self
        }
        .drawn(true)
    }

    fn drawn(&self, decades: bool) -> String {
        let mut out = format!(
            "<svg class=\"plot\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\">\
             <text x=\"{LEFT}\" y=\"18\" class=\"title\">{}</text>",
            self.title
        );
        let all = || self.series.iter().flat_map(|s| &s.points);
        if all().next().is_none() {
            return out
                + "<text x=\"230\" y=\"140\" text-anchor=\"middle\">nothing seen</text></svg>";
        }
        let (x, y) = self.axes(all(), decades);
        let (bottom, right) = (HEIGHT - BOTTOM, WIDTH - RIGHT);
        for &t in &y.ticks {
            let v = y.at(t);
            let zero = if t.abs() < 1e-9 && !decades {
                " zero"
            } else {
                ""
            };
            let _ = write!(
                out,
                "<line x1=\"{LEFT}\" x2=\"{right}\" y1=\"{v:.1}\" y2=\"{v:.1}\" class=\"grid{zero}\"/>\
                 <text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
                LEFT - 7.0,
                v + 4.0,
                y.text(t, decades)
            );
        }
        for &t in &x.ticks {
            let u = x.at(t);
            let _ = write!(
                out,
                "<line x1=\"{u:.1}\" x2=\"{u:.1}\" y1=\"{bottom}\" y2=\"{}\" class=\"axis\"/>\
                 <text x=\"{u:.1}\" y=\"{}\" text-anchor=\"middle\">{}</text>",
                bottom + 4.0,
                bottom + 17.0,
                x.text(t, false)
            );
        }
        // beside the axis if it fits there
        let (y_label_at, anchor) = if self.y_label.chars().count() <= 7 {
            (LEFT - 7.0, "end")
        } else {
            (2.0, "start")
        };
        let _ = write!(
            out,
            "<path d=\"M{LEFT} {TOP}V{bottom}H{right}\" class=\"axis\" fill=\"none\"/>\
             <text x=\"{}\" y=\"{}\" text-anchor=\"middle\">{}</text>\
             <text x=\"{}\" y=\"{}\" text-anchor=\"{anchor}\">{}</text>",
            (LEFT + right) / 2.0,
            HEIGHT - 6.0,
            self.x_label,
            y_label_at,
            TOP - 9.0,
            self.y_label
        );
        let mut legend = LEFT;
        for s in &self.series {
            let points: Vec<_> = s
                .points
                .iter()
                .map(|p| format!("{:.1},{:.1}", x.at(p.0), y.at(p.1)))
                .collect();
            if matches!(s.marks, Marks::Joined | Marks::Line) {
                let _ = write!(
                    out,
                    "<polyline points=\"{}\" fill=\"none\" stroke=\"{}\" stroke-width=\"2\"/>",
                    points.join(" "),
                    s.colour
                );
            }
            for p in &s.points {
                out += &s.mark(x.at(p.0), y.at(p.1));
            }
            if self.series.len() > 1 && !s.name.is_empty() {
                out += &s.key(legend);
                let _ = write!(
                    out,
                    "<text x=\"{}\" y=\"36\">{}</text>",
                    legend + 16.0,
                    s.name
                );
                legend += 30.0 + 6.6 * s.name.chars().count() as f64;
            }
        }
        out + "</svg>"
    }

    fn axes<'a>(&self, all: impl Iterator<Item = &'a (f64, f64)>, decades: bool) -> (Axis, Axis) {
        let mut x = (f64::INFINITY, f64::NEG_INFINITY);
        let mut y = x;
        for p in all {
            x = (x.0.min(p.0), x.1.max(p.0));
            y = (y.0.min(p.1), y.1.max(p.1));
        }
        if self.from_zero {
            y.0 = y.0.min(0.0);
        }
        let margin = |(low, high): (f64, f64), share: f64, least: f64| {
            let m = ((high - low) * share).max(least);
            (low - m, high + m)
        };
        let x = margin(x, 0.04, if self.whole_x { 0.3 } else { 1e-6 });
        let low = y.0;
        let mut y = margin(y, 0.08, 1e-3);
        if self.from_zero && low >= 0.0 {
            y.0 = 0.0;
        }
        (
            Axis::new(x.0, x.1, LEFT, WIDTH - RIGHT, 8.0, self.whole_x),
            Axis::new(y.0, y.1, HEIGHT - BOTTOM, TOP, 5.0, decades),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_numbers_inside_the_axis() {
        let axis = Axis::new(-0.3, 12.7, 0.0, 100.0, 5.0, false);
        assert_eq!(axis.ticks, [0.0, 5.0, 10.0]);
        assert_eq!(axis.text(5.0, false), "5");
        let fine = Axis::new(0.0, 0.9, 0.0, 100.0, 5.0, false);
        assert_eq!(fine.text(0.2, false), "0.2");
        let whole = Axis::new(0.7, 3.3, 0.0, 100.0, 8.0, true);
        assert_eq!(whole.ticks, [1.0, 2.0, 3.0]);
    }

    #[test]
    fn a_plot_without_points_says_so_and_one_point_is_drawn() {
        let plot = |points| Plot {
            title: "t",
            x_label: "look",
            y_label: "mm",
            whole_x: true,
            from_zero: true,
            series: vec![Series {
                name: "a",
                colour: "#000",
                points,
                marks: Marks::Joined,
            }],
        };
        assert!(plot(vec![]).svg().contains("nothing seen"));
        let one = plot(vec![(1.0, 0.5)]).svg();
        assert!(one.contains("<circle") && !one.contains("NaN") && !one.contains("inf"));
    }

    #[test]
    fn an_axis_of_decades_shows_powers_of_ten_and_leaves_out_what_has_no_logarithm() {
        let plot = Plot {
            title: "t",
            x_label: "corrections",
            y_label: "mm",
            whole_x: true,
            from_zero: false,
            series: vec![Series {
                name: "a",
                colour: "#000",
                points: vec![(0.0, 20.0), (1.0, 0.002), (2.0, 0.0)],
                marks: Marks::Dots,
            }],
        };
        let svg = plot.svg_in_decades();
        for tick in [">10<", ">1<", ">0.1<", ">0.01<"] {
            assert!(svg.contains(tick), "{tick}");
        }
        assert_eq!(svg.matches("<circle").count(), 2);
        assert!(!svg.contains("inf") && !svg.contains("NaN"));
    }
}
