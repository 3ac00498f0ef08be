//! What both training loops share: observers, checkpoints, view order, the guard against non-finite numbers, profiles.
//!
//! The loops themselves live in `reconstruct` and `enhance`. They tell an [`Observer`] what happens and ask it whether to stop,
//! keep their state in [`Checkpoints`] that are whole or absent and their own, draw views through a [`ViewOrder`] that is a function of
//! (seed, step), tell their [`Pace`], and hand numbers to the [`guard`] so that a run that has diverged says where.

mod chain;
pub mod checkpoint;
pub mod guard;
mod observer;
mod order;
mod pace;
mod profile;

pub use chain::{Checkpoints, Found, Resumable};
pub use checkpoint::{CheckpointError, CheckpointFile};
pub use guard::NonFinite;
pub use observer::{Observer, Progress, Silent, StopFlag};
pub use order::ViewOrder;
pub use pace::Pace;
pub use profile::{Part, Profile};
