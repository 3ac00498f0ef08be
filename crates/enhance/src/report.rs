//! What stage 2 says about itself: a log line per window of steps, and per view how near the targets were reached.

use serde::{Deserialize, Serialize};
use use3d_numerics::math;
use use3d_scene::Scene;
use use3d_training::Profile;

use crate::losses::Realised;
use crate::profile::StepPart;

/// Means over a window of steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LogEntry {
    /// Steps done at the window's end.
    pub step: u64,
    /// Weighted total loss.
    pub loss: f64,
    /// Global term, before its weight.
    pub global: f64,
    /// Local term, before its weight.
    pub local: f64,
    /// Pseudo-label term.
    pub pixels: f64,
    /// Total variation of the factors, before its weight.
    pub variation: f64,
    /// Realised normalised global error, root mean square.
    pub global_error: f64,
    /// Realised normalised local error, root mean square.
    pub local_error: f64,
}

/// How far a view is from its target.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ViewErrors {
    /// Global operator; not measured with pseudo-labels.
    pub global: Option<Realised>,
    /// Local operators; not measured with pseudo-labels.
    pub local: Option<Realised>,
    /// Mean absolute or squared difference to the pseudo-label (zero with targets).
    pub pixels: f64,
}

/// One view before and after.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewReport {
    /// Its name.
    pub name: String,
    /// At the identity.
    pub before: ViewErrors,
    /// With the trained field.
    pub after: ViewErrors,
}

/// What stage 2 reached.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// View by view, in the given order.
    pub views: Vec<ViewReport>,
    /// Views whose constants were kept in memory; the others were prepared anew in each of their steps.
    pub views_in_memory: usize,
    /// Trained ratio of β_bs⁺ to β_bs and of β_attn⁺ to β_attn.
    pub transport_ratios: [f32; 2],
    /// Scene-global affine, rows `(A | b)`, the identity included.
    pub scene_affine: [[f32; 4]; 3],
    /// Rendered pixels of all views as a share of all their pixels.
    pub rendered_share: f64,
}

impl Report {
    /// Root-mean-square over views of the normalised global error, before and after; `None` where it was not measured.
    pub fn global_errors(&self) -> Option<(f64, f64)> {
        self.over(|v| v.global)
    }

    /// Root-mean-square over views of the normalised local error, before and after; `None` where it was not measured.
    pub fn local_errors(&self) -> Option<(f64, f64)> {
        self.over(|v| v.local)
    }

    fn over(&self, of: impl Fn(&ViewErrors) -> Option<Realised>) -> Option<(f64, f64)> {
        let rms = |pick: &dyn Fn(&ViewReport) -> Option<Realised>| {
            let errors: Option<Vec<f64>> = self.views.iter().map(|v| pick(v).map(|r| r.error)).collect();
            let errors = errors.filter(|e| !e.is_empty())?;
            Some((errors.iter().map(|e| math::powi(*e, 2)).sum::<f64>() / errors.len() as f64).sqrt())
        };
        rms(&|v| of(&v.before)).zip(rms(&|v| of(&v.after)))
    }
}

/// The result of stage 2.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// The scene as it was given, with its enhancement.
    pub scene: Scene,
    /// One entry per window of steps.
    pub log: Vec<LogEntry>,
    /// What was reached.
    pub report: Report,
    /// Where the time of the steps went.
    pub profile: Profile<StepPart>,
}

impl Outcome {
    /// The log as JSON lines. The same run gives the same bytes.
    pub fn log_lines(&self) -> String {
        let mut lines = String::new();
        for entry in &self.log {
            // Plain numbers always serialise; a non-finite one stopped the run long before.
            if let Ok(line) = serde_json::to_string(entry) {
                lines.push_str(&line);
                lines.push('\n');
            }
        }
        lines
    }
}
