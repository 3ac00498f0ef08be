//! Errors of the shared parameters: the sandwich `H⁻¹ M H⁻¹`, with H the curvature of loss and penalty, and
//! M the scatter of the blocks' gradients.
//!
//! It stays valid if the errors are not those that the loss assumes, and if neighbouring points have common
//! errors. The gains are included, so that the uncertainty they cause is counted.

use crate::formation::{BACKSCATTER, Channel, GAIN, VEIL, all_terms, normal, square};
use crate::solve::{CAUCHY, ChannelFit, Prior, submatrix};
use use3d_numerics::cholesky::Factor;
use use3d_numerics::order::median;

/// Errors of the shared parameters.
#[derive(Clone, Debug)]
pub(crate) struct Covariance {
    /// Standard errors of `ln β_a`, `ln β_b`, `ln B_0`, `g`.
    pub(crate) errors: [f64; GAIN],
    /// Covariance of the components of `g`.
    pub(crate) slope: [f64; 9],
    /// Correlation of the errors of `ln β_b` and `ln B_0`.
    pub(crate) backscatter_veil: f64,
    /// Standard error of `ln β_b` without any assumption about `β_b/β_a`.
    pub(crate) backscatter_alone: f64,
    /// Number of observations per independent one: the blocks' scatter divided by the scatter that
    /// independent observations would have; the median over the parameters.
    pub(crate) design_effect: f64,
}

/// Computes the errors of a fit.
pub(crate) fn covariance(
    channel: &Channel,
    sigmas: &[f64],
    best: &ChannelFit,
    prior: &Prior,
    block: &[usize],
    count: usize,
) -> Covariance {
    let n = channel.parameters();
    let mut scores = vec![vec![0.0; n]; count];
    let terms = all_terms(channel, &best.theta);
    let system = normal(channel, &terms, &best.weights, prior.gain > 0.0, |p, index, part| {
        for (&k, value) in index.iter().zip(part) {
            scores[block[p]][k] += value;
        }
    });
    // The weights overstate the loss's curvature; this is the mean factor.
    let (mut bend, mut weight) = (0.0, 0.0);
    for (r, s) in best.residuals.iter().zip(sigmas) {
        let u = square(r / (s * CAUCHY));
        bend += (1.0 - u) / square(1.0 + u) / (s * s);
        weight += 1.0 / (1.0 + u) / (s * s);
    }
    let curvature = (bend / weight.max(1e-300)).clamp(0.2, 1.0);
    let with = |prior: &Prior| sandwich(&system.matrix, curvature, &scores, best, prior);
    let unknown = f64::INFINITY;
    let loose = Prior { ratio: (prior.ratio.0, 1e3), ..prior.clone() };
    let alone = with(&loose).map_or(unknown, |(v, _)| v[BACKSCATTER * GAIN + BACKSCATTER].max(0.0).sqrt());
    match with(prior) {
        Some((v, design_effect)) => {
            let error = |k: usize| v[k * GAIN + k].max(0.0).sqrt();
            let product = error(BACKSCATTER) * error(VEIL);
            Covariance {
                errors: std::array::from_fn(error),
                slope: std::array::from_fn(|i| v[(VEIL + 1 + i / 3) * GAIN + VEIL + 1 + i % 3]),
                backscatter_veil: if product > 0.0 { v[BACKSCATTER * GAIN + VEIL] / product } else { 0.0 },
                backscatter_alone: alone,
                design_effect,
            }
        }
        None => Covariance {
            errors: [unknown; GAIN],
            slope: [0.0; 9],
            backscatter_veil: 0.0,
            backscatter_alone: unknown,
            design_effect: 1.0,
        },
    }
}

/// The part of the sandwich that belongs to the shared parameters, row-major, and the design effect; `None`
/// if the curvature is singular.
fn sandwich(
    matrix: &[f64],
    curvature: f64,
    scores: &[Vec<f64>],
    best: &ChannelFit,
    prior: &Prior,
) -> Option<([f64; GAIN * GAIN], f64)> {
    let n = best.theta.len();
    let mut full: Vec<f64> = matrix.iter().map(|v| v * curvature).collect();
    prior.add(&best.theta, &mut vec![0.0; n], &mut full);
    let free: Vec<usize> = (0..n).filter(|&k| prior.free(k)).collect();
    let factor = Factor::new(submatrix(&full, n, &free), free.len())?;
    // H⁻¹ times every block's gradient; the penalty's gradient balances the blocks' mean.
    let count = scores.len() as f64;
    let mean: Vec<f64> = free.iter().map(|&k| scores.iter().map(|s| s[k]).sum::<f64>() / count).collect();
    let mut out = [0.0; GAIN * GAIN];
    for score in scores {
        let centered: Vec<f64> = free.iter().zip(&mean).map(|(&k, m)| score[k] - m).collect();
        let moved = factor.solve(&centered);
        for (a, &i) in free.iter().enumerate().filter(|(_, i)| **i < GAIN) {
            for (b, &j) in free.iter().enumerate().filter(|(_, j)| **j < GAIN) {
                out[i * GAIN + j] += moved[a] * moved[b] * count / (count - 1.0).max(1.0);
            }
        }
    }
    // The assumptions are uncertain too: this adds H⁻¹ P H⁻¹ with the penalty's curvature P.
    let mut penalty = vec![0.0; n * n];
    prior.add(&best.theta, &mut vec![0.0; n], &mut penalty);
    let columns: Vec<Vec<f64>> = (0..GAIN)
        .map(|k| {
            let unit: Vec<f64> = free.iter().map(|&i| if i == k { 1.0 } else { 0.0 }).collect();
            factor.solve(&unit)
        })
        .collect();
    let effects = (free.iter().enumerate().filter(|(_, k)| **k < GAIN))
        .map(|(a, &k)| out[k * GAIN + k] / columns[k][a])
        .filter(|e| e.is_finite());
    let design_effect = median(effects).unwrap_or(1.0).max(1.0);
    for i in 0..GAIN {
        for j in 0..GAIN {
            for (a, &p) in free.iter().enumerate() {
                for (b, &q) in free.iter().enumerate() {
                    let value = penalty[p * n + q];
                    if value != 0.0 {
                        out[i * GAIN + j] += columns[i][a] * value * columns[j][b];
                    }
                }
            }
        }
    }
    Some((out, design_effect))
}
