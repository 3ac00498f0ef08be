//! `submit`: a pipeline as jobs of a cluster's scheduler.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};

use super::pipelines::MAX_JOBS;
use super::shared::{PipelineArgs, count};

#[derive(Debug, Subcommand)]
pub(crate) enum Submit {
    /// As Slurm's jobs: a readable script for each, then `sbatch`.
    #[command(
        after_help = "Examples:\n  use3d submit slurm pipelines/seathru4.toml --cache /scratch/use3d --dry-run\n  \
        use3d submit slurm pipelines/use26.toml --cache /scratch/use3d --cluster cluster.toml --layout stages"
    )]
    Slurm(SubmitArgs),
    /// As one job of HyperQueue, `hq`.
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
    /// An array over scenes and variants for every stage, each asking for what the stage needs.
    Stages,
}

#[derive(Debug, Args)]
pub(crate) struct CancelArgs {
    /// The pipeline file (.toml) or capture folder that was submitted.
    #[arg(value_name = "PIPELINE.toml|CAPTURE_DIR")]
    pub(crate) target: PathBuf,
    /// The results folder of the submission, where one was given.
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub(crate) struct SubmitArgs {
    #[command(flatten)]
    pub(crate) pipeline: PipelineArgs,
    /// The facts of the site: account, partition, what stages need (docs/guide/cluster.md).
    #[arg(long, value_name = "FILE")]
    pub(crate) cluster: Option<PathBuf>,
    /// How the work is cut into tasks.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) layout: SubmitLayout,
    /// Tasks of `--layout workers` (default: `at_once` of the site).
    #[arg(long, value_name = "N", value_parser = count(MAX_JOBS))]
    pub(crate) workers: Option<usize>,
    /// Write nothing and submit nothing: print what would be.
    #[arg(long)]
    pub(crate) dry_run: bool,
    /// Submit although jobs of the last submission are still in the queue.
    #[arg(long)]
    pub(crate) again: bool,
    /// Where results go (default: ./use3d-out/NAME); scripts and logs go into DIR-submit beside it.
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
}
