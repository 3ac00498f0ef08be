//! Sixteen pixels at a time: the exponential, softplus, sigmoid and the spherical-harmonic basis, each with its scalar twin.
//!
//! `e^x = 2^n (1 + q(r))` with `n = round(x / ln 2)`, `r = x - n ln 2` in two steps, `q` a polynomial of degree 7 (relative error
//! below 1e-7). `ln(1 + t) = 2 artanh(t / (2 + t))` for `0 ≤ t ≤ 1`, again a polynomial. The scalar twin does the same operations
//! in the same order, so both give the same bits wherever fused multiply-add exists.

use fearless_simd::prelude::*;
use fearless_simd::{Simd, f32x16, i32x16};
use use3d_numerics::spherical_harmonics::{C0, C1, C2, C3};

/// Pixels per vector.
pub(crate) const LANES: usize = 16;

const LOG2_E: f32 = std::f32::consts::LOG2_E;
/// `ln 2` in two parts; the first has few enough bits that `n · LN2_HIGH` is exact.
const LN2_HIGH: f32 = 0.693_359_4;
const LN2_LOW: f32 = -2.121_944_4e-4;
/// `e^r - 1 - r` over `r²`.
const EXP: [f32; 6] = [1.0 / 2.0, 1.0 / 6.0, 1.0 / 24.0, 1.0 / 120.0, 1.0 / 720.0, 1.0 / 5040.0];
/// `artanh(s) / s - 1` over `s²`.
const ARTANH: [f32; 8] =
    [1.0 / 3.0, 1.0 / 5.0, 1.0 / 7.0, 1.0 / 9.0, 1.0 / 11.0, 1.0 / 13.0, 1.0 / 15.0, 1.0 / 17.0];
/// Below this `e^x` is taken as `e^LOWEST`, 1.6e-38.
const LOWEST: f32 = -87.0;

/// Loads lanes `i..i + 16` of a row, zeros beyond its end.
#[inline(always)]
pub(crate) fn load<S: Simd>(simd: S, row: &[f32], i: usize) -> f32x16<S> {
    if let Some(full) = row.get(i..i + LANES) {
        f32x16::from_slice(simd, full)
    } else {
        let mut padded = [0.0; LANES];
        padded[..row.len() - i].copy_from_slice(&row[i..]);
        f32x16::from_slice(simd, &padded)
    }
}

/// Stores lanes `i..i + 16` of a row, dropping those beyond its end.
#[inline(always)]
pub(crate) fn store<S: Simd>(value: f32x16<S>, row: &mut [f32], i: usize) {
    if let Some(full) = row.get_mut(i..i + LANES) {
        value.store_slice(full);
    } else {
        let rest = row.len() - i;
        row[i..].copy_from_slice(&value.as_slice()[..rest]);
    }
}

/// `(2^n, e^r - 1)` of `x ≤ 0`.
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
pub(crate) fn exp<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let (scale, q) = exp_parts(simd, x);
    scale.mul_add(q, scale)
}

/// `softplus(x) = ln(1 + e^x)`.
#[inline(always)]
pub(crate) fn softplus<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let zero = f32x16::splat(simd, 0.0);
    let t = exp(simd, zero - x.abs());
    let s = t / (t + 2.0);
    let ss = s * s;
    let mut p = f32x16::splat(simd, ARTANH[7]);
    for k in (0..7).rev() {
        p = p.mul_add(ss, ARTANH[k]);
    }
    let artanh = (s * ss).mul_add(p, s);
    artanh.mul_add(2.0, x.max(zero))
}

/// The slope of softplus from its value `y = ln(1 + e^x)`: `e^x / (1 + e^x) = 1 - e^{-y}`.
#[inline(always)]
pub(crate) fn softplus_slope<S: Simd>(simd: S, y: f32x16<S>) -> f32x16<S> {
    let (scale, q) = exp_parts(simd, f32x16::splat(simd, 0.0) - y);
    f32x16::splat(simd, 0.0) - scale.mul_add(q, scale - 1.0)
}

/// `1 / (1 + e^{-x})`.
#[inline(always)]
pub(crate) fn sigmoid<S: Simd>(simd: S, x: f32x16<S>) -> f32x16<S> {
    let zero = f32x16::splat(simd, 0.0);
    let one = f32x16::splat(simd, 1.0);
    let t = exp(simd, zero - x.abs());
    let small = t / (t + 1.0);
    x.simd_ge(zero).select(one - small, small)
}

/// The basis of [`use3d_numerics::spherical_harmonics::basis`] at 16 directions; values above `degree` are zero.
#[inline(always)]
pub(crate) fn basis<S: Simd>(
    simd: S,
    degree: usize,
    x: f32x16<S>,
    y: f32x16<S>,
    z: f32x16<S>,
) -> [f32x16<S>; 16] {
    let mut b = [f32x16::splat(simd, 0.0); 16];
    b[0] = f32x16::splat(simd, C0);
    if degree >= 1 {
        b[1] = y * -C1;
        b[2] = z * C1;
        b[3] = x * -C1;
    }
    if degree >= 2 {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        b[4] = (x * y) * C2[0];
        b[5] = (y * z) * C2[1];
        b[6] = (zz * 2.0 - xx - yy) * C2[2];
        b[7] = (x * z) * C2[3];
        b[8] = (xx - yy) * C2[4];
        if degree >= 3 {
            b[9] = y * C3[0] * (xx * 3.0 - yy);
            b[10] = (x * y) * C3[1] * z;
            b[11] = y * C3[2] * (zz * 4.0 - xx - yy);
            b[12] = z * C3[3] * (zz * 2.0 - xx * 3.0 - yy * 3.0);
            b[13] = x * C3[4] * (zz * 4.0 - xx - yy);
            b[14] = z * C3[5] * (xx - yy);
            b[15] = x * C3[6] * (xx - yy * 3.0);
        }
    }
    b
}

/// Scalar twins, operation for operation.
#[cfg(test)]
pub(crate) mod scalar {
    use super::*;

    fn exp_parts(x: f32) -> (f32, f32) {
        let x = x.max(LOWEST);
        let n = (x * LOG2_E).round_ties_even();
        let r = n.mul_add(-LN2_LOW, n.mul_add(-LN2_HIGH, x));
        let p = EXP[..5].iter().rev().fold(EXP[5], |p, &c| p.mul_add(r, c));
        let q = (r * r).mul_add(p, r);
        (f32::from_bits(((n as i32 + 127) << 23) as u32), q)
    }

    pub(crate) fn exp(x: f32) -> f32 {
        let (scale, q) = exp_parts(x);
        scale.mul_add(q, scale)
    }

    pub(crate) fn softplus(x: f32) -> f32 {
        let t = exp(-x.abs());
        let s = t / (t + 2.0);
        let ss = s * s;
        let p = ARTANH[..7].iter().rev().fold(ARTANH[7], |p, &c| p.mul_add(ss, c));
        (s * ss).mul_add(p, s).mul_add(2.0, x.max(0.0))
    }

    pub(crate) fn softplus_slope(y: f32) -> f32 {
        let (scale, q) = exp_parts(-y);
        0.0 - scale.mul_add(q, scale - 1.0)
    }

    pub(crate) fn sigmoid(x: f32) -> f32 {
        let t = exp(-x.abs());
        let small = t / (t + 1.0);
        if x >= 0.0 { 1.0 - small } else { small }
    }
}

#[cfg(test)]
mod tests {
    use fearless_simd::{Level, dispatch};

    use super::*;
    use use3d_numerics::math;

    /// Whether the vector code fuses multiply and add here, as the scalar twin always does.
    fn fused() -> bool {
        #[cfg(target_arch = "x86_64")]
        return std::arch::is_x86_feature_detected!("fma");
        #[cfg(not(target_arch = "x86_64"))]
        return cfg!(target_arch = "aarch64");
    }

    #[inline(always)]
    fn all<S: Simd>(simd: S, x: &[f32; 16]) -> [[f32; 16]; 4] {
        let v = f32x16::from_slice(simd, x);
        let negative = f32x16::splat(simd, 0.0) - v.abs();
        [
            exp(simd, negative).to_array(),
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
                if fused() {
                    assert_eq!(e[i].to_bits(), scalar::exp(-v.abs()).to_bits());
                    assert_eq!(s[i].to_bits(), scalar::softplus(v).to_bits());
                    assert_eq!(d[i].to_bits(), scalar::softplus_slope(v.abs()).to_bits());
                    assert_eq!(g[i].to_bits(), scalar::sigmoid(v).to_bits());
                }
            }
        }
    }
}
