//! Tests of the crate through its public interface.

mod bits;
mod differences;
mod golden;
mod hostile;
mod ply;
mod properties;
mod scene_mini;
mod support;
