//! The arguments of `photographs`.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};

use super::shared::{EngineArgs, Replace, fraction};
use super::white::WhiteArgs;

/// The look of the photographs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum PhotographLook {
    /// Light and colours of the enhanced scene.
    Enhanced,
    /// Without the water: for measuring colour, near things only.
    Clear,
    /// In the water, with even exposure and white balance.
    Reconstruction,
}

/// The names of the files.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum PhotographLayout {
    /// As the originals: for Metashape, TagLab, CoralNet, QGIS.
    #[default]
    Same,
    /// In folders `.texture`: texture layers of RealityScan.
    Texture,
}

#[derive(Clone, Debug, Default, Args)]
pub(crate) struct PhotographsArgs {
    /// The results folder of a run, or a scene.
    #[arg(value_name = "RESULTS_DIR|SCENE_DIR")]
    pub(crate) scene: PathBuf,
    /// The folder for the photographs. Originals are never replaced.
    #[arg(short, long, value_name = "DIR", required_unless_present = "video")]
    pub(crate) out: Option<PathBuf>,
    /// Enhance all frames of the film from which the capture was prepared, and write them as a film with its
    /// sound (needs ffmpeg).
    #[arg(long, value_name = "FILM", requires = "video")]
    pub(crate) film: Option<PathBuf>,
    /// The film to write: .mp4, .mov, .m4v or .mkv.
    #[arg(long, value_name = "FILE", requires = "film")]
    pub(crate) video: Option<PathBuf>,
    /// The folder of the original photographs (default: that of the capture which the results were made
    /// from).
    #[arg(long, value_name = "DIR")]
    pub(crate) images: Option<PathBuf>,
    /// The look. Default: enhanced, or reconstruction for a scene without enhancement.
    #[arg(long, value_enum)]
    pub(crate) look: Option<PhotographLook>,
    /// Share of each photograph's own exposure, white balance and light that stays, 0 (all photographs in the
    /// light of the scene) to 1.
    #[arg(long, default_value_t = 0.0, value_name = "0..1", value_parser = fraction, allow_negative_numbers = true)]
    pub(crate) keep_light: f32,
    /// Share of the enhancement to apply, 0 to 1.
    #[arg(long, default_value_t = 1.0, value_name = "0..1", value_parser = fraction, allow_negative_numbers = true)]
    pub(crate) strength: f32,
    /// Share of the look's water to keep, 0 to 1.
    #[arg(long, default_value_t = 1.0, value_name = "0..1", value_parser = fraction, allow_negative_numbers = true)]
    pub(crate) water: f32,
    #[command(flatten)]
    pub(crate) white: WhiteArgs,
    /// The names of the files.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) layout: PhotographLayout,
    /// Resample the photographs to pinhole cameras, for programs that know no distortion. Those without a
    /// camera are left out.
    #[arg(long)]
    pub(crate) undistorted: bool,
    /// Also write a mask for each photograph, black where the scene does not know it, into this folder.
    #[arg(long, value_name = "DIR2")]
    pub(crate) unknown: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) engine: EngineArgs,
    #[command(flatten)]
    pub(crate) replace: Replace,
}

impl PhotographsArgs {
    /// The arguments for all photographs of a scene as the program shows them by itself.
    pub(crate) fn of(scene: &Path, out: PathBuf) -> Self {
        Self { scene: scene.to_path_buf(), out: Some(out), strength: 1.0, water: 1.0, ..Self::default() }
    }
}
