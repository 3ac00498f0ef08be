//! HyperQueue: writes one job file with every task and its dependencies, and a small script that runs every
//! task.
//!
//! If a worker is lost, HyperQueue starts its task again, and the task resumes from its last checkpoint; so
//! no limit and no signal is needed. HyperQueue has no dependency of the kind "after that task, even if it
//! failed". Therefore a task that only `finish` waits for ends with 0 even after a failure, and `finish`,
//! which names what is missing, reports the result of the batch. If another stage waits for a stage that
//! failed, HyperQueue does not start the waiting tasks.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::ClusterError;
use super::jobs::{After, Job};
use super::quote::{word, words};
use super::site::Site;
use super::slurm::output_of;
use super::submission::{Submission, Submitted, begin, put};
use super::time;

/// Number of times that a task is started again after its worker was lost.
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
    resources: BTreeMap<String, u64>,
}

/// The path of the job file.
pub fn file_path(submission: &Submission) -> PathBuf {
    submission.folder.join("job.toml")
}

/// The path of the script that runs every task.
pub fn script_path(submission: &Submission) -> PathBuf {
    submission.folder.join("task.sh")
}

/// For the script: tasks that wait for this one start after it succeeded.
const AFTER_OK: &str = "afterok";
/// For the script: tasks that wait for this one start after its end, even if it failed.
const AFTER_ANY: &str = "afterany";

/// The text of the script: the setup of the site, then `use3d` with the script's arguments after the first.
pub fn script(submission: &Submission, site: &Site) -> String {
    let (by, place) = (&submission.by, word(&submission.place.to_string_lossy()));
    let setup = [submission.exports(), site.setup.clone()].concat().join("\n");
    let command = words(&site.command());
    // No task must follow one that was interrupted, which has the code 130.
    format!(
        r#"#!/bin/bash
# Every task of job.toml runs this script.
# Written by `{by}`. You may read and edit it.
# Its first word: `{AFTER_OK}`, or `{AFTER_ANY}` if `finish` starts after the task in any case.
after=$1; shift
cd {place} || exit 1
{setup}
echo "$(date -u +%FT%TZ) $(hostname), attempt $((${{HQ_INSTANCE_ID:-0}} + 1))"
[ "$after" = {AFTER_ANY} ] || exec {command} "$@"
code=0; {command} "$@" || code=$?
if [ "$code" = 0 ] || [ "$code" = 130 ]; then exit "$code"; fi
echo "ended with exit code $code; the task finish names what is missing" >&2
"#
    )
}

/// Returns true if only the last job waits for this one, so that the last job may start even after a failure.
fn only_last_waits(jobs: &[Job], at: usize) -> bool {
    let waits = |job: &Job| {
        job.after.iter().any(|after| matches!(after, After::Done(of) | After::Same(of) if *of == at))
    };
    !jobs[at].delivers && !jobs.iter().any(waits)
}

/// Returns true if a failure prevents the last task, because HyperQueue does not start a task that waits for
/// a failed one.
pub fn ends_with_a_failure(jobs: &[Job]) -> bool {
    (0..jobs.len()).any(|at| !jobs[at].delivers && !only_last_waits(jobs, at))
}

/// The resources that each task of a job requests, by HyperQueue's names.
fn resources_of(job: &Job) -> BTreeMap<String, u64> {
    let mut resources = job.asks.needs.resources.clone();
    resources.insert("cpus".to_string(), job.asks.cpus as u64);
    // In megabytes, the unit of HyperQueue's workers; a site may use another name for it, or 0 for no
    // request.
    resources.entry("mem".to_string()).or_insert(job.asks.memory.div_ceil(1_048_576));
    resources.retain(|_, amount| *amount > 0);
    resources
}

/// The job file of `hq job submit-file`.
pub fn file(jobs: &[Job], submission: &Submission) -> String {
    let mut tasks: Vec<Task> = Vec::new();
    // The numbers of every job's tasks in the file, with the job's own number of each task.
    let mut numbers: Vec<Vec<(Option<usize>, usize)>> = Vec::new();
    for (which, job) in jobs.iter().enumerate() {
        let after = if only_last_waits(jobs, which) { AFTER_ANY } else { AFTER_OK };
        let mut own = Vec::new();
        for at in 0..job.count() {
            let own_number = job.tasks.as_ref().map(|tasks| tasks[at]);
            let id = tasks.len();
            let mut deps = Vec::new();
            for after in &job.after {
                let (of, same) = match after {
                    After::Same(of) => (*of, true),
                    // The workers of HyperQueue limit the concurrent jobs, so such a dependency is left out.
                    After::Over(_) if !job.delivers => continue,
                    After::Done(of) | After::Over(of) => (*of, false),
                };
                let waits = |(number, _): &&(Option<usize>, usize)| !same || *number == own_number;
                deps.extend(numbers[of].iter().filter(waits).map(|(_, id)| *id));
            }
            let script = script_path(submission).to_string_lossy().into_owned();
            let mut command = vec!["bash".to_string(), script, after.to_string()];
            command.extend(["--threads".to_string(), job.asks.cpus.to_string()]);
            command.extend(submission.task(job));
            if let Some(cell) = job.cells.get(at) {
                command.extend(["--only".to_string(), cell.clone()]);
            }
            let number = own_number.map_or_else(String::new, |number| format!("-{number}"));
            // Every start of a task has its own log.
            let log = format!("{}{number}-%{{INSTANCE_ID}}.log", job.name);
            let log = submission.folder.join("logs").join(log);
            let resources = resources_of(job);
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
    // All values have forms that TOML supports, so this cannot fail.
    let text = toml::to_string(&file).unwrap_or_default();
    format!("# Written by `{}`; submit it with `hq job submit-file`.\n{text}", submission.by)
}

/// Writes the script and the job file.
///
/// # Errors
/// A file cannot be written.
pub fn write(jobs: &[Job], submission: &Submission, site: &Site) -> Result<(), ClusterError> {
    begin(submission)?;
    put(&script_path(submission), &script(submission, site))?;
    put(&file_path(submission), &file(jobs, submission))
}

/// Submits the written job file to HyperQueue, and returns the job's number.
///
/// # Errors
/// `hq` does not exist, refuses, or does not print a number.
pub fn submit(submission: &Submission) -> Result<Submitted, ClusterError> {
    let file = file_path(submission).to_string_lossy().into_owned();
    let scripts = format!("; the job file is {file}");
    let said = call(&["job", "submit-file", &file], &scripts)?;
    let number = said.trim();
    if number.is_empty() || !number.bytes().all(|b| b.is_ascii_digit()) {
        let reason = format!(
            "expected the number of a job, but the answer was {number:?}; check with `hq job list` if the \
             job was submitted"
        );
        return Err(ClusterError::Command { command: "hq".to_string(), reason });
    }
    let jobs = vec![(submission.name.clone(), number.to_string())];
    submission.keep("hq", jobs.clone())?;
    Ok(Submitted { scheduler: "hq".to_string(), jobs, ..Submitted::default() })
}

/// A worker as `hq worker list` describes it.
#[derive(Deserialize)]
struct Worker {
    configuration: WorkerConfiguration,
    /// Its end, unless it still works.
    ended: Option<Value>,
}

#[derive(Deserialize)]
struct WorkerConfiguration {
    /// Seconds for which it lives; `None` without a limit.
    time_limit: Option<f64>,
    resources: WorkerResources,
}

#[derive(Deserialize)]
struct WorkerResources {
    resources: Vec<WorkerResource>,
}

/// A resource of a worker in one of HyperQueue's forms.
#[derive(Deserialize)]
struct WorkerResource {
    name: String,
    values: Option<Vec<Value>>,
    groups: Option<Vec<Vec<Value>>>,
    start: Option<u64>,
    end: Option<u64>,
    size: Option<Value>,
}

impl WorkerResource {
    /// Its amount; `None` in a form that is not known here.
    fn amount(&self) -> Option<u64> {
        let range = || Some(self.end?.saturating_sub(self.start?) + 1);
        let grouped = || Some(self.groups.as_ref()?.iter().map(|group| group.len() as u64).sum());
        let listed = self.values.as_ref().map(|values| values.len() as u64);
        listed.or_else(grouped).or_else(range).or_else(|| self.size.as_ref()?.as_u64())
    }
}

impl Worker {
    /// True if a task with these resources and this time can run on it. A form that is not known is enough.
    fn serves(&self, resources: &BTreeMap<String, u64>, seconds: u64) -> bool {
        let WorkerConfiguration { time_limit, resources: has } = &self.configuration;
        let enough = |(name, asked): (&String, &u64)| {
            let own = has.resources.iter().find(|resource| resource.name == *name);
            own.map_or(Some(0), WorkerResource::amount).is_none_or(|amount| amount >= *asked)
        };
        time_limit.is_none_or(|limit| limit >= seconds as f64) && resources.iter().all(enough)
    }
}

/// The requests that no worker of now can serve, each with the names of its jobs. Nothing if there is no
/// worker yet, or if `hq` describes its workers in a form that is not known here.
pub fn unserved(jobs: &[Job]) -> BTreeMap<String, Vec<&str>> {
    let hint = "install HyperQueue";
    let said = output_of("hq", &["--output-mode", "json"], &["worker", "list"], hint).unwrap_or_default();
    let Ok(mut workers) = serde_json::from_str::<Vec<Worker>>(&said) else {
        return BTreeMap::new();
    };
    workers.retain(|worker| worker.ended.is_none());
    let lacks = |job: &&Job| {
        let (resources, seconds) = (resources_of(job), job.asks.time.as_secs());
        !workers.is_empty() && !workers.iter().any(|worker| worker.serves(&resources, seconds))
    };
    let asked = |job: &Job| {
        let named = resources_of(job).into_iter().map(|(name, amount)| format!("{name} = {amount}"));
        format!("{} and {}", named.collect::<Vec<_>>().join(", "), time::clock(job.asks.time))
    };
    let mut found: BTreeMap<String, Vec<&str>> = BTreeMap::new();
    for job in jobs.iter().filter(lacks) {
        found.entry(asked(job)).or_default().push(&job.name);
    }
    found
}

/// Cancels jobs.
///
/// # Errors
/// There is no `hq`, or it refuses.
pub fn cancel(numbers: &[String]) -> Result<(), ClusterError> {
    call(&["job", "cancel", &numbers.join(",")], "").map(drop)
}

/// Returns the jobs of a submission that HyperQueue has not finished, by name and number.
///
/// # Errors
/// `hq` does not exist or its server does not answer.
pub fn still_queued(submitted: Submitted) -> Result<Vec<(String, String)>, ClusterError> {
    if submitted.jobs.is_empty() {
        return Ok(Vec::new());
    }
    // There is one line for each unfinished job: its number and its state.
    let said = call(&["job", "list"], "")?;
    let open: Vec<&str> = said.lines().filter_map(|line| line.split_whitespace().next()).collect();
    Ok(submitted.jobs.into_iter().filter(|(_, number)| open.contains(&number.as_str())).collect())
}

/// Returns the output of `hq` in its mode for scripts. `more` is added to the error if there is no such
/// command.
fn call(arguments: &[&str], more: &str) -> Result<String, ClusterError> {
    let hint = format!("install HyperQueue and start `hq server start`{more}");
    output_of("hq", &["--output-mode", "quiet"], arguments, &hint)
}
