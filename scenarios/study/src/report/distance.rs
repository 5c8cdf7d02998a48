//! What the pages of figures 6 and 7 have in common: rows and plots of an error against the
//! distance from where the vector was taken.

use super::table::Table;
use crate::{experiment, growth::Growth, locality, statistics::mean};
use rover_page::{
    BLUE,
    plot::{Marks, Plot, Series},
};

/// One place where a vector was taken, with errors at targets all over the workspace.
pub(super) trait Place {
    /// One target.
    type Point;
    fn name(&self) -> &'static str;
    fn points(&self) -> &[Self::Point];
    fn vector(&self) -> &Growth;
    fn at_reference_mm(&self) -> f64;
    fn distance_m(point: &Self::Point) -> f64;
    fn open_loop_mm(point: &Self::Point) -> f64;
    fn error_mm(point: &Self::Point) -> f64;
}

macro_rules! place {
    ($reference:ty, $point:ty) => {
        impl Place for $reference {
            type Point = $point;
            fn name(&self) -> &'static str {
                self.name
            }
            fn points(&self) -> &[$point] {
                &self.points
            }
            fn vector(&self) -> &Growth {
                &self.vector
            }
            fn at_reference_mm(&self) -> f64 {
                self.at_reference_mm
            }
            fn distance_m(point: &$point) -> f64 {
                point.distance_m
            }
            fn open_loop_mm(point: &$point) -> f64 {
                point.open_loop_mm
            }
            fn error_mm(point: &$point) -> f64 {
                point.error_mm
            }
        }
    };
}

place!(locality::Reference, locality::LocalityPoint);
place!(experiment::Reference, experiment::ExperimentPoint);

/// The rows with the columns that both studies have.
pub(super) fn rows<P: Place>(places: &[P]) -> Table<'_, P> {
    Table::of(places)
        .column("vector taken at", |p| p.name().to_owned())
        .column("open loop, mm", |p| {
            let errors: Vec<f64> = p.points().iter().map(P::open_loop_mm).collect();
            format!("{:.1}", mean(&errors))
        })
        .column("at the place, mm", |p| {
            format!("{:.2}", p.at_reference_mm())
        })
        .column("slope, mm/m", |p| {
            format!("{:.1}", p.vector().slope_mm_per_m)
        })
        .column("from, mm", |p| format!("{:.2}", p.vector().intercept_mm))
        .column("r2", |p| format!("{:.3}", p.vector().r2))
        .column("at 16 cm, mm", |p| {
            format!("{:.1}", p.vector().error_at_16cm_mm)
        })
}

/// Dots of one quantity of every target against its distance, cm.
pub(super) fn dots<P: Place>(
    place: &P,
    name: &'static str,
    colour: &'static str,
    of: impl Fn(&P::Point) -> f64,
) -> Series {
    let points = place.points().iter();
    Series {
        name,
        colour,
        points: points.map(|p| (P::distance_m(p) * 100.0, of(p))).collect(),
        marks: Marks::Dots,
    }
}

/// A straight line from the place to its farthest target.
pub(super) fn line<P: Place>(
    place: &P,
    name: &'static str,
    colour: &'static str,
    (intercept_mm, slope_mm_per_m): (f64, f64),
) -> Series {
    let far = place.points().last().map_or(0.0, P::distance_m);
    let at = |x: f64| (x * 100.0, intercept_mm + slope_mm_per_m * x);
    Series {
        name,
        colour,
        points: vec![at(0.0), at(far)],
        marks: Marks::Line,
    }
}

/// The place's plot: every target with one vector, the line through them, and what else there is.
pub(super) fn plot<P: Place>(place: &P, others: Vec<Series>) -> String {
    let fitted = (place.vector().intercept_mm, place.vector().slope_mm_per_m);
    let mut series = vec![
        dots(place, "one vector", BLUE, P::error_mm),
        line(place, "its line", BLUE, fitted),
    ];
    series.extend(others);
    Plot {
        title: place.name(),
        x_label: "distance from where the vector was taken, cm",
        y_label: "mm",
        whole_x: false,
        from_zero: true,
        series,
    }
    .svg()
}
