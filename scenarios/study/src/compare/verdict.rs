//! What the comparison says, from its own numbers.

use super::{Case, Cell, Comparison, OCCLUSIONS_CM};
use rover_methods::Kind;
use std::fmt::Write;

/// Medians that differ by less agree: the scatter of a median of 200 trials, twice.
const AGREEMENT: f64 = 0.2;

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
            .filter(|(_, median)| *median < 0.98 * ours)
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
                Some(if names.is_empty() {
                    format!("blind for {cm} cm EPEC ({ours:.2} mm) loses to none")
                } else {
                    format!(
                        "blind for {cm} cm EPEC ({ours:.2} mm) loses to {}",
                        names.join(", ")
                    )
                })
            })
            .collect()
    }

    /// How the medians agree with those of the independent program: how many of how many lie within
    /// 20 %, and each that does not.
    pub fn agreement(&self) -> String {
        let compared: Vec<(&Cell, f64, f64)> = self
            .methods
            .iter()
            .filter_map(|c| Some((c, c.median_mm?, c.independent_mm?)))
            .collect();
        let outside: Vec<String> = compared
            .iter()
            .filter(|(_, here, there)| (here / there - 1.0).abs() > AGREEMENT)
            .map(|(c, here, there)| {
                let (name, case, cm) = (c.name, c.case.name(), c.occlusion_cm);
                format!("{name} ({case}, blind {cm} cm) {here:.2} for {there:.2}")
            })
            .collect();
        let within = compared.len() - outside.len();
        let mut out = format!(
            "{within} of the {} medians that the independent program has, too, agree within {:.0} %",
            compared.len(),
            100.0 * AGREEMENT
        );
        if !outside.is_empty() {
            let _ = write!(out, "; outside, in mm: {}", outside.join(", "));
        }
        out + "."
    }

    /// What the study says.
    pub fn verdict(&self) -> String {
        let at = |kind, cm| self.median_mm(kind, Case::Plain, cm);
        let number = |x: Option<f64>| x.map_or("no".to_owned(), |x| format!("{x:.2}"));
        let gain = |kind| match (at(Kind::Kinematic, 0), at(kind, 0)) {
            (Some(k), Some(h)) => format!("{:.0}", k / h),
            _ => "an unknown number of".to_owned(),
        };
        let mut out = format!(
            "With the fiducial in view at the target EPEC ends {} mm from it (median), kinematics \
             alone {} mm; blind for the last 10 cm EPEC {} mm, the field with a kinematic prior \
             {} mm. HIPS is {} times better than kinematics in its limited and {} times in its \
             full version (published: about 2 and about 10); the height of its initial poses was \
             chosen among three so that the limited version agrees with the independent program. \
             Position-based servoing with gain 1 is EPEC by another name. {}",
            number(at(Kind::Epec, 0)),
            number(at(Kind::Kinematic, 0)),
            number(at(Kind::Epec, 10)),
            number(at(Kind::EpecField, 10)),
            gain(Kind::HipsLimited),
            gain(Kind::HipsFull),
            self.agreement(),
        );
        let images = |kind, case, cm| number(self.median_mm(kind, case, cm));
        let blind = |case, cm| {
            format!(
                "kinematic {}, EPEC {}, field {}",
                images(Kind::Kinematic, case, cm),
                images(Kind::Epec, case, cm),
                images(Kind::EpecField, case, cm)
            )
        };
        if self.methods.iter().any(|c| c.case == Case::ImagesPlate) {
            let _ = write!(
                out,
                " From images, with the pose of the plate (mm): in view {}; blind for 10 cm {}. \
                 With one mark: {}; {}. With one mark and degraded cameras: {}; {}.",
                blind(Case::ImagesPlate, 0),
                blind(Case::ImagesPlate, 10),
                blind(Case::ImagesMark, 0),
                blind(Case::ImagesMark, 10),
                blind(Case::ImagesDegraded, 0),
                blind(Case::ImagesDegraded, 10),
            );
        }
        out
    }
}
