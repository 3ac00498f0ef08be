//! Where a run's jobs are done.
//!
//! The run decides what is to be done next and within which cores and memory; an [`Executor`] does it.
//! [`Threads`] does it in this process. Another executor may hand a [`Task`] to another process or machine
//! that sees the same cache: an artifact is found by its key, so once it is there [`Task::run`] finds it made
//! and returns at once. What an executor cannot have done elsewhere it simply runs.

use std::fmt;

use super::key::Key;

/// One node's work: data for whoever hands it on, and the work itself.
pub struct Task<'t> {
    /// The pipeline.
    pub pipeline: &'t str,
    /// The node in words: scene, variant and stage.
    pub label: String,
    /// The stage.
    pub stage: &'static str,
    /// The key of the artifact that is wanted.
    pub key: Key,
    /// Threads to use.
    pub threads: usize,
    /// About how much memory it takes, bytes.
    pub memory: u64,
    pub(crate) work: Box<dyn FnOnce() + Send + 't>,
}

impl Task<'_> {
    /// Does the work and tells the run how it ended: takes what is there, computes, or says that another
    /// process computes it, so that the run takes something else meanwhile.
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

/// Takes tasks while a run lasts.
pub trait Starter<'t> {
    /// Starts a task. Whatever becomes of it, [`Task::run`] is called once, at any time and on any thread,
    /// and an interruption reaches the work through it.
    fn start(&self, task: Task<'t>);
}

/// Does the jobs of runs.
pub trait Executor: fmt::Debug + Send + Sync {
    /// Calls `decide` once with what takes its tasks, and returns when `decide` has returned and every task
    /// has run.
    fn serve<'t>(&self, decide: &mut dyn FnMut(&dyn Starter<'t>));
}

/// Every task on a thread of its own in this process.
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
