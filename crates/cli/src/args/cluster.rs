//! `submit`: runs a pipeline as jobs of a cluster's scheduler.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};

use super::pipelines::MAX_JOBS;
use super::shared::{PipelineArgs, count};

#[derive(Debug, Subcommand)]
pub(crate) enum Submit {
    /// Submit to Slurm: write a readable script for each job, then call `sbatch`.
    #[command(
        after_help = "Examples:\n  use3d submit slurm pipelines/seathru4.toml --cache /scratch/use3d --dry-run\n  \
        use3d submit slurm pipelines/use26.toml --cache /scratch/use3d --cluster cluster.toml --layout stages"
    )]
    Slurm(SubmitArgs),
    /// Submit to HyperQueue as one job, with `hq`.
    #[command(
        after_help = "Example:\n  use3d submit hq pipelines/use26.toml --cache /scratch/use3d --dry-run"
    )]
    Hq(SubmitArgs),
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum SubmitLayout {
    /// One array of equal tasks that share the work.
    #[default]
    Workers,
    /// An array over scenes and variants for every stage, with the resources that the stage needs.
    Stages,
}

#[derive(Debug, Args)]
pub(crate) struct CancelArgs {
    /// The pipeline file (.toml) or capture folder that was submitted.
    #[arg(value_name = "PIPELINE.toml|CAPTURE_DIR")]
    pub(crate) target: PathBuf,
    /// The results folder of the submission, if one was given.
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub(crate) struct SubmitArgs {
    #[command(flatten)]
    pub(crate) pipeline: PipelineArgs,
    /// The facts of the site: account, partition, resources of stages (docs/reference/cluster.md).
    #[arg(long, value_name = "FILE")]
    pub(crate) cluster: Option<PathBuf>,
    /// The way in which the work is cut into tasks.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) layout: SubmitLayout,
    /// Number of tasks of `--layout workers` (default: `at_once` of the site).
    #[arg(long, value_name = "N", value_parser = count(MAX_JOBS))]
    pub(crate) workers: Option<usize>,
    /// Write nothing and submit nothing: print what would be submitted.
    #[arg(long)]
    pub(crate) dry_run: bool,
    /// Submit although jobs of the last submission are still in the queue.
    #[arg(long)]
    pub(crate) again: bool,
    /// The folder for results (default: ./use3d-out/NAME); scripts and logs go into DIR-submit beside it.
    #[arg(short, long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
}
