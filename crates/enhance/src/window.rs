//! What the log is made of: losses of steps, summed since the last line.

use serde::{Deserialize, Serialize};

use crate::engine::StepLosses;
use crate::report::LogEntry;

/// Sums since the last line of the log.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Window {
    sums: [f64; 7],
    pub(crate) steps: u64,
}

impl Window {
    pub(crate) fn add(&mut self, losses: &StepLosses) {
        let values = [
            losses.total,
            losses.global.loss,
            losses.local.loss,
            losses.pixels,
            losses.variation,
            losses.global.error,
            losses.local.error,
        ];
        for (sum, v) in self.sums.iter_mut().zip(values) {
            *sum += v;
        }
        self.steps += 1;
    }

    /// The line of the steps up to `step`; the window starts anew.
    pub(crate) fn flush(&mut self, step: u64) -> LogEntry {
        let Self { sums, steps } = std::mem::take(self);
        let [loss, global, local, pixels, variation, global_error, local_error] =
            sums.map(|sum| sum / steps as f64);
        LogEntry { step, loss, global, local, pixels, variation, global_error, local_error }
    }
}
