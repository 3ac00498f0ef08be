//! The words of the command line.

use std::path::PathBuf;

use clap::builder::{RangedU64ValueParser, TypedValueParser};
use clap::{Args, Parser, Subcommand, ValueEnum};

/// Underwater 3D scenes that look clear, from any viewpoint, reproducibly.
///
/// Reconstructs a scene together with its water, learns from image pairs what "enhanced" means, and stores that
/// enhancement in the scene itself, so that every new view comes out enhanced and consistent.
#[derive(Debug, Parser)]
#[command(
    name = "use3d",
    version,
    max_term_width = 110,
    subcommand_required = true,
    arg_required_else_help = true
)]
#[command(
    after_help = "Start with `use3d demo`, then `use3d run CAPTURE_DIR` on your own COLMAP folder.\n\n\
    Exit codes: 0 done; 1 a stage failed; 2 wrong usage or bad input; 130 interrupted."
)]
pub(crate) struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub(crate) verb: Verb,
    /// Say more (-v: details, -vv: everything).
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub(crate) verbose: u8,
    /// Say only what went wrong.
    #[arg(short, long, global = true)]
    pub(crate) quiet: bool,
    /// Threads to compute with (default: all cores). Never changes a result.
    #[arg(long, global = true, value_name = "N", env = "USE3D_THREADS", value_parser = count(MAX_THREADS))]
    pub(crate) threads: Option<usize>,
}

/// More threads than any one machine has cores; each costs memory of its own.
const MAX_THREADS: u64 = 1024;
/// More stages side by side than any one machine has memory for.
const MAX_JOBS: u64 = 256;
/// Eleven hours of film at 25 frames per second.
const MAX_FRAMES: u64 = 1_000_000;

/// A whole number from 1 to `most`.
fn count(most: u64) -> impl TypedValueParser<Value = usize> {
    // `most` fits wherever a `usize` has 32 bits.
    RangedU64ValueParser::<u64>::new().range(1..=most).map(|n| n as usize)
}

/// The verbs.
#[derive(Debug, Subcommand)]
pub(crate) enum Verb {
    /// A synthetic underwater capture, then the whole pipeline on it, then the report.
    #[command(after_help = "Examples:\n  use3d demo\n  use3d demo --size full --out ~/use3d-demo\n  \
        use3d demo --set reconstruct.iterations=300 --set enhance.iterations=100    only to see it run")]
    Demo(DemoArgs),
    /// Run a pipeline file, or the whole pipeline with defaults on one capture folder.
    #[command(
        after_help = "Examples:\n  use3d run my-reef/                      results in ./use3d-out/my-reef\n  \
        use3d run pipelines/seathru4.toml --jobs 2 --keep-going\n  \
        use3d run pipelines/seathru4.toml --scene Panama --until reconstruct\n  \
        use3d run my-reef/ --set reconstruct.iterations=3000 --set import.size=640x360\n  \
        use3d run my-reef/ --pairs uieb/raw-890 uieb/reference-890"
    )]
    Run(RunArgs),
    /// What would run, what is cached, why, and the forecast cost.
    #[command(after_help = "Examples:\n  use3d plan pipelines/seathru4.toml\n  use3d plan my-reef/ --json")]
    Plan(PlanArgs),
    /// Scene × stage table: cached, stale, missing or failed.
    #[command(after_help = "Example:\n  use3d status pipelines/seathru4.toml")]
    Status(PlanArgs),
    /// Which ingredient of a stage's key changed, with its old and new value.
    #[command(after_help = "Example:\n  use3d why pipelines/seathru4.toml Panama enhance")]
    Why(WhyArgs),
    /// The pipeline's graph with its states, as Mermaid or SVG.
    #[command(after_help = "Example:\n  use3d graph pipelines/seathru4.toml --format svg > graph.svg")]
    Graph(GraphArgs),
    /// Read a COLMAP folder: find model and images, undistort, resize, normalise, split.
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
    /// Build the scene-global and Gaussian-local targets (appearance transition consensus).
    #[command(
        after_help = "Example:\n  use3d targets scene/ my-reef/ --calibrator calibrator.safetensors --out targets.safetensors"
    )]
    Targets(TargetsArgs),
    /// Stage 2: store the enhancement in the scene.
    #[command(
        after_help = "Example:\n  use3d enhance scene/ my-reef/ --targets targets.safetensors --out enhanced-scene/"
    )]
    Enhance(EnhanceArgs),
    /// Score a scene on its held-out views, or plain folders of images.
    #[command(
        after_help = "Examples:\n  use3d evaluate enhanced-scene/ my-reef/\n  use3d evaluate --images renders/ --reference photos/ --format csv"
    )]
    Evaluate(EvaluateArgs),
    /// Render a scene from given cameras.
    #[command(
        after_help = "Examples:\n  use3d render scene/ --cameras my-reef/ --out renders/ --modes reconstruction,clear,depth\n  \
        use3d render enhanced-scene/ --cameras my-reef/ --path spiral --frames 120 --modes enhanced-clear --video swim.mp4\n  \
        use3d render enhanced-scene/ --cameras my-reef/ --out half/ --modes enhanced --water 0.5\n  \
        use3d render enhanced-scene/ --cameras my-reef/ --fps"
    )]
    Render(RenderArgs),
    /// Write a scene as a 3D Gaussian splatting PLY for other viewers.
    #[command(
        after_help = "Example:\n  use3d export enhanced-scene/ --ply reef.ply --what enhanced-clear --frame colmap"
    )]
    Export(ExportArgs),
    /// Make synthetic underwater data with known truth.
    Synth {
        /// What to make.
        #[command(subcommand)]
        what: Synth,
    },
    /// What water a capture was taken in: attenuation, backscatter and veil from its sparse points, with error bars.
    #[command(
        after_help = "Examples:\n  use3d water my-reef/\n  use3d water my-reef/ --set image_dir=images_2 --json"
    )]
    Water(WaterArgs),
    /// Networks trained by others: which files are looked for, found or missing, licence, where to get them.
    #[command(after_help = "Example:\n  use3d models --dir ~/use3d-models")]
    Models(ModelsArgs),
    /// Remove what is cheapest to make again from the cache.
    #[command(after_help = "Examples:\n  use3d gc --max-bytes 50GB --dry-run\n  use3d gc --older-than 30d")]
    Gc(GcArgs),
    /// Check the cache's files against their digests, and optionally recompute a sample.
    #[command(after_help = "Examples:\n  use3d verify\n  use3d verify pipelines/demo.toml --sample 5%")]
    Verify(VerifyArgs),
    /// Every parameter that `--set` and pipeline files know: default, range, meaning.
    #[command(after_help = "Examples:\n  use3d params\n  use3d params reconstruct\n  use3d params --json")]
    Params(ParamsArgs),
    /// Completions of this command for a shell, on stdout.
    #[command(
        after_help = "Example:\n  use3d completions bash > ~/.local/share/bash-completion/completions/use3d"
    )]
    Completions(CompletionsArgs),
    /// Man pages of this command, one per verb, from the same texts as --help.
    #[command(after_help = "Example:\n  use3d man --out ~/.local/share/man/man1")]
    Man(ManArgs),
}

impl Verb {
    /// Whether one JSON document is expected on stdout.
    pub(crate) fn wants_json(&self) -> bool {
        match self {
            Self::Run(args) => args.json,
            Self::Plan(args) | Self::Status(args) => args.json,
            Self::Why(args) => args.json,
            Self::Evaluate(args) => args.json || args.format == TableFormat::Json,
            Self::Render(args) => args.json,
            Self::Models(args) => args.json,
            Self::Gc(args) => args.json,
            Self::Verify(args) => args.json,
            Self::Params(args) => args.json,
            _ => false,
        }
    }
}

/// `--set` of a whole pipeline.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct Settings {
    /// Set a parameter of a stage, e.g. `reconstruct.iterations=3000`; may be repeated. `use3d params` lists them.
    #[arg(long = "set", value_name = "STAGE.PARAMETER=VALUE")]
    pub(crate) set: Vec<String>,
}

/// `--set` of one stage.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct StageSettings {
    /// Set a parameter of this stage, or `STAGE.PARAMETER` of one that it needs; may be repeated. `use3d params` lists
    /// them.
    #[arg(long = "set", value_name = "PARAMETER=VALUE")]
    pub(crate) set: Vec<String>,
}

/// What "enhanced" is learnt from, on the command line.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct CalibrationArgs {
    /// Learn from these pairs: two folders of images with equal file stems (they win over the pipeline file's).
    #[arg(long, num_args = 2, value_names = ["INPUT", "TARGET"], conflicts_with = "calibrator")]
    pairs: Vec<PathBuf>,
    /// Use this finished calibrator: `use3d calibrate`'s, or the authors' transition_calibrator.pth. Nothing is learnt then.
    #[arg(long, value_name = "FILE")]
    pub(crate) calibrator: Option<PathBuf>,
}

impl CalibrationArgs {
    /// The two folders of pairs, if they were given.
    pub(crate) fn pairs(&self) -> Option<(PathBuf, PathBuf)> {
        match self.pairs.as_slice() {
            [input, target] => Some((input.clone(), target.clone())),
            _ => None,
        }
    }
}

/// The cache.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct CacheArgs {
    /// The cache folder (default: the pipeline's, or ~/.cache/use3d).
    #[arg(long, env = "USE3D_CACHE", value_name = "DIR")]
    pub(crate) cache: Option<PathBuf>,
    /// The models folder (default: the pipeline's, or ./models).
    #[arg(long, env = "USE3D_MODELS", value_name = "DIR")]
    pub(crate) models: Option<PathBuf>,
    /// Read every input again instead of trusting unchanged sizes and times.
    #[arg(long)]
    pub(crate) rehash: bool,
}

/// What may be replaced.
#[derive(Clone, Copy, Debug, Default, Args)]
pub(crate) struct Replace {
    /// Replace an earlier result in the same place. Only what this program wrote is ever replaced.
    #[arg(long)]
    pub(crate) force: bool,
}

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
    /// A pipeline file (.toml) or a capture folder.
    #[arg(value_name = "PIPELINE.toml|CAPTURE_DIR")]
    pub(crate) target: PathBuf,
    /// Only this scene; may be repeated.
    #[arg(long, value_name = "NAME")]
    pub(crate) scene: Vec<String>,
    /// Stop after this stage.
    #[arg(long, value_name = "STAGE")]
    pub(crate) until: Option<String>,
    #[command(flatten)]
    pub(crate) settings: Settings,
    /// Stages to run side by side, within the cores and memory there are.
    #[arg(long, default_value_t = 1, value_name = "N", value_parser = count(MAX_JOBS))]
    pub(crate) jobs: usize,
    /// Go on with the other scenes when one fails.
    #[arg(long)]
    pub(crate) keep_going: bool,
    /// Only say what would run (the same as `use3d plan`).
    #[arg(long)]
    pub(crate) dry_run: bool,
    /// Where results go (default: ./use3d-out/NAME). Results of earlier runs there are brought up to date; what is not a result
    /// of this program is never replaced.
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) calibration: CalibrationArgs,
    #[command(flatten)]
    pub(crate) cache: CacheArgs,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct PlanArgs {
    /// A pipeline file (.toml) or a capture folder.
    #[arg(value_name = "PIPELINE.toml|CAPTURE_DIR")]
    pub(crate) target: PathBuf,
    #[command(flatten)]
    pub(crate) settings: Settings,
    #[command(flatten)]
    pub(crate) calibration: CalibrationArgs,
    #[command(flatten)]
    pub(crate) cache: CacheArgs,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct WhyArgs {
    /// A pipeline file (.toml) or a capture folder.
    #[arg(value_name = "PIPELINE.toml|CAPTURE_DIR")]
    pub(crate) target: PathBuf,
    /// The scene's name.
    pub(crate) scene: String,
    /// The stage's name.
    pub(crate) stage: String,
    #[command(flatten)]
    pub(crate) settings: Settings,
    #[command(flatten)]
    pub(crate) calibration: CalibrationArgs,
    #[command(flatten)]
    pub(crate) cache: CacheArgs,
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
    /// A pipeline file (.toml) or a capture folder.
    #[arg(value_name = "PIPELINE.toml|CAPTURE_DIR")]
    pub(crate) target: PathBuf,
    /// How to draw it.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) format: GraphFormat,
    #[command(flatten)]
    pub(crate) settings: Settings,
    #[command(flatten)]
    pub(crate) calibration: CalibrationArgs,
    #[command(flatten)]
    pub(crate) cache: CacheArgs,
}

#[derive(Debug, Args)]
pub(crate) struct ImportArgs {
    /// The capture folder.
    pub(crate) capture: PathBuf,
    /// Where the prepared capture goes.
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    #[command(flatten)]
    pub(crate) settings: StageSettings,
    #[command(flatten)]
    pub(crate) replace: Replace,
}

#[derive(Debug, Args)]
pub(crate) struct ReconstructArgs {
    /// The capture folder.
    pub(crate) capture: PathBuf,
    /// Where the scene goes.
    #[arg(long, value_name = "SCENE_DIR")]
    pub(crate) out: PathBuf,
    /// The models folder, for `--set images=proposed` and `--set depth_prior=depth-anything-v2`.
    #[arg(long, env = "USE3D_MODELS", value_name = "DIR")]
    pub(crate) models: Option<PathBuf>,
    /// Print where a step's time goes: milliseconds and share of each part. Never stored.
    #[arg(long)]
    pub(crate) profile: bool,
    #[command(flatten)]
    pub(crate) settings: StageSettings,
    #[command(flatten)]
    pub(crate) replace: Replace,
}

#[derive(Debug, Args)]
pub(crate) struct CalibrateArgs {
    /// Underwater images.
    #[arg(long, value_name = "DIR")]
    pub(crate) input: PathBuf,
    /// Their enhanced counterparts, with equal file stems.
    #[arg(long, value_name = "DIR")]
    pub(crate) target: PathBuf,
    /// The calibrator file.
    #[arg(long, value_name = "FILE")]
    pub(crate) out: PathBuf,
    /// The 2D enhancer that proposes: `nu2net` or `fusion` (default: nu2net when its weights are there).
    #[arg(long, value_name = "NAME")]
    pub(crate) proposer: Option<String>,
    /// The models folder.
    #[arg(long, env = "USE3D_MODELS", value_name = "DIR")]
    pub(crate) models: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) settings: StageSettings,
    #[command(flatten)]
    pub(crate) replace: Replace,
}

#[derive(Debug, Args)]
pub(crate) struct TargetsArgs {
    /// The reconstructed scene.
    #[arg(value_name = "SCENE_DIR")]
    pub(crate) scene: PathBuf,
    /// The capture it was made from.
    #[arg(value_name = "CAPTURE_DIR")]
    pub(crate) capture: PathBuf,
    /// The calibrator file.
    #[arg(long, value_name = "FILE")]
    pub(crate) calibrator: PathBuf,
    /// The targets file.
    #[arg(long, value_name = "FILE")]
    pub(crate) out: PathBuf,
    /// The models folder.
    #[arg(long, env = "USE3D_MODELS", value_name = "DIR")]
    pub(crate) models: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) settings: StageSettings,
    #[command(flatten)]
    pub(crate) replace: Replace,
}

#[derive(Debug, Args)]
pub(crate) struct EnhanceArgs {
    /// The reconstructed scene.
    #[arg(value_name = "SCENE_DIR")]
    pub(crate) scene: PathBuf,
    /// The capture it was made from.
    #[arg(value_name = "CAPTURE_DIR")]
    pub(crate) capture: PathBuf,
    /// The targets file.
    #[arg(long, value_name = "FILE")]
    pub(crate) targets: PathBuf,
    /// Where the enhanced scene goes.
    #[arg(long, value_name = "SCENE_DIR2")]
    pub(crate) out: PathBuf,
    /// The models folder, for `--set objective=pseudo-labels` with a network's targets.
    #[arg(long, env = "USE3D_MODELS", value_name = "DIR")]
    pub(crate) models: Option<PathBuf>,
    /// Print where a step's time goes: milliseconds and share of each part. Never stored.
    #[arg(long)]
    pub(crate) profile: bool,
    #[command(flatten)]
    pub(crate) settings: StageSettings,
    #[command(flatten)]
    pub(crate) replace: Replace,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum TableFormat {
    /// A table for people.
    #[default]
    Table,
    /// Comma-separated values.
    Csv,
    /// JSON.
    Json,
}

#[derive(Debug, Args)]
pub(crate) struct EvaluateArgs {
    /// The scene to score.
    #[arg(value_name = "SCENE_DIR", required_unless_present = "images", requires = "capture")]
    pub(crate) scene: Option<PathBuf>,
    /// The capture whose held-out views are scored.
    #[arg(value_name = "CAPTURE_DIR")]
    pub(crate) capture: Option<PathBuf>,
    /// Compare neighbouring views by the depth of this scene (stage 1 of the same capture) instead of the scene's own, so that
    /// several scenes are judged by the same pixels.
    #[arg(long, value_name = "SCENE_DIR", conflicts_with = "images")]
    pub(crate) warp_by: Option<PathBuf>,
    /// Score a plain folder of images instead.
    #[arg(long, value_name = "DIR", conflicts_with = "scene")]
    pub(crate) images: Option<PathBuf>,
    /// What the images are compared with, by equal file stems.
    #[arg(long, value_name = "DIR", requires = "images")]
    pub(crate) reference: Option<PathBuf>,
    /// The models folder.
    #[arg(long, env = "USE3D_MODELS", value_name = "DIR")]
    pub(crate) models: Option<PathBuf>,
    /// How to print the scores.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) format: TableFormat,
    /// The same as `--format json`.
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) settings: StageSettings,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum FrameFormat {
    /// 8-bit, clamped.
    #[default]
    Png,
    /// 32-bit float, unclamped.
    Exr,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum CameraPath {
    /// Swim smoothly through the given cameras.
    Interpolate,
    /// Circle around the mean camera, looking at the scene.
    Spiral,
}

#[derive(Debug, Args)]
pub(crate) struct RenderArgs {
    /// The scene to render.
    #[arg(value_name = "SCENE_DIR")]
    pub(crate) scene: PathBuf,
    /// A COLMAP model folder, a capture folder, or a JSON list of cameras.
    #[arg(long, value_name = "COLMAP_DIR|CAPTURE|FILE.json")]
    pub(crate) cameras: PathBuf,
    /// The folder for the frames; each mode gets a folder of its own.
    #[arg(long, value_name = "DIR", required_unless_present_any = ["video", "fps"])]
    pub(crate) out: Option<PathBuf>,
    /// What to render: reconstruction, clear, enhanced, enhanced-clear, depth, alpha, object, medium, backscatter, attenuation.
    #[arg(long, value_delimiter = ',', default_value = "reconstruction", value_name = "MODE,...")]
    pub(crate) modes: Vec<String>,
    /// How to write the frames.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) format: FrameFormat,
    /// Render at this size: the pictures are scaled to cover it and cropped centrally, as the import does.
    #[arg(long, value_name = "WxH")]
    pub(crate) size: Option<String>,
    /// Only the capture's held-out views.
    #[arg(long)]
    pub(crate) held_out: bool,
    /// Follow a path made from the cameras instead of the cameras themselves.
    #[arg(long, value_enum)]
    pub(crate) path: Option<CameraPath>,
    /// Frames of the path.
    #[arg(long, default_value_t = 120, value_name = "N", value_parser = count(MAX_FRAMES))]
    pub(crate) frames: usize,
    /// Write the first mode as a video: .y4m directly, anything else through ffmpeg.
    #[arg(long, value_name = "FILE")]
    pub(crate) video: Option<PathBuf>,
    /// Frames per second of the video.
    #[arg(long, default_value_t = 30, value_name = "N")]
    pub(crate) frame_rate: u32,
    /// Measure frames per second on the held-out views (all given ones where none are held out); no picture is written.
    #[arg(long, conflicts_with_all = ["out", "video", "path", "modes", "held_out"])]
    pub(crate) fps: bool,
    /// With --fps: one JSON document on stdout.
    #[arg(long, requires = "fps")]
    pub(crate) json: bool,
    /// How much of the enhancement to apply, 0 (reconstruction) to 1.
    #[arg(long, default_value_t = 1.0, value_name = "0..1")]
    pub(crate) strength: f32,
    /// How much of the water to leave in reconstruction and enhanced, 0 (they are clear and enhanced-clear) to 1.
    #[arg(long, default_value_t = 1.0, value_name = "0..1")]
    pub(crate) water: f32,
    #[command(flatten)]
    pub(crate) replace: Replace,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum ExportWhat {
    /// As clear: a PLY holds no water.
    Reconstruction,
    /// Object radiance without water.
    #[default]
    Clear,
    /// As enhanced-clear: a PLY holds no water.
    Enhanced,
    /// Enhanced object radiance without water: the enhancement is baked into the colours.
    EnhancedClear,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum ExportFrame {
    /// The frame of the COLMAP model, y down.
    #[default]
    Colmap,
    /// The scene's own normalised frame, z up.
    Normalised,
    /// COLMAP's frame turned so that y points up, as most viewers have it.
    YUp,
}

#[derive(Debug, Args)]
pub(crate) struct ExportArgs {
    /// The scene to export.
    #[arg(value_name = "SCENE_DIR")]
    pub(crate) scene: PathBuf,
    /// The PLY file.
    #[arg(long, value_name = "FILE")]
    pub(crate) ply: PathBuf,
    /// Which colours, in the words of `use3d render --modes`.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) what: ExportWhat,
    /// In which frame.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) frame: ExportFrame,
    #[command(flatten)]
    pub(crate) replace: Replace,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Synth {
    /// A swim over a procedural reef: images, COLMAP model, and the truth.
    #[command(
        after_help = "Examples:\n  use3d synth capture --out reef/ --views 48 --size 640x360 --water 3C --seed 1\n  \
        use3d synth capture --out dive/ --physics spectral --water II --depth 10 --auto-exposure 1 --fish 3"
    )]
    Capture(SynthCaptureArgs),
    /// Clean and underwater images of the same places, to train a calibrator on.
    #[command(after_help = "Example:\n  use3d synth pairs --out pairs/ --views 96")]
    Pairs(SynthArgs),
}

#[derive(Debug, Args)]
pub(crate) struct SynthArgs {
    /// Where it goes.
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// Everything random follows from it.
    #[arg(long, default_value_t = 42, value_name = "N")]
    pub(crate) seed: u64,
    /// Number of views or pairs.
    #[arg(long, value_name = "N")]
    pub(crate) views: Option<usize>,
    /// Image size.
    #[arg(long, value_name = "WxH")]
    pub(crate) size: Option<String>,
}

#[derive(Debug, Args)]
pub(crate) struct SynthCaptureArgs {
    #[command(flatten)]
    pub(crate) common: SynthArgs,
    /// Water type (Jerlov): I, IA, IB, II, III, 1C, 3C, 5C, 7C, 9C; with --physics spectral also `air`.
    #[arg(long, value_name = "TYPE")]
    pub(crate) water: Option<String>,
    /// Image formation: `display` is the method's own, on display values; `spectral` is not: wavelengths in linear light, a
    /// camera that sets itself for every view.
    #[arg(long, value_name = "NAME", default_value = "display")]
    pub(crate) physics: String,
    /// Depth below the surface, metres, 0 to 60.
    #[arg(long, value_name = "M")]
    pub(crate) depth: Option<f32>,
    /// Share of the colour cast that the camera removes, 0 to 1.
    #[arg(long, value_name = "SHARE")]
    pub(crate) white_balance: Option<f32>,
    /// Sensor noise of a middle tone, 0 to 0.2 of display range.
    #[arg(long, value_name = "SIGMA")]
    pub(crate) noise: Option<f32>,
    /// Spectral: how far exposure and white balance are set for each view on its own, 0 to 1.
    #[arg(long, value_name = "SHARE")]
    pub(crate) auto_exposure: Option<f32>,
    /// Spectral: two lamps at the camera, their light a metre ahead in units of daylight at the surface, 0 to 20.
    #[arg(long, value_name = "LIGHT")]
    pub(crate) lamps: Option<f32>,
    /// Spectral: marine snow before the lens, 0 to 1.
    #[arg(long, value_name = "AMOUNT")]
    pub(crate) snow: Option<f32>,
    /// Spectral: fish in every view, hidden by masks.
    #[arg(long, value_name = "N")]
    pub(crate) fish: Option<usize>,
    /// Write no depth priors (they are made from the true depth).
    #[arg(long)]
    pub(crate) no_depth_priors: bool,
}

#[derive(Debug, Args)]
pub(crate) struct WaterArgs {
    /// The capture folder; its COLMAP model must hold tracks.
    pub(crate) capture: PathBuf,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) settings: Settings,
}

#[derive(Debug, Args)]
pub(crate) struct ModelsArgs {
    /// The folder to look in.
    #[arg(long, env = "USE3D_MODELS", value_name = "DIR")]
    pub(crate) dir: Option<PathBuf>,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct GcArgs {
    /// Keep the cache below this size, e.g. 50GB.
    #[arg(long, value_name = "SIZE")]
    pub(crate) max_bytes: Option<String>,
    /// Remove what was not used for this long, e.g. 30d.
    #[arg(long, value_name = "AGE")]
    pub(crate) older_than: Option<String>,
    /// Never touch what these pipelines use.
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
pub(crate) struct VerifyArgs {
    /// The pipeline whose stages may be recomputed (needed for --sample).
    #[arg(value_name = "PIPELINE.toml|CAPTURE_DIR")]
    pub(crate) target: Option<PathBuf>,
    /// Recompute this share of the stages and compare, e.g. 5%.
    #[arg(long, value_name = "SHARE")]
    pub(crate) sample: Option<String>,
    #[command(flatten)]
    pub(crate) calibration: CalibrationArgs,
    #[command(flatten)]
    pub(crate) cache: CacheArgs,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Debug, Args)]
pub(crate) struct ParamsArgs {
    /// Only this stage.
    pub(crate) stage: Option<String>,
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
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,
}
