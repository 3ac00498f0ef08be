//! Removes from a cache what processes that have ended left behind.

use std::collections::BTreeSet;
use std::fs::DirEntry;
use std::path::Path;

use crate::cache::artifacts::Cache;
use crate::cache::files;
use crate::cache::key::Key;
use crate::cache::machine::ProcessId;
use crate::share::lease::{CLAIM, in_use};

/// The name of the empty file in the folder of checkpoints whose stage has finished.
const FINISHED: &str = "finished";
/// The time for which checkpoints of a finished stage stay, in seconds. A longer training begins with them.
const STAY: u64 = 14 * 86_400;

impl Cache {
    /// Notes that the stage of a folder of checkpoints has finished, or that it goes on. A failure costs only
    /// space.
    pub(crate) fn note_finished(&self, checkpoints: &Path, finished: bool) {
        let note = checkpoints.join(FINISHED);
        let _ = if finished { self.files().write(&note, b"") } else { self.files().remove_file(&note) };
    }

    /// Removes the checkpoints of stages that finished long ago, but not those that a process uses.
    fn sweep_checkpoints(&self, used: &BTreeSet<Key>) {
        let stages = files::entries(&self.root().join("checkpoints"));
        for folder in stages.flat_map(|stage| files::entries(&stage.path())) {
            let age =
                || std::fs::metadata(folder.path().join(FINISHED)).ok()?.modified().ok()?.elapsed().ok();
            let key = folder.file_name().to_str().and_then(|name| name.parse().ok());
            if age().is_some_and(|age| age.as_secs() > STAY) && key.is_none_or(|key| !used.contains(&key)) {
                let _ = self.discard(&folder.path());
            }
        }
    }

    /// Removes the leftovers of processes that have ended: leases, unfinished files, and folders in `tmp`;
    /// also old checkpoints of finished stages. Returns the number of folders in `tmp`.
    pub fn sweep(&self) -> usize {
        self.sweep_checkpoints(&in_use(self));
        for folder in [self.root().to_path_buf(), self.root().join("leases")] {
            for entry in files::entries(&folder) {
                let name = entry.file_name();
                let Some((_, owner)) = name.to_str().and_then(|n| n.split_once(files::SIBLING)) else {
                    continue;
                };
                let claims =
                    owner.starts_with(CLAIM).then(|| std::fs::read_to_string(entry.path()).ok()).flatten();
                if is_left(claims.as_deref().unwrap_or(owner), &entry, 3600) {
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

#[cfg(test)]
mod tests {
    use std::time::{Duration, SystemTime};

    use super::*;

    #[test]
    fn a_claim_goes_with_its_process_and_no_other() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache::open(&dir.path().join("cache"), false).unwrap();
        let this = ProcessId::this();
        let gone = ProcessId { started: this.started + 1, ..this.clone() };
        if gone.is_alive() != Some(false) {
            return; // a system that does not report it
        }
        let claim = |name: &str, owner: &ProcessId| {
            let path = cache.root().join("leases").join(format!("{name}{}{CLAIM}0", files::SIBLING));
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(&path, format!("{}-0", owner.name())).unwrap();
            path
        };
        let claims = [claim("a", &gone), claim("b", &this)];
        cache.sweep();
        assert_eq!(claims.map(|path| path.exists()), [false, true]);
    }

    #[test]
    fn checkpoints_go_when_their_stage_has_been_finished_for_long() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache::open(&dir.path().join("cache"), false).unwrap();
        let [old, fresh, again] = ["a", "b", "c"].map(|name| {
            let folder = cache.checkpoint_path("train", &Key::of(name.as_bytes()));
            std::fs::create_dir_all(&folder).unwrap();
            std::fs::write(folder.join("step"), "state").unwrap();
            cache.note_finished(&folder, true);
            folder
        });
        for folder in [&old, &again] {
            let note = std::fs::File::options().write(true).open(folder.join(FINISHED)).unwrap();
            note.set_modified(SystemTime::now() - Duration::from_secs(STAY + 60)).unwrap();
        }
        cache.note_finished(&again, false);
        cache.sweep();
        assert_eq!([&old, &fresh, &again].map(|folder| folder.join("step").exists()), [false, true, true]);
    }
}
