//! Sums over the 16 lanes, in a fixed order.

use fearless_simd::{Simd, SimdBase, f32x4, f32x16};

use crate::compose::tile::{ColumnSums, moments};
use crate::project::{EntryGradient, Splat, SplatGradient};

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

/// Sums the backward pass's column sums over the columns and returns them as a record; `offset` is the
/// columns' distance from `origin`.
#[inline(always)]
pub(super) fn finish<S: Simd>(
    simd: S,
    splat: &Splat,
    origin: [f32; 2],
    offset: f32x16<S>,
    of: ColumnSums<f32x16<S>>,
) -> EntryGradient {
    let ColumnSums { weight, eta, eta_eta, z, color: [r, g, b], screen: [x, y_slope] } = of;
    let x0 = weight * offset;
    let [s0, sx, sxx, s1] = sums(simd, [weight, x0, x0 * offset, eta]);
    let [sx1, s2, z, r] = sums(simd, [eta * offset, eta_eta, z, r]);
    let [g, b, x, y_slope] = sums(simd, [g, b, x, y_slope]);
    let [s0, t, y, tt, ty, yy] = moments(splat, origin, [s0, sx, sxx, s1, sx1, s2]);
    let (color, screen) = ([r, g, b], [x, y_slope]);
    SplatGradient { weight: s0, t, dy: y, t_t: tt, t_dy: ty, dy_dy: yy, z, color, screen }.record()
}
