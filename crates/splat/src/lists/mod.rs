//! The second part: finds which Gaussians meet which tile of pixels, in depth order. It does not depend on
//! light.

mod axis;
mod bins;
mod prepared;
mod sort;
mod weights;

pub(crate) use axis::TILE;
pub(crate) use bins::{Span, TileRow};
pub use prepared::Prepared;
#[cfg(test)]
pub(crate) use prepared::tests;
pub(crate) use weights::RowWeights;
