//! Removes from a cache what processes that have ended left behind.

use std::fs::DirEntry;

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
            for entry in files::entries(&folder) {
                let name = entry.file_name();
                let Some((_, owner)) = name.to_str().and_then(|n| n.split_once(files::SIBLING)) else {
                    continue;
                };
                if is_left(owner, &entry, 3600) {
                    let _ = self.files().remove_file(&entry.path());
                }
            }
        }
        let folders = files::entries(&self.root().join("tmp"));
        let left = folders.filter(|entry| is_left(&entry.file_name().to_string_lossy(), entry, 7 * 86_400));
        left.filter(|entry| self.files().remove_dir_all(&entry.path()).is_ok()).count()
    }
}

/// Returns true if the owner of a file or folder has ended. For one of another machine, the age decides;
/// `old` is in seconds.
fn is_left(owner: &str, entry: &DirEntry, old: u64) -> bool {
    let age = || entry.metadata().ok()?.modified().ok()?.elapsed().ok();
    let is_old = || age().is_some_and(|age| age.as_secs() > old);
    ProcessId::owner_is_alive(owner).map_or_else(is_old, |alive| !alive)
}
