//! File operations that every stage needs.

use std::ops::ControlFlow;
use std::path::Path;

use serde::Serialize;
use serde::de::DeserializeOwned;

use use3d_numerics::range::OutOfRange;
use use3d_workflow::{StageContext, StageError};

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
