//! The compositor on 16 lanes: one cell of 4×4 pixels is one vector. Every function here is the lane form of
//! the function of the same name in [`plain`](crate::compose::plain), with the same operations in the same
//! order per pixel and per sum.
//!
//! The outer loop inside a tile runs over batches of Gaussians: the tile's pixel state stays in the
//! first-level cache. `batch` holds the one loop over a tile's list; each function is a
//! [`Pass`](batch::Pass), which defines the work per batch. `decay` is the water between Gaussians and
//! pixels, `front` the transmittance before the next Gaussian, and `sums` adds up lanes.

mod backward;
mod batch;
mod colors;
mod decay;
mod forward;
mod front;
mod linear;
mod sums;

use fearless_simd::{Simd, SimdBase, SimdFloat, f32x16, mask32x16};

pub(crate) use self::backward::backward;
pub(crate) use self::colors::backward_colors;
pub(crate) use self::forward::forward;
pub(crate) use self::linear::{splat, splat_adjoint};
use super::tile::Lanes;

#[inline(always)]
fn load<S: Simd>(simd: S, lanes: &Lanes) -> f32x16<S> {
    f32x16::load_array_ref(simd, lanes)
}

/// `lanes += a b`.
#[inline(always)]
fn accumulate<S: Simd>(simd: S, lanes: &mut Lanes, a: f32x16<S>, b: f32x16<S>) {
    a.mul_add(b, load(simd, lanes)).store_array(lanes);
}

#[inline(always)]
fn select<S: Simd>(mask: mask32x16<S>, a: f32x16<S>, b: f32x16<S>) -> f32x16<S> {
    fearless_simd::Select::select(mask, a, b)
}
