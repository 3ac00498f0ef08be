//! The folder of the work: finished steps with their results, for the next attempt.

use std::fs::File;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::error::PrepareError;
use crate::process::StepWatch;

const STATE: &str = "state.json";
const LOG: &str = "log.txt";
/// Attempts to lock the folder of the work, and the pause between them, milliseconds.
const LOCK_TRIES: u64 = 40;
const LOCK_PAUSE: u64 = 50;
/// Endings of the files that belong to a database.
const DATABASE_FILES: [&str; 4] = ["", "-wal", "-shm", "-journal"];

/// The digest of a value's JSON.
pub(crate) fn hash(value: &impl Serialize) -> String {
    let text = serde_json::to_string(value).unwrap_or_default();
    blake3::hash(text.as_bytes()).to_hex().to_string()
}

/// A finished step.
#[derive(Serialize, Deserialize)]
struct FinishedStep {
    /// The digest of everything that the step depends on: its choices and the steps before it.
    key: String,
    result: Value,
}

/// A step: its name in notes, the file or folder that it makes, and its choices.
pub(crate) struct Step<'a> {
    pub(crate) name: &'static str,
    pub(crate) output: &'a str,
    pub(crate) choices: Value,
}

/// The folder of the work, which one process uses at a time.
pub(crate) struct Work<'a> {
    pub(crate) folder: &'a Path,
    pub(crate) log: PathBuf,
    watch: &'a StepWatch<'a>,
    /// Finished steps in their order.
    finished: Vec<FinishedStep>,
    /// The number of steps that this attempt has made or kept.
    done: usize,
    _lock: File,
}

impl<'a> Work<'a> {
    /// Opens the folder, and creates it if it does not exist.
    ///
    /// # Errors
    /// Another process uses it, or it cannot be written.
    pub(crate) fn open(folder: &'a Path, watch: &'a StepWatch<'a>) -> Result<Self, PrepareError> {
        std::fs::create_dir_all(folder).map_err(PrepareError::write(folder))?;
        let lock = File::create(folder.join("lock")).map_err(PrepareError::write(folder))?;
        // A program that another thread has just started may hold a copy of an old lock until it runs, so one
        // refusal says little. A file system without locks is no reason to refuse.
        let taken = |attempt: u64| {
            std::thread::sleep(std::time::Duration::from_millis(attempt.min(1) * LOCK_PAUSE));
            matches!(lock.try_lock(), Err(std::fs::TryLockError::WouldBlock))
        };
        if (0..LOCK_TRIES).all(taken) {
            return Err(PrepareError::Busy { path: folder.to_path_buf() });
        }
        let state = std::fs::read(folder.join(STATE)).ok();
        let finished = state.and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default();
        Ok(Self { folder, log: folder.join(LOG), watch, finished, done: 0, _lock: lock })
    }

    /// The result of the next step. It is kept from an earlier attempt if nothing that it depends on has
    /// changed and its output is still there; else `make` does the step, and later steps are forgotten. A
    /// step that was interrupted starts again, so that its result does not depend on the interruption.
    ///
    /// # Errors
    /// The step fails or makes no output, or its state cannot be written.
    pub(crate) fn step<T: Serialize + DeserializeOwned>(
        &mut self,
        step: Step<'_>,
        make: impl FnOnce(&Self) -> Result<T, PrepareError>,
    ) -> Result<T, PrepareError> {
        let Step { name, output, choices } = step;
        let before = self.done.checked_sub(1).and_then(|last| self.finished.get(last)).map(|s| &s.key);
        let key = hash(&json!([before, name, choices]));
        let kept = self.finished.get(self.done).filter(|kept| kept.key == key && self.has(output));
        if let Some(result) = kept.and_then(|kept| T::deserialize(&kept.result).ok()) {
            (self.watch.note)(&format!("{name}: kept from the last attempt"));
            self.done += 1;
            return Ok(result);
        }
        self.finished.truncate(self.done);
        self.store()?;
        DATABASE_FILES.iter().try_for_each(|end| self.remove(&format!("{output}{end}")))?;
        let result = make(self)?;
        if !self.has(output) {
            let reason = format!("the program ended without an error, but it did not write {output}");
            return Err(PrepareError::Step { step: name, reason, log: self.log.clone() });
        }
        let value = serde_json::to_value(&result)
            .map_err(|e| PrepareError::write(&self.folder.join(STATE))(std::io::Error::other(e)))?;
        self.finished.push(FinishedStep { key, result: value });
        self.done += 1;
        self.store()?;
        Ok(result)
    }

    /// Forgets the last step, so that the next attempt does it again.
    ///
    /// # Errors
    /// The state cannot be written.
    pub(crate) fn forget_last(&mut self) -> Result<(), PrepareError> {
        self.done = self.done.saturating_sub(1);
        self.finished.truncate(self.done);
        self.store()
    }

    /// Removes a file or a folder of the work, if it is there.
    ///
    /// # Errors
    /// It cannot be removed.
    pub(crate) fn remove(&self, name: &str) -> Result<(), PrepareError> {
        let path = self.folder.join(name);
        let removed =
            if path.is_dir() { std::fs::remove_dir_all(&path) } else { std::fs::remove_file(&path) };
        match removed {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(PrepareError::write(&path)(e)),
            _ => Ok(()),
        }
    }

    fn has(&self, name: &str) -> bool {
        self.folder.join(name).exists()
    }

    fn store(&self) -> Result<(), PrepareError> {
        let path = self.folder.join(STATE);
        use3d_files::write_atomically(&path, |w| serde_json::to_writer(w, &self.finished).map_err(Into::into))
            .map_err(PrepareError::write(&path))
    }
}
