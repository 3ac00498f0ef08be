//! The arguments of stages run by hand.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

use super::shared::{CommonArgs, EngineArgs, MAX_STEPS, Replace, SizeArgs, StageSettings, count};
use super::view::WatchArgs;

#[derive(Debug, Args)]
pub(crate) struct ImportArgs {
    /// The capture folder.
    pub(crate) capture: PathBuf,
    /// The folder for the prepared capture.
    #[arg(short, long, value_name = "DIR")]
    pub(crate) out: PathBuf,
    #[command(flatten)]
    pub(crate) size: SizeArgs,
    #[command(flatten)]
    pub(crate) settings: StageSettings,
    #[command(flatten)]
    pub(crate) replace: Replace,
}

#[derive(Debug, Args)]
pub(crate) struct ReconstructArgs {
    /// The capture folder.
    pub(crate) capture: PathBuf,
    /// The folder for the scene.
    #[arg(short, long, value_name = "SCENE_DIR")]
    pub(crate) out: PathBuf,
    /// The models folder, for `--set images=proposed` and `--set depth_prior=depth-anything-v2`.
    #[arg(long, env = "USE3D_MODELS", value_name = "DIR")]
    pub(crate) models: Option<PathBuf>,
    /// Print the time of each part of a step: milliseconds and share. Never stored.
    #[arg(long)]
    pub(crate) profile: bool,
    #[command(flatten)]
    pub(crate) engine: EngineArgs,
    #[command(flatten)]
    pub(crate) watch: WatchArgs,
    #[command(flatten)]
    pub(crate) common: CommonArgs,
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
    #[arg(short, long, value_name = "FILE")]
    pub(crate) out: PathBuf,
    /// The 2D enhancer for the proposals: `nu2net` or `fusion` (default: nu2net if its weights exist).
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
    /// Correct the 2D enhancer's proposals with this calibrator. Without one, they are used as they are.
    /// `source` chooses the pictures that they are made for.
    #[arg(long, value_name = "FILE")]
    pub(crate) calibrator: Option<PathBuf>,
    /// The targets file.
    #[arg(short, long, value_name = "FILE")]
    pub(crate) out: PathBuf,
    /// The models folder.
    #[arg(long, env = "USE3D_MODELS", value_name = "DIR")]
    pub(crate) models: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) size: SizeArgs,
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
    /// The folder for the enhanced scene.
    #[arg(short, long, value_name = "SCENE_DIR2")]
    pub(crate) out: PathBuf,
    /// The models folder, for `--set objective=pseudo-labels` with a network's targets.
    #[arg(long, env = "USE3D_MODELS", value_name = "DIR")]
    pub(crate) models: Option<PathBuf>,
    /// Print the time of each part of a step: milliseconds and share. Never stored.
    #[arg(long)]
    pub(crate) profile: bool,
    #[command(flatten)]
    pub(crate) engine: EngineArgs,
    /// Steps of stage 2 (the same as `--set iterations=N`).
    #[arg(long, value_name = "N", visible_alias = "steps", value_parser = count(MAX_STEPS), allow_negative_numbers = true)]
    pub(crate) iterations: Option<usize>,
    #[command(flatten)]
    pub(crate) size: SizeArgs,
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
    /// Compare neighbouring views by the depth of this scene (stage 1 of the same capture) instead of the
    /// scene's own, so that several scenes are compared at the same pixels.
    #[arg(long, value_name = "SCENE_DIR", conflicts_with = "images")]
    pub(crate) warp_by: Option<PathBuf>,
    /// Score a plain folder of images instead.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["scene", "size", "max_side", "set", "method", "preset"])]
    pub(crate) images: Option<PathBuf>,
    /// The images to compare with, by equal names apart from the extension.
    #[arg(long, value_name = "DIR", requires = "images", conflicts_with = "scene")]
    pub(crate) reference: Option<PathBuf>,
    /// The models folder.
    #[arg(long, env = "USE3D_MODELS", value_name = "DIR")]
    pub(crate) models: Option<PathBuf>,
    /// The output format of the scores.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) format: TableFormat,
    /// The same as `--format json`.
    #[arg(long, conflicts_with = "format")]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) size: SizeArgs,
    #[command(flatten)]
    pub(crate) settings: StageSettings,
}
