//! A scene as a page for browsers, and as files for other viewers. The input is a scene, with photographs and
//! saved views if there are any. Nothing here serves the page; that is the crate `viewer`.
//!
//! [`page`] makes one HTML file that shows a scene with all of its content: the water, the enhancement at any
//! strength, the positions of the photographs. It works from a disk, without a network, on any host. Its
//! renderer is our own, in plain JavaScript and GLSL below `page/`; these files are joined unchanged, nothing
//! is built or downloaded.
//!
//! The compositor is exact. The program's picture is
//!
//! `a (1 − Σw) c_m + Σ w (c A + c_m (1 − E))` with `A = e^{−β_attn s}`, `E = e^{−β_bs s}`.
//!
//! This is ordinary alpha blending of the colours `f = c A + c_m (1 − E)` over open water, so a browser draws
//! it with one blend function. The remaining differences to the program's own renderer come from half-float
//! sums and from 8-bit harmonics.
//!
//! Reading order: `evidence` and `scene_file` (numbers → bytes) → `water` and `enhancement` (the page's data
//! about both) → `photographs` → [`page`]. [`path`], `saved` and [`foreign`] are independent of these.

mod enhancement;
mod evidence;
pub mod foreign;
mod geometry;
pub mod page;
pub mod path;
mod photographs;
mod saved;
mod scene_file;
mod shot;
mod water;

pub use page::{Page, PageData, PageView, Served, Written, data, header, served, write};
pub use photographs::Photograph;
pub use saved::{SavedView, SavedViews};
pub use shot::{Shot, ShotError};

/// A page that cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum WebError {
    /// A scene without Gaussians.
    #[error("the scene has no Gaussians: there is nothing to show")]
    Empty,
    /// A photograph could not be encoded.
    #[error("photograph `{name}`: {source}")]
    Photograph {
        /// The name of the photograph.
        name: String,
        /// The encoder's error.
        source: use3d_io_image::JpegError,
    },
    /// The data could not be compressed.
    #[error("the page's data could not be packed: {0}")]
    Packing(#[from] std::io::Error),
}
