//! The fourth coordinate: a learned, bounded number that describes a colour's brightness.
//!
//! `h(c) = sign(c) ln(1 + |c|)` per channel, `γ(c) = tanh(wᵀ h(c) + b)`. The signed log limits the effect
//! of over-bright and negative colours. `w` and `b` are learned; `c` is constant in stage 2, so `h` is
//! computed once.

use fearless_simd::{Simd, f32x16, prelude::*};
use use3d_numerics::math;

use use3d_numerics::functions;

/// `sign(c) ln(1 + |c|)`.
#[inline]
pub(crate) fn signed_log(c: f32) -> f32 {
    math::ln_1p(c.abs()).copysign(c)
}

/// `γ` of 16 colours given by the planes of their signed logs.
#[inline(always)]
pub(crate) fn gamma<S: Simd>(simd: S, guide: &[f32; 4], h: [f32x16<S>; 3]) -> f32x16<S> {
    let [wr, wg, wb, b] = *guide;
    let c = |v: f32| f32x16::splat(simd, v);
    functions::tanh(simd, c(wr).mul_add(h[0], c(wg).mul_add(h[1], c(wb).mul_add(h[2], c(b)))))
}

/// Scalar twin of [`gamma`].
#[cfg(test)]
pub(crate) fn gamma_scalar(guide: &[f32; 4], h: [f32; 3]) -> f32 {
    let [wr, wg, wb, b] = *guide;
    functions::scalar::tanh(wr.mul_add(h[0], wg.mul_add(h[1], wb.mul_add(h[2], b))))
}

/// The position of a coordinate in `[-1, 1]` on a grid of `nodes` nodes: the lower node and the fraction
/// towards the next.
#[inline(always)]
pub(crate) fn locate(u: f32, nodes: usize) -> (usize, f32) {
    let at = (u + 1.0) * (0.5 * (nodes - 1) as f32);
    let node = (at as usize).min(nodes - 2);
    (node, at - node as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ends_of_a_grid_are_its_first_and_last_node() {
        assert_eq!(locate(-1.0, 16), (0, 0.0));
        assert_eq!(locate(1.0, 16), (14, 1.0));
        assert_eq!(locate(0.0, 3), (1, 0.0));
        let (node, t) = locate(-1.0 + 2.0 * 4.25 / 15.0, 16);
        assert!(node == 4 && (t - 0.25).abs() < 1e-6);
    }

    #[test]
    fn the_signed_log_is_odd() {
        for c in [0.0f32, 1e-4, 0.3, 1.0, 40.0] {
            assert_eq!(signed_log(-c), -signed_log(c));
        }
    }
}
