//! What may go wrong in an engine, wherever it computes.
//!
//! A training loop decides *what* happens; an engine holds parameters, moments and buffers and does it, on
//! the processor or on another device. The seams are traits of `reconstruct` and `enhance`; both fail in the
//! same ways, and a loop treats them alike: the run ends with the error, and says which checkpoint, written
//! before, any engine can go on from.

use std::error::Error;

/// An engine could not do what it was asked to.
#[derive(Debug, thiserror::Error)]
pub enum EngineError {
    /// The device's memory does not suffice.
    #[error(
        "the engine `{engine}` is out of memory: {what}; use smaller images or fewer Gaussians, or another engine"
    )]
    OutOfMemory {
        /// The engine's name.
        engine: &'static str,
        /// What it needed memory for, and how much, as far as that is known.
        what: String,
    },
    /// The device does not answer any more: it was reset or removed, or its driver gave up.
    #[error("the engine `{engine}` lost its device ({reason})")]
    DeviceLost {
        /// The engine's name.
        engine: &'static str,
        /// What the driver said.
        reason: String,
    },
    /// A state that is of another version, or that does not agree with itself or with what was uploaded.
    #[error("the training state cannot be used: {0}")]
    State(String),
    /// A request that makes no sense, such as a step on a view that was never uploaded.
    #[error("the engine `{engine}` cannot do that: {what}")]
    Request {
        /// The engine's name.
        engine: &'static str,
        /// What was asked, and what would be right.
        what: String,
    },
    /// A computation failed.
    #[error(transparent)]
    Failed(Box<dyn Error + Send + Sync>),
}

/// Which reports a loop waits for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Drain {
    /// Those that are there; none where every step is still under way.
    Ready,
    /// All: every step that was asked for is done and reported afterwards.
    All,
}
