//! A head of the calibrator in residual form, and its loss.
//!
//! With condition `c`, proposal `p`, medians `m` and interquartile ranges `s` of conditions (`c`) and
//! residuals (`r`),
//!
//! ```text
//! prediction = p + ( MLP( (c − m_c) / max(s_c, 10⁻⁵) ) ⊙ s_r + m_r )
//! loss       = Σ_rows w mean_k SmoothL1_{β=½}( (prediction − target)_k / max(s_r, 10⁻⁵)_k ) / max(Σ w, 10⁻⁶)
//! ```
//!
//! The output is not bounded. The statistics are those of the residual `target − proposal`, so a head of
//! zeros with a zero median returns the proposal.

use super::mlp::{Mlp, Trace};
use super::statistics::{CONDITION_FLOOR, Statistics};

/// The error at which the Smooth-L1 loss changes from quadratic to linear.
const BETA: f64 = 0.5;

/// One head: network and statistics.
#[derive(Clone, Debug, PartialEq)]
pub struct Head {
    /// The network.
    pub mlp: Mlp,
    /// Statistics of the conditions.
    pub condition: Statistics,
    /// Statistics of the residual `target − proposal`. Its ranges are the scales `s_g` or `s_ℓ` of stage 2;
    /// with the paper's scales as parameter, they are the ranges of the targets instead (R19).
    pub residual: Statistics,
}

/// Rows of samples for one head.
pub(super) struct HeadBatch<'a> {
    /// Normalised conditions.
    pub(super) conditions: &'a [f32],
    /// Proposals.
    pub(super) proposals: &'a [f32],
    /// Targets.
    pub(super) targets: &'a [f32],
    /// Row weights; `None` counts each row once.
    pub(super) weights: Option<&'a [f32]>,
}

impl Head {
    /// The head that returns the proposal.
    pub fn identity(inputs: usize, hidden: usize, outputs: usize) -> Self {
        Self {
            mlp: Mlp::zeros(inputs, hidden, outputs),
            condition: Statistics::neutral(inputs),
            residual: Statistics::neutral(outputs),
        }
    }

    /// The same head with only a share of its correction: 0 returns the proposal. The ranges, which are the
    /// scales of stage 2, stay.
    pub(super) fn damped(&self, share: f32) -> Self {
        let mut head = self.clone();
        let [.., last] = &mut head.mlp.layers;
        let correction = last.weight.iter_mut().chain(&mut last.bias).chain(&mut head.residual.median);
        correction.for_each(|v| *v *= share);
        head
    }

    /// True if it can change a proposal: its last layer and its median residual are not all zero.
    pub(super) fn corrects(&self) -> bool {
        let [.., last] = &self.mlp.layers;
        last.weight.iter().chain(&last.bias).chain(&self.residual.median).any(|v| *v != 0.0)
    }

    /// The residual of output `k` for the network's output `value`.
    #[inline]
    pub(super) fn residual_of(&self, k: usize, value: f32) -> f64 {
        f64::from(value) * f64::from(self.residual.range[k]) + f64::from(self.residual.median[k])
    }

    /// Computes the network's outputs for rows of raw conditions, into `trace.output`. The conditions are
    /// normalised in place.
    pub(super) fn run(&self, conditions: &mut [f32], trace: &mut Trace) {
        self.condition.normalise(conditions);
        self.mlp.forward(conditions, trace);
    }

    /// Returns the loss of a batch and adds the network's gradients to `gradients`.
    pub(super) fn loss(&self, batch: &HeadBatch<'_>, trace: &mut Trace, gradients: &mut Mlp) -> f64 {
        self.mlp.forward(batch.conditions, trace);
        let k = self.mlp.outputs();
        let rows = batch.targets.len() / k;
        let weight = |row: usize| batch.weights.map_or(1.0, |w| f64::from(w[row]));
        let total_weight = (0..rows).map(weight).sum::<f64>().max(1e-6);
        let mut loss = 0.0;
        let output = std::mem::take(&mut trace.output);
        let mut d_output = vec![0.0f32; output.len()];
        for row in 0..rows {
            let share = weight(row) / (total_weight * k as f64);
            for j in 0..k {
                let i = row * k + j;
                let scale = f64::from(self.residual.range[j]).max(CONDITION_FLOOR);
                let error = (f64::from(batch.proposals[i]) + self.residual_of(j, output[i])
                    - f64::from(batch.targets[i]))
                    / scale;
                let (value, slope) = smooth_l1(error);
                loss += share * value;
                d_output[i] = (share * slope * f64::from(self.residual.range[j]) / scale) as f32;
            }
        }
        trace.output = output;
        self.mlp.backward(batch.conditions, &d_output, trace, gradients);
        loss
    }
}

/// Value and derivative of Smooth-L1 with its corner at [`BETA`].
fn smooth_l1(error: f64) -> (f64, f64) {
    if error.abs() < BETA {
        (0.5 * error * error / BETA, error / BETA)
    } else {
        (error.abs() - 0.5 * BETA, error.signum())
    }
}
