//! Removes from a cache what processes that have ended left behind.

use crate::cache::artifacts::Cache;
use crate::cache::files;
use crate::cache::machine::ProcessId;
use crate::share::lease::in_use;

impl Cache {
    /// Removes the leftovers of processes that have ended: leases, unfinished files, and folders in `tmp`.
    /// Returns the number of these folders.
    pub fn sweep(&self) -> usize {
        in_use(self);
        for folder in [self.root().to_path_buf(), self.root().join("leases")] {
            for entry in std::fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok) {
                let name = entry.file_name();
                let Some((_, owner)) = name.to_str().and_then(|n| n.split_once(files::SIBLING)) else {
                    continue;
                };
                let changed = entry.metadata().ok().and_then(|m| m.modified().ok());
                let old = || changed.and_then(|t| t.elapsed().ok()).is_some_and(|age| age.as_secs() > 3600);
                if ProcessId::owner_is_alive(owner).map_or_else(old, |alive| !alive) {
                    let _ = self.files().remove_file(&entry.path());
                }
            }
        }
        let Ok(entries) = std::fs::read_dir(self.root().join("tmp")) else { return 0 };
        let mut swept = 0;
        for path in entries.filter_map(Result::ok).map(|e| e.path()) {
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let old = || {
                let changed = std::fs::metadata(&path).and_then(|m| m.modified()).ok();
                let age = changed.and_then(|t| t.elapsed().ok());
                age.is_some_and(|a| a.as_secs() > 7 * 86_400)
            };
            let gone = ProcessId::owner_is_alive(&name).map_or_else(old, |alive| !alive);
            if gone && self.files().remove_dir_all(&path).is_ok() {
                swept += 1;
            }
        }
        swept
    }
}
