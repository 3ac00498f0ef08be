//! From a plan to jobs of a cluster's scheduler.
//!
//! The graph is handed over and the head process ends. A [`site::Site`] says what is so on a cluster
//! (account, partition, what a stage needs), [`jobs::of`] makes of a plan the few jobs that do what is
//! missing, with arrays, dependencies, times and memory from the forecasts, and [`slurm`] or [`hyperqueue`]
//! writes them in the scheduler's own words. Every task is `use3d run` on a shared cache, so what is there
//! is not computed again, whichever task comes first, is cut off, or is submitted twice: nothing is ever
//! learnt from the scheduler's memory.

pub mod hyperqueue;
pub mod jobs;
pub mod quote;
pub mod site;
pub mod slurm;
pub mod time;

/// What cannot be submitted, and what to do about it.
#[derive(Debug, thiserror::Error)]
pub enum ClusterError {
    /// The site file.
    #[error("{file}: {reason}")]
    Site {
        /// The file.
        file: String,
        /// Field, expectation, next step.
        reason: String,
    },
    /// A name that a scheduler's file cannot hold.
    #[error("{what} `{name}` {reason}; rename it")]
    Name {
        /// What it names.
        what: &'static str,
        /// As it is.
        name: String,
        /// What is wrong with it.
        reason: &'static str,
    },
    /// A file that cannot be written or read.
    #[error(transparent)]
    File(#[from] use3d_build::FileError),
    /// The scheduler's command.
    #[error("{command}: {reason}")]
    Command {
        /// The command.
        command: String,
        /// What went wrong, what to do.
        reason: String,
    },
}
