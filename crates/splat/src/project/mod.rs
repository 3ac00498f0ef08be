//! The first room: what a Gaussian looks like to a camera, and its derivative. Knows no tiles.

mod color;
mod passes;
mod projection;
mod splat;

pub use color::view_colors;
pub(crate) use passes::{ColorSource, Drawn, HIDDEN, Projecting, backward};
pub use projection::{BLUR, FAR, NEAR};
pub use splat::LOG2_255;
pub(crate) use splat::{Record, Splat, SplatGradient};
