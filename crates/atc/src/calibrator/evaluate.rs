//! Measures if calibration brings transitions nearer to the paired targets, on pairs that were not used in
//! the fit.
//!
//! The *normalised transition error* is the mean over the operator's numbers of `|error| / s`, with `s` the
//! calibrator's interquartile ranges. Global operators count equally; local ones count by the confidence of
//! their cell. *Before* is the error of the proposal, *after* that of the calibrated proposal.

use serde::{Deserialize, Serialize};
use use3d_numerics::random::{Purpose, Stream};

use super::{Calibrator, CalibratorParams, Dataset, PairExample};
use crate::extractor::center;

/// An error before and after calibration, interquartile units.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ErrorChange {
    /// The proposal's error.
    pub before: f64,
    /// The calibrated proposal's error.
    pub after: f64,
}

impl ErrorChange {
    /// `after / before`: below 1 is better.
    pub fn ratio(&self) -> f64 {
        self.after / self.before.max(f64::MIN_POSITIVE)
    }
}

/// Mean normalised transition errors over some pairs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TransitionErrors {
    /// Errors of global operators.
    pub global: ErrorChange,
    /// Errors of local operators as fitted.
    pub local: ErrorChange,
    /// Errors of local operators minus their mean over the image, which the consensus uses.
    pub centered: ErrorChange,
}

/// The result of a fit to a part of the pairs, tested on the others.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct HeldOutReport {
    /// Number of pairs used in the fit.
    pub fitted: usize,
    /// Names of the pairs used in the test.
    pub tested: Vec<String>,
    /// Errors on them, with each head at the step at which it stopped and with the share of its correction
    /// that was kept. Both were chosen on these same pairs, so with few pairs the errors are slightly too
    /// good.
    pub errors: TransitionErrors,
    /// Errors on them after all steps of the recipe.
    pub all_steps: TransitionErrors,
    /// The last steps of the global and of the local head.
    pub stopped: [u64; 2],
    /// The shares of their corrections that the global and the local head keep, 0 to 1; 0 leaves the
    /// proposal unchanged.
    pub kept: [f64; 2],
}

/// Indices of the pairs to fit to and to test on; `None` if nothing is to be held out or there are too few
/// pairs.
pub fn held_out(dataset: &Dataset, params: &CalibratorParams) -> Option<(Vec<usize>, Vec<usize>)> {
    let count = dataset.examples.len();
    let tested = (count as f64 * params.held_out).round() as usize;
    if tested == 0 || count < tested + 4 {
        return None;
    }
    let mut order = Stream::new(params.seed, Purpose::new("calibrator held-out pairs"), 0).permutation(count);
    let mut fitted = order.split_off(tested);
    order.sort_unstable();
    fitted.sort_unstable();
    Some((fitted, order))
}

/// A confidence-weighted mean while it is being summed.
#[derive(Default)]
struct Mean {
    sum: f64,
    weight: f64,
}

impl Mean {
    fn add(&mut self, weight: f64, error: impl ExactSizeIterator<Item = f64>) {
        let count = error.len() as f64;
        self.sum += weight * error.sum::<f64>() / count;
        self.weight += weight;
    }

    fn value(&self) -> f64 {
        self.sum / self.weight.max(1e-12)
    }
}

/// Mean normalised transition errors over `examples`, before and after calibration.
pub fn evaluate<'a>(
    calibrator: &Calibrator,
    examples: impl IntoIterator<Item = &'a PairExample>,
) -> TransitionErrors {
    let (s_g, s_l) = (calibrator.global_scales(), calibrator.local_scales());
    let mut means: [[Mean; 2]; 3] = Default::default();
    for example in examples {
        let calibrated = calibrator.calibrate_global(&example.descriptor, &example.proposal);
        for (which, operator) in [&example.proposal, &calibrated].into_iter().enumerate() {
            let error = (0..12).map(|k| (operator[k] - example.target[k]).abs() / s_g[k]);
            means[0][which].add(1.0, error);
        }
        let cells = example.cells.iter().map(|cell| (&cell.descriptor, &cell.proposal));
        let predicted = calibrator.corrected(&example.descriptor, &example.proposal, cells, &calibrated);
        let proposed: Vec<[f64; 6]> = example.cells.iter().map(|c| c.proposal).collect();
        let wanted: Vec<[f64; 6]> = example.cells.iter().map(|c| c.target).collect();
        for (row, centered) in [(1, false), (2, true)] {
            let view = |cells: &[[f64; 6]]| {
                let mut cells = cells.to_vec();
                if centered {
                    center(&mut cells);
                }
                cells
            };
            let target = view(&wanted);
            for (which, operators) in [&proposed, &predicted].into_iter().enumerate() {
                for ((o, t), cell) in view(operators).iter().zip(&target).zip(&example.cells) {
                    let error = (0..6).map(|k| (o[k] - t[k]).abs() / s_l[k]);
                    means[row][which].add(cell.confidence, error);
                }
            }
        }
    }
    let [global, local, centered] =
        means.map(|[before, after]| ErrorChange { before: before.value(), after: after.value() });
    TransitionErrors { global, local, centered }
}
