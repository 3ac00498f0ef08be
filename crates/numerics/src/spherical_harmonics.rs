//! Real spherical harmonics to degree 3, in the order and signs of 3D Gaussian Splatting; Gaussians and
//! medium use the same basis.
//!
//! For a unit direction `(x, y, z)` the 16 values are `Y₀₀, Y₁₋₁ … Y₃₃`; a lower
//! degree `d` uses the first `(d+1)²`.

use fearless_simd::prelude::*;
use fearless_simd::{Simd, f32x16};

/// Constant of degree 0, `Y₀₀`.
pub const C0: f32 = 0.282_094_8;
/// Constant of degree 1.
pub const C1: f32 = 0.488_602_5;
/// Constants of degree 2.
pub const C2: [f32; 5] = [1.092_548_4, -1.092_548_4, 0.315_391_57, -1.092_548_4, 0.546_274_2];
/// Constants of degree 3.
pub const C3: [f32; 7] =
    [-0.590_043_6, 2.890_611_4, -0.457_045_8, 0.373_176_34, -0.457_045_8, 1.445_305_7, -0.590_043_6];

/// Number of basis functions of degree `degree` and below.
pub const fn bands(degree: usize) -> usize {
    (degree + 1) * (degree + 1)
}

/// The basis at the unit direction `d`; values above `degree` are zero. `degree` is 0 to 3.
#[inline]
pub fn basis(degree: usize, d: [f32; 3]) -> [f32; 16] {
    let [x, y, z] = d;
    let mut b = [0.0; 16];
    b[0] = C0;
    if degree >= 1 {
        b[1] = -C1 * y;
        b[2] = C1 * z;
        b[3] = -C1 * x;
    }
    if degree >= 2 {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        b[4] = C2[0] * (x * y);
        b[5] = C2[1] * (y * z);
        b[6] = C2[2] * (2.0 * zz - xx - yy);
        b[7] = C2[3] * (x * z);
        b[8] = C2[4] * (xx - yy);
        if degree >= 3 {
            b[9] = C3[0] * y * (3.0 * xx - yy);
            b[10] = C3[1] * (x * y) * z;
            b[11] = C3[2] * y * (4.0 * zz - xx - yy);
            b[12] = C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
            b[13] = C3[4] * x * (4.0 * zz - xx - yy);
            b[14] = C3[5] * z * (xx - yy);
            b[15] = C3[6] * x * (xx - 3.0 * yy);
        }
    }
    b
}

/// The basis of [`basis`] at 16 directions; values above `degree` are zero.
#[inline(always)]
pub fn basis_lanes<S: Simd>(
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math;

    /// The basis is orthonormal over the sphere: a Fibonacci lattice integrates the products.
    #[test]
    fn the_basis_is_orthonormal() {
        let n = 20_000;
        let mut gram = [[0.0f64; 16]; 16];
        for i in 0..n {
            let z = 1.0 - (2.0 * i as f64 + 1.0) / n as f64;
            let (r, phi) = ((1.0 - z * z).sqrt(), i as f64 * std::f64::consts::PI * (3.0 - 5f64.sqrt()));
            let b = basis(3, [(r * math::cos(phi)) as f32, (r * math::sin(phi)) as f32, z as f32]);
            for (row, &p) in gram.iter_mut().zip(&b) {
                for (cell, &q) in row.iter_mut().zip(&b) {
                    *cell += f64::from(p) * f64::from(q) * 4.0 * std::f64::consts::PI / n as f64;
                }
            }
        }
        for (i, row) in gram.iter().enumerate() {
            for (j, &g) in row.iter().enumerate() {
                assert!((g - f64::from(u8::from(i == j))).abs() < 2e-3, "<Y{i}, Y{j}> = {g}");
            }
        }
    }
}
