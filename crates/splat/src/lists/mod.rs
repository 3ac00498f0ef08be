//! The second room: which Gaussians meet which tile of pixels, in the order of their depth. Knows no light.

mod axis;
mod bins;
mod prepared;
mod sort;

pub(crate) use axis::TILE;
pub(crate) use bins::{Span, TileRow};
pub use prepared::Prepared;
#[cfg(test)]
pub(crate) use prepared::tests;
