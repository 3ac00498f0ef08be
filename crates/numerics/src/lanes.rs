//! Exponentials on 16 f32 lanes, each beside its plain scalar twin.
//!
//! `2^x = 2^n 2^f` with `n` the integer nearest to `x` and `f = x - n` in `[-½, ½]`. `n` is found by adding
//! and subtracting `1.5·2²³`, whose last bit has the value one; `2^f` is a polynomial `1 + f q(f)` of degree
//! 5, minimax in relative error among those that are exact at 0 (9.2e-8); `n` is added to the exponent bits.
//! In the product forms `x = a b` is never rounded: both the reduction and `f` come from fused multiply-adds.
//!
//! Stated error: relative 2.5e-7 over the whole range (measured 1.7e-7; the tests sample it).
//! Arguments are clamped to `[-126, 127]`, so results are never 0 and never infinite.
//! NaN gives an unspecified number.
//!
//! Lanes and twin give the same bits wherever fused multiply-add exists (AVX2, AVX-512, NEON); without
//! it the lanes differ by rounding.

use fearless_simd::{Bytes, Simd, SimdBase, SimdFloat, f32x16, i32x16};

/// `1.5·2²³`: adding it leaves the nearest integer in the low bits.
const MAGIC: f32 = 12_582_912.0;
/// `2^f = 1 + f (P₁ + f (P₂ + …))` on `[-½, ½]`.
#[allow(clippy::excessive_precision, reason = "as computed; the compiler rounds")]
const P: [f32; 5] = [0.693_146_98, 0.240_222_42, 5.550_733_6e-2, 9.671_513e-3, 1.326_472_2e-3];
/// `2^f` on `[-SMALL, SMALL]`, relative error 1.1e-7.
#[allow(clippy::excessive_precision, reason = "as computed; the compiler rounds")]
const Q: [f32; 3] = [0.693_147_33, 0.240_291_04, 5.548_776e-2];
const LOWEST: f32 = -126.0;
const HIGHEST: f32 = 127.0;
/// `log₂ e` as the sum of two floats.
const LOG2_E: [f32; 2] = [std::f32::consts::LOG2_E, 1.925_963e-8];

/// The largest absolute value of the argument of the cubic of [`SMALL_COEFFICIENTS`].
pub const SMALL: f32 = 0.09;

#[inline(always)]
fn polynomial(f: f32) -> f32 {
    let p = P[4].mul_add(f, P[3]).mul_add(f, P[2]).mul_add(f, P[1]).mul_add(f, P[0]);
    p.mul_add(f, 1.0)
}

#[inline(always)]
fn scale(power: f32, shifted: f32) -> f32 {
    f32::from_bits(power.to_bits().wrapping_add(shifted.to_bits() << 23))
}

/// `2^x`.
#[inline(always)]
pub fn exp2(x: f32) -> f32 {
    exp2_unclamped(x.clamp(LOWEST, HIGHEST))
}

/// `2^x` for `x` in `[-126, 127]`; elsewhere an unspecified number.
#[inline(always)]
pub fn exp2_unclamped(x: f32) -> f32 {
    let shifted = x + MAGIC;
    let f = x - (shifted - MAGIC);
    scale(polynomial(f), shifted)
}

/// The coefficients `[1, q₁, q₂, q₃]` of a cubic for `2^x` with `|x| ≤` [`SMALL`], which needs no range
/// reduction and has a relative error of 1.7e-7. Callers fold a factor into them.
pub const SMALL_COEFFICIENTS: [f32; 4] = [1.0, Q[0], Q[1], Q[2]];

/// `e^x`.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    let x = x.clamp(LOWEST / LOG2_E[0], HIGHEST / LOG2_E[0]);
    let shifted = x.mul_add(LOG2_E[0], MAGIC);
    let f = x.mul_add(LOG2_E[1], x.mul_add(LOG2_E[0], -(shifted - MAGIC)));
    scale(polynomial(f), shifted)
}

#[inline(always)]
fn polynomial_lanes<S: Simd>(simd: S, f: f32x16<S>) -> f32x16<S> {
    let c = |v: f32| f32x16::splat(simd, v);
    let p = c(P[4]).mul_add(f, c(P[3])).mul_add(f, c(P[2])).mul_add(f, c(P[1])).mul_add(f, c(P[0]));
    p.mul_add(f, c(1.0))
}

#[inline(always)]
fn scale_lanes<S: Simd>(power: f32x16<S>, shifted: f32x16<S>) -> f32x16<S> {
    let exponent: i32x16<S> = shifted.bitcast();
    let bits: i32x16<S> = power.bitcast();
    (bits + (exponent << 23)).bitcast()
}

/// [`exp2`] of 16 lanes.
#[inline(always)]
pub fn exp2_lanes<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    exp2_unclamped_lanes(simd, x.max(f32x16::splat(simd, LOWEST)).min(f32x16::splat(simd, HIGHEST)))
}

/// [`exp2_unclamped`] of 16 lanes.
#[inline(always)]
pub fn exp2_unclamped_lanes<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let magic = f32x16::splat(simd, MAGIC);
    let shifted = x + magic;
    let f = x - (shifted - magic);
    scale_lanes(polynomial_lanes(simd, f), shifted)
}

/// [`exp`] of 16 lanes.
#[inline(always)]
pub fn exp_lanes<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let c = |v: f32| f32x16::splat(simd, v);
    let x = x.max(c(LOWEST / LOG2_E[0])).min(c(HIGHEST / LOG2_E[0]));
    let shifted = x.mul_add(c(LOG2_E[0]), c(MAGIC));
    let f = x.mul_add(c(LOG2_E[1]), x.mul_add(c(LOG2_E[0]), c(MAGIC) - shifted));
    scale_lanes(polynomial_lanes(simd, f), shifted)
}

/// The sum of 16 lanes in a fixed order, the same on every instruction set: halves, quarters, then pairs.
#[inline(always)]
pub fn sum(lanes: &[f32; 16]) -> f32 {
    let quarter: [f32; 4] =
        std::array::from_fn(|i| (lanes[i] + lanes[i + 8]) + (lanes[i + 4] + lanes[i + 12]));
    (quarter[0] + quarter[2]) + (quarter[1] + quarter[3])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math;
    use crate::random::{Purpose, Stream};
    use fearless_simd::{Level, dispatch};

    fn samples(low: f64, high: f64) -> Vec<f32> {
        let stream = Stream::new(1, Purpose::new("exp2 samples"), 0);
        (0..200_000).map(|i| (low + (high - low) * stream.uniform(i)) as f32).collect()
    }

    fn worst(values: &[f32], f: impl Fn(f32) -> f32, exact: impl Fn(f64) -> f64) -> f64 {
        values.iter().map(|&x| (f64::from(f(x)) / exact(f64::from(x)) - 1.0).abs()).fold(0.0, f64::max)
    }

    /// The cubic of [`SMALL_COEFFICIENTS`].
    fn exp2_small(x: f32) -> f32 {
        let k = SMALL_COEFFICIENTS;
        k[3].mul_add(x, k[2]).mul_add(x, k[1]).mul_add(x, k[0])
    }

    #[test]
    fn errors_are_as_stated() {
        for x in [samples(-126.0, 127.0), samples(-2.0, 2.0)] {
            let error = worst(&x, exp2, math::exp2);
            assert!(error < 2.5e-7, "exp2 is off by {error:e}");
        }
        assert!(worst(&samples(-87.0, 87.0), exp, math::exp) < 2.5e-7);
        assert!(worst(&samples(-0.09, 0.09), exp2_small, math::exp2) < 1.9e-7);
    }

    #[test]
    fn integers_are_exact_and_the_ends_are_clamped() {
        for n in -126..=127 {
            assert_eq!(exp2(n as f32), math::powi(2f32, n));
        }
        assert_eq!(exp2(-1e30), math::powi(2f32, -126));
        assert_eq!(exp2(f32::INFINITY), math::powi(2f32, 127));
        assert_eq!((exp2_small(0.0), exp(0.0)), (1.0, 1.0));
        for end in [f32::NEG_INFINITY, -1e30, 1e30, f32::INFINITY] {
            assert!(exp(end).is_finite() && exp(end) > 0.0, "exp({end}) is {}", exp(end));
        }
    }

    #[inline(always)]
    fn all_lanes<S: Simd>(simd: S, x: &[f32; 16]) -> [[f32; 16]; 2] {
        let v = f32x16::load_array_ref(simd, x);
        [exp2_lanes(simd, v).to_array(), exp_lanes(simd, v).to_array()]
    }

    #[test]
    fn lanes_have_the_bits_of_the_twin_where_multiply_add_is_fused() {
        let values = samples(-80.0, 80.0);
        let check = |level: Level, tolerance: f32| {
            for chunk in values.chunks_exact(16).take(2000) {
                let x: [f32; 16] = chunk.try_into().unwrap();
                let lanes = dispatch!(level, simd => all_lanes(simd, &x));
                for (i, &v) in x.iter().enumerate() {
                    let twin = [exp2(v), exp(v)];
                    for k in 0..2 {
                        if tolerance == 0.0 {
                            assert_eq!(lanes[k][i].to_bits(), twin[k].to_bits(), "form {k} at {v}");
                        } else {
                            assert!((lanes[k][i] / twin[k] - 1.0).abs() < tolerance, "form {k} at {v}");
                        }
                    }
                }
            }
        };
        check(Level::baseline(), 1e-5);
        #[cfg(target_arch = "x86_64")]
        {
            if let Some(avx2) = Level::new().as_avx2() {
                check(Level::Avx2(avx2), 0.0);
            }
            if let Some(avx512) = Level::new().as_avx512() {
                check(Level::Avx512(avx512), 0.0);
            }
        }
    }
}
