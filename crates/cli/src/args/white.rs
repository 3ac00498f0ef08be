//! The white balance: the references that should be grey.

use std::path::PathBuf;

use clap::Args;
use use3d_pipeline::white::WhiteChoice;

/// `--white`, of verbs that show a scene.
#[derive(Clone, Debug, Default, Args)]
pub(crate) struct WhiteArgs {
    /// Balance the colours of clear and enhanced: `off`; by a pixel of a photograph that
    /// shows something grey or white (f_0001.jpg:812,430; may be repeated; the page and `use3d view` have a
    /// picker); by `reef` or `grey`; or by a file. Pixels, reef and grey need the capture, which a results
    /// folder and `run` know. Default: the balance that `use3d white` stored for the scene, or off.
    #[arg(long = "white", value_name = "off|VIEW:X,Y|reef|grey|FILE.json")]
    pub(crate) choices: Vec<WhiteChoice>,
}

/// The arguments of `white`.
#[derive(Clone, Debug, Args)]
pub(crate) struct KeepWhiteArgs {
    /// The scene, or the results folder of a run that made one.
    #[arg(value_name = "SCENE_DIR|RESULTS_DIR")]
    pub(crate) scene: PathBuf,
    /// The reference: one or more pixels of photographs that show something grey or white
    /// (f_0001.jpg:812,430), `reef`, `grey`, a file, or `off`. Without it, the stored balance is printed.
    #[arg(value_name = "VIEW:X,Y|reef|grey|FILE.json|off")]
    pub(crate) choices: Vec<WhiteChoice>,
    /// The capture that the scene was made from.
    #[arg(long, value_name = "CAPTURE")]
    pub(crate) cameras: Option<PathBuf>,
    /// Write the file here, and store nothing beside the scene.
    #[arg(short, long, value_name = "FILE.json")]
    pub(crate) out: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) replace: super::shared::Replace,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}
