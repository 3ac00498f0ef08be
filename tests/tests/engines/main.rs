//! A second engine for each stage, outside the crates of the training loops. It does what the engine of
//! another device must do, through public items only. Both engines accept steps on request and do them later,
//! several at once, like a device; both load and return whole states.

mod stage1;
mod stage2;

use std::collections::BTreeMap;
use std::path::Path;

use use3d_scene::Scene;
use use3d_training::{EngineError, Observer, TrainingProgress};

/// Number of steps that may be in progress before one is done.
const UNDER_WAY: usize = 3;

/// A device that is lost.
fn lost() -> EngineError {
    EngineError::DeviceLost { engine: "late", reason: "it was unplugged".into() }
}

/// Stops after some steps, and stores the messages that it receives.
struct Watcher {
    stop_at: u64,
    step: u64,
    notices: Vec<String>,
}

impl Watcher {
    fn new(stop_at: u64) -> Self {
        Self { stop_at, step: 0, notices: Vec::new() }
    }
}

impl Observer for Watcher {
    fn progress(&mut self, progress: &TrainingProgress) {
        self.step = progress.step;
    }

    fn notice(&mut self, message: &str) {
        self.notices.push(message.into());
    }

    fn should_stop(&self) -> bool {
        self.step == self.stop_at
    }
}

/// Every file of a saved scene.
fn bytes(scene: &Scene) -> BTreeMap<String, Vec<u8>> {
    fn collect(dir: &Path, files: &mut BTreeMap<String, Vec<u8>>) {
        for entry in std::fs::read_dir(dir).expect("a folder") {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                collect(&path, files);
            } else {
                let name = path.file_name().expect("a name").to_string_lossy().into_owned();
                files.insert(name, std::fs::read(&path).expect("a file"));
            }
        }
    }
    let dir = tempfile::tempdir().expect("a folder");
    scene.save(dir.path()).expect("a scene");
    let mut files = BTreeMap::new();
    collect(dir.path(), &mut files);
    assert!(files.len() > 1);
    files
}
