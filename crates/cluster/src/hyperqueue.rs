//! HyperQueue: one job file with every task and what it waits for, and a small script that all tasks go
//! through.
//!
//! HyperQueue starts a task again whose worker was lost, and the task goes on from its last checkpoint, so
//! that no limit and no signal is needed. It knows no "when that is over, whatever became of it": a task for
//! which only `finish` waits therefore ends with 0 even where it failed, and `finish`, which names what is
//! missing, says how the batch ended. A stage for which another one waits fails, and what waits is not begun.

use std::path::PathBuf;

use serde::Serialize;

use super::ClusterError;
use super::jobs::{After, Job};
use super::quote::{word, words};
use super::site::Site;
use super::slurm::{Submission, Submitted, create_logs, put};

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

/// For the script: who waits for this task begins when it is done.
const AFTER_OK: &str = "afterok";
/// For the script: who waits for this task begins when it is over, whatever became of it.
const AFTER_ANY: &str = "afterany";

/// The script: what the site says, then `use3d` with the words it is given behind the first.
pub fn script(submission: &Submission, site: &Site) -> String {
    let mut lines = vec![
        "#!/bin/bash".to_string(),
        "# What every task of job.toml goes through.".to_string(),
        format!("# Written by `{}`; to be read and edited.", submission.by),
        format!(
            "# Its first word: `{AFTER_OK}`, or `{AFTER_ANY}` where `finish` begins whatever becomes of the task."
        ),
        "after=$1; shift".to_string(),
        format!("cd {} || exit 1", word(&submission.place.to_string_lossy())),
    ];
    lines.extend(submission.exports());
    lines.extend(site.setup.iter().cloned());
    lines.push(r#"echo "$(date -u +%FT%TZ) $(hostname), attempt $((${HQ_INSTANCE_ID:-0} + 1))""#.to_string());
    let command = words(&site.command);
    lines.push(format!(r#"[ "$after" = {AFTER_ANY} ] || exec {command} "$@""#));
    lines.push(format!(r#"code=0; {command} "$@" || code=$?"#));
    // Who is interrupted is not to be followed by anything.
    lines.push(r#"if [ "$code" = 0 ] || [ "$code" = 130 ]; then exit "$code"; fi"#.to_string());
    lines.push(r#"echo "ended with exit code $code; the task finish names what is missing" >&2"#.to_string());
    lines.join("\n") + "\n"
}

/// Whether only the last job waits for this one, so that it may begin whatever became of it.
fn only_last_waits(jobs: &[Job], at: usize) -> bool {
    let waits = |job: &Job| {
        job.after.iter().any(|after| matches!(after, After::Done(of) | After::Same(of) if *of == at))
    };
    !jobs[at].delivers && !jobs.iter().any(waits)
}

/// Whether after a failure the last task is not begun, since HyperQueue does not begin what waits for what failed.
pub fn ends_with_a_failure(jobs: &[Job]) -> bool {
    (0..jobs.len()).any(|at| !jobs[at].delivers && !only_last_waits(jobs, at))
}

/// The job file of `hq job submit-file`.
pub fn file(jobs: &[Job], submission: &Submission) -> String {
    let mut tasks: Vec<Task> = Vec::new();
    // The file's numbers of every job's tasks, each with its own.
    let mut numbers: Vec<Vec<(Option<usize>, usize)>> = Vec::new();
    for (which, job) in jobs.iter().enumerate() {
        let after = if only_last_waits(jobs, which) { AFTER_ANY } else { AFTER_OK };
        let mut own = Vec::new();
        for at in 0..job.count() {
            let own_number = job.tasks.as_ref().map(|tasks| tasks[at]);
            let id = tasks.len();
            let deps = job.after.iter().flat_map(|after| match after {
                After::Same(of) => numbers[*of]
                    .iter()
                    .filter(|(number, _)| *number == own_number)
                    .map(|(_, id)| *id)
                    .collect(),
                // What only keeps two jobs from running side by side is a matter of the workers here.
                After::Over(_) if !job.delivers => Vec::new(),
                After::Done(of) | After::Over(of) => {
                    numbers[*of].iter().map(|(_, id)| *id).collect::<Vec<_>>()
                }
            });
            let deps = deps.collect();
            let script = script_path(submission).to_string_lossy().into_owned();
            let mut command = vec!["bash".to_string(), script, after.to_string()];
            command.extend(["--threads".to_string(), job.asks.cpus.to_string()]);
            command.extend(submission.task(job));
            command
                .extend(job.cells.get(at).into_iter().flat_map(|cell| ["--only".to_string(), cell.clone()]));
            let number = own_number.map_or_else(String::new, |number| format!("-{number}"));
            // A task that is started again has a log of its own.
            let log = format!("{}{number}-%{{INSTANCE_ID}}.log", job.name);
            let log = submission.folder.join("logs").join(log);
            let mut resources = job.asks.needs.resources.clone();
            resources.insert("cpus".to_string(), job.asks.cpus as u64);
            // In megabytes, as its workers find it out; a site may name it otherwise, or say that it is not asked for.
            resources.entry("mem".to_string()).or_insert(job.asks.memory.div_ceil(1_048_576));
            resources.retain(|_, amount| *amount > 0);
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
            own.push((own_number, id));
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

/// Hands the written file to HyperQueue; the job's number.
///
/// # Errors
/// `hq` that is not there, refuses, or does not say a number.
pub fn submit(submission: &Submission) -> Result<Submitted, ClusterError> {
    let file = file_path(submission).to_string_lossy().into_owned();
    let scripts = format!("; the job file is {file}");
    let said = call(&["job".to_string(), "submit-file".to_string(), file], &scripts)?;
    let number = said.trim();
    if number.is_empty() || !number.bytes().all(|b| b.is_ascii_digit()) {
        return Err(wrong(format!(
            "expected the number of a job, and it said: {number:?}; see with `hq job list` whether it took the job"
        )));
    }
    let submitted =
        Submitted { scheduler: "hq".to_string(), jobs: vec![(submission.name.clone(), number.to_string())] };
    submission.keep(&submitted)?;
    Ok(submitted)
}

/// Cancels jobs.
///
/// # Errors
/// `hq` that is not there or refuses.
pub fn cancel(numbers: &[String]) -> Result<(), ClusterError> {
    let words = ["job".to_string(), "cancel".to_string(), numbers.join(",")];
    call(&words, "").map(drop)
}

/// The job of the last submission from this folder, where HyperQueue still has work of it, by name and number.
///
/// # Errors
/// `hq` that is not there or whose server does not answer.
pub fn queued(submission: &Submission) -> Result<Vec<(String, String)>, ClusterError> {
    let last = submission.submitted().jobs;
    if last.is_empty() {
        return Ok(Vec::new());
    }
    // A line for each job that is not over: its number, its state.
    let said = call(&["job", "list"].map(String::from), "")?;
    let open: Vec<&str> = said.lines().filter_map(|line| line.split_whitespace().next()).collect();
    Ok(last.into_iter().filter(|(_, number)| open.contains(&number.as_str())).collect())
}

fn wrong(reason: String) -> ClusterError {
    ClusterError::Command { command: "hq".to_string(), reason }
}

/// What `hq` prints where only what scripts need is asked for. `more` is said where there is no such command.
fn call(arguments: &[String], more: &str) -> Result<String, ClusterError> {
    let mut command = std::process::Command::new("hq");
    command.args(["--output-mode", "quiet"]).args(arguments);
    let output = command
        .output()
        .map_err(|e| wrong(format!("{e}; install HyperQueue and start `hq server start`{more}")))?;
    if output.status.success() {
        return Ok(String::from_utf8_lossy(&output.stdout).into_owned());
    }
    let said = String::from_utf8_lossy(&output.stderr);
    Err(wrong(format!("{}: {}", words(arguments), said.trim())))
}
