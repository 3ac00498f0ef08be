//! Element-wise functions. Each is written once as plain scalar code that the compiler vectorises for the
//! processor. The code has no branches, and fused multiply-adds only where written, so that every instruction
//! set gives the same bits.
//!
//! Accuracy against exact arithmetic (tested): sigmoid, tanh, ELU and GELU 2e-7 absolute per unit. They use
//! the exponential of the crate `numerics` ([`use3d_numerics::lanes::exp`]).

use fearless_simd::{Level, Simd, dispatch};
use rayon::prelude::*;
use use3d_numerics::functions::scalar::{logistic, tanh};
use use3d_numerics::lanes::exp;

/// Applied to every element of a layer's output.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Activation {
    /// The value itself.
    #[default]
    Identity,
    /// max(x, 0).
    Relu,
    /// x for x > 0, else e^x − 1.
    Elu,
    /// x·Φ(x) with the exact normal distribution Φ (the erf form).
    Gelu,
    /// tanh.
    Tanh,
    /// 1 / (1 + e^−x).
    Sigmoid,
}

/// The upper tail of the normal distribution times two, erfc(z/√2) for z ≥ 0, as e^(−z·h(z)) with a
/// polynomial h fitted on [0, 8] (Chebyshev nodes); beyond 8 the value at 8, 1e-15, is kept.
#[inline(always)]
fn two_sided_tail(z: f32) -> f32 {
    const H: [f32; 13] = [
        2.416_738_5,
        1.808_868_5,
        9.778_538e-2,
        -5.016_739_3e-2,
        2.482_343_5e-2,
        -1.149_331_2e-2,
        4.721_187_5e-3,
        -1.524_292_6e-3,
        3.288_544_2e-4,
        4.597_129_7e-5,
        -3.170_160_6e-4,
        3.463_472_8e-4,
        -1.200_263_1e-4,
    ];
    let z = z.min(8.0);
    let u = z.mul_add(0.25, -1.0);
    let mut h = H[12];
    for k in (0..12).rev() {
        h = h.mul_add(u, H[k]);
    }
    exp(-z * h)
}

#[inline(always)]
fn activate(activation: Activation, x: f32) -> f32 {
    match activation {
        Activation::Identity => x,
        Activation::Relu => x.max(0.0),
        Activation::Elu => {
            if x > 0.0 {
                x
            } else {
                exp(x) - 1.0
            }
        }
        Activation::Gelu => (-0.5 * x.abs()).mul_add(two_sided_tail(x.abs()), x.max(0.0)),
        Activation::Tanh => tanh(x),
        Activation::Sigmoid => logistic(x),
    }
}

/// `x ← activation(x + bias)` over one row.
pub(crate) fn finish(level: Level, activation: Activation, bias: f32, row: &mut [f32]) {
    dispatch!(level, simd => finish_row(simd, activation, bias, row));
}

#[inline(always)]
fn finish_row<S: Simd>(_: S, activation: Activation, bias: f32, row: &mut [f32]) {
    // One loop per function, so that the function is selected once and each loop is vectorised.
    macro_rules! each {
        ($($name:ident)*) => {
            match activation {
                Activation::Identity => row.iter_mut().for_each(|x| *x += bias),
                $(Activation::$name => row.iter_mut().for_each(|x| *x = activate(Activation::$name, *x + bias)),)*
            }
        };
    }
    each!(Relu Elu Gelu Tanh Sigmoid);
}

/// Applies an activation to a whole map, in parallel.
pub(crate) fn apply(activation: Activation, values: &mut [f32]) {
    let level = Level::new();
    values.par_chunks_mut(1 << 14).for_each(|chunk| finish(level, activation, 0.0, chunk));
}

/// Shifts and scales a row, then activates it: `x ← activation((x − mean) · scale + shift)`.
pub(crate) fn normalise(
    level: Level,
    activation: Activation,
    mean: f32,
    scale: f32,
    shift: f32,
    row: &mut [f32],
) {
    #[inline(always)]
    fn run<S: Simd>(_: S, mean: f32, scale: f32, shift: f32, row: &mut [f32]) {
        row.iter_mut().for_each(|x| *x = (*x - mean).mul_add(scale, shift));
    }
    dispatch!(level, simd => run(simd, mean, scale, shift, row));
    if activation != Activation::Identity {
        finish(level, activation, 0.0, row);
    }
}

/// Column-wise softmax of `[rows][N]`, in place: each column becomes e^(x − max). The reciprocals of the
/// column sums are returned; the caller applies them to the product of the columns with other data (fewer
/// divisions, same result to rounding).
pub(crate) fn softmax_columns<const N: usize>(level: Level, rows: &mut [[f32; N]]) -> [f32; N] {
    #[inline(always)]
    fn run<S: Simd, const N: usize>(_: S, rows: &mut [[f32; N]]) -> [f32; N] {
        let mut largest = [f32::NEG_INFINITY; N];
        for row in rows.iter() {
            for i in 0..N {
                largest[i] = largest[i].max(row[i]);
            }
        }
        let mut sums = [0.0f32; N];
        // Partial sums of 64 rows keep the rounding error of long columns small.
        for block in rows.chunks_mut(64) {
            let mut partial = [0.0f32; N];
            for row in block {
                for i in 0..N {
                    row[i] = exp(row[i] - largest[i]);
                    partial[i] += row[i];
                }
            }
            for i in 0..N {
                sums[i] += partial[i];
            }
        }
        sums.map(|s| 1.0 / s)
    }
    dispatch!(level, simd => run(simd, rows))
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_numerics::math;

    /// The largest error of the scalar definition, on its own set of arguments, against f64 mathematics.
    fn worst(activation: Activation, exact: impl Fn(f64) -> f64) -> f64 {
        let arguments: Vec<f32> = (-40_000..40_000).map(|i| i as f32 * 3.7e-4).collect();
        let mut values = arguments.clone();
        finish(Level::new(), activation, 0.0, &mut values);
        let mut worst = 0.0f64;
        for (x, y) in arguments.iter().zip(values) {
            assert_eq!(y, activate(activation, *x), "vector and scalar differ at {x}");
            let x = f64::from(*x);
            worst = worst.max((f64::from(y) - exact(x)).abs() / x.abs().max(1.0));
        }
        worst
    }

    /// Φ by Simpson's rule from 0, independent of the fitted polynomial.
    fn normal_distribution(x: f64) -> f64 {
        let n = 400;
        let h = x / f64::from(n);
        let density = |t: f64| math::exp(-0.5 * t * t) / (2.0 * std::f64::consts::PI).sqrt();
        let inner: f64 = (1..n).map(|i| density(h * f64::from(i)) * if i % 2 == 1 { 4.0 } else { 2.0 }).sum();
        0.5 + h / 3.0 * (density(0.0) + inner + density(x))
    }

    #[test]
    fn activations_are_accurate_and_vector_equals_scalar() {
        assert!(worst(Activation::Elu, |x| if x > 0.0 { x } else { math::exp_m1(x) }) < 2e-7);
        assert!(worst(Activation::Tanh, math::tanh) < 2e-7);
        assert!(worst(Activation::Sigmoid, |x| 1.0 / (1.0 + math::exp(-x))) < 2e-7);
        assert!(worst(Activation::Relu, |x| x.max(0.0)) == 0.0);
        let gelu = worst(Activation::Gelu, |x| x * normal_distribution(x));
        assert!(gelu < 2e-7, "{gelu}");
    }

    #[test]
    fn what_is_not_a_number_stays_so() {
        for activation in [Activation::Elu, Activation::Gelu, Activation::Tanh, Activation::Sigmoid] {
            let mut row = [1.0, f32::NAN, 2.0];
            finish(Level::new(), activation, 0.0, &mut row);
            assert_eq!(row.map(f32::is_nan), [false, true, false], "{activation:?}");
        }
    }

    #[test]
    fn softmax_columns_sum_to_one() {
        let mut rows: Vec<[f32; 4]> =
            (0..300).map(|r| std::array::from_fn(|c| math::sin((r * 7 + c * 13) as f32) * 9.0)).collect();
        let raw = rows.clone();
        let scale = softmax_columns(Level::new(), &mut rows);
        for c in 0..4 {
            let total: f64 = raw.iter().map(|r| math::exp(f64::from(r[c]))).sum();
            for (r, raw) in rows.iter().zip(&raw) {
                let exact = math::exp(f64::from(raw[c])) / total;
                assert!((f64::from(r[c] * scale[c]) - exact).abs() < 1e-6 * exact.max(1e-3));
            }
        }
    }
}
