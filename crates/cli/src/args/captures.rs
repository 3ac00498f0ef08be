//! Captures: the arguments for synthetic captures, and for estimating the water of a capture.

use std::path::PathBuf;

use clap::{Args, Subcommand};

use use3d_synth::ChosenFault;

use super::shared::{SizeArgs, StageSettings};

#[derive(Debug, Subcommand)]
pub(crate) enum Synth {
    /// A swim over a procedural reef: images, COLMAP model, and the true scene.
    #[command(
        after_help = "Examples:\n  use3d synth capture --out reef/ --views 48 --size 640x360 --water 3C --seed 1\n  \
        use3d synth capture --out dive/ --physics spectral --water II --depth 10 --auto-exposure 1 --fish 3\n  \
        use3d synth capture --out wrong/ --views 12 --size 96x64 --fault poses-turned:weak"
    )]
    Capture(SynthCaptureArgs),
    /// Clean and underwater images of the same places, to train a calibrator on.
    #[command(after_help = "Example:\n  use3d synth pairs --out pairs/ --views 96")]
    Pairs(SynthPairsArgs),
}

#[derive(Debug, Args)]
pub(crate) struct SynthArgs {
    /// The folder to write.
    #[arg(short, long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    /// The seed of everything random.
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
pub(crate) struct SynthPairsArgs {
    #[command(flatten)]
    pub(crate) common: SynthArgs,
    /// Image formation of the underwater images: `display`, or `spectral` with a camera that adjusts itself
    /// for every picture.
    #[arg(long, value_name = "NAME", default_value = "display")]
    pub(crate) physics: String,
}

#[derive(Debug, Args)]
pub(crate) struct SynthCaptureArgs {
    #[command(flatten)]
    pub(crate) common: SynthArgs,
    /// Water type (Jerlov): I, IA, IB, II, III, 1C, 3C, 5C, 7C, 9C; with --physics spectral also `air`.
    #[arg(long, value_name = "TYPE")]
    pub(crate) water: Option<String>,
    /// The place: `reef`; `pool`, a tiled basin of even surfaces; `veil-pool`, whose tiles have the
    /// colour of open water.
    #[arg(long, value_name = "NAME", default_value = "reef")]
    pub(crate) place: String,
    /// Image formation: `display` is the method's own model, on display values; `spectral` is not:
    /// wavelengths in linear light, and a camera that adjusts itself for every view.
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
    /// Spectral: amount by which exposure and white balance are set for each view on its own, 0 to 1.
    #[arg(long, value_name = "SHARE")]
    pub(crate) auto_exposure: Option<f32>,
    /// Spectral: two lamps at the camera; their light at a distance of one metre, in units of daylight at the
    /// surface, 0 to 20.
    #[arg(long, value_name = "LIGHT")]
    pub(crate) lamps: Option<f32>,
    /// Spectral: marine snow in front of the lens, 0 to 1.
    #[arg(long, value_name = "AMOUNT")]
    pub(crate) snow: Option<f32>,
    /// Spectral: fish in every view, hidden by masks.
    #[arg(long, value_name = "N")]
    pub(crate) fish: Option<usize>,
    /// Spectral: the camera's processing of its light: `plain` (sRGB), or `action` (bounded white balance,
    /// colour matrix, saturation, contrast, clipping; surfaces have reef spectra).
    #[arg(long, value_name = "NAME", default_value = "plain")]
    pub(crate) camera: String,
    /// Spectral, in air: amount of backlight from the sky, 0 to 1.
    #[arg(long, value_name = "AMOUNT")]
    pub(crate) backlight: Option<f32>,
    /// The lens: `pinhole`; `radial` (pincushion, as behind a flat port), `opencv` (barrel) or `fisheye` (100
    /// degrees) distort photographs, truth and model alike.
    #[arg(long, value_name = "NAME", default_value = "pinhole")]
    pub(crate) lens: String,
    /// Boards with grey patches near and far, listed in truth/greys/.
    #[arg(long)]
    pub(crate) greys: bool,
    /// A fault to put into the finished capture, to test what a check finds: `poses-turned`,
    /// `turned-180:weak`, `focal-length:12`. A strength is `weak`, `middle`, `strong` or a number. The name
    /// `list` prints all faults.
    #[arg(long, value_name = "NAME[:STRENGTH]")]
    pub(crate) fault: Option<ChosenFault>,
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
    pub(crate) size: SizeArgs,
    #[command(flatten)]
    pub(crate) settings: StageSettings,
}
