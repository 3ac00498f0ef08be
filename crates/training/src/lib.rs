//! Parts that both training loops share: their skeleton, observers, checkpoints, view order, the guard
//! against non-finite numbers, profiles.
//!
//! The work of the loops is in `reconstruct` and `enhance`; a [`Session`] runs it. The loops report to an
//! [`Observer`] and stop at its request. They keep their state in [`Checkpoints`] that are complete or absent
//! and separate for each run. They draw views through a [`ViewOrder`] that is a function of (seed, step), and
//! measure their [`Pace`]. They check numbers with the [`guard`], so that a run that has diverged reports the
//! place. An engine does the work of a step, and fails with an [`EngineError`].
//!
//! This crate contains no losses, no gradients and no optimiser.

mod chain;
pub mod checkpoint;
mod choice;
mod engine;
pub mod guard;
mod observer;
mod order;
mod pace;
mod profile;
mod session;
#[cfg(test)]
mod test_support;

pub use chain::{Checkpoints, Resumable, ResumePoint};
pub use checkpoint::{CheckpointError, CheckpointFile};
pub use choice::{EngineChoice, UnknownEngine};
pub use engine::{Drain, EngineError};
pub use guard::NonFinite;
pub use observer::{Observer, Silent, Snapshot, StopFlag, TrainingProgress};
pub use order::ViewOrder;
pub use pace::Pace;
pub use profile::{Part, Profile};
pub use session::{Session, SessionEnd, Steps};
