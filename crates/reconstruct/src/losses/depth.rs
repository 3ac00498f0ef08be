//! Agreement with a monocular depth prior, up to scale and shift.
//!
//! ```text
//! d = 1 / (10 max(D, 1e-6) + 1)         L = 1 − Pearson(d, prior)                    (R14)
//! ```
//!
//! The sums run over pixels with a finite, positive prior and positive rendered depth `D` (expected z).
//! With fewer than 32 of them, `L = 0`. The prior is disparity-like: larger is nearer, 0 is unknown.
//! `Pearson = mean(a b) / max(std a · std b, 1e-6)` of centred values with population moments. The factor
//! 10 assumes a normalised scene.

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;
use use3d_capture::Map;

use super::{LossTerm, LossValue, Observation, Term, ViewGradients};
use crate::{DepthPrior, ReconstructParams};

/// The row of the depth term.
pub(super) const TERM: LossTerm =
    LossTerm { values: &[LossValue { name: "depth_loss", weight }], term: || Box::new(DepthPriorLoss) };

fn weight(params: &ReconstructParams, _step: u64) -> f64 {
    if params.depth_prior == DepthPrior::Off { 0.0 } else { params.depth_weight }
}

/// The factor in `1 / (10 D + 1)`.
pub const DEPTH_SCALE: f32 = 10.0;
/// Smallest number of pixels for a loss.
pub const FEWEST_PIXELS: usize = 32;
const DEPTH_FLOOR: f32 = 1e-6;
const DEVIATION_FLOOR: f64 = 1e-6;
const BLOCK: usize = 1 << 13;

/// The depth term.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DepthPriorLoss;

impl DepthPriorLoss {
    /// Returns the loss; overwrites `gradient` with `weight` times its gradient with respect to `depth`.
    pub fn evaluate(self, depth: &Map, prior: &Map, weight: f64, gradient: &mut Map) -> f64 {
        gradient.resize(depth.width(), depth.height());
        let (depth, prior) = (depth.data(), prior.data());
        let level = Level::new();
        let partial: Vec<[f64; 6]> = depth
            .par_chunks(BLOCK)
            .zip(prior.par_chunks(BLOCK))
            .map(|(d, p)| dispatch!(level, _simd => moments(d, p)))
            .collect();
        let mut total = [0.0; 6];
        for block in &partial {
            for (t, v) in total.iter_mut().zip(block) {
                *t += v;
            }
        }
        let [n, d, p, dd, pp, dp] = total;
        if n < FEWEST_PIXELS as f64 {
            gradient.data_mut().fill(0.0);
            return 0.0;
        }
        let (mean_d, mean_p) = (d / n, p / n);
        let variance_d = (dd / n - mean_d * mean_d).max(0.0);
        let variance_p = (pp / n - mean_p * mean_p).max(0.0);
        let product = (variance_d * variance_p).sqrt();
        let correlation = (dp / n - mean_d * mean_p) / product.max(DEVIATION_FLOOR);
        // d L / d d_i = (own (d_i − mean) + other (prior_i − mean)); at the floor only the numerator
        // varies.
        let (own, other) = if product > DEVIATION_FLOOR {
            (weight * correlation / (n * variance_d), -weight / (n * product))
        } else {
            (0.0, -weight / (n * DEVIATION_FLOOR))
        };
        let constants = [own, mean_d, other, mean_p].map(|v| v as f32);
        gradient
            .data_mut()
            .par_chunks_mut(BLOCK)
            .zip(depth.par_chunks(BLOCK).zip(prior.par_chunks(BLOCK)))
            .for_each(|(g, (d, p))| dispatch!(level, _simd => backward(g, d, p, constants)));
        1.0 - correlation
    }
}

impl Term for DepthPriorLoss {
    fn evaluate(
        &mut self,
        seen: &Observation<'_>,
        weights: &[f64],
        values: &mut [Option<f64>],
        gradients: &mut ViewGradients,
    ) {
        let Some(prior) = &seen.target.prior else { return };
        let value =
            gradients.depth.add(|g| DepthPriorLoss::evaluate(*self, seen.depth, prior, weights[0], g));
        values[0] = Some(value);
    }
}

#[inline(always)]
fn disparity(depth: f32) -> f32 {
    1.0 / (DEPTH_SCALE * depth.max(DEPTH_FLOOR) + 1.0)
}

/// True if both are finite and positive.
#[inline(always)]
pub(super) fn known(depth: f32, prior: f32) -> bool {
    // NaN compares false; infinity is excluded explicitly.
    prior > 0.0 && prior < f32::INFINITY && depth > 0.0 && depth < f32::INFINITY
}

/// Count, Σd, Σp, Σd², Σp², Σdp of a block, eight interleaved sums each.
#[inline(always)]
fn moments(depth: &[f32], prior: &[f32]) -> [f64; 6] {
    const WAYS: usize = 8;
    let mut sums = [[0.0f64; WAYS]; 6];
    let add = |sums: &mut [[f64; WAYS]; 6], way: usize, depth: f32, prior: f32| {
        let valid = known(depth, prior);
        let (d, p) = if valid { (f64::from(disparity(depth)), f64::from(prior)) } else { (0.0, 0.0) };
        for (sum, term) in sums.iter_mut().zip([f64::from(u8::from(valid)), d, p, d * d, p * p, d * p]) {
            sum[way] += term;
        }
    };
    let (depths, priors) = (depth.chunks_exact(WAYS), prior.chunks_exact(WAYS));
    let rest = (depths.remainder(), priors.remainder());
    for (d, p) in depths.zip(priors) {
        for way in 0..WAYS {
            add(&mut sums, way, d[way], p[way]);
        }
    }
    for (&d, &p) in rest.0.iter().zip(rest.1) {
        add(&mut sums, 0, d, p);
    }
    sums.map(|ways| ways.iter().sum())
}

#[inline(always)]
fn backward(gradient: &mut [f32], depth: &[f32], prior: &[f32], [own, mean_d, other, mean_p]: [f32; 4]) {
    for ((g, &depth), &prior) in gradient.iter_mut().zip(depth).zip(prior) {
        let d = disparity(depth);
        let d_disparity = own * (d - mean_d) + other * (prior - mean_p);
        // d d / d D = −10 d²; zero below the floor.
        let d_depth = if depth > DEPTH_FLOOR { -DEPTH_SCALE * d * d } else { 0.0 };
        *g = if known(depth, prior) { d_disparity * d_depth } else { 0.0 };
    }
}
