//! The graph of a batch, the keys of its nodes, the states that they have, and the forecast of a run.

pub(crate) mod builder;
mod devices;
pub(crate) mod gaps;
pub mod graph;
pub mod history;
mod layers;
pub mod picture;
pub(crate) mod planning;
pub(crate) mod resolve;
pub mod status;

pub use planning::{Plan, PlannedNode, State};
