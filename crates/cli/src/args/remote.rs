//! `push`, `pull` and `store`: a pipeline's artifacts to a store and from it, and what a store holds.

use std::path::PathBuf;

use clap::{Args, Subcommand};

use super::shared::{CacheArgs, PipelineArgs};

#[derive(Debug, Subcommand)]
pub(crate) enum Store {
    /// How many artifacts of each stage a store holds, and their bytes.
    #[command(after_help = "Example:\n  use3d store ls --remote s3://lab/use3d")]
    Ls(StoreLsArgs),
    /// Remove from a store what was sent long ago and no pipeline to keep has.
    #[command(
        after_help = "Example:\n  use3d store gc --remote s3://lab/use3d --older-than 90d --keep pipelines/use26.toml --dry-run"
    )]
    Gc(StoreGcArgs),
}

/// A store's address.
#[derive(Clone, Debug, Args)]
pub(crate) struct RemoteArgs {
    /// The store: a folder, or s3://BUCKET/PREFIX where this program was built with S3. Keys and server come
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
    /// Remove what was sent longer ago than this, e.g. 90d.
    #[arg(long, value_name = "AGE")]
    pub(crate) older_than: String,
    /// Never remove what the cache has of these pipelines.
    #[arg(long = "keep", value_name = "PIPELINE.toml")]
    pub(crate) keep: Vec<PathBuf>,
    /// Only say what would go.
    #[arg(long)]
    pub(crate) dry_run: bool,
    #[command(flatten)]
    pub(crate) cache: CacheArgs,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct PushArgs {
    #[command(flatten)]
    pub(crate) what: TransferArgs,
    /// Read back what the store has already, and replace what is not as it should be.
    #[arg(long)]
    pub(crate) check: bool,
}

#[derive(Debug, Args)]
pub(crate) struct TransferArgs {
    #[command(flatten)]
    pub(crate) pipeline: PipelineArgs,
    #[command(flatten)]
    pub(crate) store: RemoteArgs,
    /// End with 1 where an artifact of the pipeline is missing on the side that gives.
    #[arg(long)]
    pub(crate) all_or_fail: bool,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}
