//! `push`, `pull` and `store`: send a pipeline's artifacts to a store or fetch them, and list or clean a
//! store.

use clap::{Args, Subcommand};

use super::shared::PipelineArgs;
use super::upkeep::SweepArgs;

#[derive(Debug, Subcommand)]
pub(crate) enum Store {
    /// Show the number of artifacts of each stage in a store, and their size.
    #[command(after_help = "Example:\n  use3d store ls --remote s3://lab/use3d")]
    Ls(StoreLsArgs),
    /// Remove old artifacts from a store, except those of the pipelines to keep.
    #[command(
        after_help = "Example:\n  use3d store gc --remote s3://lab/use3d --older-than 90d --keep pipelines/use26.toml --dry-run"
    )]
    Gc(StoreGcArgs),
}

/// The address of a store.
#[derive(Clone, Debug, Args)]
pub(crate) struct RemoteArgs {
    /// The store: a folder, or s3://BUCKET/PREFIX if this program was built with S3. Keys and server come
    /// from the usual AWS_… variables.
    #[arg(long, env = "USE3D_REMOTE", value_name = "URL", hide_env_values = true)]
    pub(crate) remote: String,
}

#[derive(Debug, Args)]
pub(crate) struct StoreLsArgs {
    #[command(flatten)]
    pub(crate) store: RemoteArgs,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct StoreGcArgs {
    #[command(flatten)]
    pub(crate) store: RemoteArgs,
    /// Remove artifacts that were sent longer ago than this, e.g. 90d.
    #[arg(long, value_name = "AGE")]
    pub(crate) older_than: String,
    #[command(flatten)]
    pub(crate) sweep: SweepArgs,
}

#[derive(Debug, Args)]
pub(crate) struct PushArgs {
    #[command(flatten)]
    pub(crate) what: TransferArgs,
    /// Read back the objects in the store, compare them with those here, and replace those that are wrong.
    #[arg(long)]
    pub(crate) check: bool,
}

#[derive(Debug, Args)]
pub(crate) struct TransferArgs {
    #[command(flatten)]
    pub(crate) pipeline: PipelineArgs,
    #[command(flatten)]
    pub(crate) store: RemoteArgs,
    /// End with 1 if an artifact of the pipeline is missing on the sending side.
    #[arg(long)]
    pub(crate) all_or_fail: bool,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}
