//! The errors of engines on all devices.
//!
//! A training loop decides *what* to do; an engine holds parameters, moments and buffers and does it, on the
//! processor or on another device. The interfaces are traits of `reconstruct` and `enhance`. Both fail in the
//! same ways, and a loop handles the errors alike: the run ends with the error, and names the earlier
//! checkpoint from which any engine can resume.

use std::error::Error;

/// The error of an engine.
#[derive(Debug, thiserror::Error)]
pub enum EngineError {
    /// The device has not enough memory.
    #[error(
        "the engine `{engine}` is out of memory: {what}; use smaller images or fewer Gaussians, or another engine"
    )]
    OutOfMemory {
        /// The engine's name.
        engine: &'static str,
        /// The purpose of the memory, and its size if it is known.
        what: String,
    },
    /// The device does not answer any more: it was reset or removed, or its driver failed.
    #[error("the engine `{engine}` lost its device ({reason})")]
    DeviceLost {
        /// The engine's name.
        engine: &'static str,
        /// The driver's error.
        reason: String,
    },
    /// The state has another version, or is not consistent with itself or with the uploaded data.
    #[error("the training state cannot be used: {0}")]
    State(String),
    /// The request makes no sense, such as a step on a view that was never uploaded.
    #[error("the engine `{engine}` cannot do that: {what}")]
    Request {
        /// The engine's name.
        engine: &'static str,
        /// The request, and the expected one.
        what: String,
    },
    /// A computation failed.
    #[error(transparent)]
    Failed(Box<dyn Error + Send + Sync>),
}

/// The reports for which a loop waits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Drain {
    /// The finished ones; possibly none, if every step is still running.
    Ready,
    /// All: afterwards every requested step is done and reported.
    All,
}
