//! The arguments of `use3d check`.

use std::path::PathBuf;

use clap::Args;

use super::shared::{Replace, StageSettings, count};

#[derive(Debug, Args)]
pub(crate) struct CheckArgs {
    /// The capture folder.
    #[arg(value_name = "CAPTURE_DIR")]
    pub(crate) capture: PathBuf,
    /// Write the report as a page with small pictures.
    #[arg(long, value_name = "FILE.html")]
    pub(crate) html: Option<PathBuf>,
    /// Look at photographs whose longer side has at most N pixels.
    #[arg(long, value_name = "N", default_value_t = 960, value_parser = count(65_535))]
    pub(crate) max_side: usize,
    #[command(flatten)]
    pub(crate) settings: StageSettings,
    #[command(flatten)]
    pub(crate) replace: Replace,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}
