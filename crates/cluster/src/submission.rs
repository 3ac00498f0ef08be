//! A submission: the data that all of its jobs share, and the files that remember it.
//!
//! ```text
//! <out>-submit/submitted.json     the jobs in the queue, by name and number, with their scenes
//!              scenes-<id>.json   the scenes and variants of one submission ([`crate::cells`])
//!              logs/              the output of the tasks
//! ```

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use use3d_workflow::files::{Disk, write_atomic};
use use3d_workflow::task::SUBMISSION;
use use3d_workflow::{Digest, FileError, machine};

use super::ClusterError;
use super::jobs::Job;
use super::quote::word;

/// Data that all jobs of a submission share.
#[derive(Clone, Debug, Default)]
pub struct Submission {
    /// The pipeline's name.
    pub name: String,
    /// The command line that wrote the scripts, for their readers.
    pub by: String,
    /// The folder in which `use3d run` starts.
    pub place: PathBuf,
    /// The arguments of `use3d run` that all jobs share.
    pub run: Vec<String>,
    /// The arguments that set the results folder.
    pub results: Vec<String>,
    /// The folder of the scripts, lists and logs.
    pub folder: PathBuf,
    /// Environment variables, with their values, that tasks need and that a scheduler may not pass on.
    pub variables: Vec<(String, String)>,
    /// The text by which its tasks know each other.
    pub id: String,
    /// The scenes and variants that it computes, each with the digest of its part of the pipeline.
    pub cells: BTreeMap<String, String>,
    /// Earlier submissions for the same results whose jobs are still in the queue.
    pub before: Submitted,
    /// The folder with the record of all of them.
    pub record: PathBuf,
}

/// The submitted jobs of a submission.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Submitted {
    /// `slurm` or `hq`.
    #[serde(default)]
    pub scheduler: String,
    /// Each job's name, and its number from the scheduler.
    pub jobs: Vec<(String, String)>,
    /// Their scenes and variants, each with the digest of its part of the pipeline.
    #[serde(default)]
    pub cells: BTreeMap<String, String>,
}

impl Submitted {
    /// Returns the last submission from a folder.
    pub fn read(folder: &Path) -> Self {
        let text = std::fs::read_to_string(folder.join("submitted.json")).unwrap_or_default();
        serde_json::from_str(&text).unwrap_or_default()
    }
}

impl Submission {
    /// The submission of these scenes and variants now, for results in `out`: its folders, and the text by
    /// which its tasks know each other.
    pub fn of_cells(self, cells: BTreeMap<String, String>, out: &Path) -> Self {
        let (record, now) = (folder_of(out), machine::now());
        // Tasks that wait in the queue read the lists of their own submission.
        let folder = match self.before.jobs.is_empty() {
            true => record.clone(),
            false => record.join(format!("added-{now}")),
        };
        let listed = serde_json::to_vec(&cells).unwrap_or_default();
        let id = format!("{}-{now}", Digest::of(&listed).short());
        Self { folder, record, id, cells, ..self }
    }

    /// The path of the script of a job.
    pub fn script_path(&self, job: &Job) -> PathBuf {
        self.folder.join(format!("{}.sbatch", job.name))
    }

    /// The path of the list of a job's tasks.
    pub fn list_path(&self, job: &Job) -> PathBuf {
        self.folder.join(format!("{}.tasks", job.name))
    }

    /// The path of the list of its scenes and variants. Its tasks compare it with the pipeline.
    pub fn cells_path(&self) -> PathBuf {
        self.folder.join(format!("scenes-{}.json", self.id))
    }

    /// Stores the submitted jobs beside those of before, for [`Submitted::read`].
    pub(crate) fn keep(&self, scheduler: &str, jobs: Vec<(String, String)>) -> Result<(), ClusterError> {
        let mut all = self.before.clone();
        if !jobs.is_empty() {
            all.scheduler = scheduler.to_string();
            all.cells.extend(self.cells.clone());
            all.jobs.extend(jobs);
        }
        put(&self.record.join("submitted.json"), &serde_json::to_string_pretty(&all).unwrap_or_default())
    }

    /// The lines of a script that set the variables. The networks are those at the time of submission, or
    /// none: a variable of a task's machine would give its stages other keys than planned.
    pub(crate) fn exports(&self) -> Vec<String> {
        let exports = self.variables.iter().map(|(name, value)| format!("export {name}={}", word(value)));
        ["unset USE3D_MODELS".to_string(), format!("export {SUBMISSION}={}", word(&self.id))]
            .into_iter()
            .chain(exports)
            .collect()
    }

    /// The arguments of a job's task after the command's name; the task's own scene and variant come last.
    pub(crate) fn task(&self, job: &Job) -> Vec<String> {
        let own = if job.delivers { &self.results } else { &Vec::new() };
        [&["run".to_string()][..], &self.run, own, &job.words].concat()
    }
}

/// The folder of the scripts and logs for results in `out`.
pub fn folder_of(out: &Path) -> PathBuf {
    out.with_file_name(format!("{}-submit", out.file_name().unwrap_or_default().to_string_lossy()))
}

/// Creates the folder for the logs of a submission's tasks, and writes the list of its scenes and variants.
pub(crate) fn begin(submission: &Submission) -> Result<(), ClusterError> {
    let path = submission.folder.join("logs");
    let created = std::fs::create_dir_all(&path);
    created.map_err(|source| FileError { path, doing: "create", source })?;
    put(&submission.cells_path(), &serde_json::to_string_pretty(&submission.cells).unwrap_or_default())
}

/// Replaces a file by another one. A shell that is reading the old file continues to read it.
pub(crate) fn put(path: &Path, text: &str) -> Result<(), ClusterError> {
    Ok(write_atomic(&Disk, path, text.as_bytes())?)
}
