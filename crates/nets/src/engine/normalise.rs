//! Normalisations, all with the population (biased) variance: `(x − mean) / √(variance + ε)`.
//!
//! Means and variances are f64 sums in a fixed order, in two passes, so that nearly constant maps do not lose
//! precision.

use fearless_simd::{Level, Simd, dispatch};
use rayon::prelude::*;

use super::activation::{self, Activation};
use super::planes::Planes;

/// Mean and 1/√(variance + ε) of a slice.
fn moments(level: Level, values: &[f32], epsilon: f64) -> (f32, f32) {
    #[inline(always)]
    fn run<S: Simd>(_: S, values: &[f32]) -> (f64, f64) {
        #[inline(always)]
        fn total(values: &[f32], term: impl Fn(f64) -> f64) -> f64 {
            let mut lanes = [0.0f64; 16];
            let (chunks, rest) = values.as_chunks::<16>();
            for chunk in chunks {
                for i in 0..16 {
                    lanes[i] += term(f64::from(chunk[i]));
                }
            }
            lanes.iter().sum::<f64>() + rest.iter().map(|&v| term(f64::from(v))).sum::<f64>()
        }
        let n = values.len() as f64;
        let mean = total(values, |v| v) / n;
        (mean, total(values, |v| (v - mean) * (v - mean)) / n)
    }
    let (mean, variance) = dispatch!(level, simd => run(simd, values));
    (mean as f32, (1.0 / (variance + epsilon).sqrt()) as f32)
}

/// Normalises every plane over all its pixels, without learned scale, then applies an activation.
pub(crate) fn instance(planes: &mut Planes, epsilon: f64, activation: Activation) {
    let (level, area) = (Level::new(), planes.area());
    planes.data.par_chunks_mut(area).for_each(|plane| {
        let (mean, scale) = moments(level, plane, epsilon);
        activation::normalise(level, activation, mean, scale, 0.0, plane);
    });
}

/// Normalises groups of neighbouring channels, with a learned scale and shift per channel.
pub(crate) fn group(
    planes: &mut Planes,
    groups: usize,
    epsilon: f64,
    affine: &Affine,
    activation: Activation,
) {
    let (level, area) = (Level::new(), planes.area());
    let channels = planes.channels / groups;
    for (g, values) in planes.data.chunks_exact_mut(channels * area).enumerate() {
        let (mean, scale) = moments(level, values, epsilon);
        for (i, plane) in values.chunks_exact_mut(area).enumerate() {
            let c = g * channels + i;
            activation::normalise(level, activation, mean, scale * affine.scale[c], affine.shift[c], plane);
        }
    }
}

/// A learned scale and shift per channel.
#[derive(Clone, Debug)]
pub(crate) struct Affine {
    pub(crate) scale: Vec<f32>,
    pub(crate) shift: Vec<f32>,
}

/// Normalises every token (column) over its channels, with a learned scale and shift.
pub(crate) fn layer(tokens: &Planes, epsilon: f64, affine: &Affine) -> Planes {
    const BLOCK: usize = 128;
    let (level, columns, channels) = (Level::new(), tokens.area(), tokens.channels);
    let mut statistics = vec![[0.0f32; 2]; columns];
    statistics.par_chunks_mut(BLOCK).enumerate().for_each(|(b, out)| {
        let first = b * BLOCK;
        column_moments(level, &tokens.data, columns, first, epsilon, out);
    });
    let (means, scales): (Vec<f32>, Vec<f32>) = statistics.into_iter().map(|[m, s]| (m, s)).unzip();
    let mut out = Planes::new(channels, tokens.height, tokens.width);
    out.data.par_chunks_mut(columns).zip(tokens.data.par_chunks(columns)).enumerate().for_each(
        |(c, (out, row))| {
            let (scale, shift) = (affine.scale[c], affine.shift[c]);
            for i in 0..columns {
                out[i] = (row[i] - means[i]) * scales[i] * scale + shift;
            }
        },
    );
    out
}

/// Mean and reciprocal deviation of columns `first..first + out.len()` of `[rows, columns]`.
fn column_moments(
    level: Level,
    values: &[f32],
    columns: usize,
    first: usize,
    epsilon: f64,
    out: &mut [[f32; 2]],
) {
    #[inline(always)]
    fn add_row<S: Simd>(_: S, row: &[f32], means: &[f64], power: i32, sums: &mut [f64]) {
        if power == 1 {
            sums.iter_mut().zip(row).for_each(|(s, &v)| *s += f64::from(v));
        } else {
            for ((s, &v), m) in sums.iter_mut().zip(row).zip(means) {
                let d = f64::from(v) - m;
                *s += d * d;
            }
        }
    }
    let n = out.len();
    let rows = (values.len() / columns) as f64;
    let mut means = vec![0.0; n];
    let mut sums = vec![0.0; n];
    for power in [1, 2] {
        sums.fill(0.0);
        for row in values.chunks_exact(columns) {
            let row = &row[first..first + n];
            dispatch!(level, simd => add_row(simd, row, &means, power, &mut sums));
        }
        if power == 1 {
            means.iter_mut().zip(&sums).for_each(|(m, s)| *m = s / rows);
        }
    }
    for (i, o) in out.iter_mut().enumerate() {
        *o = [means[i] as f32, (1.0 / (sums[i] / rows + epsilon).sqrt()) as f32];
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::noise;
    use use3d_numerics::math;

    #[test]
    fn normalised_values_have_mean_zero_and_the_variance_that_epsilon_leaves() {
        let data: Vec<f32> = noise(1, 3 * 35).iter().map(|v| 0.9 + 3e-3 * v).collect();
        let raw = Planes::from_data(3, 5, 7, data);
        let mut planes = raw.clone();
        instance(&mut planes, 1e-5, Activation::Identity);
        for c in 0..3 {
            let plane: Vec<f64> = raw.plane(c).iter().map(|&v| f64::from(v)).collect();
            let mean = plane.iter().sum::<f64>() / 35.0;
            let variance = plane.iter().map(|v| math::powi(v - mean, 2)).sum::<f64>() / 35.0;
            for (a, v) in planes.plane(c).iter().zip(&plane) {
                assert!((f64::from(*a) - (v - mean) / (variance + 1e-5).sqrt()).abs() < 5e-5);
            }
        }
    }

    #[test]
    fn layer_norm_works_column_by_column_and_group_norm_group_by_group() {
        let (channels, columns) = (6, 300);
        let tokens = Planes::from_data(channels, 1, columns, noise(2, channels * columns));
        let affine = Affine { scale: noise(3, channels), shift: noise(4, channels) };
        let out = layer(&tokens, 1e-6, &affine);
        for t in 0..columns {
            // A column as one group of `channels` planes of one pixel must give the same result.
            let column = (0..channels).map(|c| tokens.plane(c)[t]).collect();
            let mut one = Planes::from_data(channels, 1, 1, column);
            group(&mut one, 1, 1e-6, &affine, Activation::Identity);
            for c in 0..channels {
                assert!((one.data[c] - out.plane(c)[t]).abs() < 1e-6);
            }
        }
    }
}
