//! Measures how much the fused targets depend on the order of the views.
//!
//! Fusion one by one is not commutative: the first two views of a Gaussian have no Cauchy factor, and every
//! factor is computed with the mean so far. The effect is measured on Gaussians that both orders support,
//! as the largest `|Δμ_j| / s_j` over the six channels: interquartile units of the paired data.

use serde::{Deserialize, Serialize};

use super::LocalConsensus;

/// Differences between two orders of the same views.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct OrderEffect {
    /// Number of Gaussians compared.
    pub compared: usize,
    /// Median of the difference, interquartile units.
    pub median: f64,
    /// Its 95th percentile.
    pub percentile_95: f64,
    /// Share of the Gaussians that differ by less than 0.1.
    pub within_tenth: f64,
}

/// Compares two fusions of the same views.
pub fn order_effect(a: &LocalConsensus, b: &LocalConsensus, scales: &[f64; 6]) -> OrderEffect {
    let mut differences: Vec<f64> = (0..a.count.len().min(b.count.len()))
        .filter(|&i| a.supported(i) && b.supported(i))
        .map(|i| {
            (0..6).fold(0.0f64, |m, k| {
                m.max((f64::from(a.mean[i][k]) - f64::from(b.mean[i][k])).abs() / scales[k])
            })
        })
        .collect();
    if differences.is_empty() {
        return OrderEffect::default();
    }
    differences.sort_unstable_by(f64::total_cmp);
    let at = |q: f64| differences[((differences.len() - 1) as f64 * q).round() as usize];
    OrderEffect {
        compared: differences.len(),
        median: at(0.5),
        percentile_95: at(0.95),
        within_tenth: differences.partition_point(|&d| d < 0.1) as f64 / differences.len() as f64,
    }
}
