//! The third room: light through lists of Gaussians and water, forward and backward, one tile at a time.
//!
//! `plain` says what is computed and `lanes` computes the same bits on vectors; `tile` is what they work
//! on, `inputs` and `outputs` what goes in and out of it. `strips`, `groups` and `sums` share the work
//! by `rows` of tiles, `per_image` lays water over what was composed without any; `rasterizer` and
//! `linear` are what callers see.

mod groups;
mod inputs;
mod lanes;
mod linear;
mod outputs;
mod pairs;
mod per_image;
mod pixels;
mod plain;
mod rasterizer;
mod rows;
mod strips;
mod sums;
mod tile;
mod trim;

pub use pairs::Pairs;
pub use rasterizer::Rasterizer;
