//! What both training loops share: their skeleton, observers, checkpoints, view order, the guard against
//! non-finite numbers, profiles.
//!
//! What the loops do lives in `reconstruct` and `enhance`; a [`Session`] runs it. They tell an [`Observer`]
//! what happens and ask it whether to stop, keep their state in [`Checkpoints`] that are whole or absent and
//! their own, draw views through a [`ViewOrder`] that is a function of (seed, step), tell their [`Pace`], and
//! hand numbers to the [`guard`] so that a run that has diverged says where. The work of a step is an
//! engine's, which fails with an [`EngineError`].

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
mod testing;

pub use chain::{Checkpoints, Found, Resumable};
pub use checkpoint::{CheckpointError, CheckpointFile};
pub use choice::{EngineChoice, UnknownEngine};
pub use engine::{Drain, EngineError};
pub use guard::NonFinite;
pub use observer::{Observer, Progress, Silent, Snapshot, StopFlag};
pub use order::ViewOrder;
pub use pace::Pace;
pub use profile::{Part, Profile};
pub use session::{Ended, Session, Steps};
