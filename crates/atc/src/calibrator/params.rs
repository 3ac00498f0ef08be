//! The parameters of the calibrator's training (R18, R19).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_numerics::math;
use use3d_numerics::range::{OutOfRange, positive, within};

use super::RANGE_FLOOR;

/// Number of pairs for which the recipe was made: the paper trains on 800 of UIEB.
pub const METHOD_PAIRS: usize = 800;

/// The operators whose interquartile ranges are the scales of errors (R19).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Scales {
    /// The residuals `target − proposal`, as in the authors' release.
    #[default]
    Residuals,
    /// The paired operators themselves, as the paper writes.
    Operators,
}

/// The start of a head's last layer (R18).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum LastLayer {
    /// At zero, so that training starts from the median residual.
    #[default]
    Zero,
    /// At random like the layers below it, as in the authors' release.
    Random,
}

/// Parameters of the calibrator's training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CalibratorParams {
    /// Optimiser steps.
    pub steps: u64,
    /// Pairs per step, drawn with replacement (all, if there are fewer).
    pub pairs_per_step: usize,
    /// Cells per step, drawn with replacement from all cells of all pairs (all, if there are fewer).
    pub cells_per_step: usize,
    /// Learning rate of the first step.
    pub learning_rate: f64,
    /// The last learning rate as a fraction of the first (cosine decay).
    pub final_fraction: f64,
    /// Largest joint norm of the gradient.
    pub gradient_limit: f64,
    /// Width of the global head's hidden layers.
    pub global_hidden: usize,
    /// Width of the local head's hidden layers.
    pub local_hidden: usize,
    /// The start of the last layers.
    pub last_layer: LastLayer,
    /// The operators whose ranges scale the errors of the fit and of stage 2.
    pub scales: Scales,
    /// Smallest range that scales errors, above 0 to 1. Ranges below 1e-4 count as 1e-4 in stage 2.
    pub scale_floor: f64,
    /// Share of the pairs held out for the report (0: no report, and no early stopping). The final fit uses
    /// all pairs.
    pub held_out: f64,
    /// Stop each head of the final fit at the step at which the fit without the held-out pairs was best on
    /// them. A few dozen pairs are overfitted long before the last step; with many the last step
    /// is the best.
    pub stop_early: bool,
    /// Largest share of its correction that a head may keep, 0 (the proposal unchanged) to 1.
    pub trust: f64,
    /// Seed. Not read from settings: the caller sets it.
    #[serde(skip)]
    pub seed: u64,
}

impl Default for CalibratorParams {
    fn default() -> Self {
        Self {
            steps: 750,
            pairs_per_step: 128,
            cells_per_step: 4096,
            learning_rate: 2e-4,
            final_fraction: 0.05,
            gradient_limit: 10.0,
            global_hidden: 128,
            local_hidden: 256,
            last_layer: LastLayer::Zero,
            scales: Scales::Residuals,
            scale_floor: RANGE_FLOOR,
            held_out: 0.2,
            stop_early: true,
            trust: 1.0,
            seed: 42,
        }
    }
}

impl CalibratorParams {
    /// Checks the ranges.
    pub fn validate(&self) -> Result<(), OutOfRange> {
        within("pairs_per_step", self.pairs_per_step, 1, 1 << 20)?;
        within("cells_per_step", self.cells_per_step, 1, 1 << 20)?;
        // The number of weights grows with the square of a width.
        within("global_hidden", self.global_hidden, 1, 8192)?;
        within("local_hidden", self.local_hidden, 1, 8192)?;
        within("steps", self.steps, 0, 200_000_000)?;
        positive("learning_rate", self.learning_rate)?;
        positive("gradient_limit", self.gradient_limit)?;
        positive("scale_floor", self.scale_floor)?;
        within("scale_floor", self.scale_floor, 0.0, 1.0)?;
        within("final_fraction", self.final_fraction, 0.0, 1.0)?;
        within("held_out", self.held_out, 0.0, 0.9)?;
        within("trust", self.trust, 0.0, 1.0)
    }

    /// True if a data set has less than half of the pairs for which the recipe was made ([`METHOD_PAIRS`]).
    pub fn few(pairs: usize) -> bool {
        2 * pairs < METHOD_PAIRS
    }

    /// The learning rate of `step`, counted from 1.
    pub(super) fn rate(&self, step: u64) -> f64 {
        let t = (step - 1) as f64 / self.steps.max(1) as f64;
        let cosine = 0.5 * (1.0 + math::cos(std::f64::consts::PI * t));
        self.learning_rate * (self.final_fraction + (1.0 - self.final_fraction) * cosine)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_falls_along_half_a_cosine_to_its_final_fraction() {
        let params = CalibratorParams {
            learning_rate: 2e-3,
            final_fraction: 0.2,
            steps: 100,
            ..CalibratorParams::default()
        };
        for (step, share) in [(1, 1.0), (51, 0.6), (101, 0.2)] {
            assert!((params.rate(step) - 2e-3 * share).abs() < 1e-12, "{step}: {}", params.rate(step));
        }
    }
}
