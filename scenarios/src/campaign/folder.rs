//! A campaign on disk: what it is, and one record for each run that has ended.

use crate::report::RunReport;
use rover_files::FileError;
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use std::{
    collections::BTreeMap,
    io,
    path::{Path, PathBuf},
};

const MANIFEST: &str = "campaign.json";
const RUNS: &str = "runs";

/// Why a campaign's folder cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CampaignError {
    /// The system refused.
    #[error("{path}: {source}")]
    File {
        /// The file or folder.
        path: String,
        /// What the system said.
        source: FileError,
    },
    /// A file of the campaign is not what it should be.
    #[error("{path}: {message}")]
    Broken {
        /// The file.
        path: String,
        /// What is wrong.
        message: String,
    },
    /// The folder belongs to another campaign.
    #[error("{path} holds another campaign ({field} differs): give another folder")]
    Other {
        /// The folder.
        path: String,
        /// What differs.
        field: &'static str,
    },
}

/// What a campaign is; a folder belongs to one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Version of the program: another one may give other digests.
    pub version: String,
    /// The scenario as it was named.
    pub scenario: String,
    /// Overrides, as for `--set`.
    pub set: Vec<String>,
    /// Seed of the first run; each run has the next.
    pub first_seed: u64,
    /// The effective scenario with nothing drawn, TOML.
    pub effective: String,
    /// Text of the robot file.
    pub robot: String,
}

impl Manifest {
    fn difference(&self, other: &Self) -> Option<&'static str> {
        [
            ("version", self.version == other.version),
            ("scenario", self.scenario == other.scenario),
            ("set", self.set == other.set),
            ("first_seed", self.first_seed == other.first_seed),
            ("the scenario's content", self.effective == other.effective),
            ("the robot file's content", self.robot == other.robot),
        ]
        .into_iter()
        .find_map(|(field, same)| (!same).then_some(field))
    }
}

/// One run that has ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Record {
    /// Its seed.
    pub seed: u64,
    /// What does it again.
    pub command: String,
    /// The fields that were drawn, by path.
    pub varied: BTreeMap<String, serde_json::Value>,
    /// Wall time of the whole process, s.
    pub wall_s: f64,
    /// The report, if the run ended by itself.
    pub report: Option<RunReport>,
    /// Otherwise what the process said last.
    pub failure: Option<String>,
}

/// A campaign's folder.
#[derive(Clone, Debug)]
pub struct Folder {
    path: PathBuf,
}

impl Folder {
    /// Opens the folder for a campaign, new or begun before.
    ///
    /// # Errors
    /// [`CampaignError`]; a folder of another campaign is refused and left as it is.
    pub fn open(path: &Path, manifest: &Manifest) -> Result<Self, CampaignError> {
        let folder = Self { path: path.into() };
        let runs = path.join(RUNS);
        std::fs::create_dir_all(&runs).map_err(unwritten(&runs))?;
        let present = path.join(MANIFEST);
        match std::fs::read_to_string(&present) {
            Ok(text) => {
                let found: Manifest = parse(&present, &text)?;
                match found.difference(manifest) {
                    None => Ok(folder),
                    Some(field) => Err(CampaignError::Other {
                        path: path.display().to_string(),
                        field,
                    }),
                }
            }
            Err(e) if e.kind() == io::ErrorKind::NotFound => {
                folder.write(MANIFEST, &pretty(&present, manifest)?)?;
                Ok(folder)
            }
            Err(source) => Err(unread(&present, source)),
        }
    }

    /// The record of a seed, if that run has ended.
    ///
    /// # Errors
    /// [`CampaignError`] when there is a file that is no record of that seed.
    pub fn record(&self, seed: u64) -> Result<Option<Record>, CampaignError> {
        let path = self.path.join(name(seed));
        match std::fs::read_to_string(&path) {
            Ok(text) => {
                let record: Record = parse(&path, &text)?;
                if record.seed == seed {
                    return Ok(Some(record));
                }
                Err(CampaignError::Broken {
                    path: path.display().to_string(),
                    message: format!("record of seed {}, expected {seed}", record.seed),
                })
            }
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(source) => Err(unread(&path, source)),
        }
    }

    /// Keeps the record of a run.
    ///
    /// # Errors
    /// [`CampaignError`].
    pub fn keep(&self, record: &Record) -> Result<(), CampaignError> {
        let name = name(record.seed);
        self.write(&name, &pretty(&self.path.join(&name), record)?)
    }

    /// Writes a file of the folder so that it is there whole or not at all.
    ///
    /// # Errors
    /// [`CampaignError::File`].
    pub fn write(&self, name: &str, text: &str) -> Result<(), CampaignError> {
        let path = self.path.join(name);
        let folder = path.parent().unwrap_or(&self.path);
        let write = || -> io::Result<()> {
            let mut new = tempfile::NamedTempFile::new_in(folder)?;
            io::Write::write_all(&mut new, text.as_bytes())?;
            new.as_file().sync_all()?;
            new.persist(&path).map_err(|e| e.error)?;
            Ok(())
        };
        write().map_err(unwritten(&path))
    }
}

fn name(seed: u64) -> String {
    format!("{RUNS}/seed_{seed:06}.json")
}

fn unread(path: &Path, source: io::Error) -> CampaignError {
    CampaignError::File {
        path: path.display().to_string(),
        source: source.into(),
    }
}

fn unwritten(path: &Path) -> impl Fn(io::Error) -> CampaignError {
    let path = path.display().to_string();
    move |source| CampaignError::File {
        path: path.clone(),
        source: FileError::writing(source),
    }
}

fn broken(path: &Path, error: &serde_json::Error) -> CampaignError {
    CampaignError::Broken {
        path: path.display().to_string(),
        message: error.to_string(),
    }
}

fn parse<T: DeserializeOwned>(path: &Path, text: &str) -> Result<T, CampaignError> {
    serde_json::from_str(text).map_err(|e| broken(path, &e))
}

fn pretty<T: Serialize>(path: &Path, value: &T) -> Result<String, CampaignError> {
    let text = serde_json::to_string_pretty(value).map_err(|e| broken(path, &e))?;
    Ok(text + "\n")
}
