//! The task of a cluster's scheduler in which a process runs, and notes about killed processes.
//!
//! A lease alone does not show if a process on another machine has ended, but a scheduler does. So a lease
//! names its task. If a later attempt of the same task exists, the earlier one has ended. A cache can also
//! get a function that asks the scheduler ([`Cache::asking`]).

use std::path::PathBuf;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use use3d_capture::name::shown;

use super::cache::Cache;
use super::files;
use super::key::Key;

/// A task of a scheduler.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClusterTask {
    /// `slurm` or `hq`.
    pub scheduler: String,
    /// The name of the cluster; empty if it is not known.
    #[serde(default)]
    pub cluster: String,
    /// Its number there; `123_4` for a task of an array.
    pub id: String,
    /// The number of earlier starts.
    pub attempt: u32,
    /// The memory that it was granted in bytes; 0 if that is not known.
    #[serde(default)]
    pub memory: u64,
}

impl ClusterTask {
    /// The task of this process, from the variables that schedulers set.
    pub fn this() -> Option<Self> {
        Self::of(&|name: &str| std::env::var(name).ok().filter(|value| !value.is_empty()))
    }

    fn of(variable: &dyn Fn(&str) -> Option<String>) -> Option<Self> {
        let number = |name: &str| variable(name).and_then(|text| text.parse::<u64>().ok());
        let attempt = |name: &str| number(name).and_then(|n| u32::try_from(n).ok()).unwrap_or(0);
        if let Some(job) = variable("SLURM_JOB_ID") {
            let of_array = variable("SLURM_ARRAY_JOB_ID").zip(variable("SLURM_ARRAY_TASK_ID"));
            let id = of_array.map_or(job, |(array, task)| format!("{array}_{task}"));
            let memory =
                number("SLURM_MEM_PER_NODE").map_or(0, |megabytes| megabytes.saturating_mul(1 << 20));
            return Some(Self {
                scheduler: "slurm".into(),
                cluster: variable("SLURM_CLUSTER_NAME").unwrap_or_default(),
                id,
                attempt: attempt("SLURM_RESTART_COUNT"),
                memory,
            });
        }
        let (job, task) = (variable("HQ_JOB_ID")?, variable("HQ_TASK_ID")?);
        let (id, attempt) = (format!("{job}_{task}"), attempt("HQ_INSTANCE_ID"));
        Some(Self { scheduler: "hq".into(), cluster: String::new(), id, attempt, memory: 0 })
    }

    /// Returns true if this is a later attempt of the same task.
    pub(crate) fn follows(&self, earlier: &Self) -> bool {
        let same = |task: &Self| (task.scheduler.clone(), task.cluster.clone(), task.id.clone());
        same(self) == same(earlier) && self.attempt > earlier.attempt
    }
}

impl std::fmt::Display for ClusterTask {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // The text comes from a file of another machine.
        write!(f, "{} {}", shown(&self.scheduler), shown(&self.id))
    }
}

/// Asks a scheduler if a task is over; it returns `None` if the scheduler gives no answer.
pub type IsOver = Arc<dyn Fn(&ClusterTask) -> Option<bool> + Send + Sync>;

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
    /// Returns the same cache with a function that asks a scheduler about the tasks that leases name.
    #[must_use]
    pub fn asking(self, is_over: IsOver) -> Self {
        let node = self.node().clone().asking(is_over);
        self.as_node(node)
    }

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
    fn a_task_is_known_by_what_its_scheduler_sets() {
        let of = |set: &[(&str, &str)]| {
            let set: Vec<(String, String)> =
                set.iter().map(|(a, b)| (a.to_string(), b.to_string())).collect();
            ClusterTask::of(&|name| set.iter().find(|(n, _)| n == name).map(|(_, value)| value.clone()))
        };
        assert_eq!(of(&[]), None);
        let first = of(&[
            ("SLURM_JOB_ID", "17"),
            ("SLURM_ARRAY_JOB_ID", "12"),
            ("SLURM_ARRAY_TASK_ID", "4"),
            ("SLURM_MEM_PER_NODE", "900"),
        ])
        .unwrap();
        assert_eq!((first.id.as_str(), first.attempt, first.memory), ("12_4", 0, 900 << 20));
        let later = ClusterTask { attempt: 2, ..first.clone() };
        assert!(later.follows(&first) && !first.follows(&later) && !first.follows(&first));
        let other = of(&[("SLURM_JOB_ID", "17"), ("SLURM_RESTART_COUNT", "9")]).unwrap();
        assert!(other.id == "17" && !other.follows(&first));
        assert_eq!(
            of(&[("HQ_JOB_ID", "3"), ("HQ_TASK_ID", "8"), ("HQ_INSTANCE_ID", "1")]).unwrap().attempt,
            1
        );
    }

    #[test]
    fn what_was_not_enough_is_asked_for_and_half_as_much_again() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache::open(dir.path(), false).unwrap();
        let key = super::super::digest::Digest::of(b"key");
        let task = ClusterTask {
            scheduler: "slurm".into(),
            cluster: String::new(),
            id: "1".into(),
            attempt: 0,
            memory: 1000,
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
