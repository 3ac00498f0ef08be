//! The arguments for viewing a scene in a browser, finished or during its training.

use std::path::PathBuf;

use clap::Args;

use super::shared::{CacheArgs, port};
use super::white::WhiteArgs;

/// Watching a training.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct WatchArgs {
    /// Watch the training in a browser: picture, curves, pause, resume, stop. Changes no result.
    #[arg(long)]
    pub(crate) view: bool,
    /// With --view: the port on this machine (default: a free one).
    #[arg(long, value_name = "N", requires = "view", value_parser = port)]
    pub(crate) port: Option<u16>,
    /// With --view: only print the address; open no browser.
    #[arg(long, requires = "view")]
    pub(crate) no_open: bool,
}

#[derive(Debug, Args)]
pub(crate) struct ViewArgs {
    /// A scene, the results folder of a run that made one, or a capture, shown by its sparse points and
    /// cameras.
    #[arg(
        value_name = "SCENE_DIR|RESULTS_DIR|CAPTURE",
        required_unless_present = "follow",
        conflicts_with = "follow"
    )]
    pub(crate) target: Option<PathBuf>,
    /// Follow a training of another process through its files: a pipeline file or capture folder in work, the
    /// --out of `use3d reconstruct`, a folder of checkpoints, or one checkpoint.
    #[arg(long, value_name = "PIPELINE.toml|CAPTURE|SCENE_DIR|FILE")]
    pub(crate) follow: Option<PathBuf>,
    /// With --follow of a pipeline: the scene to follow (default: the first).
    #[arg(long, value_name = "NAME", requires = "follow", conflicts_with = "target")]
    pub(crate) scene: Option<String>,
    /// The capture whose photographs and camera positions the page offers (or cameras alone, as for
    /// `use3d render`).
    #[arg(long, value_name = "CAPTURE")]
    pub(crate) cameras: Option<PathBuf>,
    /// Named views that were saved from the page (the page's "Save file").
    #[arg(long, value_name = "FILE.json")]
    pub(crate) views: Option<PathBuf>,
    /// Metres per unit of the COLMAP model; the page then measures in metres.
    #[arg(long, value_name = "M", allow_negative_numbers = true)]
    pub(crate) metres_per_unit: Option<f64>,
    /// With --follow of a pipeline: the settings of its run.
    #[arg(
        long = "set",
        value_name = "STAGE.PARAMETER=VALUE",
        requires = "follow",
        conflicts_with = "target"
    )]
    pub(crate) set: Vec<String>,
    #[command(flatten)]
    pub(crate) white: WhiteArgs,
    /// The port on this machine (default: a free one).
    #[arg(long, value_name = "N", value_parser = port)]
    pub(crate) port: Option<u16>,
    /// Only print the address; open no browser.
    #[arg(long)]
    pub(crate) no_open: bool,
    #[command(flatten)]
    pub(crate) cache: CacheArgs,
}
