//! Notes about killed processes, so that the next task requests enough memory.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::cache::artifacts::Cache;
use crate::cache::files;
use crate::cache::key::Key;
use crate::cache::task::ClusterTask;

/// A process that ended in the middle of its work without a message. Usually it was killed for memory or
/// time, or its machine was lost.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Killed {
    /// The machine.
    pub host: String,
    /// The process id on it.
    pub process: u32,
    /// Its task.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<ClusterTask>,
    /// The time in seconds that it had worked, by its last pulse.
    pub seconds: u64,
    /// Its peak memory in bytes, by its last pulse.
    pub peak_memory: u64,
    /// The number of times that this happened to this artifact.
    pub times: u32,
}

impl Killed {
    /// The memory that the next task should request: 1.5 times the memory that was not enough.
    pub fn asks_for(&self) -> u64 {
        let had = self.task.as_ref().map_or(0, |task| task.memory);
        let most = self.peak_memory.max(had);
        most.saturating_add(most / 2)
    }
}

impl Cache {
    fn killed_path(&self, key: &Key) -> PathBuf {
        self.root().join("killed").join(format!("{key}.json"))
    }

    /// Returns the note about the last process that computed a key, if it was killed.
    pub fn killed(&self, key: &Key) -> Option<Killed> {
        serde_json::from_slice(&self.files().read(&self.killed_path(key)).ok()?).ok()
    }

    /// Notes that the process that computed a key was killed.
    pub(crate) fn note_killed(&self, key: &Key, mut killed: Killed) {
        if let Some(before) = self.killed(key) {
            killed.peak_memory = killed.peak_memory.max(before.peak_memory);
            killed.times = before.times.saturating_add(1);
        }
        let bytes = serde_json::to_vec(&killed).unwrap_or_default();
        // If the note is lost, the next task may request too little again.
        let _ = files::write_atomic(self.files(), &self.killed_path(key), &bytes);
    }

    /// Removes the note, because the artifact was computed after all.
    pub(crate) fn forget_killed(&self, key: &Key) {
        let _ = self.files().remove_file(&self.killed_path(key));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_not_enough_is_asked_for_and_half_as_much_again() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache::open(dir.path(), false).unwrap();
        let key = use3d_code::digest::Digest::of(b"key");
        let task = ClusterTask {
            scheduler: "slurm".into(),
            cluster: String::new(),
            id: "1".into(),
            attempt: 0,
            memory: 1000,
            submission: String::new(),
        };
        let killed = |peak_memory| Killed {
            host: "n1".into(),
            process: 7,
            task: Some(task.clone()),
            seconds: 3,
            peak_memory,
            times: 1,
        };
        assert_eq!(cache.killed(&key), None);
        cache.note_killed(&key, killed(3000));
        cache.note_killed(&key, killed(200));
        let known = cache.killed(&key).unwrap();
        assert_eq!((known.times, known.peak_memory, known.asks_for()), (2, 3000, 4500));
        assert_eq!(Killed { peak_memory: 10, ..known }.asks_for(), 1500);
        cache.forget_killed(&key);
        assert_eq!(cache.killed(&key), None);
    }
}
