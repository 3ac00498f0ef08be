//! The work: a batch or one stage is run, a cache is verified and cleaned, and artifacts are transferred.

mod again;
pub mod gc;
pub(crate) mod job;
pub(crate) mod runner;
pub(crate) mod summary;
pub(crate) mod sync;
pub(crate) mod text;
pub mod verify;

pub use runner::RunOptions;
pub use summary::{NodeResult, RanNode, Summary};
