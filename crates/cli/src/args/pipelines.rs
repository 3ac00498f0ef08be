//! Whole pipelines: run, plan, status, why, graph, and the demo.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, ValueEnum};

use super::shared::{CacheArgs, MAX_STEPS, PipelineArgs, Replace, Settings, count, time};
use super::view::WatchArgs;
use super::white::WhiteArgs;

/// More stages at the same time than the memory of any one machine allows.
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
    /// The folder for the capture, the results and the report.
    #[arg(short, long, default_value = "use3d-out/demo", value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// The size of the pictures, and the length of the training.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) size: DemoSize,
    /// Steps of stage 1 (the same as `--set reconstruct.iterations=N`).
    #[arg(long, value_name = "N", visible_alias = "steps", value_parser = count(MAX_STEPS), allow_negative_numbers = true)]
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
    /// Compute only that stage. If a stage before it is missing, that scene is left to others.
    #[arg(long, requires = "until")]
    pub(crate) alone: bool,
    /// Stages to run at the same time, within the cores and memory of the machine.
    #[arg(short, long, default_value_t = 1, value_name = "N", value_parser = count(MAX_JOBS))]
    pub(crate) jobs: usize,
    /// Continue with the other scenes when one fails.
    #[arg(long)]
    pub(crate) keep_going: bool,
    /// Only this scene in this variant and the stages it needs, if there are variants; may be repeated.
    /// Unlike `--scene`, it does not change the batch.
    #[arg(long, value_name = "SCENE[@VARIANT]", conflicts_with = "scene")]
    pub(crate) only: Vec<String>,
    /// Stop before this time has passed, e.g. `3h`, `90min` or `3:50:00`: trainings write checkpoints, and
    /// the exit code is 75 unless all is done. The same command continues from there.
    #[arg(long, value_name = "TIME", value_parser = time)]
    pub(crate) max_time: Option<Duration>,
    /// After two and a half minutes with nothing else to do, leave the work of other processes on the same
    /// cache to them instead of waiting. That is longer than the wait for a killed process.
    #[arg(long)]
    pub(crate) until_empty: bool,
    /// Compute only stages over the whole batch (the report), from the results that exist, and fill the
    /// results folder. If something is missing, it is named, and the exit code is 1.
    #[arg(long, conflicts_with_all = ["until", "until_empty", "cache_only"])]
    pub(crate) gather: bool,
    /// Fill the cache, and write no results folder.
    #[arg(long, conflicts_with = "out")]
    pub(crate) cache_only: bool,
    /// Put only the report with its pages and tables into the results folder. The scenes stay in the cache.
    #[arg(long, conflicts_with_all = ["cache_only", "until", "photographs"])]
    pub(crate) report_only: bool,
    /// A store beside the cache (a folder, or s3://BUCKET/PREFIX): its results are fetched instead of
    /// computed, and computed results are sent to it. If it fails, the run continues without it.
    #[arg(long, env = "USE3D_REMOTE", value_name = "URL", hide_env_values = true)]
    pub(crate) remote: Option<String>,
    /// Only fetch from the store: nothing is sent to it, and no permission to write is needed.
    #[arg(long, requires = "remote")]
    pub(crate) remote_read_only: bool,
    /// Compute only the scenes and variants of this list, and refuse those that have other keys now. `use3d
    /// submit` writes it for its tasks, so edited settings or another version of this program are noticed.
    #[arg(long, value_name = "FILE", hide = true)]
    pub(crate) submitted: Option<PathBuf>,
    /// Only show what would run (the same as `use3d plan`).
    #[arg(long)]
    pub(crate) dry_run: bool,
    /// The folder for results (default: ./use3d-out/NAME). Results of earlier runs there are updated; other
    /// files there are never replaced.
    #[arg(short, long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
    /// Also write all photographs at full size, in the light and colours of the scene, into
    /// RESULTS/SCENE/photographs (`use3d photographs` has more choices).
    #[arg(long, conflicts_with_all = ["cache_only", "until"])]
    pub(crate) photographs: bool,
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
    /// A results folder, or its name below ./use3d-out (default: all of them).
    #[arg(value_name = "NAME|RESULTS_DIR")]
    pub(crate) name: Option<PathBuf>,
    /// Restore the results of this run. Nothing is computed.
    #[arg(value_name = "N", value_parser = count(1_000_000))]
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
    /// The page to write (default: a name made of the two, and an earlier page of the same two is replaced).
    #[arg(short, long, value_name = "FILE.html")]
    pub(crate) out: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) replace: Replace,
}

#[derive(Debug, Args)]
pub(crate) struct PlanArgs {
    #[command(flatten)]
    pub(crate) pipeline: PipelineArgs,
    /// Accepted for the same arguments as `use3d run`; it has no effect here.
    #[arg(short, long, value_name = "DIR", hide = true)]
    out: Option<PathBuf>,
    /// Accepted for the same arguments as `use3d run`; it has no effect here.
    #[arg(short, long, value_name = "N", hide = true)]
    jobs: Option<usize>,
    /// Accepted for the same arguments as `use3d run`; it has no effect here.
    #[arg(long, hide = true)]
    keep_going: bool,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct StatusArgs {
    #[command(flatten)]
    pub(crate) plan: PlanArgs,
    /// Show only this scene; may be repeated.
    #[arg(long, value_name = "NAME")]
    pub(crate) scene: Vec<String>,
    /// Show only rows with a failure.
    #[arg(long)]
    pub(crate) failed: bool,
    /// Show the number of cells by stage and state instead of the rows.
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
