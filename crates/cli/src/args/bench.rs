//! The arguments of `bench`.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};

use super::pipelines::MAX_JOBS;
use super::shared::{CacheArgs, CalibrationArgs, Replace, Settings, SizeArgs, StageSettings, count};

/// More photographs than a capture of synthetic views ever needs.
const MAX_VIEWS: u64 = 10_000;

#[derive(Debug, Subcommand)]
pub(crate) enum Bench {
    /// Synthetic captures, the whole pipeline and simple alternatives to it on each, and one table against
    /// the true clean scenes.
    #[command(
        after_help = "Examples:\n  use3d bench truth --out bench/                        all captures, seeds 1, 2 and 3\n  \
        use3d bench truth --out quick/ --captures display-III,air --seeds 1 --iterations 600 --baselines simple\n\n\
        Interrupted, the same command goes on from there; a second call computes nothing. docs/science/results.md explains the table."
    )]
    Truth(BenchTruthArgs),
    /// Measure a training step on a trained scene: pairs of pixel and Gaussian, time of each part, and the
    /// share of the machine's limit.
    #[command(
        after_help = "Examples:\n  use3d bench scene                                     a made scene that is like a trained one\n  use3d bench scene use3d-out/reef reef/ --max-side 640 --threads 1"
    )]
    Scene(BenchSceneArgs),
    /// Measure a graphics card into one file: limits, agreement with the processor, same bits, times.
    #[command(
        after_help = "Examples:\n  use3d bench gpu --out card.json\n  use3d bench gpu --read card.json                      what the file says, in words\n  use3d bench gpu --kernels kernels/                    the texts of all kernels\n  use3d bench gpu --out software.json --device llvmpipe --sizes 96x64 --rounds 2 --gaussians 2000 --steps 20"
    )]
    Gpu(BenchGpuArgs),
}

#[derive(Debug, Args)]
pub(crate) struct BenchSceneArgs {
    /// A trained scene, or the folder with its results (default: a made scene with such statistics).
    #[arg(requires = "capture")]
    pub(crate) scene: Option<PathBuf>,
    /// The capture from which it was trained.
    pub(crate) capture: Option<PathBuf>,
    /// Number of training views.
    #[arg(long, default_value_t = 6, value_name = "N", value_parser = count(MAX_VIEWS))]
    pub(crate) views: usize,
    /// Steps a view; the fastest counts.
    #[arg(long, default_value_t = 5, value_name = "N", value_parser = count(10_000))]
    pub(crate) rounds: usize,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) size: SizeArgs,
    #[command(flatten)]
    pub(crate) settings: StageSettings,
}

#[derive(Debug, Args)]
pub(crate) struct BenchGpuArgs {
    /// The file to write.
    #[arg(short, long, value_name = "FILE.json", required_unless_present_any = ["read", "kernels"])]
    pub(crate) out: Option<PathBuf>,
    /// Read such a file instead, from any machine, and print what it says: a table of the kernels, and a
    /// verdict in words.
    #[arg(long, value_name = "FILE.json", conflicts_with_all = ["out", "kernels"])]
    pub(crate) read: Option<PathBuf>,
    /// Write the text of every kernel into this folder instead, as drivers receive them; needs no card.
    #[arg(long, value_name = "DIR", conflicts_with = "out")]
    pub(crate) kernels: Option<PathBuf>,
    /// An adapter: `#0` or another number of `use3d devices`, its PCI address, its UUID, or any part of its
    /// name in any case; software adapters are used only if named here (default: the best card).
    #[arg(long, value_name = "NAME")]
    pub(crate) device: Option<String>,
    /// Sizes of views at which kernels are timed.
    #[arg(long, value_delimiter = ',', default_value = "640x360,1280x720,1400x933", value_name = "WxH,...")]
    pub(crate) sizes: Vec<String>,
    /// Times that each size is run; the first one warms up and is not counted.
    #[arg(long, default_value_t = 5, value_name = "N", value_parser = count(10_000))]
    pub(crate) rounds: usize,
    /// Numbers of Gaussians for the trainings at each size; each is timed.
    #[arg(long, value_delimiter = ',', default_value = "50000,200000,500000", value_name = "N,...", value_parser = count(100_000_000))]
    pub(crate) gaussians: Vec<usize>,
    /// Steps of each training that are timed (default: 200, and 1000 at the middle size with the middle
    /// number of Gaussians; 10 on software).
    #[arg(long, value_name = "N", value_parser = count(1_000_000))]
    pub(crate) steps: Option<usize>,
    /// Minutes after which no further times or trainings are begun; what is left out is named in the file.
    #[arg(long, default_value_t = 2, value_name = "N", value_parser = count(10_000))]
    pub(crate) minutes: usize,
    #[command(flatten)]
    pub(crate) replace: Replace,
}

/// The methods to compare.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum Baselines {
    /// All methods.
    #[default]
    All,
    /// Only those that need no training of their own: photographs, and the 2D enhancer on them and on stage-1
    /// renders.
    Simple,
}

#[derive(Debug, Args)]
pub(crate) struct BenchTruthArgs {
    /// The folder for captures, table and pictures.
    #[arg(short, long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// Only these captures: display-I, display-II, display-III, display-1C, display-5C, pool, spectral,
    /// lamps, air, veil-pool, air-backlit, camera-I, camera-II, camera-1C.
    #[arg(long, value_delimiter = ',', value_name = "NAME,...")]
    pub(crate) captures: Vec<String>,
    /// The seeds, of captures and trainings alike.
    #[arg(long, value_delimiter = ',', default_value = "1,2,3", value_name = "N,...")]
    pub(crate) seeds: Vec<u32>,
    /// Size of the photographs.
    #[arg(long, default_value = "320x180", value_name = "WxH")]
    pub(crate) size: String,
    /// Photographs per capture; every eighth is held out.
    #[arg(long, default_value_t = 28, value_name = "N", value_parser = count(MAX_VIEWS))]
    pub(crate) views: usize,
    /// Steps of stage 1; stage 2 has a fifth of them.
    #[arg(long, default_value_t = 2000, value_name = "N", value_parser = count(200_000_000))]
    pub(crate) iterations: usize,
    /// The methods to compare: all, or only those that need no training of their own.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) baselines: Baselines,
    /// Train the methods that the paper compares with, too; a row shows the clear view of each as its authors
    /// do.
    #[arg(long, conflicts_with = "method")]
    pub(crate) methods: bool,
    /// Stages to run at the same time, within the cores and memory of the machine.
    #[arg(short, long, default_value_t = 1, value_name = "N", value_parser = count(MAX_JOBS))]
    pub(crate) jobs: usize,
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
