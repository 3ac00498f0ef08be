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
//!
//! A [`submission::Submission`] has the data that its jobs share. Its list of scenes, [`cells`], keeps a task
//! from computing what was edited since.

pub mod cells;
pub mod hyperqueue;
pub mod jobs;
pub mod quote;
mod scheduler;
pub mod site;
pub mod slurm;
pub mod submission;
pub mod time;
pub mod variables;

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
    /// A path that no script can hold.
    #[error("{0}: a script cannot hold a path that is not UTF-8")]
    NotUtf8(String),
    /// A text that no script can hold.
    #[error("{0} has a control character in it; a script cannot hold it")]
    Control(String),
    /// The list of the submitted scenes cannot be read.
    #[error("{file}: the list of the submitted scenes cannot be read ({source}); submit again")]
    List {
        /// The file.
        file: String,
        /// The problem.
        source: std::io::Error,
    },
    /// Nothing of a task is as it was submitted; the pipeline file.
    #[error(
        "{0}: this is not the submitted pipeline: the settings of this task were edited since, this is another \
         version of the program, or `arguments` of the site change a parameter; submit it again"
    )]
    Edited(String),
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
