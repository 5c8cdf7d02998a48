//! Scenario files: what is to be placed where, how, and in which simulated world.
//!
//! A scenario is one TOML file. Unknown fields are refused, every field but the target has a
//! default, and `rover run --print` writes the effective scenario with all of them filled in.
//! A field's name carries its unit.

mod documentation;
mod overrides;
mod target;
mod variation;

use crate::embedded;
use rover_files::FileError;
use rover_messages::{
    placement::{ContactGoal, Method, Observation, PlaceGoal, PlaceResult},
    target::Target,
};
use rover_robot::{Robot, RobotError};
use rover_sim::{SimulationDescription, SimulationError, World};
use serde::{Deserialize, Serialize};
use std::{
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};
pub use target::{ApproachSettings, PickChoice, TargetChoice};
pub use variation::{CampaignSettings, Variation};

/// One scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scenario {
    /// Name in reports.
    pub name: String,
    /// What the scenario shows.
    #[serde(default)]
    pub description: String,
    /// The robot file, relative to the scenario file.
    pub robot: String,
    /// Seed of everything that is drawn by chance: model errors, noise, terrain.
    #[serde(default = "default_seed")]
    pub seed: u64,
    /// What to place the instrument on.
    pub target: TargetChoice,
    /// How the rover gets there; absent where the target lies in the arm's workspace.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub approach: Option<ApproachSettings>,
    /// How the instrument is brought to the standoff.
    #[serde(default)]
    pub servo: ServoSettings,
    /// How contact is made.
    #[serde(default)]
    pub contact: ContactSettings,
    /// Where the arm starts and ends.
    #[serde(default)]
    pub arm: ArmSettings,
    /// Limits on wall-clock time: a run that exceeds one is ended as a fault.
    #[serde(default)]
    pub limits: Limits,
    /// What differs from run to run of a campaign.
    #[serde(default)]
    pub campaign: CampaignSettings,
    /// The world and the truth about the robot.
    #[serde(default)]
    pub simulation: SimulationDescription,
}

/// How the instrument is brought to the standoff.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ServoSettings {
    /// How the end-effector's position error is estimated.
    pub method: Method,
    /// What is observed of the fiducial.
    pub observation: Observation,
    /// Distances from the target along the normal at which to look, far to near, m; the last is
    /// the standoff.
    pub stations_m: Vec<f64>,
    /// At the standoff: correct until the next correction is below this, mm.
    pub tolerance_mm: f64,
    /// At the standoff: at most so many corrections.
    pub max_corrections_n: u32,
    /// Refuse to go on when the predicted lateral error (95 % bound) exceeds this, mm.
    pub max_predicted_error_mm: f64,
}

impl Default for ServoSettings {
    fn default() -> Self {
        Self {
            method: Method::EpecField,
            observation: Observation::Pose,
            stations_m: vec![0.16, 0.12, 0.09, 0.06, 0.03],
            tolerance_mm: 0.1,
            max_corrections_n: 4,
            max_predicted_error_mm: 10.0,
        }
    }
}

/// How contact is made.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ContactSettings {
    /// Speed along the normal, mm/s.
    pub speed_mm_s: f64,
    /// Travel beyond the target after which there is no surface, mm.
    pub max_overtravel_mm: f64,
    /// Largest axial force, N.
    pub max_force_n: f64,
    /// Whether to go back to the standoff after contact.
    pub retract: bool,
}

impl Default for ContactSettings {
    fn default() -> Self {
        Self {
            speed_mm_s: 5.0,
            max_overtravel_mm: 20.0,
            max_force_n: 20.0,
            retract: true,
        }
    }
}

/// Where the arm starts and ends.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ArmSettings {
    /// Posture of the robot file in which the arm starts.
    pub start_posture: String,
    /// Posture to which the arm goes after a placement with retract; it stays at the standoff
    /// when this is empty.
    pub end_posture: String,
}

impl Default for ArmSettings {
    fn default() -> Self {
        Self {
            start_posture: "stow".into(),
            end_posture: String::new(),
        }
    }
}

/// Limits on wall-clock time, s.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// For simulator and services to appear, s.
    pub start_s: f64,
    /// For one question (designation, survey, plan, score), s.
    pub question_s: f64,
    /// For one action (servo, contact, arm motion), s.
    pub action_s: f64,
    /// For an orderly stop, s.
    pub stop_s: f64,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            start_s: 120.0,
            question_s: 60.0,
            action_s: 1800.0,
            stop_s: 10.0,
        }
    }
}

fn default_seed() -> u64 {
    1
}

/// Why a scenario cannot be used; all of these are bad input.
#[derive(Debug, thiserror::Error)]
pub enum ScenarioError {
    /// Neither on disk nor among the shipped files.
    #[error("{path}: no such {kind} on disk, nor among the shipped ones: {shipped}")]
    NotFound {
        /// `scenario` or `robot`.
        kind: &'static str,
        /// The path as given.
        path: String,
        /// What there is.
        shipped: String,
    },
    /// The file could not be read.
    #[error("{path}: {source}")]
    File {
        /// The file.
        path: String,
        /// What the system said.
        source: FileError,
    },
    /// Not a scenario; the message has line, column, field, found and expected.
    #[error("{origin}: {message}")]
    Syntax {
        /// Where the text came from.
        origin: String,
        /// The parser's message.
        message: String,
    },
    /// A field has a value that cannot be.
    #[error("{origin}: {field}: {message}")]
    Field {
        /// Where the text came from.
        origin: String,
        /// The field's path.
        field: String,
        /// What was found and what was expected.
        message: String,
    },
    /// `--set` was given something that is not `PATH=VALUE`, or a path that there is not.
    #[error("--set {given}: {message}")]
    Override {
        /// The argument.
        given: String,
        /// What is wrong and what would be right.
        message: String,
    },
    /// The robot file is wrong.
    #[error(transparent)]
    Robot(#[from] RobotError),
}

/// A scenario with its robot, checked against each other.
#[derive(Clone, Debug)]
pub struct LoadedScenario {
    /// The effective scenario.
    pub scenario: Scenario,
    /// The believed robot.
    pub robot: Arc<Robot>,
    /// Text of the robot file.
    pub robot_text: String,
    /// Where the robot file was found, for messages.
    pub robot_origin: String,
}

impl LoadedScenario {
    /// Finds, reads and checks a scenario and its robot. A path on disk wins over a shipped file
    /// of the same name. `sets` are `PATH=VALUE` overrides, applied in order; `seed` wins over
    /// the scenario's own.
    ///
    /// # Errors
    /// [`ScenarioError`] with file, line or field, what was found and what was expected.
    pub fn load(name: &str, sets: &[String], seed: Option<u64>) -> Result<Self, ScenarioError> {
        let (scenario, origin) = Self::read(name, sets, seed)?;
        Self::complete(scenario, &origin)
    }

    /// As [`LoadedScenario::load`], with the fields that the scenario's campaign varies drawn
    /// from the seed.
    ///
    /// # Errors
    /// As [`LoadedScenario::load`].
    pub fn load_varied(
        name: &str,
        sets: &[String],
        seed: Option<u64>,
    ) -> Result<Self, ScenarioError> {
        let (scenario, origin) = Self::read(name, sets, seed)?;
        Self::complete(variation::drawn(scenario, &origin)?, &origin)
    }

    fn read(
        name: &str,
        sets: &[String],
        seed: Option<u64>,
    ) -> Result<(Scenario, String), ScenarioError> {
        let (text, origin) = read(embedded::SCENARIOS, "scenario", Path::new(name), name)?;
        let mut scenario = Scenario::parse(&text, &origin)?;
        for set in sets {
            scenario = overrides::apply(&scenario, set)?;
        }
        scenario.seed = seed.unwrap_or(scenario.seed);
        Ok((scenario, origin))
    }

    /// Reads the robot of a scenario and checks both; `origin` is the scenario's path.
    ///
    /// # Errors
    /// As [`LoadedScenario::load`].
    pub fn complete(scenario: Scenario, origin: &str) -> Result<Self, ScenarioError> {
        let beside: PathBuf = Path::new(origin)
            .parent()
            .unwrap_or(Path::new(""))
            .join(&scenario.robot);
        let (robot_text, robot_origin) = read(embedded::ROBOTS, "robot", &beside, &scenario.robot)?;
        let robot = Arc::new(Robot::parse(&robot_text, &robot_origin)?);
        scenario.check(&robot, origin)?;
        Ok(Self {
            scenario,
            robot,
            robot_text,
            robot_origin,
        })
    }
}

impl LoadedScenario {
    /// The simulated world at its start: the arm at rest in its start posture.
    ///
    /// # Errors
    /// [`SimulationError`] with the field, what was found and what was expected.
    pub fn world(&self) -> Result<World, SimulationError> {
        let mut description = self.scenario.simulation.clone();
        if description.target.is_none() {
            description.target = self.scenario.target.known_from_the_start();
        }
        let start_rad = self
            .robot
            .posture(&self.scenario.arm.start_posture)
            .map_err(|e| SimulationError::Robot {
                robot: self.robot.name().into(),
                field: "postures".into(),
                message: e.to_string(),
            })?;
        World::new(
            self.robot.clone(),
            &description,
            self.scenario.seed,
            start_rad,
        )
    }
}

/// Finds and reads a robot file; a path on disk wins over a shipped file of the same name.
///
/// # Errors
/// [`ScenarioError`].
pub fn load_robot(name: &str) -> Result<Arc<Robot>, ScenarioError> {
    let (text, origin) = read(embedded::ROBOTS, "robot", Path::new(name), name)?;
    Ok(Arc::new(Robot::parse(&text, &origin)?))
}

fn read(
    shipped: &'static [embedded::ShippedFile],
    kind: &'static str,
    path: &Path,
    name: &str,
) -> Result<(String, String), ScenarioError> {
    match std::fs::read_to_string(path) {
        Ok(text) => Ok((text, path.display().to_string())),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => embedded::find(shipped, name)
            .map(|(name, text)| (text.to_owned(), name.to_owned()))
            .ok_or_else(|| ScenarioError::NotFound {
                kind,
                path: path.display().to_string(),
                shipped: embedded::names(shipped),
            }),
        Err(source) => Err(ScenarioError::File {
            path: path.display().to_string(),
            source: source.into(),
        }),
    }
}

impl Scenario {
    /// Reads a scenario from TOML text; `origin` is named in errors.
    ///
    /// # Errors
    /// [`ScenarioError::Syntax`] with line and column.
    pub fn parse(text: &str, origin: &str) -> Result<Self, ScenarioError> {
        toml::from_str(text).map_err(|e| ScenarioError::Syntax {
            origin: origin.into(),
            message: e.to_string().trim_end().into(),
        })
    }

    /// The effective scenario as TOML, every field explained.
    ///
    /// # Errors
    /// [`ScenarioError::Syntax`] when a value cannot be written as TOML.
    pub fn to_toml(&self) -> Result<String, ScenarioError> {
        let text = toml::to_string(self).map_err(|e| ScenarioError::Syntax {
            origin: self.name.clone(),
            message: e.to_string(),
        })?;
        Ok(documentation::annotate(&text))
    }

    /// Checks every value and that the robot has what is named.
    ///
    /// # Errors
    /// [`ScenarioError::Field`].
    pub fn check(&self, robot: &Robot, origin: &str) -> Result<(), ScenarioError> {
        let check = Check { origin };
        check.require(
            !self.name.trim().is_empty(),
            "name",
            "empty, expected a name",
        )?;
        check.require(
            i64::try_from(self.seed).is_ok(),
            "seed",
            format!(
                "{}, expected 0 to {} as TOML numbers go",
                self.seed,
                i64::MAX
            ),
        )?;
        self.target.check(robot, &check)?;
        if let Some(approach) = &self.approach {
            approach.check(robot, &self.target, &check)?;
        }
        let s = &self.servo;
        check.require(
            !s.stations_m.is_empty(),
            "servo.stations_m",
            "empty, expected at least one",
        )?;
        for (i, &station) in s.stations_m.iter().enumerate() {
            check.range(&format!("servo.stations_m[{i}]"), station, 0.005, 1.0)?;
        }
        check.require(
            s.stations_m.windows(2).all(|w| w[1] < w[0]),
            "servo.stations_m",
            format!("{:?}, expected far to near", s.stations_m),
        )?;
        check.range("servo.tolerance_mm", s.tolerance_mm, 1e-3, 100.0)?;
        check.range(
            "servo.max_corrections_n",
            f64::from(s.max_corrections_n),
            1.0,
            100.0,
        )?;
        check.range(
            "servo.max_predicted_error_mm",
            s.max_predicted_error_mm,
            1e-3,
            1000.0,
        )?;
        let c = &self.contact;
        check.range("contact.speed_mm_s", c.speed_mm_s, 0.1, 100.0)?;
        check.range("contact.max_overtravel_mm", c.max_overtravel_mm, 0.0, 200.0)?;
        check.range("contact.max_force_n", c.max_force_n, 0.1, 200.0)?;
        robot
            .posture(&self.arm.start_posture)
            .map_err(|e| check.error("arm.start_posture", e.to_string()))?;
        if !self.arm.end_posture.is_empty() {
            robot
                .posture(&self.arm.end_posture)
                .map_err(|e| check.error("arm.end_posture", e.to_string()))?;
            check.require(
                c.retract,
                "arm.end_posture",
                "given without contact.retract: the arm does not leave the surface by a planned \
                 motion; expected contact.retract = true or an empty posture",
            )?;
        }
        for (field, value) in [
            ("limits.start_s", self.limits.start_s),
            ("limits.question_s", self.limits.question_s),
            ("limits.action_s", self.limits.action_s),
            ("limits.stop_s", self.limits.stop_s),
        ] {
            check.range(field, value, 0.1, 86_400.0)?;
        }
        Ok(())
    }

    /// The approach's settings with the sun in them.
    pub fn approach_under_the_sun(&self) -> Option<ApproachSettings> {
        let mut settings = self.approach?;
        settings.sun_deg.get_or_insert_with(|| {
            let start = self.simulation.rover.unwrap_or_default();
            let sun = &self.simulation.sun;
            [sun.azimuth_deg - start.heading_deg, sun.elevation_deg]
        });
        Some(settings)
    }

    /// The servo's goal for a selected target. `lost_m` is what may be lost of it on the way
    /// (95 %), as was told before the drive: the servo's limit is on what comes on top.
    pub fn place_goal(&self, target: &Target, lost_m: f64) -> PlaceGoal {
        PlaceGoal {
            target: target.clone(),
            stations_m: self.servo.stations_m.clone(),
            method: self.servo.method,
            observation: self.servo.observation,
            tolerance_m: self.servo.tolerance_mm * 1e-3,
            max_corrections_n: self.servo.max_corrections_n,
            max_predicted_error_m: lost_m.hypot(self.servo.max_predicted_error_mm * 1e-3),
        }
    }

    /// The contact motion's goal after the servo.
    pub fn contact_goal(&self, target: &Target, placed: &PlaceResult) -> ContactGoal {
        ContactGoal {
            target: target.clone(),
            compensation: placed.compensation.clone(),
            standoff_m: placed.standoff_m,
            max_overtravel_m: self.contact.max_overtravel_mm * 1e-3,
            max_force_n: self.contact.max_force_n,
            speed_m_s: self.contact.speed_mm_s * 1e-3,
            retract: self.contact.retract,
        }
    }
}

impl Limits {
    /// For simulator and services to appear.
    pub fn start(&self) -> Duration {
        Duration::from_secs_f64(self.start_s)
    }
    /// For one question.
    pub fn question(&self) -> Duration {
        Duration::from_secs_f64(self.question_s)
    }
    /// For one action.
    pub fn action(&self) -> Duration {
        Duration::from_secs_f64(self.action_s)
    }
    /// For an orderly stop.
    pub fn stop(&self) -> Duration {
        Duration::from_secs_f64(self.stop_s)
    }
}

struct Check<'a> {
    origin: &'a str,
}

impl Check<'_> {
    fn error(&self, field: &str, message: impl Into<String>) -> ScenarioError {
        ScenarioError::Field {
            origin: self.origin.into(),
            field: field.into(),
            message: message.into(),
        }
    }

    fn require(
        &self,
        ok: bool,
        field: &str,
        message: impl Into<String>,
    ) -> Result<(), ScenarioError> {
        if ok {
            Ok(())
        } else {
            Err(self.error(field, message))
        }
    }

    fn range(&self, field: &str, x: f64, low: f64, high: f64) -> Result<(), ScenarioError> {
        self.require(
            (low..=high).contains(&x),
            field,
            format!("{x}, expected {low} to {high}"),
        )
    }
}
