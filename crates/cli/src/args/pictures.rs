//! The arguments for output from a finished scene: pictures, films, files for other viewers.

use std::path::PathBuf;
use std::str::FromStr;

use clap::{Args, ValueEnum};
use use3d_pipeline::export::GaussianFrame;
use use3d_render::Mode;

use super::shared::{EngineArgs, Replace, count, fraction};
use super::white::WhiteArgs;
use crate::error::WorkError;

/// Eleven hours of film at 25 frames per second.
const MAX_FRAMES: u64 = 1_000_000;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum FrameFormat {
    /// For looking: 256 steps, and what is brighter than white is cut off.
    #[default]
    Png,
    /// For measuring: numbers, and nothing is cut off.
    Exr,
}

impl FrameFormat {
    /// The ending of its files.
    pub(crate) fn extension(self) -> &'static str {
        match self {
            Self::Png => "png",
            Self::Exr => "exr",
        }
    }
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum CameraPath {
    /// Swim smoothly through the given cameras.
    Interpolate,
    /// Circle around the mean camera, looking at the scene.
    Spiral,
    /// Follow a path file, in the form that a scene's page saves.
    File(PathBuf),
}

impl FromStr for CameraPath {
    type Err = WorkError;

    fn from_str(text: &str) -> Result<Self, WorkError> {
        match text {
            "interpolate" => Ok(Self::Interpolate),
            "spiral" => Ok(Self::Spiral),
            file if [".json", ".txt"].iter().any(|e| file.to_lowercase().ends_with(e)) => {
                Ok(Self::File(file.into()))
            }
            _ => Err(WorkError::input(
                "expected `interpolate`, `spiral`, or a path file: .json of a scene's page or of nerfstudio, or COLMAP's images.txt",
            )),
        }
    }
}

#[derive(Clone, Debug, Args)]
pub(crate) struct RenderArgs {
    /// The scene to render, or the results folder of a run that made one.
    #[arg(value_name = "SCENE_DIR|RESULTS_DIR")]
    pub(crate) scene: PathBuf,
    /// A COLMAP model folder, a capture folder, or a JSON list of cameras (default: the capture that a
    /// results folder was made from).
    #[arg(long, value_name = "COLMAP_DIR|CAPTURE|FILE.json")]
    pub(crate) cameras: Option<PathBuf>,
    /// The folder for the frames; each mode gets a folder of its own.
    #[arg(short, long, value_name = "DIR", required_unless_present_any = ["video", "fps"])]
    pub(crate) out: Option<PathBuf>,
    /// The looks to render: enhanced (for showing), reconstruction (as photographed), clear (without water:
    /// for measuring the colour of near things, with --format exr), depth. For experts: enhanced-clear (too
    /// strong colours), alpha, object, medium, backscatter, attenuation. Default: the look that the scene's
    /// page opens with, or the looks in a path file.
    #[arg(long, value_delimiter = ',', value_name = "MODE,...")]
    pub(crate) modes: Vec<String>,
    /// The file format of the frames.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) format: FrameFormat,
    /// Render at this size: the pictures are scaled to cover it and cropped centrally, as in the import.
    #[arg(long, value_name = "WxH")]
    pub(crate) size: Option<String>,
    /// Only the capture's held-out views.
    #[arg(long)]
    pub(crate) held_out: bool,
    /// Follow a path instead of the cameras themselves: `interpolate` and `spiral` are made from them; a file
    /// saved by a scene's page has its own cameras, looks and frames per second. Also nerfstudio's
    /// camera_path.json (with its model's dataparser_transforms.json beside it) and COLMAP's images.txt (with
    /// cameras.txt beside it), at --frame-rate.
    #[arg(long, value_name = "interpolate|spiral|FILE.json|images.txt")]
    pub(crate) path: Option<CameraPath>,
    /// Frames of the path.
    #[arg(long, default_value_t = 120, value_name = "N", value_parser = count(MAX_FRAMES))]
    pub(crate) frames: usize,
    /// Write the first mode as a video: .y4m directly, anything else through ffmpeg.
    #[arg(long, value_name = "FILE")]
    pub(crate) video: Option<PathBuf>,
    /// Frames per second of the video (default: those of a path file, else 30).
    #[arg(long, value_name = "N")]
    pub(crate) frame_rate: Option<u32>,
    /// Measure frames per second on the held-out views (on all given views if none are held out); no picture
    /// is written.
    #[arg(long, conflicts_with_all = ["out", "video", "path", "modes", "held_out"])]
    pub(crate) fps: bool,
    /// With --fps: one JSON document on stdout.
    #[arg(long, requires = "fps", conflicts_with_all = ["out", "video"])]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) engine: EngineArgs,
    /// Share of the enhancement to apply, 0 (reconstruction) to 1.
    #[arg(long, default_value_t = 1.0, value_name = "0..1", value_parser = fraction, allow_negative_numbers = true)]
    pub(crate) strength: f32,
    /// Water that is left in reconstruction and enhanced: 1 all of it, 0 none.
    #[arg(long, default_value_t = 1.0, value_name = "0..1", value_parser = fraction, allow_negative_numbers = true)]
    pub(crate) water: f32,
    #[command(flatten)]
    pub(crate) white: WhiteArgs,
    #[command(flatten)]
    pub(crate) replace: Replace,
}

/// A version of SPZ.
fn spz_version(text: &str) -> Result<u8, WorkError> {
    text.parse()
        .ok()
        .filter(|version| matches!(version, 3 | 4))
        .ok_or_else(|| WorkError::input("expected 3 or 4"))
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum ExportWhat {
    /// The scene as photographed, in its water.
    Reconstruction,
    /// The scene without its water: true for near things, a guess for far ones.
    Clear,
    /// The enhanced scene, for showing.
    Enhanced,
    /// For experts: the enhanced scene without its water; far things become too red.
    EnhancedClear,
}

impl ExportWhat {
    /// The mode of this look.
    pub(crate) fn mode(self) -> Mode {
        match self {
            Self::Reconstruction => Mode::Reconstruction,
            Self::Clear => Mode::Clear,
            Self::Enhanced => Mode::Enhanced,
            Self::EnhancedClear => Mode::EnhancedClear,
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum ExportFrame {
    /// The frame of the COLMAP model, y down.
    Colmap,
    /// The scene's own normalised frame, z up.
    Normalised,
    /// COLMAP's frame turned so that y points up, as in most viewers; SuperSplat turns files by itself and
    /// needs colmap.
    YUp,
    /// Metres along the axes of the capture's world. A large offset, such as that of UTM, is left out and
    /// written into the file's header.
    Metric,
}

impl ExportFrame {
    /// The frame of the file.
    pub(crate) fn frame(self) -> GaussianFrame {
        match self {
            Self::Colmap => GaussianFrame::Colmap,
            Self::Normalised => GaussianFrame::Normalised,
            Self::YUp => GaussianFrame::YUp,
            Self::Metric => GaussianFrame::Metric,
        }
    }
}

#[derive(Clone, Debug, Args)]
pub(crate) struct ExportArgs {
    /// The scene to export, or the results folder of a run that made one.
    #[arg(value_name = "SCENE_DIR|RESULTS_DIR")]
    pub(crate) scene: PathBuf,
    /// A PLY of 3D Gaussian splatting.
    #[arg(long, value_name = "FILE")]
    pub(crate) ply: Option<PathBuf>,
    /// A glTF file with KHR_gaussian_splatting, for Cesium, Babylon, three and GIS viewers.
    #[arg(long, value_name = "FILE.glb")]
    pub(crate) glb: Option<PathBuf>,
    /// An SPZ file, a tenth of the size, y up.
    #[arg(long, value_name = "FILE.spz")]
    pub(crate) spz: Option<PathBuf>,
    /// Version of the SPZ file: every viewer with SPZ reads 3, newer ones 4 too.
    #[arg(long, value_name = "3|4", requires = "spz", default_value_t = 3, value_parser = spz_version)]
    pub(crate) spz_version: u8,
    /// A compressed PLY, for PlayCanvas and SuperSplat.
    #[arg(long, value_name = "FILE.ply")]
    pub(crate) compressed_ply: Option<PathBuf>,
    /// A page that shows the scene in a browser, with its water and enhancement: one file
    /// up to 32 MB, else with a folder.
    #[arg(long, value_name = "FILE.html")]
    pub(crate) web: Option<PathBuf>,
    /// The capture. A page offers its photographs and camera positions (or cameras alone, as for
    /// `use3d render`), --white is measured in its views, and the other files show the scene through its
    /// water. Default: the capture that a results folder was made from; for the water, the cameras that an
    /// enhanced scene keeps.
    #[arg(long, value_name = "CAPTURE")]
    pub(crate) cameras: Option<PathBuf>,
    /// With --web: named views that were saved from the page (the page's "Save file").
    #[arg(long, value_name = "FILE.json", requires = "web")]
    pub(crate) views: Option<PathBuf>,
    /// With --web: metres per unit of the COLMAP model; the page then measures in metres.
    #[arg(long, value_name = "M", requires = "web", allow_negative_numbers = true)]
    pub(crate) metres_per_unit: Option<f64>,
    /// The look of files other than the page, with the names of `use3d render --modes`. Default: the look
    /// that the page opens with.
    #[arg(long, value_enum)]
    pub(crate) what: Option<ExportWhat>,
    /// Water that is left in the look: 1 all of it, 0 none.
    #[arg(long, value_name = "SHARE", default_value_t = 1.0, value_parser = fraction, allow_negative_numbers = true)]
    pub(crate) water: f32,
    /// Leave out the sphere of Gaussians that shows open water behind the scene.
    #[arg(long)]
    pub(crate) no_backdrop: bool,
    /// The frame of a PLY or compressed PLY (default: colmap). GLB and SPZ always have their own upright
    /// frame.
    #[arg(long, value_enum)]
    pub(crate) frame: Option<ExportFrame>,
    #[command(flatten)]
    pub(crate) white: WhiteArgs,
    #[command(flatten)]
    pub(crate) replace: Replace,
}
