//! Who watches a long loop, and may ask it to stop.

use std::any::Any;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Where a loop is. Optional numbers are absent where a loop has none.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Progress {
    /// Steps done.
    pub step: u64,
    /// Steps in all.
    pub steps: u64,
    /// Smoothed loss.
    pub loss: Option<f64>,
    /// Smoothed PSNR of the training views, dB.
    pub psnr: Option<f64>,
    /// PSNR of the held-out views when they were last measured, dB.
    pub held_out_psnr: Option<f64>,
    /// Gaussians in the scene.
    pub gaussians: Option<usize>,
    /// Steps per second over the last seconds.
    pub steps_per_second: Option<f64>,
    /// Seconds left, by that pace and what the steps to come are known to cost.
    pub seconds_left: Option<f64>,
}

/// What is being trained as it stands after a step, copied so that it may be looked at in another thread
/// while training goes on. Which type it is, the loop's crate says: this one knows no scenes.
pub type Snapshot = Arc<dyn Any + Send + Sync>;

/// Watches a loop. Every method has a default that does nothing, so a test may pass [`Silent`].
pub trait Observer {
    /// After every step; implementations decide how often to show it.
    fn progress(&mut self, _progress: &Progress) {}

    /// Something a person should know, said once: a fallback taken, a cap that bites.
    fn notice(&mut self, _message: &str) {}

    /// Whether the loop should write its checkpoint and leave. Asked after every step.
    fn should_stop(&self) -> bool {
        false
    }

    /// Whether somebody wants to see what is being trained. Asked after every step; whatever
    /// the answer, results are the same.
    fn wants_view(&self) -> bool {
        false
    }

    /// What is being trained, for who wanted it.
    fn view(&mut self, _view: Snapshot) {}
}

/// Watches nothing and never stops anything.
#[derive(Clone, Copy, Debug, Default)]
pub struct Silent;

impl Observer for Silent {}

/// A request to stop that can be raised from another thread or a signal handler.
#[derive(Clone, Debug, Default)]
pub struct StopFlag(Arc<AtomicBool>);

impl StopFlag {
    /// A flag that is down.
    pub fn new() -> Self {
        Self::default()
    }

    /// Asks to stop.
    pub fn raise(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Whether someone asked.
    pub fn is_raised(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    /// The shared flag itself, as signal handlers want it.
    pub fn shared(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.0)
    }
}

impl Observer for StopFlag {
    fn should_stop(&self) -> bool {
        self.is_raised()
    }
}
