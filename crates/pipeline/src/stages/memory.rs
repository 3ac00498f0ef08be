//! How much memory a stage will take, forecast from the size of the pictures.
//!
//! It decides what runs side by side and what a plan says, never what comes out: it is part of no
//! stage's code and of no key, and is laid over the table of stages from outside. Where the
//! prepared capture is there already,
//!
//! ```text
//! memory = program + a × pixels of the largest view + b × Gaussians + networks
//! ```
//!
//! with the Gaussians of the scene where that is there (from the size of its file), else as many as a scene
//! of that size comes to. Stage 1 says its own need ([`memory_need`]). Without the capture a forecast is the
//! fixed figure of the stage's `cost`.
//!
//! `a` and `b` are from the largest resident set of each stage by hand (two threads; ten views of
//! 320x180, 640x360 and 1280x720; eight and two hundred thousand Gaussians). Stage 2 keeps something
//! of each view, up to `cache_mib`.

use std::path::Path;

use serde_json::Value;
use use3d_build::{Stage, StageInput};
use use3d_import::{Extent, prepared_extent};
use use3d_reconstruct::{CaptureSize, ReconstructParams, memory_need};

use super::weights::{judge_files, proposer_files};

/// The program with its threads and tables.
const PROGRAM: u64 = 40 << 20;
/// A Gaussian of degree 3 in a scene's PLY.
const STORED_GAUSSIAN: u64 = 248;
/// Nu2Net at full detail, the greediest of the networks, per pixel (docs/science/networks.md).
const NETWORK_PER_PIXEL: u64 = 771;
/// The same at 384 pixels, whatever the picture's size.
const NETWORK_AT_384: u64 = 150 << 20;

/// The stage with its forecast, where it follows from the size of the pictures.
pub(super) fn with_forecast(stage: Stage) -> Stage {
    match stage.name() {
        "reconstruct" => stage.memory(|p: &ReconstructParams, inputs| {
            Some(PROGRAM + memory_need(&size(&extent(inputs)?), p).likely)
        }),
        "depth" => stage.memory(|_: &Value, inputs| {
            let weights = input(inputs, "models").map_or(0, heaviest);
            Some(PROGRAM + 110 * largest(inputs)? + weights * 14 / 10 + (128 << 20))
        }),
        "propose" => stage.memory(|_: &Value, inputs| {
            let network = networks(inputs, proposer_files, NETWORK_PER_PIXEL);
            Some(PROGRAM + 120 * largest(inputs)? + network.on(largest(inputs)?))
        }),
        "targets" => stage.memory(|_: &Value, inputs| {
            let network = networks(inputs, proposer_files, 0);
            Some(PROGRAM + 135 * largest(inputs)? + 700 * gaussians(inputs)? + network.on(0))
        }),
        "enhance" => stage.memory(|p: &Value, inputs| {
            let (gaussians, views) = (gaussians(inputs)?, extent(inputs)?.train.len() as u64);
            let kept = (views * (85 * gaussians + (1 << 20))).min(p["cache_mib"].as_u64()? << 20);
            let network = networks(inputs, proposer_files, 0);
            Some(PROGRAM + kept + 30 * largest(inputs)? + 400 * gaussians + network.on(0))
        }),
        "render" => stage
            .memory(|_: &Value, inputs| Some(PROGRAM + 270 * largest(inputs)? + 600 * gaussians(inputs)?)),
        // A scene and the reference's, and three views in all their appearances side by side.
        "evaluate" => stage.memory(|_: &Value, inputs| {
            let network = networks(inputs, judge_files, NETWORK_PER_PIXEL);
            let pixels = largest(inputs)?;
            Some(PROGRAM + 650 * pixels + 1200 * gaussians(inputs)? + network.on(pixels))
        }),
        // The import keeps a budget of its own, whatever the size; the others look at no scene.
        _ => stage,
    }
}

fn input<'a>(inputs: &'a [StageInput], role: &str) -> Option<&'a Path> {
    inputs.iter().find(|i| i.role == role).map(|i| i.path.as_path())
}

fn extent(inputs: &[StageInput]) -> Option<Extent> {
    prepared_extent(input(inputs, "import")?).ok()
}

/// Pixels of the largest view.
fn largest(inputs: &[StageInput]) -> Option<u64> {
    Some(size(&extent(inputs)?).largest)
}

fn size(extent: &Extent) -> CaptureSize {
    let views = extent.sizes.iter().enumerate().map(|(i, size)| (*size, extent.train.contains(&i)));
    CaptureSize::new(views, extent.points)
}

/// Gaussians of the scene that is read, else as many as one of this capture comes to.
fn gaussians(inputs: &[StageInput]) -> Option<u64> {
    let scene = ["enhanced", "scene"].into_iter().find_map(|role| input(inputs, role));
    let file = scene.and_then(|scene| std::fs::metadata(scene.join("gaussians.ply")).ok());
    match file {
        Some(file) => Some(file.len() / STORED_GAUSSIAN),
        None => Some(size(&extent(inputs)?).likely(&ReconstructParams::default()) as u64),
    }
}

/// Networks whose weights are in the models folder.
struct Networks {
    weights: u64,
    per_pixel: u64,
}

impl Networks {
    /// Bytes on a picture of so many pixels.
    fn on(&self, pixels: u64) -> u64 {
        match self.weights {
            0 => 0,
            weights => weights + (self.per_pixel * pixels).max(NETWORK_AT_384),
        }
    }
}

fn networks(
    inputs: &[StageInput],
    files: impl Fn(&Path) -> Vec<std::path::PathBuf>,
    per_pixel: u64,
) -> Networks {
    let length = |models: &Path| {
        let each = files(models).into_iter().filter_map(|file| std::fs::metadata(models.join(file)).ok());
        each.map(|file| file.len()).sum()
    };
    Networks { weights: input(inputs, "models").map_or(0, length), per_pixel }
}

/// The largest file of a models folder: which of several sizes of a network is taken is decided later.
fn heaviest(models: &Path) -> u64 {
    let entries = std::fs::read_dir(models).into_iter().flatten().flatten();
    entries.filter_map(|e| e.metadata().ok()).filter(|m| m.is_file()).map(|m| m.len()).max().unwrap_or(0)
}
