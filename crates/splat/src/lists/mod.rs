//! The second room: which Gaussians meet which tile of pixels, in the order of their depth. Knows no light.

mod axis;
mod prepared;
mod sort;

pub(crate) use axis::TILE;
pub use prepared::Prepared;
#[cfg(test)]
pub(crate) use prepared::tests;
pub(crate) use prepared::{Span, TileRow};
