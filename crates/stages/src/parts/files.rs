//! The names of files that one stage writes and another reads, and file operations that every stage needs.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;

use use3d_capture::View;
use use3d_numerics::range::OutOfRange;
use use3d_workflow::{StageContext, StageError};

/// The paired data in `pairs`.
pub(crate) const DATASET: &str = "dataset.json";
/// The calibrator in `calibrate`.
pub const CALIBRATOR: &str = "calibrator.safetensors";
/// The contact sheet in `reconstruct`.
pub(crate) const CONTACT: &str = "contact.png";
/// The targets in `targets`.
pub const TARGETS: &str = "targets.safetensors";
/// The scores in `evaluate`.
pub const SCORES: &str = "scores.json";
/// The consistency strip in `evaluate`, and its description.
pub(crate) const STRIP: (&str, &str) = ("strip.png", "strip.json");
/// The folder in `evaluate` with the held-out photographs enhanced in 2D, by stem.
pub(crate) const ENHANCED_IN_2D: &str = "proposal";
/// The folder in `evaluate` with held-out views without water, for captures that come with their truth.
pub(crate) const TRUE_VIEWS: &str = "truth";
/// The folder of held-out views without water as the authors of a method show them.
pub(crate) const AUTHORS_CLEAR: &str = "published-clear";
/// The note of `evaluate` with the speed of drawing the scene.
pub const SPEED: &str = "speed";
/// In `report`: the page and the scores, as data.
pub const BATCH: &str = "batch.json";
/// In `reconstruct`: the choices that its parameters left open and the run made.
pub const CHOICES: &str = "choices.json";
/// In `targets`: the origin of the calibrator that corrected the proposals.
pub const CALIBRATED: &str = "calibrator.json";
/// In `reconstruct` and `enhance`: the training cameras, as a list that `use3d render --cameras` reads.
pub const CAMERAS: &str = "cameras.json";
/// In `reconstruct`: the images that the scene was learnt from, and the scores of the held-out views.
pub(crate) const EVALUATION: &str = "evaluation.json";
/// In `reconstruct`: the water estimated from the capture's tracks.
pub(crate) const WATER: &str = "water.json";

/// A value out of range as the error of a stage's parameter check: the path and a message.
pub(crate) fn out_of_range(wrong: OutOfRange) -> (String, String) {
    let words = wrong.words();
    (wrong.path, words)
}

/// Writes pretty JSON with a final newline.
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<(), StageError> {
    let mut text = serde_json::to_string_pretty(value)?;
    text.push('\n');
    write(path, text)
}

/// Reads JSON.
pub fn read_json<T: DeserializeOwned>(path: &Path) -> Result<T, StageError> {
    serde_json::from_slice(&read(path)?).map_err(|e| StageError::message(format!("{}: {e}", path.display())))
}

/// Reads a file.
pub(crate) fn read(path: &Path) -> Result<Vec<u8>, StageError> {
    std::fs::read(path).map_err(|e| StageError::io(path, e))
}

/// Writes a file.
pub(crate) fn write(path: &Path, content: impl AsRef<[u8]>) -> Result<(), StageError> {
    std::fs::write(path, content).map_err(|e| StageError::io(path, e))
}

/// Creates a folder in the output, with its parents.
pub(crate) fn folder(path: &Path) -> Result<(), StageError> {
    std::fs::create_dir_all(path).map_err(|e| StageError::io(path, e))
}

/// Ends a loop of another crate if the stage must stop.
pub(crate) fn go_on(context: &StageContext) -> ControlFlow<()> {
    if context.cancelled() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
}

/// The file of a view's proposal in the artifact of `propose`.
pub(crate) fn proposal_of(proposals: &Path, view: &View) -> PathBuf {
    proposals.join(format!("{}.png", view.flat_stem()))
}

/// More files and folders than this are not compared one by one to find a change.
const MOST_COMPARED: usize = 4096;

/// The sources of the choice of files: all folders of the capture, whose times change when a file is added or
/// removed, and the files that name the images, such as models and lists.
pub(crate) fn choice_sources(capture: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in walkdir::WalkDir::new(capture).follow_links(true).sort_by_file_name() {
        // An unreadable entry may become readable later, so such a choice is made again each time.
        let Ok(entry) = entry else { return Vec::new() };
        let extension = entry.path().extension().map(|e| e.to_string_lossy().to_lowercase());
        let endings = ["bin", "txt", "json", "xml", "ply", "csv", "xmp"];
        let names_images = extension.is_some_and(|extension| endings.contains(&&*extension));
        if entry.file_type().is_dir() || names_images {
            found.push(entry.path().strip_prefix(capture).unwrap_or(entry.path()).to_path_buf());
        }
        if found.len() > MOST_COMPARED {
            return Vec::new();
        }
    }
    found
}

/// The names of the files of a folder without extension, in no order.
///
/// # Errors
/// The folder cannot be listed.
pub fn stems(folder: &Path) -> Result<Vec<String>, StageError> {
    let entries = std::fs::read_dir(folder).map_err(|e| StageError::io(folder, e))?;
    let stem = |entry: std::io::Result<std::fs::DirEntry>| {
        Some(entry.ok()?.path().file_stem()?.to_string_lossy().into_owned())
    };
    Ok(entries.filter_map(stem).collect())
}
