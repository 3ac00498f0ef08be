//! Early stopping, and the share of the correction that is kept: the held-out pairs decide both.
//!
//! The recipe's 750 steps suit the 800 pairs for which it was made. A few dozen pairs are overfitted long
//! before, and an overfitted calibrator makes every other transition worse than the proposal. So a fit to a
//! part of the pairs is evaluated on the others. Each head of the final fit, which uses all pairs, stops at
//! the step at which it was best there: the global head by its own error, the local head by that of the
//! centred operators, which the consensus uses. The heads share no gradient, so they may stop at different
//! steps. With many pairs the best step is the last one.
//!
//! Even the best step may make results worse if the pairs have little in common. So each head keeps only
//! that share of its correction, out of [`SHARES`], that was best on the held-out pairs:
//! `proposal + share · correction`. A share of 0 returns the proposal.
//!
//! Held-out pairs are evidence only for pairs of their own kind. Synthetic pairs support nearly all of a
//! correction that turns a real reef cyan. So [`CalibratorParams::trust`] limits the share. With 0 nothing is
//! fitted; only the scales are taken from the pairs.

use super::evaluate::held_out;
use super::training::{fit_until, scales_only};
use super::{Calibrator, CalibratorParams, Dataset, Head, HeldOutReport, evaluate};
use crate::error::AtcError;
use crate::progress::ProgressCallback;

/// Number of steps between two evaluations on the held-out pairs.
const LOOK: u64 = 25;
/// Shares of the trusted part of a correction that may be kept. The largest comes first and wins ties.
const SHARES: [f64; 5] = [1.0, 0.75, 0.5, 0.25, 0.0];

/// The last step of each head.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Stop {
    /// The global head's last step.
    pub(super) global: u64,
    /// The local head's last step.
    pub(super) local: u64,
}

impl Stop {
    /// A stop after every step of the recipe.
    pub(super) fn never(params: &CalibratorParams) -> Self {
        Self { global: params.steps, local: params.steps }
    }

    /// The later of the two.
    pub(super) fn last(&self) -> u64 {
        self.global.max(self.local)
    }
}

/// A head at its best step, and its error at that step.
struct Best {
    step: u64,
    error: f64,
    head: Head,
}

impl Best {
    fn offer(best: &mut Option<Self>, step: u64, error: f64, head: &Head) {
        if best.as_ref().is_none_or(|b| error < b.error) {
            *best = Some(Self { step, error, head: head.clone() });
        }
    }
}

/// Fits a calibrator to all pairs of a data set, with a held-out report from a fit to a part of them. If
/// the parameters request it, it stops where that fit was best and keeps the share of the correction that
/// was best. `data` describes the origin of the pairs.
pub fn train(
    dataset: &Dataset,
    params: &CalibratorParams,
    data: &str,
    watch: &mut ProgressCallback<'_>,
) -> Result<Calibrator, AtcError> {
    params.validate()?;
    let trust = params.trust;
    if trust == 0.0 {
        // No correction would be kept, so both fits would be wasted.
        let mut calibrator = scales_only(dataset, params)?;
        calibrator.provenance.data = data.to_string();
        return Ok(calibrator);
    }
    let mut stop = Stop::never(params);
    let mut kept = [trust; 2];
    let mut report = None;
    if let Some((fitted, tested)) = held_out(dataset, params) {
        let errors_of = |heads: &Calibrator| evaluate(heads, tested.iter().map(|&i| &dataset.examples[i]));
        let (mut global, mut local) = (None, None);
        let mut whole = fit_until(&dataset.subset(&fitted), params, stop, watch, &mut |step, heads| {
            if params.stop_early && (step % LOOK == 0 || step == params.steps) {
                let errors = errors_of(heads);
                Best::offer(&mut global, step, errors.global.after, &heads.global);
                Best::offer(&mut local, step, errors.centered.after, &heads.local);
            }
        })?;
        let all_steps = errors_of(&whole);
        if let (Some(global), Some(local)) = (global, local) {
            stop = Stop { global: global.step, local: local.step };
            (whole.global, whole.local) = (global.head.clone(), local.head.clone());
            // The global head comes first, because its output is a condition of the local head.
            kept[0] = best_share(trust, |share| {
                whole.global = global.head.damped(share);
                errors_of(&whole).global.after
            });
            whole.global = global.head.damped(kept[0] as f32);
            kept[1] = best_share(trust, |share| {
                whole.local = local.head.damped(share);
                errors_of(&whole).centered.after
            });
            whole.local = local.head.damped(kept[1] as f32);
        } else {
            (whole.global, whole.local) =
                (whole.global.damped(trust as f32), whole.local.damped(trust as f32));
        }
        report = Some(HeldOutReport {
            fitted: fitted.len(),
            tested: tested.iter().map(|&i| dataset.examples[i].name.clone()).collect(),
            errors: errors_of(&whole),
            all_steps,
            stopped: [stop.global, stop.local],
            kept,
        });
    }
    let mut calibrator = fit_until(dataset, params, stop, watch, &mut |_, _| {})?;
    calibrator.global = calibrator.global.damped(kept[0] as f32);
    calibrator.local = calibrator.local.damped(kept[1] as f32);
    calibrator.provenance.data = data.to_string();
    calibrator.provenance.held_out = report;
    Ok(calibrator)
}

fn best_share(trust: f64, mut error: impl FnMut(f32) -> f64) -> f64 {
    let mut best = (f64::INFINITY, trust);
    for share in SHARES.map(|share| trust * share) {
        let error = error(share as f32);
        if error < best.0 {
            best = (error, share);
        }
    }
    best.1
}
