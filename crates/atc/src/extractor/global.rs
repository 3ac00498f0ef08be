//! The global operator: a weighted, identity-centred ridge fit of one affine between two images.
//!
//! With `x̃ = (r, g, b, 1)` of the source, `y` the target, `Y` the source's luminance and `S` the logistic
//! function,
//!
//! ```text
//! w  = 0.05 + 0.95 S((Y − 0.005) / 0.02) S((1.2 − Y) / 0.10)
//! A  = Σ w x̃ x̃ᵀ,   λ = 10⁻³ max(mean diag A, 10⁻⁴)
//! M − [I|0] = ( Σ w (y − x) x̃ᵀ ) (A + λ I)⁻¹
//! ```
//!
//! This minimises `Σ w ‖M x̃ − y‖² + λ ‖M − [I|0]‖²`: the ridge shrinks all four columns towards the
//! identity (R15). `A`, its inverse and `w` depend on the source alone. The fit is linear in `y`, so with
//! `K = (∂L/∂M)(A + λ I)⁻¹` the gradient is `∂L/∂y = w K x̃`. Sums and the solve are in f64. The fit is a
//! contraction: colour directions that the source hardly contains are shrunk towards the identity, so
//! `E(I, T(I)) = T` holds only up to that shrinkage.

use rayon::prelude::*;
use use3d_capture::{Image, Map};
use use3d_numerics::math;

use super::Affine;
use crate::vectorized::{LANES, total, vectorized};

/// The relative ridge.
const RIDGE: f64 = 1e-3;
/// Floor of the mean squared feature that scales the ridge.
const ENERGY_FLOOR: f64 = 1e-4;
/// The weights of BT.601 luminance.
pub(crate) const LUMINANCE: [f64; 3] = [0.299, 0.587, 0.114];

/// The weight of every source pixel: small where it is black or brighter than white.
pub(crate) fn pixel_weights(source: &Image) -> Map {
    let logistic = |v: f64| 1.0 / (1.0 + math::exp(-v));
    let mut weights = Map::new(source.width(), source.height());
    let [r, g, b] = source.planes();
    weights.data_mut().par_iter_mut().enumerate().for_each(|(p, w)| {
        let y =
            LUMINANCE[0] * f64::from(r[p]) + LUMINANCE[1] * f64::from(g[p]) + LUMINANCE[2] * f64::from(b[p]);
        *w = (0.05 + 0.95 * logistic((y - 0.005) / 0.02) * logistic((1.2 - y) / 0.10)) as f32;
    });
    weights
}

/// The part of the fit that depends on the source alone: `(A + λ I)⁻¹`, symmetric.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Ridge {
    inverse: [[f64; 4]; 4],
}

impl Ridge {
    /// Sums the source's moments and inverts. `None` if a source pixel is not finite.
    pub(crate) fn new(source: &Image, weights: &Map) -> Option<Self> {
        let (w, h) = (source.width(), source.height());
        let rows: Vec<[f64; 10]> = (0..h)
            .into_par_iter()
            .map(|y| {
                let mut sums = [0.0; 10];
                for x in 0..w {
                    let [r, g, b] = source.pixel(x, y).map(f64::from);
                    let feature = [r, g, b, 1.0];
                    let weight = f64::from(weights.pixel(x, y)[0]);
                    let mut k = 0;
                    for i in 0..4 {
                        for j in i..4 {
                            sums[k] += weight * feature[i] * feature[j];
                            k += 1;
                        }
                    }
                }
                sums
            })
            .collect();
        let mut upper = [0.0; 10];
        for row in &rows {
            for (u, v) in upper.iter_mut().zip(row) {
                *u += v;
            }
        }
        let mut a = [[0.0; 4]; 4];
        let mut k = 0;
        for i in 0..4 {
            for j in i..4 {
                a[i][j] = upper[k];
                a[j][i] = upper[k];
                k += 1;
            }
        }
        let mean_diagonal = (a[0][0] + a[1][1] + a[2][2] + a[3][3]) / 4.0;
        let lambda = RIDGE * mean_diagonal.max(ENERGY_FLOOR);
        for (i, row) in a.iter_mut().enumerate() {
            row[i] += lambda;
        }
        invert_positive_definite(&a).map(|inverse| Self { inverse })
    }

    /// Computes `M − [I|0]` for a target of the source's size. `row_sums` is working memory.
    pub(crate) fn forward(
        &self,
        source: &Image,
        weights: &Map,
        target: &Image,
        row_sums: &mut Vec<Affine>,
    ) -> Affine {
        row_sums.resize(source.height(), [0.0; 12]);
        row_sums.par_iter_mut().enumerate().for_each(|(y, sums)| {
            let x: [&[f32]; 3] = std::array::from_fn(|c| source.row(c, y));
            let t: [&[f32]; 3] = std::array::from_fn(|c| target.row(c, y));
            *sums = vectorized!(correlate_row(x, weights.row(0, y), t));
        });
        let mut correlation = [0.0; 12];
        for sums in row_sums.iter() {
            for (c, s) in correlation.iter_mut().zip(sums) {
                *c += s;
            }
        }
        self.times_inverse(&correlation)
    }

    /// `rows (A + λ I)⁻¹`: `K` of the module's header for the gradient with respect to the operator.
    pub(crate) fn times_inverse(&self, rows: &Affine) -> Affine {
        std::array::from_fn(|i| {
            let (c, j) = (i / 4, i % 4);
            (0..4).map(|k| rows[4 * c + k] * self.inverse[k][j]).sum()
        })
    }
}

/// `Σ w (y − x) x̃ᵀ` over one row, in eight fixed partial sums.
#[inline(always)]
fn correlate_row(x: [&[f32]; 3], w: &[f32], y: [&[f32]; 3]) -> Affine {
    let mut acc = [[0.0f64; LANES]; 12];
    let n = w.len();
    let whole = n - n % LANES;
    let mut at = 0;
    while at < whole {
        let chunk = |s: &[f32]| -> [f64; LANES] {
            let s = &s[at..at + LANES];
            std::array::from_fn(|l| f64::from(s[l]))
        };
        let (r, g, b, w) = (chunk(x[0]), chunk(x[1]), chunk(x[2]), chunk(w));
        let features = [r, g, b];
        for c in 0..3 {
            let target = chunk(y[c]);
            let mut difference = [0.0; LANES];
            for l in 0..LANES {
                difference[l] = (target[l] - features[c][l]) * w[l];
            }
            for l in 0..LANES {
                acc[4 * c][l] += difference[l] * r[l];
            }
            for l in 0..LANES {
                acc[4 * c + 1][l] += difference[l] * g[l];
            }
            for l in 0..LANES {
                acc[4 * c + 2][l] += difference[l] * b[l];
            }
            for l in 0..LANES {
                acc[4 * c + 3][l] += difference[l];
            }
        }
        at += LANES;
    }
    for p in whole..n {
        let feature = [f64::from(x[0][p]), f64::from(x[1][p]), f64::from(x[2][p]), 1.0];
        for c in 0..3 {
            let difference = (f64::from(y[c][p]) - feature[c]) * f64::from(w[p]);
            for j in 0..4 {
                acc[4 * c + j][p - whole] += difference * feature[j];
            }
        }
    }
    std::array::from_fn(|i| total(&acc[i]))
}

/// The inverse of a symmetric positive definite matrix by Cholesky; `None` if it is not positive definite
/// or not finite.
pub(crate) fn invert_positive_definite(a: &[[f64; 4]; 4]) -> Option<[[f64; 4]; 4]> {
    let mut l = [[0.0; 4]; 4];
    for i in 0..4 {
        for j in 0..=i {
            let sum = a[i][j] - (0..j).map(|k| l[i][k] * l[j][k]).sum::<f64>();
            if i == j {
                if !(sum > 0.0 && sum.is_finite()) {
                    return None;
                }
                l[i][i] = sum.sqrt();
            } else {
                l[i][j] = sum / l[j][j];
            }
        }
    }
    let mut inverse = [[0.0; 4]; 4];
    for column in 0..4 {
        let mut v = [0.0; 4];
        for i in 0..4 {
            let unit = f64::from(u8::from(i == column));
            v[i] = (unit - (0..i).map(|k| l[i][k] * v[k]).sum::<f64>()) / l[i][i];
        }
        for i in (0..4).rev() {
            v[i] = (v[i] - (i + 1..4).map(|k| l[k][i] * v[k]).sum::<f64>()) / l[i][i];
        }
        for i in 0..4 {
            inverse[i][column] = v[i];
        }
    }
    Some(inverse)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `0.05 + 0.95 S((Y − 0.005) / 0.02) S((1.2 − Y) / 0.10)` of greys, by numpy in float64.
    #[test]
    fn black_and_burnt_out_pixels_count_little() {
        for (grey, expected) in [
            (-0.1, 0.05495910819966238),
            (0.0, 0.46592976859766944),
            (0.02, 0.6952149221638723),
            (0.5, 0.9991345013483941),
            (1.2, 0.525),
            (1.5, 0.09505457951868843),
        ] {
            let found = f64::from(pixel_weights(&Image::filled(1, 1, grey)).data()[0]);
            assert!((found - expected).abs() < 2e-6, "{grey}: {found}, expected {expected}");
        }
    }

    #[test]
    fn the_inverse_inverts() {
        let a = [[4.0, 1.0, 0.5, 0.2], [1.0, 3.0, 0.3, 0.1], [0.5, 0.3, 2.0, 0.7], [0.2, 0.1, 0.7, 5.0]];
        let inverse = invert_positive_definite(&a).unwrap();
        for i in 0..4 {
            for j in 0..4 {
                let product: f64 = (0..4).map(|k| a[i][k] * inverse[k][j]).sum();
                assert!((product - f64::from(u8::from(i == j))).abs() < 1e-14);
            }
        }
        assert!(invert_positive_definite(&[[f64::NAN; 4]; 4]).is_none());
        assert!(invert_positive_definite(&[[0.0; 4]; 4]).is_none());
    }
}
