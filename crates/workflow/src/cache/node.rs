//! The identity and clock with which a process uses a shared cache: this process and the system's steady
//! clock. Tests use one cache as several machines at once, whose clocks differ.

use std::time::{Duration, Instant};

use crate::cache::machine::{Machine, ProcessId};
use crate::cache::task::{ClusterTask, IsOver};

/// A steady clock: seconds since some moment of its own. The clocks of two machines are never compared.
#[derive(Clone, Copy, Debug)]
pub struct Clock {
    start: Instant,
    offset: Duration,
    rate: f64,
}

impl Clock {
    /// The system's clock.
    pub fn system() -> Self {
        Self { start: Instant::now(), offset: Duration::ZERO, rate: 1.0 }
    }

    /// A clock that is `offset` ahead and runs `rate` (above 0) times as fast, for tests.
    pub fn other(offset: Duration, rate: f64) -> Self {
        Self { offset, rate, ..Self::system() }
    }

    /// The present time of this clock.
    pub fn now(&self) -> Duration {
        self.offset + self.start.elapsed().mul_f64(self.rate)
    }

    /// The real time that passes until this clock has advanced by `time`.
    pub(crate) fn wait_for(&self, time: Duration) -> Duration {
        time.div_f64(self.rate)
    }
}

/// One user of a cache.
#[derive(Clone)]
pub struct Node {
    pub(crate) process: ProcessId,
    pub(crate) host: String,
    pub(crate) clock: Clock,
    /// The task of a scheduler that this process is.
    pub(crate) task: Option<ClusterTask>,
    /// The function that asks a scheduler about tasks.
    pub(crate) is_over: Option<IsOver>,
}

impl Node {
    /// This process.
    pub fn this() -> Self {
        Self {
            process: ProcessId::this(),
            host: Machine::this().host,
            clock: Clock::system(),
            task: ClusterTask::this(),
            is_over: None,
        }
    }

    /// A process of a machine called `host`, for tests: this process cannot check that it runs.
    pub fn elsewhere(host: &str, clock: Clock) -> Self {
        let process =
            ProcessId { place: format!("{host} {:016x}", use3d_files::random()), pid: 1, started: 1 };
        Self { process, host: host.to_string(), clock, task: None, is_over: None }
    }

    /// The same process as a task of a scheduler, for tests.
    #[must_use]
    pub fn in_task(self, task: ClusterTask) -> Self {
        Self { task: Some(task), ..self }
    }

    /// The task that this process is, if it belongs to a submission.
    pub(crate) fn submitted(&self) -> Option<&ClusterTask> {
        self.task.as_ref().filter(|task| !task.submission.is_empty())
    }

    /// Returns true if this process is a later attempt of a task, so that the task is over.
    pub(crate) fn has_followed(&self, task: &ClusterTask) -> bool {
        self.task.as_ref().is_some_and(|own| own.follows(task))
    }

    /// Returns true if the scheduler reports that a task is over.
    pub(crate) fn is_over(&self, task: &ClusterTask) -> bool {
        self.is_over.as_ref().is_some_and(|ask| ask(task) == Some(true))
    }

    /// Returns true if the process runs, false if it has ended, and `None` if it belongs to another machine.
    pub(crate) fn is_alive(&self, process: &ProcessId) -> Option<bool> {
        if process.place != self.process.place {
            return None;
        }
        if *process == self.process { Some(true) } else { process.is_alive() }
    }

    /// A short name for files, shared by all processes of this machine that share its kernel.
    pub(crate) fn machine(&self) -> String {
        use3d_code::digest::Digest::of(self.process.place.as_bytes()).short()
    }

    /// A number of this process. It makes nodes differ in order or time where they should not all act alike.
    pub(crate) fn number(&self) -> u64 {
        let name = use3d_code::digest::Digest::of(self.process.name().as_bytes());
        name.as_bytes().iter().take(8).fold(0, |all, byte| all << 8 | u64::from(*byte))
    }
}
