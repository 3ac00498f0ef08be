//! The parts of a forecast of the memory that a stage needs, from the size of the pictures.
//!
//! A forecast decides which stages run in parallel and what a plan prints, never a result. If the prepared
//! capture exists already,
//!
//! ```text
//! memory = program + a × pixels of the largest view + b × Gaussians + networks
//! ```
//!
//! with the number of Gaussians from the size of the scene's file if it exists, else the likely number for a
//! scene of that size. Stage 1 computes its own need. Without the capture, the forecast is
//! the fixed figure of the stage's `cost`.
//!
//! `a` and `b` come from the largest resident set of each stage, run by itself (two threads; ten views of
//! 320x180, 640x360 and 1280x720; eight and two hundred thousand Gaussians). Stage 2 keeps some data of each
//! view, up to `cache_mib`.

use std::path::{Path, PathBuf};

use use3d_import::{Extent, prepared_extent};
use use3d_reconstruct::{CaptureSize, ReconstructParams};
use use3d_workflow::StageInput;

/// Memory of the program with its threads and tables, bytes.
pub(crate) const PROGRAM: u64 = 40 << 20;
/// Bytes of a Gaussian of degree 3 in a scene's PLY file.
const STORED_GAUSSIAN: u64 = 248;
/// Bytes per pixel of Nu2Net at full detail, the largest need of all networks (docs/science/networks.md).
pub(crate) const NETWORK_PER_PIXEL: u64 = 771;
/// Bytes of Nu2Net at 384 pixels, independent of the picture's size.
const NETWORK_AT_384: u64 = 150 << 20;

pub(crate) fn input<'a>(inputs: &'a [StageInput], role: &str) -> Option<&'a Path> {
    inputs.iter().find(|i| i.role == role).map(|i| i.path.as_path())
}

pub(crate) fn extent(inputs: &[StageInput]) -> Option<Extent> {
    prepared_extent(input(inputs, "import")?).ok()
}

/// Pixels of the largest view.
pub(crate) fn largest(inputs: &[StageInput]) -> Option<u64> {
    Some(size(&extent(inputs)?).largest)
}

pub(crate) fn size(extent: &Extent) -> CaptureSize {
    let views = extent.sizes.iter().enumerate().map(|(i, size)| (*size, extent.train.contains(&i)));
    CaptureSize::new(views, extent.points)
}

/// The number of Gaussians of the scene that is read; else the likely number for this capture.
pub(crate) fn gaussians(inputs: &[StageInput]) -> Option<u64> {
    let scene = ["enhanced", "scene"].into_iter().find_map(|role| input(inputs, role));
    match scene.and_then(|scene| std::fs::metadata(scene.join("gaussians.ply")).ok()) {
        Some(file) => Some(file.len() / STORED_GAUSSIAN),
        None => Some(size(&extent(inputs)?).likely(&ReconstructParams::default()) as u64),
    }
}

/// The memory of the networks whose weights are in the models folder. They need `bytes` for a picture, but at
/// least those of Nu2Net at 384 pixels.
pub(crate) fn networks(inputs: &[StageInput], files: impl Fn(&Path) -> Vec<PathBuf>, bytes: u64) -> u64 {
    let length = |models: &Path| {
        let each = files(models).into_iter().filter_map(|file| std::fs::metadata(models.join(file)).ok());
        each.map(|file| file.len()).sum()
    };
    match input(inputs, "models").map_or(0, length) {
        0 => 0,
        weights => weights + bytes.max(NETWORK_AT_384),
    }
}

/// The largest file of a models folder. It is an upper bound: the size of the network is chosen later.
pub(crate) fn heaviest(models: &Path) -> u64 {
    let entries = std::fs::read_dir(models).into_iter().flatten().flatten();
    entries.filter_map(|e| e.metadata().ok()).filter(|m| m.is_file()).map(|m| m.len()).max().unwrap_or(0)
}
