//! Sums over the 16 lanes, in a fixed order.

use fearless_simd::{Simd, SimdBase, f32x4, f32x16};

use crate::compose::tile::LaneSums;
use crate::project::EntryGradient;

/// Adds the lanes whose indices differ by a multiple of four, in the order of
/// [`use3d_numerics::lanes::sum`].
#[inline(always)]
fn quarter<S: Simd>(simd: S, v: f32x16<S>) -> f32x4<S> {
    let (low, high) = simd.split_f32x16(v);
    let (a, b) = simd.split_f32x8(low + high);
    a + b
}

/// Four sums at once, each in the order of [`use3d_numerics::lanes::sum`].
#[inline(always)]
pub(super) fn sums<S: Simd>(simd: S, [a, b, c, d]: [f32x16<S>; 4]) -> [f32; 4] {
    // Written out one by one, because `array::map` is a call that is not compiled for the instruction set.
    let (a, b, c, d) = (quarter(simd, a), quarter(simd, b), quarter(simd, c), quarter(simd, d));
    let ab = (a.zip_low(b) + a.zip_high(b)).to_array();
    let cd = (c.zip_low(d) + c.zip_high(d)).to_array();
    [ab[0] + ab[2], ab[1] + ab[3], cd[0] + cd[2], cd[1] + cd[3]]
}

/// Adds the lanes of `a` and of `b` whose indices differ by eight, alternately of `a` and of `b`.
#[inline(always)]
fn fold<S: Simd>(a: f32x16<S>, b: f32x16<S>) -> f32x16<S> {
    a.zip_low(b) + a.zip_high(b)
}

/// Adds the lanes of the backward pass's sums, each in the order of [`use3d_numerics::lanes::sum`], and
/// returns them as a record. Four foldings of sixteen vectors leave one sum in each lane; the order of the
/// lanes is that of [`SplatGradient::of`](crate::project::SplatGradient::of).
#[inline(always)]
pub(super) fn finish<S: Simd>(of: LaneSums<f32x16<S>>) -> EntryGradient {
    let LaneSums { weight, t, dy, t_t, t_dy, dy_dy, z, color: [r, g, b], screen: [x, y] } = of;
    let first = fold(fold(weight, t), fold(dy, t_t));
    let second = fold(fold(t_dy, dy_dy), fold(z, r));
    let third = fold(fold(g, b), fold(x, y));
    fold(fold(first, second), fold(third, third)).to_array()
}
