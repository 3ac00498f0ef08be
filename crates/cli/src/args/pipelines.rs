//! Whole pipelines: run, plan, status, why, graph, and the demo.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, ValueEnum};

use super::shared::{CacheArgs, PipelineArgs, Settings, count, time};
use super::view::WatchArgs;

/// More stages side by side than any one machine has memory for.
pub(super) const MAX_JOBS: u64 = 256;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum DemoSize {
    /// A few minutes on two cores.
    #[default]
    Small,
    /// The demo at the size of a real capture.
    Full,
}

#[derive(Debug, Args)]
pub(crate) struct DemoArgs {
    /// Where the capture, the results and the report go.
    #[arg(long, default_value = "use3d-out/demo", value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// How large the pictures are, and how long the training.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) size: DemoSize,
    #[command(flatten)]
    pub(crate) settings: Settings,
    #[command(flatten)]
    pub(crate) cache: CacheArgs,
}

#[derive(Debug, Args)]
pub(crate) struct RunArgs {
    #[command(flatten)]
    pub(crate) pipeline: PipelineArgs,
    /// Only this scene; may be repeated.
    #[arg(long, value_name = "NAME")]
    pub(crate) scene: Vec<String>,
    /// Stop after this stage.
    #[arg(long, value_name = "STAGE")]
    pub(crate) until: Option<String>,
    /// Stages to run side by side, within the cores and memory there are.
    #[arg(long, default_value_t = 1, value_name = "N", value_parser = count(MAX_JOBS))]
    pub(crate) jobs: usize,
    /// Go on with the other scenes when one fails.
    #[arg(long)]
    pub(crate) keep_going: bool,
    /// Only this scene in this variant and what it needs, where there are variants; may be repeated. Unlike
    /// `--scene`, it leaves the batch as it is.
    #[arg(long, value_name = "SCENE[@VARIANT]", conflicts_with = "scene")]
    pub(crate) only: Vec<String>,
    /// Leave before so much time has passed, e.g. `3h`, `90min` or `3:50:00`: trainings write checkpoints,
    /// and the exit code is 75 unless all is done. The same command goes on from there.
    #[arg(long, value_name = "TIME", value_parser = time)]
    pub(crate) max_time: Option<Duration>,
    /// Leave what other processes on the same cache compute to them, once there was nothing else to do for
    /// longer than a process that was killed is waited for, instead of waiting for it.
    #[arg(long)]
    pub(crate) until_empty: bool,
    /// Compute nothing but what is made of the whole batch (the report), from what is there, and fill the
    /// results folder. Where something is missing, it is named, and the exit code is 1.
    #[arg(long, conflicts_with_all = ["until", "until_empty", "cache_only"])]
    pub(crate) gather: bool,
    /// Fill the cache and put no results into a folder.
    #[arg(long, conflicts_with = "out")]
    pub(crate) cache_only: bool,
    /// A store beside the cache (a folder, or s3://BUCKET/PREFIX): what it has is fetched instead of
    /// computed, what is computed is sent to it. It may fail: the run goes on without it.
    #[arg(long, env = "USE3D_REMOTE", value_name = "URL", hide_env_values = true)]
    pub(crate) remote: Option<String>,
    /// Only fetch from the store: nothing is sent to it, and no right to write is needed.
    #[arg(long, requires = "remote")]
    pub(crate) remote_read_only: bool,
    /// Refuse to run where the pipeline is not the one of this digest, which `use3d submit` writes into its
    /// scripts: its file was edited since, or another version of this program would compute something else.
    #[arg(long, value_name = "DIGEST", hide = true)]
    pub(crate) submitted: Option<String>,
    /// Only say what would run (the same as `use3d plan`).
    #[arg(long)]
    pub(crate) dry_run: bool,
    /// Where results go (default: ./use3d-out/NAME). Results of earlier runs there are brought up to date;
    /// what is not a result of this program is never replaced.
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) watch: WatchArgs,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct PlanArgs {
    #[command(flatten)]
    pub(crate) pipeline: PipelineArgs,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct StatusArgs {
    #[command(flatten)]
    pub(crate) plan: PlanArgs,
    /// Only this scene; may be repeated.
    #[arg(long, value_name = "NAME")]
    pub(crate) scene: Vec<String>,
    /// Only rows with a failure.
    #[arg(long)]
    pub(crate) failed: bool,
    /// No rows, but how many cells of each stage stand how.
    #[arg(long, conflicts_with_all = ["scene", "failed"])]
    pub(crate) summary: bool,
}

#[derive(Debug, Args)]
pub(crate) struct WhyArgs {
    #[command(flatten)]
    pub(crate) pipeline: PipelineArgs,
    /// The scene's name.
    pub(crate) scene: String,
    /// The stage's name.
    pub(crate) stage: String,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum GraphFormat {
    /// Text that many pages draw.
    #[default]
    Mermaid,
    /// A picture.
    Svg,
}

#[derive(Debug, Args)]
pub(crate) struct GraphArgs {
    #[command(flatten)]
    pub(crate) pipeline: PipelineArgs,
    /// How to draw it.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) format: GraphFormat,
}
