//! The third part: light through lists of Gaussians and water, forward and backward, one tile at a time.
//!
//! `plain` defines the computation, and `lanes` computes the same bits on vectors. `tile` holds the data of
//! one tile, `inputs` fills it and `outputs` writes its results. `strips`, `groups` and `sums` divide the
//! work into `rows` of tiles. `per_image` adds water to an image that was composed without it. `trim`
//! shortens the lists of a frozen view, and `weighted` composes a small one from its kept weights.
//! `rasterizer` and `linear` are the public interface.

mod depth_network;
mod groups;
mod inputs;
mod laid_over;
mod lanes;
mod linear;
mod normalised;
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
mod weighted;

pub use normalised::DepthRange;
pub use pairs::Pairs;
pub use rasterizer::Rasterizer;
