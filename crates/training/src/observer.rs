//! Observers of a long loop, which may also stop it.

use std::any::Any;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// The progress of a loop. Optional numbers are absent if a loop does not have them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TrainingProgress {
    /// Number of steps done.
    pub step: u64,
    /// Total number of steps.
    pub steps: u64,
    /// Smoothed loss.
    pub loss: Option<f64>,
    /// Smoothed PSNR of the training views, dB.
    pub psnr: Option<f64>,
    /// PSNR of the held-out views when they were last measured, dB.
    pub held_out_psnr: Option<f64>,
    /// Number of Gaussians in the scene.
    pub gaussians: Option<usize>,
    /// Steps per second over the last seconds.
    pub steps_per_second: Option<f64>,
    /// Seconds left, estimated from that pace and the known work of the remaining steps.
    pub seconds_left: Option<f64>,
}

/// A copy of the trained state after a step, so that another thread can read it while training continues. The
/// loop's crate defines its type, because this crate has no type for scenes.
pub type Snapshot = Arc<dyn Any + Send + Sync>;

/// Observes a loop. Every method has a default that does nothing, so a test may pass [`Silent`].
pub trait Observer {
    /// Called after every step; implementations decide how often to display it.
    fn progress(&mut self, _progress: &TrainingProgress) {}

    /// Reports a message for the user, once: a fallback, a limit that was reached.
    fn notice(&mut self, _message: &str) {}

    /// Returns true if the loop should write its checkpoint and stop. Called after every step.
    fn should_stop(&self) -> bool {
        false
    }

    /// Returns true if the observer wants a view of the training. Called after every step; the answer never
    /// changes a result.
    fn wants_view(&self) -> bool {
        false
    }

    /// Receives a view of the training, if one was wanted.
    fn view(&mut self, _view: Snapshot) {}
}

/// Ignores all reports and never stops the loop.
#[derive(Clone, Copy, Debug, Default)]
pub struct Silent;

impl Observer for Silent {}

/// A request to stop that another thread or a signal handler can make.
#[derive(Clone, Debug, Default)]
pub struct StopFlag(Arc<AtomicBool>);

impl StopFlag {
    /// A flag that is not set.
    pub fn new() -> Self {
        Self::default()
    }

    /// Requests a stop.
    pub fn raise(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Returns true if a stop was requested.
    pub fn is_raised(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    /// The shared flag itself, in the form for signal handlers.
    pub fn shared(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.0)
    }
}

impl Observer for StopFlag {
    fn should_stop(&self) -> bool {
        self.is_raised()
    }
}
