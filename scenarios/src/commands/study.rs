//! `rover study`: the paper's analysis, carried out again.

use super::{CommandError, Exit};
use crate::output::{Output, print};
use rover_study::{self as studies, StudyConfig, StudyError, StudyReport};
use std::path::PathBuf;

/// Which study.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Which {
    /// One error vector at the target: the paper's table 1
    Table1,
    /// One error vector away from the target: the paper's figure 6
    Locality,
    /// The same with images of the simulated testbed: the paper's figure 7
    Experiment,
    /// Each error source's share in the final error, by Jacobians and by simulation
    Sensitivity,
    /// Every method that the paper names, under the same truths and noise, and from images
    Compare,
    /// Time and memory of a cycle of each method
    Cost,
    /// All of them in one report
    All,
}

/// Carries out the paper's analysis again and compares
///
/// Every number is computed here and now; seeds are fixed, so the same command gives the same
/// numbers on any number of threads. Only times depend on the machine.
#[derive(Clone, Debug, clap::Args)]
pub struct StudyArgs {
    /// Which study
    #[arg(value_enum)]
    pub which: Which,
    /// Seed of all draws
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
    /// Draws per target, place or cell (default: the paper's, or what the study's text says)
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub trials: Option<u32>,
    /// Threads (default: all)
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=512))]
    pub threads: Option<u16>,
    /// Writes the result as JSON; `-` is standard output
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Writes a page with plots, the paper's numbers and a verdict into this folder
    #[arg(long, value_name = "DIR")]
    pub report: Option<PathBuf>,
    /// Overwrites outputs that exist
    #[arg(long)]
    pub force: bool,
}

impl From<StudyError> for CommandError {
    fn from(error: StudyError) -> Self {
        Self::Internal(error.into())
    }
}

/// Runs the command.
///
/// # Errors
/// [`CommandError`].
pub fn run(args: &StudyArgs) -> Result<Exit, CommandError> {
    let open = |path: &std::path::Path| Output::open(path, args.force);
    let json = args.json.as_deref().map(open).transpose()?;
    let page = args
        .report
        .as_deref()
        .map(|folder| {
            if folder.exists() && !folder.is_dir() {
                return Err(CommandError::BadInput(format!(
                    "--report {}: is a file, expected a folder",
                    folder.display()
                )));
            }
            Ok(open(&folder.join("index.html"))?)
        })
        .transpose()?;
    let report = study(args)?;
    if let Some(output) = &json {
        output.write(&report.to_json().map_err(anyhow::Error::from)?)?;
    }
    if let Some(page) = &page {
        page.write(&report.page())?;
    }
    if json != Some(Output::Stdout) {
        print(&report.summary())?;
    }
    Ok(Exit::Done)
}

fn study(args: &StudyArgs) -> Result<StudyReport, StudyError> {
    let config = |paper: usize| {
        let trials = args.trials.map_or(paper, |n| n as usize);
        StudyConfig::new(args.seed, trials, args.threads.map(usize::from))
    };
    let all = args.which == Which::All;
    let mut report = StudyReport::new(args.seed, all);
    if all || args.which == Which::Table1 {
        report.table1 = Some(studies::table1::table1(&config(
            studies::table1::PAPER_TRIALS,
        ))?);
    }
    if all || args.which == Which::Locality {
        let trials = config(studies::locality::PAPER_TRIALS);
        report.locality = Some(studies::locality::locality(&trials)?);
    }
    if all || args.which == Which::Experiment {
        let trials = config(studies::experiment::TRIALS);
        report.experiment = Some(studies::experiment::experiment(&trials)?);
    }
    if all || args.which == Which::Sensitivity {
        let trials = config(studies::sensitivity::TRIALS);
        report.sensitivity = Some(studies::sensitivity::sensitivity(&trials)?);
    }
    if all || args.which == Which::Compare {
        let trials = config(studies::compare::TRIALS);
        report.compare = Some(studies::compare::compare(
            &trials,
            &studies::compare::Case::ALL,
            &studies::compare::OCCLUSIONS_CM,
        )?);
    }
    if all || args.which == Which::Cost {
        report.cost = Some(studies::cost::cost(&config(studies::cost::TRIALS))?);
    }
    Ok(report)
}
