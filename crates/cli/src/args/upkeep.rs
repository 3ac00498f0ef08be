//! The arguments for the cache, the models folder, and the command itself.

use std::path::PathBuf;

use clap::Args;

use super::shared::{CacheArgs, PipelineSettings, Replace};

#[derive(Debug, Args)]
pub(crate) struct ModelsArgs {
    /// The folder to search.
    #[arg(long, env = "USE3D_MODELS", value_name = "DIR")]
    pub(crate) dir: Option<PathBuf>,
    /// Only the networks that this preset needs; exit code 2 if some are missing.
    #[arg(long = "for", value_name = "PRESET")]
    pub(crate) preset: Option<String>,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct DevicesArgs {
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct DoctorArgs {
    /// The cache folder (default: ~/.cache/use3d).
    #[arg(long, env = "USE3D_CACHE", value_name = "DIR")]
    pub(crate) cache: Option<PathBuf>,
    /// The models folder (default: ./models).
    #[arg(long, env = "USE3D_MODELS", value_name = "DIR")]
    pub(crate) models: Option<PathBuf>,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

/// The part that is not removed, of a cache or a store.
#[derive(Debug, Args)]
pub(crate) struct SweepArgs {
    /// Never remove results that these pipelines use.
    #[arg(long = "keep", value_name = "PIPELINE.toml")]
    pub(crate) keep: Vec<PathBuf>,
    /// Only list what would be removed.
    #[arg(long)]
    pub(crate) dry_run: bool,
    #[command(flatten)]
    pub(crate) cache: CacheArgs,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct GcArgs {
    /// Keep the cache below this size: a number with a unit, e.g. 50GB.
    #[arg(long, value_name = "SIZE")]
    pub(crate) max_bytes: Option<String>,
    /// Remove items that were not used for this long, e.g. 30d.
    #[arg(long, value_name = "AGE")]
    pub(crate) older_than: Option<String>,
    /// Clean this results folder instead of the cache: remove the results of scenes that were written
    /// longer ago than --older-than. Report and tables stay.
    #[arg(long, value_name = "DIR", requires = "older_than", conflicts_with_all = ["max_bytes", "keep", "cache"])]
    pub(crate) results: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) sweep: SweepArgs,
}

#[derive(Debug, Args)]
pub(crate) struct VerifyArgs {
    /// The pipeline whose stages may be recomputed (needed for --sample).
    #[arg(value_name = "PIPELINE.toml|CAPTURE_DIR")]
    pub(crate) target: Option<PathBuf>,
    /// Recompute this share of the stages and compare, e.g. 5%.
    #[arg(long, value_name = "SHARE")]
    pub(crate) sample: Option<String>,
    #[command(flatten)]
    pub(crate) settings: PipelineSettings,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct PipelinesArgs {
    /// The file to print; `schema` is the JSON schema of pipeline files. Without a name, all are listed.
    #[arg(value_name = "NAME", conflicts_with = "json")]
    pub(crate) name: Option<String>,
    /// The list as one JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct ParamsArgs {
    /// Only this stage.
    pub(crate) stage: Option<String>,
    /// Show the values of this preset instead of the defaults: paper, 3d-use, 3dgs, seasplat,
    /// water-splatting, plenodium, 3d-uir, marinestd-gs.
    #[arg(long, value_name = "NAME")]
    pub(crate) preset: Option<String>,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct CompletionsArgs {
    /// The shell.
    #[arg(value_enum)]
    pub(crate) shell: clap_complete::Shell,
}

#[derive(Debug, Args)]
pub(crate) struct ManArgs {
    /// The folder to write to, e.g. ~/.local/share/man/man1.
    #[arg(short, long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    #[command(flatten)]
    pub(crate) replace: Replace,
}
