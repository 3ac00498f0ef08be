//! The first part: the projection of a Gaussian into a camera, and its derivative. It does not depend on
//! tiles.

mod color;
mod passes;
mod projection;
mod splat;

pub use color::view_colors;
pub(crate) use passes::{ColorSource, HIDDEN, Projecting, VisibleSplats, backward};
pub use projection::{BLUR, FAR, NEAR};
pub use splat::LOG2_255;
pub(crate) use splat::{EntryGradient, Splat, SplatGradient};
