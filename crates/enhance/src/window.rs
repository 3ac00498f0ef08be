//! The source of the log: losses of steps, summed since the last line.

use serde::{Deserialize, Serialize};

use crate::losses::{COUNT, Realised, StepLosses};
use crate::report::LogEntry;

/// Sums since the last line of the log.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Window {
    loss: f64,
    /// One sum per row of the table.
    terms: [Realised; COUNT],
    pub(crate) steps: u64,
}

impl Window {
    pub(crate) fn add(&mut self, losses: &StepLosses) {
        self.loss += losses.total;
        for (sum, value) in self.terms.iter_mut().zip(losses.values) {
            let value = value.unwrap_or_default();
            sum.loss += value.loss;
            sum.error += value.error;
        }
        self.steps += 1;
    }

    /// Returns the line of the steps up to `step` and starts a new window.
    pub(crate) fn flush(&mut self, step: u64) -> LogEntry {
        let Self { loss, terms, steps } = std::mem::take(self);
        let n = steps as f64;
        let terms = terms.map(|sum| Realised { loss: sum.loss / n, error: sum.error / n });
        LogEntry { step, loss: loss / n, terms }
    }
}
