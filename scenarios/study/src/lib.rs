//! The paper's analysis carried out again, its experiment, and the comparison that it left for
//! later (sections 5 and 6).
//!
//! Every study is a function from a [`StudyConfig`] to a result that serialises; what it draws at
//! random belongs to the seed and the place in the study, so results do not depend on threads.
//!
//! | module | question it answers |
//! |---|---|
//! | [`table1`] | how much does one vector correct at the target, and a second one |
//! | [`locality`] | how far from the target may the vector be taken |
//! | [`experiment`] | the same with pictures, as in the paper's experiment |
//! | [`sensitivity`] | how does each error source enter the final error |
//! | [`compare`] | what do the other methods achieve |
//! | [`cost`] | what does a cycle cost in time and memory |
//! | [`detectors`] | how exactly are fiducials found and points matched, and how often falsely |

pub mod batch;
pub mod compare;
pub mod cost;
pub mod detectors;
pub mod draws;
pub mod experiment;
pub mod growth;
pub mod locality;
pub mod report;
pub mod sensitivity;
pub mod statistics;
pub mod table1;
pub mod testbed;
pub mod workspace;
pub mod world;

pub use report::StudyReport;

/// What all studies take.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StudyConfig {
    /// Seed of all draws.
    pub seed: u64,
    /// Draws per target, place or cell.
    pub trials: usize,
    /// Threads; none for as many as the machine has.
    pub threads: Option<usize>,
}

/// Why a study has no result.
#[derive(Debug, thiserror::Error)]
pub enum StudyError {
    /// The arm's rows are unusable.
    #[error(transparent)]
    Arm(#[from] rover_kinematics::ArmError),
    /// The workspace does not hold the targets.
    #[error("{found} targets are within reach, expected {expected}")]
    Targets {
        /// Wanted.
        expected: usize,
        /// Found.
        found: usize,
    },
    /// Nothing to average.
    #[error("{what}: no trial succeeded")]
    NoTrials {
        /// Which study.
        what: &'static str,
    },
    /// A shipped robot or scenario is unusable.
    #[error("shipped files: {0}")]
    Shipped(String),
    /// The testbed cannot be simulated.
    #[error(transparent)]
    Simulation(#[from] rover_sim::SimulationError),
    /// A camera of the testbed does not see what it should.
    #[error("testbed: {0}")]
    Testbed(String),
    /// The system gives no threads.
    #[error("threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
}

impl StudyConfig {
    /// A configuration.
    pub fn new(seed: u64, trials: usize, threads: Option<usize>) -> Self {
        Self {
            seed,
            trials,
            threads,
        }
    }

    /// The same with another number of trials.
    pub fn with_trials(&self, trials: usize) -> Self {
        Self {
            trials,
            ..self.clone()
        }
    }

    /// The threads that compute.
    ///
    /// # Errors
    /// [`StudyError::Threads`].
    pub fn pool(&self) -> Result<rayon::ThreadPool, StudyError> {
        Ok(rayon::ThreadPoolBuilder::new()
            .num_threads(self.threads.unwrap_or(0))
            .build()?)
    }
}
