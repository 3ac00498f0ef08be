//! Whole pipelines: run, plan, status, why, graph, and the demo.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, ValueEnum};

use super::shared::{CacheArgs, MAX_STEPS, PipelineArgs, Replace, Settings, count, time};
use super::view::WatchArgs;
use super::white::WhiteArgs;

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
    #[arg(short, long, default_value = "use3d-out/demo", value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// How large the pictures are, and how long the training.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) size: DemoSize,
    /// Steps of stage 1 (the same as `--set reconstruct.iterations=N`).
    #[arg(long, value_name = "N", visible_alias = "steps", value_parser = count(MAX_STEPS))]
    pub(crate) iterations: Option<usize>,
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
    #[arg(short, long, default_value_t = 1, value_name = "N", value_parser = count(MAX_JOBS))]
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
    /// Leave what other processes on the same cache compute to them, once there was nothing else to do for a
    /// minute, instead of waiting for it.
    #[arg(long)]
    pub(crate) until_empty: bool,
    /// Fill the cache and put no results into a folder.
    #[arg(long, conflicts_with = "out")]
    pub(crate) cache_only: bool,
    /// A store beside the cache (a folder, or s3://BUCKET/PREFIX): what it has is fetched instead of
    /// computed, what is computed is sent to it. It may fail: the run goes on without it.
    #[arg(long, env = "USE3D_REMOTE", value_name = "URL", hide_env_values = true)]
    pub(crate) remote: Option<String>,
    /// Only say what would run (the same as `use3d plan`).
    #[arg(long)]
    pub(crate) dry_run: bool,
    /// Where results go (default: ./use3d-out/NAME). Results of earlier runs there are brought up to date;
    /// what is not a result of this program is never replaced.
    #[arg(short, long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) white: WhiteArgs,
    #[command(flatten)]
    pub(crate) watch: WatchArgs,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct ResultsArgs {
    /// A results folder, or its name below ./use3d-out (default: all that are there).
    #[arg(value_name = "NAME|RESULTS_DIR")]
    pub(crate) name: Option<PathBuf>,
    /// Bring the results of this run back. Nothing is computed.
    #[arg(value_name = "N")]
    pub(crate) run: Option<usize>,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct CompareArgs {
    /// A results folder, its name below ./use3d-out, or NAME:N for its run N.
    #[arg(value_name = "A")]
    pub(crate) a: String,
    /// Another one.
    #[arg(value_name = "B")]
    pub(crate) b: String,
    /// The page that is written.
    #[arg(short, long, value_name = "FILE.html", default_value = "compare.html")]
    pub(crate) out: PathBuf,
    #[command(flatten)]
    pub(crate) replace: Replace,
}

#[derive(Debug, Args)]
pub(crate) struct PlanArgs {
    #[command(flatten)]
    pub(crate) pipeline: PipelineArgs,
    /// Taken as `use3d run` takes it, and of no account here.
    #[arg(short, long, value_name = "DIR", hide = true)]
    out: Option<PathBuf>,
    /// Taken as `use3d run` takes it, and of no account here.
    #[arg(short, long, value_name = "N", hide = true)]
    jobs: Option<usize>,
    /// Taken as `use3d run` takes it, and of no account here.
    #[arg(long, hide = true)]
    keep_going: bool,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
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
