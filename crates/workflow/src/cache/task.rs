//! The task of a cluster's scheduler in which a process runs.
//!
//! A lease alone does not show if a process on another machine has ended, but a scheduler does. So a lease
//! names its task. If a later attempt of the same task exists, the earlier one has ended. A cache can also
//! get a function that asks the scheduler ([`Cache::asking`](crate::Cache::asking)).

use std::sync::Arc;

use serde::{Deserialize, Serialize};
use use3d_capture::name::shown;

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
    /// The submission that it belongs to; empty if it was not written by `use3d submit`.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub submission: String,
}

/// The variable by which the tasks of one submission know each other.
pub const SUBMISSION: &str = "USE3D_SUBMISSION";

impl ClusterTask {
    /// The task of this process, from the variables that schedulers set.
    pub fn this() -> Option<Self> {
        Self::of(&|name: &str| std::env::var(name).ok().filter(|value| !value.is_empty()))
    }

    fn of(variable: &dyn Fn(&str) -> Option<String>) -> Option<Self> {
        let number = |name: &str| variable(name).and_then(|text| text.parse::<u64>().ok());
        let submission = variable(SUBMISSION).unwrap_or_default();
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
                submission,
            });
        }
        let (job, task) = (variable("HQ_JOB_ID")?, variable("HQ_TASK_ID")?);
        let (id, attempt) = (format!("{job}_{task}"), attempt("HQ_INSTANCE_ID"));
        Some(Self { scheduler: "hq".into(), cluster: String::new(), id, attempt, memory: 0, submission })
    }

    /// Returns true if both tasks belong to one submission.
    pub(crate) fn is_submitted_with(&self, other: &Self) -> bool {
        !self.submission.is_empty() && self.submission == other.submission
    }

    /// Returns true if this is a later attempt of the same task.
    pub(crate) fn follows(&self, earlier: &Self) -> bool {
        (&self.scheduler, &self.cluster, &self.id) == (&earlier.scheduler, &earlier.cluster, &earlier.id)
            && self.attempt > earlier.attempt
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
            (SUBMISSION, "a1"),
        ])
        .unwrap();
        assert_eq!((first.id.as_str(), first.attempt, first.memory), ("12_4", 0, 900 << 20));
        let later = ClusterTask { attempt: 2, ..first.clone() };
        assert!(later.follows(&first) && !first.follows(&later) && !first.follows(&first));
        let other = of(&[("SLURM_JOB_ID", "17"), ("SLURM_RESTART_COUNT", "9")]).unwrap();
        assert!(other.id == "17" && !other.follows(&first));
        assert!(first.is_submitted_with(&later) && !other.is_submitted_with(&other));
        assert_eq!(
            of(&[("HQ_JOB_ID", "3"), ("HQ_TASK_ID", "8"), ("HQ_INSTANCE_ID", "1")]).unwrap().attempt,
            1
        );
    }
}
