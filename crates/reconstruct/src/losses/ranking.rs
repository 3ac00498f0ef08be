//! Agreement of the order of depths with a monocular depth prior: Plenodium's depth-ranking loss.
//!
//! ```text
//! p_k = mean of D / max D over patch k         q_k = mean of the prior / its maximum
//! L = 1/K² Σ_jk max(0, (p_j − p_k) (q_j − q_k))
//! ```
//!
//! A view has 16 × 16 patches, which overlap by a pixel where its sides are no multiples of 16. `D` is
//! expected depth, and its maximum has no gradient. The prior is disparity-like: larger is nearer, 0 is
//! unknown. So a pair of patches adds to the loss if depth and prior grow together. The means run over
//! pixels where both are known, and the K patches are those that have one.

use std::ops::Range;

use use3d_capture::Map;

use super::depth::known;
use super::{LossTerm, LossValue, Observation, Term, ViewGradients};
use crate::{DepthPrior, ReconstructParams};

/// The row of the depth-ranking term.
pub(super) const TERM: LossTerm =
    LossTerm { values: &[LossValue { name: "depth_ranking", weight }], term: || Box::new(DepthRanking) };

fn weight(params: &ReconstructParams, step: u64) -> f64 {
    let on = params.depth_prior != DepthPrior::Off && step < params.densify_end();
    if on { params.ranking_weight } else { 0.0 }
}

/// Patches along a side.
const PATCHES: usize = 16;

/// The depth-ranking term.
#[derive(Clone, Copy, Debug)]
pub(super) struct DepthRanking;

/// The pixels of patch `i` along a side of `n`.
fn patch(i: usize, n: usize) -> Range<usize> {
    i * n / PATCHES..((i + 1) * n).div_ceil(PATCHES)
}

impl DepthRanking {
    /// Returns the loss; overwrites `gradient` with `weight` times its gradient with respect to `depth`.
    pub(super) fn evaluate(self, depth: &Map, prior: &Map, weight: f64, gradient: &mut Map) -> f64 {
        let (width, height) = (depth.width(), depth.height());
        gradient.resize(width, height);
        gradient.data_mut().fill(0.0);
        let pairs = || depth.data().iter().zip(prior.data()).filter(|(d, p)| known(**d, **p));
        let most = |values: &mut dyn Iterator<Item = f32>| f64::from(values.fold(0.0, f32::max));
        let (deepest, nearest) = (most(&mut pairs().map(|(d, _)| *d)), most(&mut pairs().map(|(_, p)| *p)));
        // Columns, rows, number of pixels, depth and prior of every patch.
        let mut patches = Vec::with_capacity(PATCHES * PATCHES);
        for (columns, rows) in
            (0..PATCHES * PATCHES).map(|k| (patch(k % PATCHES, width), patch(k / PATCHES, height)))
        {
            let mut sums = [0.0f64; 3];
            for y in rows.clone() {
                let line = depth.row(0, y)[columns.clone()].iter().zip(&prior.row(0, y)[columns.clone()]);
                for (d, p) in line.filter(|(d, p)| known(**d, **p)) {
                    sums[0] += 1.0;
                    sums[1] += f64::from(*d) / deepest;
                    sums[2] += f64::from(*p) / nearest;
                }
            }
            if sums[0] > 0.0 {
                patches.push((columns, rows, sums[0], sums[1] / sums[0], sums[2] / sums[0]));
            }
        }
        let each = 1.0 / (patches.len() * patches.len()).max(1) as f64;
        let mut loss = 0.0;
        for (columns, rows, count, p, q) in &patches {
            let mut slope = 0.0;
            for (.., other_p, other_q) in &patches {
                let (dp, dq) = (p - other_p, q - other_q);
                if dp * dq > 0.0 {
                    loss += each * dp * dq;
                    // A pair is in the sum twice.
                    slope += 2.0 * each * dq;
                }
            }
            let slope = (weight * slope / (count * deepest)) as f32;
            for y in rows.clone() {
                let given = depth.row(0, y)[columns.clone()].iter().zip(&prior.row(0, y)[columns.clone()]);
                let line = &mut gradient.data_mut()[y * width..][columns.clone()];
                let counted = line.iter_mut().zip(given).filter(|(_, (d, p))| known(**d, **p));
                counted.for_each(|(g, _)| *g += slope);
            }
        }
        loss
    }
}

impl Term for DepthRanking {
    fn evaluate(
        &mut self,
        seen: &Observation<'_>,
        weights: &[f64],
        values: &mut [Option<f64>],
        gradients: &mut ViewGradients,
    ) {
        let Some(prior) = &seen.target.prior else { return };
        let value = gradients.depth.add(|g| DepthRanking::evaluate(*self, seen.depth, prior, weights[0], g));
        values[0] = Some(value);
    }
}
