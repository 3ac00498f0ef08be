//! Functions for networks and the water on 16 lanes, each with its scalar twin; the bits are equal wherever
//! fused multiply-add exists.
//!
//! There are two ways to compute an exponential. [`lanes::exp`](crate::lanes::exp) is short and covers the
//! whole range; [`logistic`] and [`tanh`] use it (logistic relative error 4e-7, tanh absolute error 2e-7).
//! [`exp_negative`] keeps `e^x - 1` separate: `e^x = 2^n (1 + q(r))` with `n = round(x / ln 2)`,
//! `r = x - n ln 2` in two steps, `q` a polynomial of degree 7. [`softplus`], its derivative and [`sigmoid`]
//! use that and are accurate relatively (4e-7) even where they go to zero:
//! `ln(1 + t) = 2 artanh(t / (2 + t))` for `0 ≤ t ≤ 1`, again a polynomial.

use fearless_simd::prelude::*;
use fearless_simd::{Simd, f32x16, i32x16};

use crate::lanes::{exp as exp_scalar, exp_lanes};

const LOG2_E: f32 = std::f32::consts::LOG2_E;
/// `ln 2` in two parts; the first has few enough bits that `n · LN2_HIGH` is exact.
const LN2_HIGH: f32 = 0.693_359_4;
const LN2_LOW: f32 = -2.121_944_4e-4;
/// `e^r - 1 - r` over `r²`.
const EXP: [f32; 6] = [1.0 / 2.0, 1.0 / 6.0, 1.0 / 24.0, 1.0 / 120.0, 1.0 / 720.0, 1.0 / 5040.0];
/// `artanh(s) / s - 1` over `s²`.
const ARTANH: [f32; 8] =
    [1.0 / 3.0, 1.0 / 5.0, 1.0 / 7.0, 1.0 / 9.0, 1.0 / 11.0, 1.0 / 13.0, 1.0 / 15.0, 1.0 / 17.0];
/// The smallest argument; for any smaller `x` the result is `e^LOWEST`, 1.6e-38.
const LOWEST: f32 = -87.0;

/// `(2^n, e^r - 1)` for `x ≤ 0`.
#[inline(always)]
fn exp_parts<S: Simd>(simd: S, x: f32x16<S>) -> (f32x16<S>, f32x16<S>) {
    let x = x.max(LOWEST);
    let n = (x * LOG2_E).round_ties_even();
    let r = n.mul_add(-LN2_LOW, n.mul_add(-LN2_HIGH, x));
    let mut p = f32x16::splat(simd, EXP[5]);
    p = p.mul_add(r, EXP[4]);
    p = p.mul_add(r, EXP[3]);
    p = p.mul_add(r, EXP[2]);
    p = p.mul_add(r, EXP[1]);
    p = p.mul_add(r, EXP[0]);
    let q = (r * r).mul_add(p, r);
    let exponent: i32x16<S> = n.to_int();
    let scale: f32x16<S> = ((exponent + 127) << 23).bitcast();
    (scale, q)
}

/// `e^x` for `x ≤ 0`.
#[inline(always)]
pub fn exp_negative<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let (scale, q) = exp_parts(simd, x);
    scale.mul_add(q, scale)
}

/// `softplus(x) = ln(1 + e^x)`.
#[inline(always)]
pub fn softplus<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let zero = f32x16::splat(simd, 0.0);
    let t = exp_negative(simd, zero - x.abs());
    let s = t / (t + 2.0);
    let ss = s * s;
    let mut p = f32x16::splat(simd, ARTANH[7]);
    for k in (0..7).rev() {
        p = p.mul_add(ss, ARTANH[k]);
    }
    let artanh = (s * ss).mul_add(p, s);
    artanh.mul_add(2.0, x.max(zero))
}

/// The derivative of softplus from its value `y = ln(1 + e^x)`: `e^x / (1 + e^x) = 1 - e^{-y}`.
#[inline(always)]
pub fn softplus_slope<S: Simd>(simd: S, y: f32x16<S>) -> f32x16<S> {
    let (scale, q) = exp_parts(simd, f32x16::splat(simd, 0.0) - y);
    f32x16::splat(simd, 0.0) - scale.mul_add(q, scale - 1.0)
}

/// `1 / (1 + e^{-x})`.
#[inline(always)]
pub fn sigmoid<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let zero = f32x16::splat(simd, 0.0);
    let one = f32x16::splat(simd, 1.0);
    let t = exp_negative(simd, zero - x.abs());
    let small = t / (t + 1.0);
    x.simd_ge(zero).select(one - small, small)
}

/// `1 / (1 + e⁻ˣ)`.
#[inline(always)]
pub fn logistic<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let one = f32x16::splat(simd, 1.0);
    one / (one + exp_lanes(simd, -x))
}

/// `tanh x` as `sign(x) (1 - e)/(1 + e)`, `e = e^{-2|x|}`: absolute error 2e-7, never outside `[-1, 1]`.
#[inline(always)]
pub fn tanh<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let one = f32x16::splat(simd, 1.0);
    let e = exp_lanes(simd, x.abs() * f32x16::splat(simd, -2.0));
    ((one - e) / (one + e)).copysign(x)
}

/// Scalar twins, operation for operation.
pub mod scalar {
    use super::*;

    #[inline(always)]
    fn exp_parts(x: f32) -> (f32, f32) {
        let x = x.max(LOWEST);
        let n = (x * LOG2_E).round_ties_even();
        let r = n.mul_add(-LN2_LOW, n.mul_add(-LN2_HIGH, x));
        let p = EXP[..5].iter().rev().fold(EXP[5], |p, &c| p.mul_add(r, c));
        let q = (r * r).mul_add(p, r);
        (f32::from_bits(((n as i32 + 127) << 23) as u32), q)
    }

    /// `e^x` for `x ≤ 0`; at least `e^-87`.
    #[inline(always)]
    pub fn exp_negative(x: f32) -> f32 {
        let (scale, q) = exp_parts(x);
        scale.mul_add(q, scale)
    }

    /// `ln(1 + e^x)`.
    #[inline(always)]
    pub fn softplus(x: f32) -> f32 {
        let t = exp_negative(-x.abs());
        let s = t / (t + 2.0);
        let ss = s * s;
        let p = ARTANH[..7].iter().rev().fold(ARTANH[7], |p, &c| p.mul_add(ss, c));
        (s * ss).mul_add(p, s).mul_add(2.0, x.max(0.0))
    }

    /// `1 - e^-y`: the derivative of softplus at the point where its value is `y`.
    #[inline(always)]
    pub fn softplus_slope(y: f32) -> f32 {
        let (scale, q) = exp_parts(-y);
        0.0 - scale.mul_add(q, scale - 1.0)
    }

    /// `1 / (1 + e^-x)`, accurate relatively at both ends.
    #[inline(always)]
    pub fn sigmoid(x: f32) -> f32 {
        let t = exp_negative(-x.abs());
        let small = t / (t + 1.0);
        if x >= 0.0 { 1.0 - small } else { small }
    }

    /// Scalar twin of [`logistic`].
    #[inline(always)]
    pub fn logistic(x: f32) -> f32 {
        1.0 / (1.0 + exp_scalar(-x))
    }

    /// Scalar twin of [`tanh`].
    #[inline(always)]
    pub fn tanh(x: f32) -> f32 {
        let e = exp_scalar(x.abs() * -2.0);
        ((1.0 - e) / (1.0 + e)).copysign(x)
    }
}

#[cfg(test)]
mod tests {
    use fearless_simd::{Level, dispatch};

    use super::*;
    use crate::math;
    use crate::test_support::fuses;

    #[inline(always)]
    fn all<S: Simd>(simd: S, x: &[f32; 16]) -> [[f32; 16]; 4] {
        let v = f32x16::from_slice(simd, x);
        let negative = f32x16::splat(simd, 0.0) - v.abs();
        [
            exp_negative(simd, negative).to_array(),
            softplus(simd, v).to_array(),
            softplus_slope(simd, v.abs()).to_array(),
            sigmoid(simd, v).to_array(),
        ]
    }

    #[test]
    fn the_lanes_are_exact_to_a_few_ulps_and_equal_their_scalar_twins() {
        let level = Level::new();
        for block in 0..400 {
            let x: [f32; 16] = std::array::from_fn(|i| {
                let t = (block * 16 + i) as f32 / 6400.0;
                (t - 0.5) * if block % 2 == 0 { 180.0 } else { 6.0 }
            });
            let [e, s, d, g] = dispatch!(level, simd => all(simd, &x));
            for (i, &v) in x.iter().enumerate() {
                let w = f64::from(v);
                for (value, exact) in [
                    (e[i], math::exp((-w.abs()).max(-87.0))),
                    (s[i], w.max(0.0) + math::ln_1p(math::exp(-w.abs()))),
                    (d[i], -math::exp_m1(-w.abs())),
                    (g[i], 1.0 / (1.0 + math::exp(-w))),
                ] {
                    let error = (f64::from(value) - exact).abs();
                    assert!(error <= 4e-7 * exact.abs() + 2e-38, "at {v}: {value:e} against {exact:e}");
                }
                if fuses() {
                    assert_eq!(e[i].to_bits(), scalar::exp_negative(-v.abs()).to_bits());
                    assert_eq!(s[i].to_bits(), scalar::softplus(v).to_bits());
                    assert_eq!(d[i].to_bits(), scalar::softplus_slope(v.abs()).to_bits());
                    assert_eq!(g[i].to_bits(), scalar::sigmoid(v).to_bits());
                }
            }
        }
    }

    #[inline(always)]
    fn evaluate<S: Simd>(simd: S, x: &[f32]) -> Vec<[f32; 2]> {
        let mut out = Vec::with_capacity(x.len());
        for chunk in x.chunks_exact(16) {
            let v = f32x16::from_slice(simd, chunk);
            let (l, t) = (logistic(simd, v), tanh(simd, v));
            out.extend((0..16).map(|k| [l[k], t[k]]));
        }
        out
    }

    #[test]
    fn logistic_and_tanh_agree_with_their_twins_and_with_f64() {
        let x: Vec<f32> = (0..16 * 4000).map(|i| (i as f32 - 32_000.0) * 2.6e-3).collect();
        let lanes = dispatch!(Level::new(), simd => evaluate(simd, &x));
        for (&x, lane) in x.iter().zip(&lanes) {
            let twin = [scalar::logistic(x), scalar::tanh(x)];
            if fuses() {
                assert_eq!(lane.map(f32::to_bits), twin.map(f32::to_bits), "at {x}");
            }
            let d = f64::from(x);
            assert!((f64::from(lane[0]) * (1.0 + math::exp(-d)) - 1.0).abs() < 4e-7, "logistic {x}");
            assert!((f64::from(lane[1]) - math::tanh(d)).abs() < 2e-7, "tanh {x}: {}", lane[1]);
        }
    }
}
