//! The source of the log and of the progress display: reports of steps, summed since the last line and
//! smoothed.

use serde::{Deserialize, Serialize};

use crate::engine::StepReport;
use crate::losses;
use crate::report::LogEntry;

/// Sums since the last log line, and the smoothed numbers for the progress display.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Window {
    pub(crate) steps: u64,
    loss: f64,
    /// Sum and count of each of the loss's values.
    terms: Vec<(f64, u64)>,
    psnr: (f64, u64),
    pub(crate) smooth_loss: Option<f64>,
    pub(crate) smooth_psnr: Option<f64>,
}

impl Window {
    pub(crate) fn add(&mut self, report: &StepReport) {
        self.steps += 1;
        self.loss += report.loss;
        self.terms.resize(self.terms.len().max(report.values.len()), (0.0, 0));
        for (sum, value) in self.terms.iter_mut().zip(&report.values) {
            if let Some(value) = value {
                *sum = (sum.0 + value, sum.1 + 1);
            }
        }
        if let Some(psnr) = report.psnr {
            self.psnr = (self.psnr.0 + psnr, self.psnr.1 + 1);
        }
        let smooth = |old: Option<f64>, new: f64| Some(old.map_or(new, |old| 0.97 * old + 0.03 * new));
        self.smooth_loss = smooth(self.smooth_loss, report.loss);
        self.smooth_psnr = report.psnr.map_or(self.smooth_psnr, |psnr| smooth(self.smooth_psnr, psnr));
    }

    /// Returns the log line of the window and starts a new one.
    pub(crate) fn flush(&mut self, step: u64, gaussians: usize, divisor: usize, degree: usize) -> LogEntry {
        let n = self.steps.max(1) as f64;
        let mean = |sum: &(f64, u64)| (sum.1 > 0).then(|| sum.0 / sum.1 as f64);
        let mean_of = |(i, name): (usize, &str)| {
            let mean = self.terms.get(i).and_then(mean);
            (i < losses::OWN_VALUES || mean.is_some()).then(|| (name.into(), mean))
        };
        let entry = LogEntry::Steps {
            step,
            loss: self.loss / n,
            terms: losses::names().enumerate().filter_map(mean_of).collect(),
            psnr: mean(&self.psnr),
            gaussians,
            divisor,
            degree,
        };
        *self = Self { smooth_loss: self.smooth_loss, smooth_psnr: self.smooth_psnr, ..Self::default() };
        entry
    }
}
