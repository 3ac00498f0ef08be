//! The third room: light through lists of Gaussians and water, forward and backward, one tile at a time.
//!
//! `plain` says what is computed and `lanes` computes the same bits on vectors; `tile` is what they work on, `pixels` what goes in and
//! out of it, `per_image` lays water over what was composed without any, `strips` and `sums` how tile rows share the work, `rasterizer` and `linear` what callers see.

mod lanes;
mod linear;
mod pairs;
mod per_image;
mod pixels;
mod plain;
mod rasterizer;
mod strips;
mod sums;
mod tile;
mod trim;

pub use pairs::Pairs;
pub use rasterizer::Rasterizer;
