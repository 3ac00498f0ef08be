//! Gaussians, their projection and tiles, the underwater compositor with its exact backward pass, the
//! linear splat with its adjoint, and PLY files.
//!
//! A view is rendered in two steps. [`Prepared::prepare`] projects, sorts and bins the Gaussians for a
//! camera and a lattice of pixels. A [`Rasterizer`] then composes and differentiates the view any number of
//! times. For each pixel, with the contributing Gaussians in depth order, `T_i` the transmittance before
//! Gaussian `i`, `s_i = z_i |d(p)|` (R1) and water `c_m`, `β_bs`, `β_attn` per pixel:
//!
//! ```text
//! image = Σ T_i α_i c_i e^{−β_attn s_i}
//!       + Σ T_i c_m (e^{−β_bs s_{i−1}} − e^{−β_bs s_i})
//!       + T_{N+1} c_m e^{−β_bs s_N}
//! ```
//!
//! Without a medium the same kernel is the plain compositor, and with channels instead of colours it is the
//! linear splat `S_v`. Everything is exact: a Gaussian reaches every pixel with `α ≥ 1/255`, and nothing
//! depends on how the image is cut into tiles.
//!
//! The crate has three parts, one below the other, each with its forward and backward pass side by side:
//! `project` (a Gaussian seen by a camera), `lists` (the tiles that it meets), `compose` (light through
//! them).
//!
//! The same inputs give the same bits on any number of threads, and on AVX2, AVX-512 and the scalar twin.
//! A small view of frozen geometry is an exception: it is composed from kept weights
//! ([`Rasterizer::trim`]). Its bits are the same on any number of threads and any instruction set, but the
//! scalar twin walks the lists.

#![deny(clippy::too_many_arguments)]

mod compose;
mod gaussians;
mod lists;
pub mod ply;
mod project;
mod view;

pub use compose::{DepthRange, Pairs, Rasterizer};
pub use gaussians::{GaussianGradients, Gaussians, GaussiansError};
pub use lists::Prepared;
pub use project::{BLUR, FAR, LOG2_255, NEAR, view_colors};
pub use view::{Colors, Gradients, Layers, Options, RenderGradients, Rendered, ViewOf};
