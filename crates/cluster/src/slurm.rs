//! Slurm: writes a readable script for every job, and calls `sbatch` for one after the other.
//!
//! A task ends before its time limit with a checkpoint and exit code 75: by itself (`--max-time`), or at the
//! signal that Slurm sends before the limit if the node's clock or another queue makes the time shorter. The
//! script then puts the task into the queue again. A task whose work is done ends at once, so tasks may enter
//! the queue again or be submitted twice without harm.

use std::collections::HashMap;
use std::process::Command;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use use3d_workflow::task::{ClusterTask, IsOver};

use super::ClusterError;
use super::jobs::{After, Job};
use super::quote::{word, words};
use super::site::Site;
use super::submission::{Submission, Submitted, begin, put};
use super::time::clock;

/// Time before the limit at which Slurm sends its signal.
const SIGNAL: Duration = Duration::from_secs(120);
/// Time before the limit at which a task should have ended by itself.
const SPARE: Duration = Duration::from_secs(60);

/// The first line of a task's log.
const ATTEMPT: &str = r#"echo "$(date -u +%FT%TZ) $(hostname), attempt $((${SLURM_RESTART_COUNT:-0} + 1))""#;

/// A job as a script for `sbatch`.
pub fn script(job: &Job, submission: &Submission, site: &Site) -> String {
    let mut lines = vec![
        "#!/bin/bash".to_string(),
        format!("# {}", job.about),
        format!(
            "# Written by `{}`. You may read it, edit it, and submit it by hand with `sbatch`.",
            submission.by
        ),
    ];
    let mut option = |text: String| lines.push(format!("#SBATCH {text}"));
    option(format!("--job-name={}", word(&format!("{}-{}", submission.name, job.name))));
    let number = if job.tasks.is_some() { "%A_%a" } else { "%j" };
    // In the name of a log, Slurm treats `%` as the beginning of a number.
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
        lines.push(format!(
            r#"# The scene and variant of this task: the line of the list with its number.
cell=$(sed -n "s/^$SLURM_ARRAY_TASK_ID //p" {list})
[ -n "$cell" ] || exit 0"#
        ));
    }
    lines.push(String::new());
    lines.push(ATTEMPT.to_string());
    let threads = format!(r#"--threads "${{SLURM_CPUS_PER_TASK:-{}}}""#, job.asks.cpus);
    let most = job.asks.time.saturating_sub(SPARE).as_secs();
    let task = words(&submission.task(job));
    let cell = if job.cells.is_empty() { "" } else { r#" --only "$cell""# };
    lines.push(format!("{} {threads} {task} --max-time {most}s{cell} &", words(&site.command())));
    let own = match job.tasks {
        Some(_) => "${SLURM_ARRAY_JOB_ID}_${SLURM_ARRAY_TASK_ID}",
        None => "$SLURM_JOB_ID",
    };
    let requeues = site.requeues;
    lines.push(format!(
        r#"child=$!
# Shortly before the time limit, and on cancellation: write a checkpoint, then end.
trap 'told=1; kill -USR1 "$child" 2>/dev/null' USR1
# Slurm also signals the command itself; two such signals at once count as one.
trap 'told=1; kill -TERM "$child" 2>/dev/null' TERM
told=0; wait "$child"; code=$?
while [ "$told" = 1 ]; do told=0; wait "$child"; code=$?; done
if [ "$code" = 75 ] && [ "${{SLURM_RESTART_COUNT:-0}}" -lt {requeues} ]; then
  # Time limit reached: queue the task again; it continues from the checkpoint.
  scontrol requeue "{own}" && sleep 60
fi
exit "$code"
"#
    ));
    lines.join("\n")
}

/// Writes numbers in the form of Slurm: `0-3,7`.
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

/// The option of `sbatch` with the jobs, by Slurm's numbers, that this one waits for.
pub fn dependency(job: &Job, numbers: &[String]) -> Option<String> {
    let part = |after: &After| {
        let (kind, of) = match after {
            After::Done(of) => ("afterok", of),
            After::Same(of) => ("aftercorr", of),
            After::Over(of) => ("afterany", of),
        };
        Some(format!("{kind}:{}", numbers.get(*of)?))
    };
    let parts: Vec<String> = job.after.iter().filter_map(part).collect();
    (!parts.is_empty()).then(|| format!("--dependency={}", parts.join(",")))
}

/// Writes scripts and lists into the submission's folder.
///
/// # Errors
/// A file cannot be written.
pub fn write(jobs: &[Job], submission: &Submission, site: &Site) -> Result<(), ClusterError> {
    begin(submission)?;
    for job in jobs {
        put(&submission.script_path(job), &script(job, submission, site))?;
        if !job.cells.is_empty() {
            put(&submission.list_path(job), &job.list())?;
        }
    }
    Ok(())
}

/// Submits the written jobs to Slurm, one after the other, and returns their numbers in the same order.
///
/// # Errors
/// `sbatch` does not exist, refuses or does not print a job's number; jobs submitted before are then
/// cancelled.
pub fn submit(jobs: &[Job], submission: &Submission) -> Result<Submitted, ClusterError> {
    let mut numbers: Vec<String> = Vec::new();
    let named = |numbers: &[String]| {
        let jobs = jobs.iter().map(|job| job.name.clone()).zip(numbers.iter().cloned()).collect();
        Submitted { scheduler: "slurm".to_string(), jobs, ..Submitted::default() }
    };
    let scripts = format!("; the scripts lie in {}", submission.folder.display());
    // Half a batch would only wait for the rest. Jobs that could not be cancelled stay in the record.
    let give_up = |numbers: &[String], error: ClusterError| {
        if !numbers.is_empty() && cancel(numbers).is_ok() {
            let _ = submission.keep("", Vec::new());
        }
        Err(error)
    };
    for job in jobs {
        let script = submission.script_path(job).to_string_lossy().into_owned();
        let arguments =
            ["--parsable".to_string()].into_iter().chain(dependency(job, &numbers)).chain([script]);
        match call("sbatch", &arguments.collect::<Vec<_>>(), &scripts).and_then(|said| number(&said)) {
            Ok(number) => {
                numbers.push(number);
                // The file is written at once, so an interrupted `submit` leaves a record of its jobs.
                if let Err(error) = submission.keep("slurm", named(&numbers).jobs) {
                    return give_up(&numbers, error);
                }
            }
            Err(error) => return give_up(&numbers, requested(job, error)),
        }
    }
    Ok(named(&numbers))
}

/// The error of `sbatch` for a job that asks for more than the site has, with the request and its place.
fn requested(job: &Job, error: ClusterError) -> ClusterError {
    match error {
        ClusterError::Command { command, reason } if reason.contains("submission failed") => {
            let within = job.asks.needs.partition.as_ref().map(|name| format!(" in the partition {name}"));
            let reason = format!(
                "{reason}; the job asks for {} and {}{}; if no node has these, write partition, cpus, memory and \
                 time of your site into --cluster FILE (docs/reference/cluster.md)",
                job.asks.words(),
                clock(job.asks.time),
                within.unwrap_or_default()
            );
            ClusterError::Command { command, reason }
        }
        error => error,
    }
}

/// Cancels jobs.
///
/// # Errors
/// There is no `scancel`, or it refuses.
pub fn cancel(numbers: &[String]) -> Result<(), ClusterError> {
    call("scancel", numbers, "").map(drop)
}

/// A value of Slurm's configuration; `None` if it does not say.
fn configured(name: &str) -> Option<String> {
    value_in(&call("scontrol", &["show", "config"], "").ok()?, name)
}

/// The value of a name in a text of lines such as `ClusterName = reef`.
fn value_in(config: &str, name: &str) -> Option<String> {
    let mut values = config.lines().filter_map(|line| line.split_once('='));
    values.find(|(key, _)| key.trim() == name).map(|(_, value)| value.trim().to_string())
}

/// The largest number of tasks in an array by Slurm's configuration; `None` if it does not say.
pub fn largest_array() -> Option<usize> {
    // The largest task number is one less.
    configured("MaxArraySize")?.parse::<usize>().ok()?.checked_sub(1).filter(|most| *most > 0)
}

/// True if a task may be in the queue of the cluster `here`. Another cluster with the same cache has numbers
/// of its own. A task without a cluster's name was started before these were stored.
fn is_of(task: &ClusterTask, here: Option<&str>) -> bool {
    task.scheduler == "slurm" && (task.cluster.is_empty() || here == Some(&task.cluster))
}

/// Returns the jobs that can never start, each with Slurm's reason. A job has the reason `None` until Slurm
/// has examined it, and while it runs; this asks again until no job has, or `patience` is over.
pub fn never(numbers: &[String], patience: Duration) -> Vec<(String, String)> {
    const FOR_EVER: [&str; 6] = [
        "PartitionConfig",
        "PartitionNodeLimit",
        "PartitionTimeLimit",
        "BadConstraints",
        "AccountNotAllowed",
        "QOSNotAllowed",
    ];
    let arguments = ["--noheader", "--array-unique", "--format=%i %r", "--jobs", &numbers.join(",")];
    let start = Instant::now();
    loop {
        let said = call("squeue", &arguments, "").unwrap_or_default();
        let lines = said.lines().filter_map(|line| line.trim().split_once(' '));
        let reasons: Vec<_> = lines.map(|(number, why)| (number, why.trim_matches(['(', ')']))).collect();
        if start.elapsed() < patience && reasons.iter().any(|(_, reason)| *reason == "None") {
            std::thread::sleep(patience / 8);
            continue;
        }
        let stuck = reasons.into_iter().filter(|(_, why)| FOR_EVER.iter().any(|known| why.contains(known)));
        return stuck.map(|(number, reason)| (number.to_string(), reason.to_string())).collect();
    }
}

/// The job's number in the output of `sbatch --parsable`: if there are several clusters, a semicolon and the
/// cluster follow.
fn number(said: &str) -> Result<String, ClusterError> {
    let number = said.trim().split(';').next().unwrap_or_default();
    if !number.is_empty() && number.bytes().all(|b| b.is_ascii_digit()) {
        return Ok(number.to_string());
    }
    let reason = format!(
        "expected the number of a job, but the answer was {:?}; check with `squeue --me` if the job was \
         submitted",
        said.trim()
    );
    Err(ClusterError::Command { command: "sbatch".to_string(), reason })
}

/// Returns the jobs of a submission that are still in Slurm's queue, by name and number. A job that Slurm no
/// longer knows has ended.
///
/// # Errors
/// `squeue` does not exist.
pub fn still_queued(submitted: Submitted) -> Result<Vec<(String, String)>, ClusterError> {
    let mut found = Vec::new();
    for (name, number) in submitted.jobs {
        // One call for each job: an unknown number is an error of the whole call.
        match call("squeue", &["--noheader", "--format=%i", "--jobs", &number], "") {
            Ok(lines) if !lines.trim().is_empty() => found.push((name, number)),
            Ok(_) => {}
            Err(ClusterError::Command { reason, .. }) if reason.contains("Invalid job id") => {}
            Err(error) => return Err(error),
        }
    }
    Ok(found)
}

/// The time for which an answer of Slurm about a task is used again.
const FRESH: Duration = Duration::from_secs(10);

/// Returns a function that asks Slurm if a task is over, so that its queue no longer has it.
pub fn is_over() -> IsOver {
    type Said = HashMap<String, (Instant, Option<bool>)>;
    let said: Mutex<Said> = Mutex::default();
    // Slurm sets the variable in its jobs only.
    let here: OnceLock<Option<String>> = OnceLock::new();
    let ask = || std::env::var("SLURM_CLUSTER_NAME").ok().or_else(|| configured("ClusterName"));
    Arc::new(move |task: &ClusterTask| {
        let named = !task.cluster.is_empty();
        if !is_of(task, named.then(|| here.get_or_init(ask).as_deref()).flatten()) {
            return None;
        }
        let mut said = said.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((at, answer)) = said.get(&task.id)
            && at.elapsed() < FRESH
        {
            return *answer;
        }
        let answer = match call("squeue", &["--noheader", "--format=%T", "--jobs", &task.id], "") {
            // A task that waits for its next start is over too, because its process is gone.
            Ok(states) => Some(states.lines().all(|state| state.trim() == "PENDING")),
            Err(ClusterError::Command { reason, .. }) if reason.contains("Invalid job id") => Some(true),
            Err(_) => None,
        };
        said.insert(task.id.clone(), (Instant::now(), answer));
        answer
    })
}

/// Returns the output of a command of Slurm. `more` is added to the error if there is no such command.
fn call(command: &str, arguments: &[impl AsRef<str>], more: &str) -> Result<String, ClusterError> {
    let hint = format!("submit where Slurm's commands are, such as a login node{more}");
    output_of(command, &[], arguments, &hint)
}

/// Returns the output of a scheduler's command. `hint` is added to the error if there is no such command;
/// other errors name `arguments`, but not `options`.
pub(crate) fn output_of(
    command: &str,
    options: &[&str],
    arguments: &[impl AsRef<str>],
    hint: &str,
) -> Result<String, ClusterError> {
    let wrong = |reason: String| ClusterError::Command { command: command.to_string(), reason };
    let all = options.iter().copied().chain(arguments.iter().map(AsRef::as_ref));
    let output = Command::new(command).args(all).output().map_err(|e| wrong(format!("{e}; {hint}")))?;
    if output.status.success() {
        return Ok(String::from_utf8_lossy(&output.stdout).into_owned());
    }
    let said = String::from_utf8_lossy(&output.stderr);
    Err(wrong(format!("{}: {}", words(arguments), said.trim())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_task_is_looked_for_in_the_queue_of_its_own_cluster_only() {
        let task = |scheduler: &str, cluster: &str| ClusterTask {
            scheduler: scheduler.into(),
            cluster: cluster.into(),
            id: "17".into(),
            attempt: 0,
            memory: 0,
            submission: String::new(),
        };
        assert!(is_of(&task("slurm", "reef"), Some("reef")) && is_of(&task("slurm", ""), None));
        for (other, here) in
            [(task("slurm", "reef"), Some("wreck")), (task("slurm", "reef"), None), (task("hq", ""), None)]
        {
            assert!(!is_of(&other, here), "{other:?} {here:?}");
        }
    }

    #[test]
    fn values_are_found_in_a_configuration() {
        let text =
            "Configuration data as of 2026\nClusterName             = reef\nMaxArraySize            = 1001\n";
        assert_eq!(value_in(text, "ClusterName").as_deref(), Some("reef"));
        assert_eq!(
            (value_in(text, "MaxArraySize").as_deref(), value_in(text, "Array")),
            (Some("1001"), None)
        );
    }
}
