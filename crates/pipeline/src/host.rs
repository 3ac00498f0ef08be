//! The process in which work runs: its threads, its stop flag, and the listener of its progress.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use use3d_workflow::{Event, Listener, RunOptions};

/// The data that every work gets from its process.
#[derive(Clone)]
pub struct Host {
    /// Number of threads for computing.
    pub threads: usize,
    /// Set when the work shall end.
    pub stop: Arc<AtomicBool>,
    /// Gets the events of stages.
    pub listener: Arc<dyn Listener>,
}

impl Host {
    /// The same host, whose events `hear` gets too.
    pub fn heard_by(&self, hear: impl Fn(&Event<'_>) + Send + Sync + 'static) -> Self {
        let inner = self.listener.clone();
        let listener = Arc::new(move |event: &Event<'_>| {
            inner.event(event);
            hear(event);
        });
        Self { listener, ..self.clone() }
    }

    /// True if the work shall end.
    pub fn stops(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// Reports the progress of work that is no stage of a pipeline.
    pub fn progress(&self, label: &str, done: u64, total: u64, unit: &str, message: &str) {
        let event = Event::Progress { node: 0, label, done, total, unit, message, seconds_left: None };
        self.listener.event(&event);
    }

    /// Reports the end of such work.
    pub fn over(&self, label: &str) {
        self.listener.event(&Event::Done { node: 0, label, cached: true, seconds: 0.0 });
    }

    /// The default options of a run in this process.
    pub fn options(&self) -> RunOptions {
        RunOptions { cores: self.threads, stop: self.stop.clone(), ..RunOptions::default() }
    }
}
