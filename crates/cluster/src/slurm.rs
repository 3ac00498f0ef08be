//! Slurm: a readable script for every job, and `sbatch` for each in turn.
//!
//! A task leaves before its limit with a checkpoint and the exit code 75, by itself (`--max-time`) or, where
//! the node's clock or another queue cuts it shorter, at the signal that Slurm sends before; the script then
//! has it queued again. A task that finds its work done ends at once, so that tasks may be queued again or
//! submitted twice without harm.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use use3d_build::FileError;
use use3d_build::files::{Disk, write_atomic};
use use3d_build::task::{IsOver, Task};

use super::ClusterError;
use super::jobs::{After, Job};
use super::quote::{word, words};
use super::site::Site;
use super::time::clock;

/// How long before the limit Slurm sends its signal.
const SIGNAL: Duration = Duration::from_secs(120);
/// How long before the limit a task is to be gone by itself.
const SPARE: Duration = Duration::from_secs(60);

/// The first line of a task's log.
const ATTEMPT: &str = r#"echo "$(date -u +%FT%TZ) $(hostname), attempt $((${SLURM_RESTART_COUNT:-0} + 1))""#;

/// What all jobs of a submission have in common.
#[derive(Clone, Debug)]
pub struct Submission {
    /// The pipeline's name.
    pub name: String,
    /// The command line that wrote the scripts, for their readers.
    pub by: String,
    /// Where `use3d run` is to be started.
    pub place: PathBuf,
    /// The words after `use3d run`, the same for all jobs.
    pub run: Vec<String>,
    /// The words that say where results go.
    pub results: Vec<String>,
    /// The folder of the scripts, lists and logs.
    pub folder: PathBuf,
    /// Environment variables that tasks need and that a scheduler may not hand on, with their values.
    pub variables: Vec<(String, String)>,
}

/// The jobs of a submission that the scheduler knows.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Submitted {
    /// `slurm` or `hq`.
    #[serde(default)]
    pub scheduler: String,
    /// Name and the scheduler's number of each.
    pub jobs: Vec<(String, String)>,
}

impl Submitted {
    /// What was submitted last from a folder.
    pub fn read(folder: &Path) -> Self {
        let text = std::fs::read_to_string(folder.join("submitted.json")).unwrap_or_default();
        serde_json::from_str(&text).unwrap_or_default()
    }
}

impl Submission {
    /// The script of a job.
    pub fn script_path(&self, job: &Job) -> PathBuf {
        self.folder.join(format!("{}.sbatch", job.name))
    }

    /// The list of a job's tasks.
    pub fn list_path(&self, job: &Job) -> PathBuf {
        self.folder.join(format!("{}.tasks", job.name))
    }

    /// The jobs of the last submission from this folder.
    pub(crate) fn submitted(&self) -> Submitted {
        Submitted::read(&self.folder)
    }

    /// Keeps what was submitted, for [`Self::submitted`].
    pub(crate) fn keep(&self, submitted: &Submitted) -> Result<(), ClusterError> {
        let text = serde_json::to_string_pretty(submitted).unwrap_or_default();
        put(&self.folder.join("submitted.json"), &text)
    }

    /// A script's lines for the variables. The networks are those that were there at submission, or none:
    /// what a task's machine names would give its stages other keys than were planned.
    pub(crate) fn exports(&self) -> Vec<String> {
        let exports = self.variables.iter().map(|(name, value)| format!("export {name}={}", word(value)));
        ["unset USE3D_MODELS".to_string()].into_iter().chain(exports).collect()
    }

    /// The words of a task of a job after the command's name; the task's own scene and variant come last.
    pub(crate) fn task(&self, job: &Job) -> Vec<String> {
        let own = if job.delivers { &self.results } else { &Vec::new() };
        [&["run".to_string()][..], &self.run, own, &job.words].concat()
    }
}

/// A job as a script for `sbatch`.
pub fn script(job: &Job, submission: &Submission, site: &Site) -> String {
    let mut lines = vec![
        "#!/bin/bash".to_string(),
        format!("# {}", job.about),
        format!(
            "# Written by `{}`; to be read, edited, and submitted by hand with `sbatch` as well.",
            submission.by
        ),
    ];
    let mut option = |text: String| lines.push(format!("#SBATCH {text}"));
    option(format!("--job-name={}", word(&format!("{}-{}", submission.name, job.name))));
    let number = if job.tasks.is_some() { "%A_%a" } else { "%j" };
    // In a name of a log, Slurm reads `%` as the beginning of a number.
    let log = submission.folder.join("logs").join(&job.name).to_string_lossy().replace('%', "%%");
    option(format!("--output={}", word(&format!("{log}-{number}.log"))));
    option("--open-mode=append".to_string());
    if let Some(tasks) = &job.tasks {
        option(format!("--array={}%{}", ranges(tasks), job.at_once));
    }
    option(format!("--time={}", clock(job.asks.time)));
    option(format!("--mem={}M", job.asks.memory.div_ceil(1_048_576)));
    option(format!("--cpus-per-task={}", job.asks.cpus));
    if let Some(partition) = job.asks.needs.partition.as_ref().or(site.partition.as_ref()) {
        option(format!("--partition={partition}"));
    }
    if let Some(account) = &site.account {
        option(format!("--account={account}"));
    }
    option(format!("--signal=B:USR1@{}", SIGNAL.as_secs()));
    option("--requeue".to_string());
    option("--kill-on-invalid-dep=yes".to_string());
    site.options.iter().chain(&job.asks.needs.options).for_each(|o| option(o.clone()));
    lines.push(String::new());
    lines.push(format!("cd {} || exit 1", word(&submission.place.to_string_lossy())));
    lines.extend(submission.exports());
    lines.extend(site.setup.iter().cloned());
    if !job.cells.is_empty() {
        let list = word(&submission.list_path(job).to_string_lossy());
        lines.push("# The scene and variant of this task: the line of the list with its number.".to_string());
        lines.push(format!(r#"cell=$(sed -n "s/^$SLURM_ARRAY_TASK_ID //p" {list})"#));
        lines.push(r#"[ -n "$cell" ] || exit 0"#.to_string());
    }
    lines.push(String::new());
    lines.push(ATTEMPT.to_string());
    let threads = format!(r#"--threads "${{SLURM_CPUS_PER_TASK:-{}}}""#, job.asks.cpus);
    let most = job.asks.time.saturating_sub(SPARE).as_secs();
    let task = words(&submission.task(job));
    let cell = if job.cells.is_empty() { "" } else { r#" --only "$cell""# };
    lines.push(format!("{} {threads} {task} --max-time {most}s{cell} &", words(&site.command)));
    lines.push("child=$!".to_string());
    lines.push(
        "# Shortly before the limit, and when it is cancelled: a checkpoint, then the end.".to_string(),
    );
    lines.push(r#"trap 'told=1; kill -USR1 "$child" 2>/dev/null' USR1"#.to_string());
    lines
        .push("# Slurm tells the command itself as well; two such signals at once count as one.".to_string());
    lines.push(r#"trap 'told=1; kill -TERM "$child" 2>/dev/null' TERM"#.to_string());
    lines.push(r#"told=0; wait "$child"; code=$?"#.to_string());
    lines.push(r#"while [ "$told" = 1 ]; do told=0; wait "$child"; code=$?; done"#.to_string());
    lines.push(format!(
        r#"if [ "$code" = 75 ] && [ "${{SLURM_RESTART_COUNT:-0}}" -lt {} ]; then"#,
        site.requeues
    ));
    lines.push("  # Out of time: into the queue again, to go on from the checkpoint.".to_string());
    let own = if job.tasks.is_some() {
        r#""${SLURM_ARRAY_JOB_ID}_${SLURM_ARRAY_TASK_ID}""#
    } else {
        r#""$SLURM_JOB_ID""#
    };
    lines.push(format!("  scontrol requeue {own} && sleep 60"));
    lines.push("fi".to_string());
    lines.push(r#"exit "$code""#.to_string());
    lines.join("\n") + "\n"
}

/// Numbers as Slurm reads them: `0-3,7`.
fn ranges(numbers: &[usize]) -> String {
    let mut parts: Vec<(usize, usize)> = Vec::new();
    for &number in numbers {
        match parts.last_mut() {
            Some((_, last)) if *last + 1 == number => *last = number,
            _ => parts.push((number, number)),
        }
    }
    let text = |(first, last): (usize, usize)| {
        if first == last { first.to_string() } else { format!("{first}-{last}") }
    };
    parts.into_iter().map(text).collect::<Vec<_>>().join(",")
}

/// What `sbatch` is told besides the script: on which jobs, by Slurm's numbers, this one waits.
pub fn dependency(job: &Job, numbers: &[String]) -> Option<String> {
    let part = |after: &After| match after {
        After::Done(of) => Some(format!("afterok:{}", numbers.get(*of)?)),
        After::Same(of) => Some(format!("aftercorr:{}", numbers.get(*of)?)),
        After::Over(of) => Some(format!("afterany:{}", numbers.get(*of)?)),
    };
    let parts: Vec<String> = job.after.iter().filter_map(part).collect();
    (!parts.is_empty()).then(|| format!("--dependency={}", parts.join(",")))
}

/// Writes scripts and lists into the submission's folder.
///
/// # Errors
/// A file that cannot be written.
pub fn write(jobs: &[Job], submission: &Submission, site: &Site) -> Result<(), ClusterError> {
    create_logs(submission)?;
    for job in jobs {
        put(&submission.script_path(job), &script(job, submission, site))?;
        if !job.cells.is_empty() {
            put(&submission.list_path(job), &job.list())?;
        }
    }
    Ok(())
}

/// Hands the written jobs to Slurm, one after the other; their numbers in the same order.
///
/// # Errors
/// `sbatch` that is not there, refuses or does not say a job's number; what it had taken before is cancelled.
pub fn submit(jobs: &[Job], submission: &Submission) -> Result<Submitted, ClusterError> {
    let mut numbers: Vec<String> = Vec::new();
    let named = |numbers: &[String]| {
        let jobs = jobs.iter().map(|job| job.name.clone()).zip(numbers.iter().cloned()).collect();
        Submitted { scheduler: "slurm".to_string(), jobs }
    };
    let scripts = format!("; the scripts lie in {}", submission.folder.display());
    for job in jobs {
        let script = submission.script_path(job).to_string_lossy().into_owned();
        let arguments =
            ["--parsable".to_string()].into_iter().chain(dependency(job, &numbers)).chain([script]);
        match call("sbatch", &arguments.collect::<Vec<_>>(), &scripts).and_then(|said| number(&said)) {
            Ok(number) => {
                numbers.push(number);
                // At once: whoever is cut off here has jobs in the queue, and is to find them.
                submission.keep(&named(&numbers))?;
            }
            Err(error) => {
                if !numbers.is_empty() {
                    // Half a batch would only wait for the rest.
                    let _ = call("scancel", &numbers, "");
                    submission.keep(&Submitted::default())?;
                }
                return Err(error);
            }
        }
    }
    Ok(named(&numbers))
}

/// Cancels jobs.
///
/// # Errors
/// `scancel` that is not there or refuses.
pub fn cancel(numbers: &[String]) -> Result<(), ClusterError> {
    call("scancel", numbers, "").map(drop)
}

/// How many tasks an array may have, as Slurm's configuration says; `None` where it does not say.
pub fn largest_array() -> Option<usize> {
    let said = call("scontrol", &["show".to_string(), "config".to_string()], "").ok()?;
    let line = said.lines().find(|line| line.trim_start().starts_with("MaxArraySize"))?;
    // The largest number of a task is one less.
    line.split_once('=')?.1.trim().parse::<usize>().ok()?.checked_sub(1).filter(|most| *most > 0)
}

/// Jobs of these that wait for what they will never get, each with Slurm's reason.
pub fn never(numbers: &[String]) -> Vec<(String, String)> {
    const FOR_EVER: [&str; 6] = [
        "PartitionConfig",
        "PartitionNodeLimit",
        "PartitionTimeLimit",
        "BadConstraints",
        "AccountNotAllowed",
        "QOSNotAllowed",
    ];
    let arguments = ["--noheader", "--array-unique", "--format=%i %r", "--jobs"].map(String::from);
    let arguments: Vec<String> = arguments.into_iter().chain([numbers.join(",")]).collect();
    let said = call("squeue", &arguments, "").unwrap_or_default();
    let lines = said.lines().filter_map(|line| line.trim().split_once(' '));
    let stuck = lines.filter(|(_, reason)| FOR_EVER.iter().any(|known| reason.contains(known)));
    stuck.map(|(number, reason)| (number.to_string(), reason.trim_matches(['(', ')']).to_string())).collect()
}

/// The job's number in what `sbatch --parsable` prints: behind a semicolon stands the cluster where there are several.
fn number(said: &str) -> Result<String, ClusterError> {
    let number = said.trim().split(';').next().unwrap_or_default();
    if !number.is_empty() && number.bytes().all(|b| b.is_ascii_digit()) {
        return Ok(number.to_string());
    }
    let reason = format!(
        "expected the number of a job, and it said: {:?}; see with `squeue --me` whether it took the job",
        said.trim()
    );
    Err(ClusterError::Command { command: "sbatch".to_string(), reason })
}

/// The jobs of the last submission from this folder that Slurm still has in its queue, by name and number.
/// What Slurm does not know any more is over.
///
/// # Errors
/// `squeue` that is not there.
pub fn queued(submission: &Submission) -> Result<Vec<(String, String)>, ClusterError> {
    let mut found = Vec::new();
    for (name, number) in submission.submitted().jobs {
        // Asked for one by one: a number that Slurm has forgotten is an error of the whole call.
        let arguments = ["--noheader", "--format=%i", "--jobs", &number].map(String::from);
        match call("squeue", &arguments, "") {
            Ok(lines) if !lines.trim().is_empty() => found.push((name, number)),
            Ok(_) => {}
            Err(ClusterError::Command { reason, .. }) if reason.contains("Invalid job id") => {}
            Err(error) => return Err(error),
        }
    }
    Ok(found)
}

/// How long Slurm's word about a task is taken for true, and a silence for a silence.
const FRESH: Duration = Duration::from_secs(10);

/// Asks Slurm whether a task is over: whether its queue does not have it any more.
pub fn is_over() -> IsOver {
    type Said = HashMap<String, (Instant, Option<bool>)>;
    let said: Mutex<Said> = Mutex::default();
    Arc::new(move |task: &Task| {
        if task.scheduler != "slurm" {
            return None;
        }
        let mut said = said.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((at, answer)) = said.get(&task.id)
            && at.elapsed() < FRESH
        {
            return *answer;
        }
        let arguments = ["--noheader", "--format=%T", "--jobs", &task.id].map(String::from);
        let answer = match call("squeue", &arguments, "") {
            // One that waits to be started again is over, too: its process is gone.
            Ok(states) => Some(states.lines().all(|state| state.trim() == "PENDING")),
            Err(ClusterError::Command { reason, .. }) if reason.contains("Invalid job id") => Some(true),
            Err(_) => None,
        };
        said.insert(task.id.clone(), (Instant::now(), answer));
        answer
    })
}

/// What a command of Slurm's prints. `more` is said where there is no such command.
fn call(command: &str, arguments: &[String], more: &str) -> Result<String, ClusterError> {
    let wrong = |reason: String| ClusterError::Command { command: command.to_string(), reason };
    let output = Command::new(command)
        .args(arguments)
        .output()
        .map_err(|e| wrong(format!("{e}; submit where Slurm's commands are, such as a login node{more}")))?;
    if output.status.success() {
        return Ok(String::from_utf8_lossy(&output.stdout).into_owned());
    }
    let said = String::from_utf8_lossy(&output.stderr);
    Err(wrong(format!("{}: {}", words(arguments), said.trim())))
}

/// Creates the folder for the logs of a submission's tasks.
pub(crate) fn create_logs(submission: &Submission) -> Result<(), ClusterError> {
    let path = submission.folder.join("logs");
    let created = std::fs::create_dir_all(&path);
    Ok(created.map_err(|source| FileError { path, doing: "create", source })?)
}

/// Puts a file in place of another one. A shell that is in the middle of the one before reads on in that one.
pub(crate) fn put(path: &Path, text: &str) -> Result<(), ClusterError> {
    Ok(write_atomic(&Disk, path, text.as_bytes())?)
}
