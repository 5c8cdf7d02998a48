//! The record of one run, as `rover run --json` writes it.
//!
//! The field names are part of the product's interface. What a run did not come to is `null`.

mod approach;

pub use approach::{ApproachReport, EarlierBase, ErrorSources, StopReport, Waypoints};

use rover_messages::{
    Fault,
    codec::{NotFinite, check_finite},
    placement::{ContactResult, Method, PlaceResult},
    simulation::Score,
    target::Target,
};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;

/// Why a report cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// A number is not finite and so has no JSON form.
    #[error("report: {0}")]
    NotFinite(#[from] NotFinite),
    /// The JSON writer refused.
    #[error("report: {0}")]
    Json(#[from] serde_json::Error),
}

/// How a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// The instrument made contact.
    Placed,
    /// The run ended safely without placing the instrument.
    Aborted,
}

/// One run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunReport {
    /// Name of the scenario.
    pub scenario: String,
    /// Name of the robot.
    pub robot: String,
    /// The seed used.
    pub seed: u64,
    /// How the run ended.
    pub outcome: Outcome,
    /// Why it was aborted: `name: message`.
    pub reason: Option<String>,
    /// What was done, in order.
    pub phases: Vec<Phase>,
    /// The selected target.
    pub target: Option<TargetReport>,
    /// The way to the target, if the robot drove to it.
    pub approach: Option<ApproachReport>,
    /// The way to the standoff, if it was reached.
    pub servo: Option<ServoReport>,
    /// The contact motion, if it ended by itself.
    pub contact: Option<ContactReport>,
    /// The placement measured by the simulator against its own geometry.
    pub truth: Option<TruthReport>,
    /// Wall time by kind of computing ([`rover_messages::status::work`]), summed over simulator
    /// and services, s; `bus` is what is left of the wall time.
    #[serde(default)]
    pub wall_by_kind_s: BTreeMap<String, f64>,
    /// SHA-256 over everything but wall times, hexadecimal.
    pub digest: String,
}

/// One phase of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Phase {
    /// Its name.
    pub name: String,
    /// Simulated time that passed in it, s.
    pub sim_s: f64,
    /// Wall time that passed in it, s.
    pub wall_s: f64,
    /// `done`, or the name of the fault that ended it.
    pub outcome: String,
}

/// The selected target.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TargetReport {
    /// Camera pair.
    pub pair: String,
    /// Designated pixel in the left image, px.
    pub pixel_px: [f64; 2],
    /// Believed position, rover frame, m.
    pub position_m: [f64; 3],
    /// Believed outward normal, rover frame.
    pub normal: [f64; 3],
    /// Root mean square distance of the surface points from the plane, mm.
    pub plane_rms_mm: f64,
    /// Standard deviations of the position along the rover axes, mm.
    pub sigma_mm: [f64; 3],
}

/// The way to the standoff.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ServoReport {
    /// How the error was estimated.
    pub method: String,
    /// Looks at the fiducial.
    pub iterations: usize,
    /// Whether the last correction was below the tolerance.
    pub converged: bool,
    /// Seen minus predicted tip at each look, rover frame, mm; `null` where it was not seen.
    pub error_vectors_mm: Vec<Option<[f64; 3]>>,
    /// Whether the fiducial was found, at each look.
    pub fiducial_found: Vec<bool>,
    /// Predicted lateral error of the placement, 95 % bound, mm.
    pub predicted_error_mm: f64,
}

/// The contact motion.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ContactReport {
    /// Whether the switch closed.
    pub made: bool,
    /// Travel of the switch at rest in contact, mm.
    pub switch_travel_mm: f64,
    /// Largest axial force, N.
    pub peak_force_n: f64,
    /// Distance driven along the normal until contact, or until the motion ended without it, m.
    pub approach_m: f64,
}

/// The placement against the truth; a quantity that does not exist is `null`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TruthReport {
    /// Distance between the contact and the true point seen at the designated pixel, in the
    /// plane of the true normal, mm.
    pub lateral_error_mm: Option<f64>,
    /// The same along the true normal, mm.
    pub range_error_mm: Option<f64>,
    /// Angle between the instrument's axis and the true inward normal, deg.
    pub axis_error_deg: Option<f64>,
    /// Lateral error of a purely kinematic placement under the same truth, mm.
    pub open_loop_lateral_error_mm: Option<f64>,
    /// Distance between believed and true tip, mm.
    pub arm_model_error_mm: f64,
    /// The lateral error by source.
    pub sources: ErrorSources,
}

impl From<&Target> for TargetReport {
    fn from(t: &Target) -> Self {
        Self {
            pair: t.pair.clone(),
            pixel_px: t.pixel_px,
            position_m: t.position_m.coords.into(),
            normal: t.normal.unit.into_inner().into(),
            plane_rms_mm: t.plane_rms_mm,
            sigma_mm: t.sigma_mm(),
        }
    }
}

impl ServoReport {
    /// From the servo's result.
    pub fn new(method: Method, placed: &PlaceResult) -> Self {
        let mm = |v: [f64; 3]| v.map(|x| x * 1e3);
        let looks = &placed.looks;
        Self {
            method: method_name(method).into(),
            iterations: looks.len(),
            converged: placed.converged,
            error_vectors_mm: looks.iter().map(|l| l.error_vector_m.map(mm)).collect(),
            fiducial_found: looks.iter().map(|l| l.found).collect(),
            predicted_error_mm: placed.predicted_error_m * 1e3,
        }
    }
}

impl ContactReport {
    /// A motion that ended without contact, from the numbers that its fault carries.
    pub fn missed(fault: &Fault) -> Option<Self> {
        let detail = |name: &str| fault.details.get(name).copied();
        Some(Self {
            made: false,
            switch_travel_mm: detail("switch_travel_mm")?,
            peak_force_n: detail("peak_force_n")?,
            approach_m: detail("approach_mm")? / 1e3,
        })
    }
}

impl From<&ContactResult> for ContactReport {
    fn from(c: &ContactResult) -> Self {
        Self {
            made: true,
            switch_travel_mm: c.switch_travel_m * 1e3,
            peak_force_n: c.peak_force_n,
            approach_m: c.approach_m,
        }
    }
}

impl TruthReport {
    /// From the simulator's score and the true places met on the way.
    pub fn new(s: &Score, waypoints: &Waypoints) -> Self {
        Self {
            lateral_error_mm: s.lateral_error_mm,
            range_error_mm: s.range_error_mm,
            axis_error_deg: s.axis_error_deg,
            open_loop_lateral_error_mm: s.open_loop_lateral_error_mm,
            arm_model_error_mm: s.arm_model_error_mm,
            sources: waypoints.sources(s),
        }
    }
}

/// A method's name as scenarios write it.
pub fn method_name(method: Method) -> &'static str {
    method.name()
}

impl RunReport {
    /// The same report with its digest computed.
    ///
    /// # Errors
    /// [`ReportError`].
    pub fn sealed(mut self) -> Result<Self, ReportError> {
        self.digest = self.compute_digest()?;
        Ok(self)
    }

    /// SHA-256 over the report in canonical JSON: keys sorted, no white space, every number in
    /// its shortest form that reads back to the same bits, without wall times and digest.
    ///
    /// # Errors
    /// [`ReportError`].
    pub fn compute_digest(&self) -> Result<String, ReportError> {
        check_finite(self)?;
        let mut value = serde_json::to_value(self)?;
        strip(&mut value);
        let digest = Sha256::digest(canonical(&value)?.as_bytes());
        Ok(digest.iter().map(|byte| format!("{byte:02x}")).collect())
    }

    /// The report as indented JSON with a line end.
    ///
    /// # Errors
    /// [`ReportError`].
    pub fn to_json(&self) -> Result<String, ReportError> {
        check_finite(self)?;
        Ok(serde_json::to_string_pretty(self)? + "\n")
    }

    /// A few lines for a person.
    pub fn summary(&self) -> String {
        let mut lines = vec![match self.outcome {
            Outcome::Placed => format!("{}: placed", self.scenario),
            Outcome::Aborted => format!("{}: aborted", self.scenario),
        }];
        let mut line = |name: &str, text: String| lines.push(format!("  {name:<22} {text}"));
        if let Some(reason) = &self.reason {
            line("reason", reason.clone());
        }
        line("robot, seed", format!("{}, {}", self.robot, self.seed));
        if let Some(t) = &self.target {
            let [x, y, z] = t.position_m;
            line(
                "target",
                format!("{x:.4} {y:.4} {z:.4} m, plane rms {:.2} mm", t.plane_rms_mm),
            );
        }
        if let Some(approach) = &self.approach {
            line("approach", approach.summary());
        }
        if let Some(s) = &self.servo {
            let found = s.fiducial_found.iter().filter(|f| **f).count();
            line(
                "servo",
                format!(
                    "{}, {} looks, fiducial found in {found}{}, predicted error {:.2} mm (95 %)",
                    s.method,
                    s.iterations,
                    if s.converged { ", converged" } else { "" },
                    s.predicted_error_mm
                ),
            );
        }
        if let Some(c) = &self.contact {
            let made = if c.made { "made" } else { "not made" };
            line(
                "contact",
                format!(
                    "{made} after {:.1} mm, peak force {:.1} N, switch travel {:.2} mm",
                    c.approach_m * 1e3,
                    c.peak_force_n,
                    c.switch_travel_mm
                ),
            );
        }
        if let Some(t) = &self.truth {
            let mm = |v: Option<f64>| v.map_or("none".to_owned(), |v| format!("{v:.3} mm"));
            line("lateral error", mm(t.lateral_error_mm));
            line("range error", mm(t.range_error_mm));
            if let Some(angle) = t.axis_error_deg {
                line("axis error", format!("{angle:.2} deg"));
            }
            line("open-loop lateral", mm(t.open_loop_lateral_error_mm));
            line("arm model error", format!("{:.3} mm", t.arm_model_error_mm));
        }
        let (sim, wall) = self.times();
        line("time", format!("{sim:.1} s simulated in {wall:.1} s"));
        if !self.wall_by_kind_s.is_empty() {
            let kinds: Vec<String> = self
                .wall_by_kind_s
                .iter()
                .map(|(kind, s)| format!("{kind} {s:.1}"))
                .collect();
            line("of this, s", kinds.join(", "));
        }
        line("digest", self.digest.clone());
        lines.join("\n") + "\n"
    }

    /// Simulated and wall time of all phases, s.
    pub fn times(&self) -> (f64, f64) {
        self.phases.iter().fold((0.0, 0.0), |(sim, wall), p| {
            (sim + p.sim_s, wall + p.wall_s)
        })
    }
}

/// Removes what a digest does not cover.
fn strip(report: &mut Value) {
    let Value::Object(fields) = report else {
        return;
    };
    fields.remove("digest");
    fields.remove("wall_by_kind_s");
    if let Some(Value::Array(phases)) = fields.get_mut("phases") {
        for phase in phases {
            if let Value::Object(phase) = phase {
                phase.remove("wall_s");
            }
        }
    }
}

/// JSON with sorted keys, whatever order the map type keeps.
fn canonical(value: &Value) -> Result<String, serde_json::Error> {
    Ok(match value {
        Value::Object(fields) => {
            let mut entries: Vec<_> = fields.iter().collect();
            entries.sort_by_key(|(key, _)| key.as_str());
            let entries: Result<Vec<_>, serde_json::Error> = entries
                .into_iter()
                .map(|(k, v)| Ok(format!("{}:{}", serde_json::to_string(k)?, canonical(v)?)))
                .collect();
            format!("{{{}}}", entries?.join(","))
        }
        Value::Array(items) => {
            let items: Result<Vec<_>, _> = items.iter().map(canonical).collect();
            format!("[{}]", items?.join(","))
        }
        other => serde_json::to_string(other)?,
    })
}
