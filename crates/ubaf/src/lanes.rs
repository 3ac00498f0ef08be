//! Logistic function and tanh on sixteen lanes, each beside its scalar twin; equal bits where multiply and
//! add fuse.

use fearless_simd::{Simd, f32x16, prelude::*};

pub(crate) use use3d_numerics::lanes::{exp as exp_scalar, exp_lanes as exp};

/// `1 / (1 + e⁻ˣ)`.
#[inline(always)]
pub(crate) fn logistic<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let one = f32x16::splat(simd, 1.0);
    one / (one + exp(simd, -x))
}

/// Scalar twin of [`logistic`].
#[cfg(test)]
pub(crate) fn logistic_scalar(x: f32) -> f32 {
    1.0 / (1.0 + exp_scalar(-x))
}

/// `tanh x` as `sign(x) (1 - e)/(1 + e)`, `e = e^{-2|x|}`: absolute error 2e-7, never outside `[-1, 1]`.
#[inline(always)]
pub(crate) fn tanh<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let one = f32x16::splat(simd, 1.0);
    let e = exp(simd, x.abs() * f32x16::splat(simd, -2.0));
    ((one - e) / (one + e)).copysign(x)
}

/// Scalar twin of [`tanh`].
#[cfg(test)]
pub(crate) fn tanh_scalar(x: f32) -> f32 {
    let e = exp_scalar(x.abs() * -2.0);
    ((1.0 - e) / (1.0 + e)).copysign(x)
}

#[cfg(test)]
mod tests {
    use fearless_simd::{Level, dispatch};

    use super::*;
    use use3d_numerics::math;

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
    fn lanes_and_twins_agree_with_each_other_and_with_f64() {
        let x: Vec<f32> = (0..16 * 4000).map(|i| (i as f32 - 32_000.0) * 2.6e-3).collect();
        let lanes = dispatch!(Level::new(), simd => evaluate(simd, &x));
        for (&x, lane) in x.iter().zip(&lanes) {
            let twin = [logistic_scalar(x), tanh_scalar(x)];
            if crate::tests::fuses(Level::new()) {
                assert_eq!(lane.map(f32::to_bits), twin.map(f32::to_bits), "at {x}");
            }
            let d = f64::from(x);
            assert!((f64::from(lane[0]) * (1.0 + math::exp(-d)) - 1.0).abs() < 5e-7, "logistic {x}");
            assert!((f64::from(lane[1]) - math::tanh(d)).abs() < 2e-7, "tanh {x}: {}", lane[1]);
        }
    }
}
