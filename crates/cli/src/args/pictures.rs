//! What is made of a finished scene: pictures, films, files for other viewers.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

use super::shared::{Replace, count};

/// Eleven hours of film at 25 frames per second.
const MAX_FRAMES: u64 = 1_000_000;

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
    /// A PLY of 3D Gaussian splatting.
    #[arg(long, value_name = "FILE", required_unless_present_any = ["web"])]
    pub(crate) ply: Option<PathBuf>,
    /// A page that shows the scene in a browser, with its water and enhancement: one file up to 32 MB, else with a folder.
    #[arg(long, value_name = "FILE.html")]
    pub(crate) web: Option<PathBuf>,
    /// With --web: the capture whose photographs and places the page offers (or cameras alone, as `use3d render` reads them).
    #[arg(long, value_name = "CAPTURE", requires = "web")]
    pub(crate) cameras: Option<PathBuf>,
    /// With --web: metres per unit of the COLMAP model, so that the page measures in metres.
    #[arg(long, value_name = "M", requires = "web")]
    pub(crate) metres_per_unit: Option<f64>,
    /// Which colours a PLY has, in the words of `use3d render --modes`.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) what: ExportWhat,
    /// In which frame a PLY is.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) frame: ExportFrame,
    #[command(flatten)]
    pub(crate) replace: Replace,
}
