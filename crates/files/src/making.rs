//! The unfinished files and folders of this process, so that a process that must end at once can remove them.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

static MAKING: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

/// Registers a temporary file or folder of this process until it is dropped.
#[derive(Debug)]
pub struct Making(PathBuf);

impl Making {
    /// Registers the file or folder at `path`.
    pub fn new(path: &Path) -> Self {
        MAKING.lock().unwrap_or_else(PoisonError::into_inner).insert(path.to_path_buf());
        Self(path.to_path_buf())
    }
}

impl Drop for Making {
    fn drop(&mut self) {
        MAKING.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.0);
    }
}

/// Removes every registered file and folder. Only a process that is about to end may call it, because other
/// threads may still write into them.
pub fn abandon() {
    for path in MAKING.lock().unwrap_or_else(PoisonError::into_inner).iter() {
        let is_folder = std::fs::symlink_metadata(path).is_ok_and(|found| found.is_dir());
        let _ = if is_folder { std::fs::remove_dir_all(path) } else { std::fs::remove_file(path) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unfinished_files_are_removed_and_finished_ones_stay() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        for name in ["half", "whole"] {
            std::fs::create_dir(at(name)).unwrap();
            std::fs::write(at(name).join("a"), "a").unwrap();
        }
        std::fs::write(at("half.png"), "half").unwrap();
        let _half = (Making::new(&at("half")), Making::new(&at("half.png")));
        drop(Making::new(&at("whole")));
        abandon();
        assert!(at("whole").join("a").exists() && !at("half").exists() && !at("half.png").exists());
    }
}
