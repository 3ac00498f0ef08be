//! When to stop: the held-out pairs decide.
//!
//! The recipe's 750 steps suit the 800 pairs that it was made for. A few dozen pairs are learned by heart long before, and a
//! calibrator that knows its pairs by heart makes every other transition worse than the proposal was. So the fit to a part of
//! the pairs is watched on the others, and each head of the final fit, which uses all pairs, stops at the step at which
//! it was best there: the global head by its own error, the local head by that of the centred operators, which are what the
//! consensus uses. The heads share no gradient, so they may stop apart. With many pairs the best step is the last one.

use super::evaluate::held_out;
use super::training::fit_until;
use super::{Calibrator, CalibratorParams, Dataset, HeldOutReport, TransitionErrors, evaluate};
use crate::error::AtcError;
use crate::progress::Watch;

/// Steps between two looks at the held-out pairs.
const LOOK: u64 = 25;

/// The last step of each head.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Stop {
    /// Of the global head.
    pub(super) global: u64,
    /// Of the local head.
    pub(super) local: u64,
}

impl Stop {
    /// Every step of the recipe.
    pub(super) fn never(params: &CalibratorParams) -> Self {
        Self { global: params.steps, local: params.steps }
    }

    /// The later of the two.
    pub(super) fn last(&self) -> u64 {
        self.global.max(self.local)
    }
}

/// Fits a calibrator to all pairs of a data set, with a held-out report from a fit to a part of them, and stops where that
/// fit was best if the parameters say so. `data` says where the pairs come from.
pub fn train(
    dataset: &Dataset,
    params: &CalibratorParams,
    data: &str,
    watch: &mut Watch<'_>,
) -> Result<Calibrator, AtcError> {
    params.validate()?;
    let mut stop = Stop::never(params);
    let mut report = None;
    if let Some((fitted, tested)) = held_out(dataset, params) {
        let errors_of = |heads: &Calibrator| evaluate(heads, tested.iter().map(|&i| &dataset.examples[i]));
        let mut curve: Vec<(u64, TransitionErrors)> = Vec::new();
        let whole = fit_until(&dataset.subset(&fitted), params, stop, watch, &mut |step, heads| {
            if step % LOOK == 0 && step < params.steps {
                curve.push((step, errors_of(heads)));
            }
        })?;
        let all_steps = errors_of(&whole);
        curve.push((params.steps, all_steps));
        let mut errors = all_steps;
        let best = |of: fn(&TransitionErrors) -> f64| {
            curve.iter().min_by(|a, b| of(&a.1).total_cmp(&of(&b.1))).copied()
        };
        if params.stop_early
            && let Some((global, at_global)) = best(|e| e.global.after)
            && let Some((local, at_local)) = best(|e| e.centered.after)
        {
            stop = Stop { global, local };
            errors = TransitionErrors { global: at_global.global, ..at_local };
        }
        report = Some(HeldOutReport {
            fitted: fitted.len(),
            tested: tested.iter().map(|&i| dataset.examples[i].name.clone()).collect(),
            errors,
            all_steps,
            stopped: [stop.global, stop.local],
        });
    }
    let mut calibrator = fit_until(dataset, params, stop, watch, &mut |_, _| {})?;
    calibrator.provenance.data = data.to_string();
    calibrator.provenance.held_out = report;
    Ok(calibrator)
}
