//! `push` and `pull`: send a pipeline's artifacts to a store, or fetch them.

use clap::Args;

use super::shared::PipelineArgs;

#[derive(Debug, Args)]
pub(crate) struct PushArgs {
    #[command(flatten)]
    pub(crate) what: TransferArgs,
    /// Read back the objects in the store, and replace those that are wrong.
    #[arg(long)]
    pub(crate) check: bool,
}

#[derive(Debug, Args)]
pub(crate) struct TransferArgs {
    #[command(flatten)]
    pub(crate) pipeline: PipelineArgs,
    /// The store: a folder, or s3://BUCKET/PREFIX where this program was built with S3. Keys and server come
    /// from the usual AWS_… variables.
    #[arg(long, env = "USE3D_REMOTE", value_name = "URL", hide_env_values = true)]
    pub(crate) remote: String,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}
