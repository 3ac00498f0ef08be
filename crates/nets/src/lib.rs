//! Networks trained by others, in pure Rust: Nu2Net, Depth Anything V2, LPIPS, RAFT, URanker, MUSIQ.
//!
//! The inputs are images and the official checkpoint files; the outputs are pictures, maps or scores. The
//! crate only runs the networks: it does not train them and downloads nothing.
//!
//! | network | for | call |
//! |---|---|---|
//! | [`Nu2Net`] | the proposer: one enhanced view | [`Nu2Net::enhance`] |
//! | [`DepthAnythingV2`] | the depth prior | [`DepthAnythingV2::disparity`] |
//! | [`Lpips`] | perceptual distance | [`Lpips::distance`] |
//! | [`Raft`] | optical flow for the warped distance | [`Raft::flow`] |
//! | [`URanker`], [`Musiq`] | quality without reference | [`URanker::score`], [`Musiq::score`] |
//!
//! [`Models`] finds the official checkpoint files in a folder, reads them without executing anything and
//! without network access, and reports missing files.
//!
//! Every network is written by hand with a few operations (`engine`): one matrix product into which
//! convolutions gather their windows, attention in blocks, normalisations, resamplers. No tensor library is
//! used, because inference needs only about fifteen operations. For the most expensive one, the convolution,
//! a general library is several times slower than a product that never stores the unrolled picture. Further
//! advantages are 80 fewer crates, no unsafe code, memory that is bounded by the feature maps, and the same
//! bits for any number of threads. The disadvantage is that graphics processors are not used.
//!
//! All arithmetic is f32; long sums are f64. Agreement with the original implementations is tested on
//! intermediate activations with reproducible stand-in weights ([`weights::StandIn`]).

mod archive;
pub mod checkpoint;
mod depth_anything;
mod dpt;
mod engine;
pub mod error;
mod images;
mod lpips;
pub mod models;
mod musiq;
mod nu2net;
mod raft;
#[cfg(test)]
mod test_support;
mod uranker;
pub mod weights;

pub use archive::Archive;
pub use checkpoint::Checkpoint;
pub use depth_anything::{DepthAnythingSize, DepthAnythingV2};
pub use error::NetError;
pub use images::limit_long_side;
pub use lpips::{Features, Lpips};
pub use models::{Models, Network};
pub use musiq::Musiq;
pub use nu2net::{InputPolicy, Nu2Net};
pub use raft::{Flow, Raft};
pub use uranker::{RankerInput, URanker};
