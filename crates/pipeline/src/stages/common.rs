//! What several stages do: read a capture or a scene, watch a loop, write JSON.

use std::path::Path;

use serde::Serialize;
use serde::de::DeserializeOwned;
use use3d_capture::Capture;
use use3d_scene::Scene;
use use3d_training::{Observer, Progress};

use crate::engine::{StageContext, StageError};

/// In a reconstructed scene's folder: which images it was learnt from, and how held-out ones came out.
pub(super) const EVALUATION: &str = "evaluation.json";

/// A capture as the import stage left it.
pub(super) fn capture(context: &StageContext) -> Result<Capture, StageError> {
    let imported = use3d_io_colmap::load_prepared(context.input("import")?).map_err(StageError::bad_input)?;
    imported.capture.validate().map_err(StageError::bad_input)?;
    Ok(imported.capture)
}

/// The scene of a role.
pub(super) fn scene(context: &StageContext, role: &str) -> Result<Scene, StageError> {
    Scene::load(context.input(role)?).map_err(StageError::bad_input)
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

/// Makes a folder in the output.
pub(super) fn folder(path: &Path) -> Result<(), StageError> {
    std::fs::create_dir_all(path).map_err(|e| StageError::io(path, e))
}

/// A training loop's observer that speaks to the engine.
pub(super) struct Watch<'a> {
    context: &'a StageContext,
}

impl<'a> Watch<'a> {
    pub(super) fn new(context: &'a StageContext) -> Self {
        Self { context }
    }
}

impl Observer for Watch<'_> {
    fn progress(&mut self, progress: &Progress) {
        let mut words = Vec::new();
        if let Some(loss) = progress.loss {
            words.push(format!("loss {loss:.4}"));
        }
        if let Some(psnr) = progress.psnr {
            words.push(format!("{psnr:.2} dB"));
        }
        if let Some(gaussians) = progress.gaussians {
            words.push(format!("{gaussians} Gaussians"));
        }
        if let Some(pace) = progress.steps_per_second {
            words.push(format!("{pace:.1} steps/s"));
        }
        let words = words.join(", ");
        self.context.progress_left(progress.step, progress.steps, "steps", &words, progress.seconds_left);
    }

    fn notice(&mut self, message: &str) {
        self.context.say(message);
    }

    fn should_stop(&self) -> bool {
        self.context.cancelled()
    }
}
