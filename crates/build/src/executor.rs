//! The places where a run's jobs are done.
//!
//! The run chooses the next job and keeps within the limits of cores and memory; an [`Executor`] does the
//! job. [`Threads`] does it in this process. Another executor may pass a [`Task`] to another process or
//! machine that shares the same cache. An artifact is found by its key, so once it exists, [`Task::run`]
//! finds it and returns at once. An executor that cannot pass a task on simply runs it.

use std::fmt;

use super::key::Key;

/// One node's work: data for an executor that passes it on, and the work itself.
pub struct Task<'t> {
    /// The pipeline.
    pub pipeline: &'t str,
    /// Scene, variant and stage, for display.
    pub label: String,
    /// The stage.
    pub stage: &'static str,
    /// The key of the artifact to make.
    pub key: Key,
    /// Threads to use.
    pub threads: usize,
    /// Estimated memory in bytes.
    pub memory: u64,
    pub(crate) work: Box<dyn FnOnce() + Send + 't>,
}

impl Task<'_> {
    /// Does the work and reports the result to the run. It uses the artifact if it exists, or computes it, or
    /// reports that another process computes it, so that the run can take another node meanwhile.
    pub fn run(self) {
        (self.work)();
    }
}

impl fmt::Debug for Task<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { label, key, threads, memory, .. } = self;
        write!(f, "{label}, key {}, {threads} threads, {memory} bytes", key.short())
    }
}

/// Accepts tasks during a run.
pub trait Starter<'t> {
    /// Starts a task. [`Task::run`] must be called exactly once, even after a failure, at any time and on any
    /// thread; an interruption reaches the work through it.
    fn start(&self, task: Task<'t>);
}

/// Does the jobs of runs.
pub trait Executor: fmt::Debug + Send + Sync {
    /// Calls `decide` once with the starter that accepts its tasks, and returns when `decide` has returned
    /// and every task has run.
    fn serve<'t>(&self, decide: &mut dyn FnMut(&dyn Starter<'t>));
}

/// Runs every task on a thread of its own in this process.
#[derive(Clone, Copy, Debug, Default)]
pub struct Threads;

impl Executor for Threads {
    fn serve<'t>(&self, decide: &mut dyn FnMut(&dyn Starter<'t>)) {
        std::thread::scope(|scope| decide(&Scoped(scope)));
    }
}

struct Scoped<'s, 't>(&'s std::thread::Scope<'s, 't>);

impl<'t> Starter<'t> for Scoped<'_, 't> {
    fn start(&self, task: Task<'t>) {
        self.0.spawn(move || task.run());
    }
}
