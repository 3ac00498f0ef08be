//! File operations that every stage needs.

use std::path::Path;

use serde::Serialize;
use serde::de::DeserializeOwned;

use use3d_numerics::range::OutOfRange;
use use3d_workflow::StageError;

/// A value out of range as the error of a stage's parameter check: the path and a message.
pub(super) fn out_of_range(wrong: OutOfRange) -> (String, String) {
    let words = wrong.words();
    (wrong.path, words)
}

/// Writes pretty JSON with a final newline.
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<(), StageError> {
    let mut text = serde_json::to_string_pretty(value)?;
    text.push('\n');
    std::fs::write(path, text).map_err(|e| StageError::io(path, e))
}

/// Reads JSON.
pub fn read_json<T: DeserializeOwned>(path: &Path) -> Result<T, StageError> {
    let text = std::fs::read(path).map_err(|e| StageError::io(path, e))?;
    serde_json::from_slice(&text).map_err(|e| StageError::message(format!("{}: {e}", path.display())))
}

/// Writes a text file.
pub(super) fn write_text(path: &Path, text: &str) -> Result<(), StageError> {
    std::fs::write(path, text).map_err(|e| StageError::io(path, e))
}

/// Creates a folder in the output, with its parents.
pub(super) fn folder(path: &Path) -> Result<(), StageError> {
    std::fs::create_dir_all(path).map_err(|e| StageError::io(path, e))
}
