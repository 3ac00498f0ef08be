//! Tests of the crate through its public interface.

mod bits;
mod differences;
mod golden;
mod hostile;
mod per_image;
mod ply;
mod properties;
mod scene_mini;
mod support;
