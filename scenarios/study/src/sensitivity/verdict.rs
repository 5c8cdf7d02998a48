//! What the study of error sources says, from its own numbers.

use super::{Both, COLUMNS, Row, Sensitivity, Source};

/// Cells with less, mm, are not compared between Jacobians and simulation.
const LEAST_COMPARED_MM: f64 = 0.05;
/// Relative difference up to which they agree.
const AGREEMENT: f64 = 0.10;

impl Sensitivity {
    /// What the study says, from its own numbers.
    pub fn verdict(&self) -> String {
        let simulated = |source: Source, of: fn(&Row) -> Both| {
            self.row(source).map_or(f64::NAN, |r| of(r).simulated_mm)
        };
        let largest = |of: fn(&Row) -> Both| {
            let single = self.rows.iter().filter(|r| r.source != Source::All);
            single
                .max_by(|a, b| of(a).simulated_mm.total_cmp(&of(b).simulated_mm))
                .map_or("none", |r| r.name)
        };
        let plate_loses =
            simulated(Source::Intrinsics, |r| r.plate) > simulated(Source::Intrinsics, |r| r.mark);
        let range = if plate_loses {
            "; its range comes from the plate's size, too, so that what is wrong with the cameras \
             is no longer the same for target and fiducial, which is what makes the paper's vector \
             forgive bad cameras"
        } else {
            ""
        };
        format!(
            "Without correction {:.1} mm rms, most of it from {}. One vector of one mark, seen at \
             the target, removes what mount translation does and all but {:.1} of {:.1} mm of what \
             arm lengths do; of arm angles and mount rotation it leaves {:.1} and {:.1} mm, because the error of the tool's \
             direction acts over the lever between mark and tip. The pose of the plate leaves \
             {:.2} and {:.2} mm of these. Wrong intrinsics leave {:.1} mm with the mark and {:.1} \
             mm with the plate{range}. Two sources no vector corrects: the match of the target \
             ({:.1} mm, mostly in range) and a tilt of the body that carries arm and cameras \
             ({:.1} mm). All together: {:.1} mm with the mark and {:.1} mm with the plate at the \
             target, {:.1} and {:.1} mm when seen 10 cm above it. {}",
            simulated(Source::All, |r| r.before),
            largest(|r| r.before),
            simulated(Source::ArmLengths, |r| r.mark),
            simulated(Source::ArmLengths, |r| r.before),
            simulated(Source::ArmAngles, |r| r.mark),
            simulated(Source::MountRotation, |r| r.mark),
            simulated(Source::ArmAngles, |r| r.plate),
            simulated(Source::MountRotation, |r| r.plate),
            simulated(Source::Intrinsics, |r| r.mark),
            simulated(Source::Intrinsics, |r| r.plate),
            simulated(Source::Match, |r| r.plate),
            simulated(Source::BodyTilt, |r| r.plate),
            simulated(Source::All, |r| r.mark),
            simulated(Source::All, |r| r.plate),
            simulated(Source::All, |r| r.mark_above),
            simulated(Source::All, |r| r.plate_above),
            self.agreement()
        )
    }

    /// How Jacobians and simulation agree; the cells that differ by more than 10 % by name.
    pub fn agreement(&self) -> String {
        let mut within: f64 = 0.0;
        let mut apart = Vec::new();
        let mut cells = 0;
        for r in &self.rows {
            for (column, of) in COLUMNS {
                let b = of(r);
                if b.simulated_mm.max(b.analytic_mm) <= LEAST_COMPARED_MM {
                    continue;
                }
                cells += 1;
                let (low, high) = (
                    b.analytic_mm.min(b.simulated_mm),
                    b.analytic_mm.max(b.simulated_mm),
                );
                let difference = high / low - 1.0;
                if difference > AGREEMENT {
                    let (name, here, there) = (r.name, b.analytic_mm, b.simulated_mm);
                    apart.push(format!("{name}, {column}: {here:.3} against {there:.3} mm"));
                } else {
                    within = within.max(difference);
                }
            }
        }
        let close = cells - apart.len();
        let mut out = format!(
            "Where more than {LEAST_COMPARED_MM} mm is left, Jacobians and simulation agree within \
             {:.0} % in {close} of {cells} cells",
            within * 100.0
        );
        if !apart.is_empty() {
            out += "; not in these, where the first order cancels and rare draws dominate the rms of \
                    what is left, which is of second and higher order (Jacobians against \
                    simulated): ";
            out += &apart.join("; ");
        }
        out + "."
    }
}
