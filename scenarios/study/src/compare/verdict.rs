//! What the comparison says, from its own numbers.

use super::{Case, Cell, Comparison, OCCLUSIONS_CM};
use rover_methods::Kind;
use std::fmt::Write;

/// Medians that differ by less agree: the scatter of a median of 200 trials, twice.
const AGREEMENT: f64 = 0.2;
/// Cells outside that the verdict names.
const NAMED: usize = 4;

/// Whether a median is better than EPEC's by more than 2 %.
pub fn is_better(median_mm: f64, epec_mm: f64) -> bool {
    median_mm < 0.98 * epec_mm
}

impl Comparison {
    /// The methods whose median is better than EPEC's by more than 2 %, best first; none if EPEC
    /// has no median there.
    pub fn better_than_epec(&self, case: Case, occlusion_cm: u32) -> Option<Vec<(&str, f64)>> {
        let ours = self.median_mm(Kind::Epec, case, occlusion_cm)?;
        let mut better: Vec<(&str, f64)> = self
            .methods
            .iter()
            .filter(|c| c.case == case && c.occlusion_cm == occlusion_cm)
            .filter_map(|c| Some((c.name, c.median_mm?)))
            .filter(|(_, median)| is_better(*median, ours))
            .collect();
        better.sort_by(|a, b| a.1.total_cmp(&b.1));
        Some(better)
    }

    /// Where EPEC loses, one line per blind part of a case.
    pub fn losses(&self, case: Case) -> Vec<String> {
        OCCLUSIONS_CM
            .iter()
            .filter_map(|cm| {
                let ours = self.median_mm(Kind::Epec, case, *cm)?;
                let better = self.better_than_epec(case, *cm)?;
                let names: Vec<String> = better
                    .iter()
                    .map(|(name, median)| format!("{name} {median:.2}"))
                    .collect();
                let blind = match cm {
                    0 => "seen to the end".to_owned(),
                    cm => format!("blind for the last {cm} cm"),
                };
                Some(if names.is_empty() {
                    format!("{blind}: EPEC ({ours:.2} mm) loses to none")
                } else {
                    format!(
                        "{blind}: EPEC ({ours:.2} mm) loses to {} of {}: {}",
                        names.len(),
                        Kind::ALL.len() - 1,
                        names.join(", ")
                    )
                })
            })
            .collect()
    }

    /// The cells that the independent program has, too, with its medians, mm.
    fn compared(&self) -> impl Iterator<Item = (&Cell, f64, f64)> {
        self.methods
            .iter()
            .filter_map(|c| Some((c, c.median_mm?, c.independent_mm?)))
    }

    /// The cells whose median differs by more than 20 % from that of the independent program, with
    /// both, mm.
    pub fn disagreements(&self) -> Vec<(&Cell, f64, f64)> {
        self.compared()
            .filter(|(_, here, there)| (here / there - 1.0).abs() > AGREEMENT)
            .collect()
    }

    /// How the medians agree with those of the independent program.
    pub fn agreement(&self) -> String {
        let outside: Vec<String> = self
            .disagreements()
            .iter()
            .map(|(c, here, there)| {
                let (name, case, cm) = (c.name, c.case.name(), c.occlusion_cm);
                format!("{name} ({case}, blind {cm} cm) {here:.2} for {there:.2}")
            })
            .collect();
        let all = self.compared().count();
        let within = all - outside.len();
        let mut out = format!(
            "Of the {all} medians that an independent program has, too, {within} agree within \
             {:.0} %",
            100.0 * AGREEMENT
        );
        if !outside.is_empty() {
            let named: Vec<&str> = outside.iter().take(NAMED).map(String::as_str).collect();
            let _ = write!(out, "; outside, in mm: {}", named.join(", "));
        }
        if outside.len() > NAMED {
            let _ = write!(out, " and {} more", outside.len() - NAMED);
        }
        out + "."
    }

    /// What the study says.
    pub fn verdict(&self) -> String {
        let at = |kind, cm| self.median_mm(kind, Case::Plain, cm);
        let number = |x: Option<f64>| x.map_or("no".to_owned(), |x| format!("{x:.2}"));
        let gain = |kind, cm| match (at(Kind::Kinematic, cm), at(kind, cm)) {
            (Some(k), Some(h)) => format!("{:.0}", k / h),
            _ => "an unknown number of".to_owned(),
        };
        let mut out = format!(
            "With the fiducial at the tip and in view at the target EPEC ends {} mm from it \
             (median), kinematics alone {} mm; blind for the last 10 cm EPEC ends {} mm from it, \
             the field with a kinematic prior {} mm. HIPS is {} times better than kinematics in \
             its limited version, and in its full version {} times in view and {} times blind for \
             the last 10 cm (published: about 2 and about 10). Position-based servoing with gain 1 \
             is EPEC by another name. {}",
            number(at(Kind::Epec, 0)),
            number(at(Kind::Kinematic, 0)),
            number(at(Kind::Epec, 10)),
            number(at(Kind::EpecField, 10)),
            gain(Kind::HipsLimited, 0),
            gain(Kind::HipsFull, 0),
            gain(Kind::HipsFull, 10),
            self.agreement(),
        );
        for (what, case) in [
            ("with the pose of the plate", Case::ImagesPlate),
            ("with one mark 9 cm from the tip", Case::ImagesMark),
            ("with that mark and degraded cameras", Case::ImagesDegraded),
        ] {
            let median = |kind, cm| number(self.median_mm(kind, case, cm));
            if self.methods.iter().any(|c| c.case == case) {
                let _ = write!(
                    out,
                    " From images {what}: kinematics {} mm; in view EPEC {} and the field {} mm, \
                     blind for the last 10 cm {} and {} mm.",
                    median(Kind::Kinematic, 0),
                    median(Kind::Epec, 0),
                    median(Kind::EpecField, 0),
                    median(Kind::Epec, 10),
                    median(Kind::EpecField, 10),
                );
            }
        }
        out
    }
}
