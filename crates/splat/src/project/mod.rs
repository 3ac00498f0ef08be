//! The first room: what a Gaussian looks like to a camera, and its derivative. Knows no tiles.

mod color;
mod projection;
mod splat;

pub use color::view_colors;
pub use projection::{BLUR, FAR, NEAR};
pub(crate) use splat::{
    ColorSource, Drawn, HIDDEN, LOG2_255, Projecting, Record, Splat, SplatGradient, backward,
};
