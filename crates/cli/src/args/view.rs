//! Looking at a scene in a browser, finished or in the making.

use std::path::PathBuf;

use clap::Args;

use super::shared::CacheArgs;
use super::white::WhiteArgs;

/// Where a browser finds the viewer.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct ViewerArgs {
    /// The port on this machine (default: a free one).
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    pub(crate) port: Option<u16>,
    /// Only print the address; open no browser.
    #[arg(long)]
    pub(crate) no_open: bool,
}

/// Watching a training.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct WatchArgs {
    /// Watch the training in a browser: picture, curves, pause, resume, stop. Changes no result.
    #[arg(long)]
    pub(crate) view: bool,
    /// With --view: the port on this machine (default: a free one).
    #[arg(long, value_name = "N", requires = "view", value_parser = clap::value_parser!(u16).range(1..))]
    port: Option<u16>,
    /// With --view: only print the address; open no browser.
    #[arg(long, requires = "view")]
    no_open: bool,
}

impl WatchArgs {
    /// Where the viewer is to be.
    pub(crate) fn viewer(&self) -> ViewerArgs {
        ViewerArgs { port: self.port, no_open: self.no_open }
    }
}

#[derive(Debug, Args)]
pub(crate) struct ViewArgs {
    /// A scene, the results folder of a run that made one, or a capture: its sparse points and cameras.
    #[arg(
        value_name = "SCENE_DIR|RESULTS_DIR|CAPTURE",
        required_unless_present = "follow",
        conflicts_with = "follow"
    )]
    pub(crate) target: Option<PathBuf>,
    /// Follow a training that another process does, by its files: a pipeline file or capture folder that is
    /// being run, the --out of `use3d reconstruct`, a folder of checkpoints, or one checkpoint.
    #[arg(long, value_name = "PIPELINE.toml|CAPTURE|SCENE_DIR|FILE")]
    pub(crate) follow: Option<PathBuf>,
    /// With --follow of a pipeline: which scene (default: the first).
    #[arg(long, value_name = "NAME", requires = "follow")]
    pub(crate) scene: Option<String>,
    /// The capture whose photographs and places the page offers (or cameras alone,
    /// as `use3d render` reads them).
    #[arg(long, value_name = "CAPTURE")]
    pub(crate) cameras: Option<PathBuf>,
    /// Views that somebody saved from the page, with their names (the page's "Save file").
    #[arg(long, value_name = "FILE.json")]
    pub(crate) views: Option<PathBuf>,
    /// Metres per unit of the COLMAP model, so that the page measures in metres.
    #[arg(long, value_name = "M")]
    pub(crate) metres_per_unit: Option<f64>,
    /// With --follow of a pipeline: settings that its run was given.
    #[arg(long = "set", value_name = "STAGE.PARAMETER=VALUE", requires = "follow")]
    pub(crate) set: Vec<String>,
    #[command(flatten)]
    pub(crate) white: WhiteArgs,
    #[command(flatten)]
    pub(crate) viewer: ViewerArgs,
    #[command(flatten)]
    pub(crate) cache: CacheArgs,
}
