//! Converts a plan to jobs of a cluster's scheduler (Slurm or HyperQueue).
//!
//! The inputs are a plan of the crate `workflow` and a description of the site. The outputs are the
//! scheduler's files, and the jobs that its own command submits. This crate computes no stage, and it does
//! not watch the jobs.
//!
//! The whole graph is submitted at once, and no process stays behind. A [`site::Site`] describes a cluster
//! (account, partition, resources of a stage). [`jobs::of`] makes the few jobs that compute the missing
//! stages of a plan, with arrays, dependencies, times and memory from the forecasts. [`slurm`] or
//! [`hyperqueue`] writes them in the scheduler's own format. Every task is `use3d run` on a shared cache. So
//! existing artifacts are not computed again, in whatever order tasks run, and even if one is interrupted or
//! submitted twice. The state of the work is never read from the scheduler.

pub mod hyperqueue;
pub mod jobs;
pub mod quote;
mod scheduler;
pub mod site;
pub mod slurm;
pub mod time;

/// An error of a submission, with the next step for the user.
#[derive(Debug, thiserror::Error)]
pub enum ClusterError {
    /// The site file is wrong.
    #[error("{file}: {reason}")]
    Site {
        /// The file.
        file: String,
        /// The field, the expected value, and the next step.
        reason: site::SiteError,
    },
    /// A name that a scheduler's file cannot hold.
    #[error("{what} `{name}` {reason}; rename it")]
    Name {
        /// The kind of the name.
        what: &'static str,
        /// The name.
        name: String,
        /// The problem with it.
        reason: &'static str,
    },
    /// Equal workers cannot run in several partitions: these, each with a stage.
    #[error(
        "the stages need several partitions: {0}; workers are in one: name it as `partition` of [stage.run], \
         or submit with --layout stages"
    )]
    Partitions(String),
    /// A file that cannot be written or read.
    #[error(transparent)]
    File(#[from] use3d_workflow::FileError),
    /// The scheduler's command failed.
    #[error("{command}: {reason}")]
    Command {
        /// The command.
        command: String,
        /// The problem, and the next step.
        reason: String,
    },
}
