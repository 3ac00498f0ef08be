//! The schedulers behind one set of functions.

use std::fmt::Write;
use std::time::Duration;

use super::jobs::Job;
use super::site::{Scheduler, Site};
use super::submission::{Submission, Submitted};
use super::{ClusterError, hyperqueue, slurm};

/// The longest time that Slurm needs to find that a job can never run.
const EXAMINED: Duration = Duration::from_secs(2);

impl Scheduler {
    /// The scheduler of a submission.
    pub fn of(submitted: &Submitted) -> Self {
        if submitted.scheduler == "hq" { Self::HyperQueue } else { Self::Slurm }
    }

    /// Its name, its word on the command line, and its command that cancels a job.
    pub fn words(self) -> [&'static str; 3] {
        match self {
            Self::Slurm => ["Slurm", "slurm", "scancel"],
            Self::HyperQueue => ["HyperQueue", "hq", "hq job cancel"],
        }
    }

    /// The jobs of a submission that have not ended, by name and number.
    ///
    /// # Errors
    /// The scheduler does not answer.
    pub fn still_queued(self, submitted: Submitted) -> Result<Vec<(String, String)>, ClusterError> {
        match self {
            Self::Slurm => slurm::still_queued(submitted),
            Self::HyperQueue => hyperqueue::still_queued(submitted),
        }
    }

    /// Writes the files of a submission.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn write(self, jobs: &[Job], submission: &Submission, site: &Site) -> Result<(), ClusterError> {
        match self {
            Self::Slurm => slurm::write(jobs, submission, site),
            Self::HyperQueue => hyperqueue::write(jobs, submission, site),
        }
    }

    /// Submits the files that were written.
    ///
    /// # Errors
    /// The scheduler refuses a job; none stays in the queue.
    pub fn submit(self, jobs: &[Job], submission: &Submission) -> Result<Submitted, ClusterError> {
        match self {
            Self::Slurm => slurm::submit(jobs, submission),
            Self::HyperQueue => hyperqueue::submit(submission),
        }
    }

    /// Cancels jobs by their numbers.
    ///
    /// # Errors
    /// The scheduler refuses.
    pub fn cancel(self, numbers: &[String]) -> Result<(), ClusterError> {
        match self {
            Self::Slurm => slurm::cancel(numbers),
            Self::HyperQueue => hyperqueue::cancel(numbers),
        }
    }

    /// The files that would be written, with the commands that would submit them.
    pub fn preview(self, jobs: &[Job], submission: &Submission, site: &Site) -> String {
        let mut text = String::new();
        // Writing to a text does not fail.
        let _ = match self {
            Self::Slurm => jobs.iter().enumerate().try_for_each(|(at, job)| {
                let before: Vec<String> =
                    jobs[..at].iter().map(|job| format!("NUMBER_OF_{}", job.name)).collect();
                let dependency = slurm::dependency(job, &before).unwrap_or_default();
                writeln!(text, "\n--- sbatch {dependency} {}", submission.script_path(job).display())?;
                text += &slurm::script(job, submission, site);
                let list = submission.list_path(job);
                job.list().lines().try_for_each(|line| writeln!(text, "--- {}: {line}", list.display()))
            }),
            Self::HyperQueue => write!(
                text,
                "\n--- {}\n{}\n--- hq job submit-file {}\n{}",
                hyperqueue::script_path(submission).display(),
                hyperqueue::script(submission, site),
                hyperqueue::file_path(submission).display(),
                hyperqueue::file(jobs, submission)
            ),
        };
        text
    }

    /// Warnings about submitted jobs that will never start, because the site has no place for their requests.
    /// This waits until the scheduler knows, or for two seconds.
    pub fn warnings(self, jobs: &[Job], submitted: &Submitted) -> Vec<String> {
        if self == Self::HyperQueue {
            let warning = |(asked, jobs): (String, Vec<&str>)| {
                format!(
                    "no worker of now has {asked} for {}; tasks wait until one comes: start a larger worker with \
                     `hq worker start`, or write cpus, memory and time of your workers into \
                     --cluster FILE (docs/reference/cluster.md), run `use3d cancel`, and submit again",
                    jobs.join(", ")
                )
            };
            return hyperqueue::unserved(jobs).into_iter().map(warning).collect();
        }
        let numbers: Vec<String> = submitted.jobs.iter().map(|(_, number)| number.clone()).collect();
        let warning = |(number, reason): (String, String)| {
            let why = match reason.contains("NotAllowed") {
                true => "your account may not use it; write account or qos of the site into",
                false => {
                    "no node of its partition has what it requests; write partition, cpus, memory and time of the \
                     site into"
                }
            };
            format!(
                "job {number} can never start ({reason}): {why} --cluster FILE (docs/reference/cluster.md), run \
                 `use3d cancel`, and submit again"
            )
        };
        slurm::never(&numbers, EXAMINED).into_iter().map(warning).collect()
    }
}
