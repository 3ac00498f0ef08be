//! HyperQueue: one job file with every task and what it waits for, and a small script that all tasks go
//! through.
//!
//! HyperQueue starts a task again whose worker was lost, and the task goes on from its last checkpoint, so
//! that no limit and no signal is needed. It knows no "when that is over, whatever became of it": the last
//! task runs when all others are done; after a failure the same submission does what is missing.

use std::path::PathBuf;

use serde::Serialize;

use super::ClusterError;
use super::jobs::{After, Job};
use super::quote::{word, words};
use super::site::Site;
use super::slurm::{Submission, create_logs, put};

/// How often a task is started again whose worker was lost.
const CRASHES: u32 = 50;

#[derive(Serialize)]
struct JobFile {
    name: String,
    task: Vec<Task>,
}

#[derive(Serialize)]
struct Task {
    id: usize,
    command: Vec<String>,
    stdout: String,
    stderr: String,
    cwd: String,
    crash_limit: u32,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    deps: Vec<usize>,
    request: Vec<Request>,
}

#[derive(Serialize)]
struct Request {
    time_request: String,
    resources: std::collections::BTreeMap<String, u64>,
}

/// The job file.
pub fn file_path(submission: &Submission) -> PathBuf {
    submission.folder.join("job.toml")
}

/// The script that tasks go through.
pub fn script_path(submission: &Submission) -> PathBuf {
    submission.folder.join("task.sh")
}

/// The script: what the site says, then `use3d` with the words it is given.
pub fn script(submission: &Submission, site: &Site) -> String {
    let mut lines = vec![
        "#!/bin/bash".to_string(),
        "# What every task of job.toml goes through.".to_string(),
        format!("# Written by `{}`; to be read and edited.", submission.by),
        format!("cd {} || exit 1", word(&submission.place.to_string_lossy())),
    ];
    lines.extend(site.setup.iter().cloned());
    lines.push(r#"echo "$(date -u +%FT%TZ) $(hostname), attempt $((${HQ_INSTANCE_ID:-0} + 1))""#.to_string());
    lines.push(format!(r#"exec {} "$@""#, word(&site.command)));
    lines.join("\n") + "\n"
}

/// The job file of `hq job submit-file`.
pub fn file(jobs: &[Job], submission: &Submission) -> String {
    let mut tasks: Vec<Task> = Vec::new();
    // The numbers of every job's tasks.
    let mut numbers: Vec<Vec<usize>> = Vec::new();
    for job in jobs {
        let mut own = Vec::new();
        for at in 0..job.tasks.unwrap_or(1) {
            let id = tasks.len();
            let deps = job.after.iter().flat_map(|after| match after {
                After::Same(of) => numbers[*of].get(at).copied().into_iter().collect::<Vec<_>>(),
                After::Done(of) | After::Over(of) => numbers[*of].clone(),
            });
            let deps = deps.collect();
            let script = script_path(submission).to_string_lossy().into_owned();
            let mut command =
                vec!["bash".to_string(), script, "--threads".to_string(), job.asks.cpus.to_string()];
            command.extend(submission.task(job));
            command
                .extend(job.cells.get(at).into_iter().flat_map(|cell| ["--only".to_string(), cell.clone()]));
            let number = if job.tasks.is_some() { format!("-{at}") } else { String::new() };
            let log = submission.folder.join("logs").join(format!("{}{number}.log", job.name));
            let mut resources = job.asks.needs.resources.clone();
            resources.insert("cpus".to_string(), job.asks.cpus as u64);
            let request = Request { time_request: format!("{}s", job.asks.time.as_secs()), resources };
            tasks.push(Task {
                id,
                command,
                stdout: log.to_string_lossy().into_owned(),
                stderr: log.with_extension("err").to_string_lossy().into_owned(),
                cwd: submission.place.to_string_lossy().into_owned(),
                crash_limit: CRASHES,
                deps,
                request: vec![request],
            });
            own.push(id);
        }
        numbers.push(own);
    }
    let file = JobFile { name: submission.name.clone(), task: tasks };
    // Nothing in it has a form that TOML does not know.
    let text = toml::to_string(&file).unwrap_or_default();
    format!("# Written by `{}`; submit it with `hq job submit-file`.\n{text}", submission.by)
}

/// Writes both.
///
/// # Errors
/// A file that cannot be written.
pub fn write(jobs: &[Job], submission: &Submission, site: &Site) -> Result<(), ClusterError> {
    create_logs(submission)?;
    put(&script_path(submission), &script(submission, site))?;
    put(&file_path(submission), &file(jobs, submission))
}

/// Hands the written file to HyperQueue; what it says.
///
/// # Errors
/// `hq` that is not there or refuses.
pub fn submit(submission: &Submission) -> Result<String, ClusterError> {
    let file = file_path(submission).to_string_lossy().into_owned();
    let arguments = ["job".to_string(), "submit-file".to_string(), file];
    let wrong = |reason: String| ClusterError::Command { command: "hq".to_string(), reason };
    let output = std::process::Command::new("hq").args(&arguments).output().map_err(|e| {
        wrong(format!(
            "{e}; install HyperQueue and start `hq server start`, or write the file with --dry-run"
        ))
    })?;
    if output.status.success() {
        return Ok(String::from_utf8_lossy(&output.stdout).trim().to_string());
    }
    let said = String::from_utf8_lossy(&output.stderr);
    Err(wrong(format!("{}: {}", words(&arguments), said.trim())))
}
