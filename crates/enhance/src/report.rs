//! The reports of stage 2: a log line per window of steps, and for each view its distance from the targets.

use serde::ser::SerializeMap;
use serde::{Deserialize, Serialize, Serializer};
use use3d_numerics::math;
use use3d_scene::Scene;
use use3d_training::Profile;

use crate::losses::{COUNT, Realised, TERMS, Values};
use crate::profile::StepPart;

/// Means over a window of steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LogEntry {
    /// Steps done at the window's end.
    pub step: u64,
    /// Weighted total loss.
    pub loss: f64,
    /// The value before its weight, and the error, of each row of [`TERMS`]; 0 if it had no value.
    pub terms: [Realised; COUNT],
}

impl LogEntry {
    /// The line of the log: step and loss, the terms by name, then the errors of those that measure one.
    pub fn to_json(&self) -> String {
        // A number that is not finite becomes null; such a number ends the run long before.
        let number = |value: f64| serde_json::Value::from(value);
        let terms = || TERMS.iter().zip(&self.terms);
        let values = terms().map(|(row, mean)| (row.name.to_string(), mean.loss));
        let measuring = terms().filter(|(row, _)| row.measures_errors());
        let errors = measuring.map(|(row, mean)| (format!("{}_error", row.name), mean.error));
        let fields = values.chain(errors).map(|(name, value)| format!(",\"{name}\":{}", number(value)));
        let fields: String = fields.collect();
        format!("{{\"step\":{},\"loss\":{}{fields}}}", self.step, number(self.loss))
    }
}

/// The distance of a view from its goals: the values of the terms of views, `None` for a term that was not
/// measured.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ViewErrors(pub Values);

impl ViewErrors {
    /// The value of the term with this name.
    pub fn of(&self, term: &str) -> Option<Realised> {
        let rows = TERMS.iter().zip(&self.0);
        rows.filter(|(row, _)| row.name == term).find_map(|(_, value)| *value)
    }
}

/// Serialised by name: value and error of a term that measures an error, null if it was not measured; for
/// other terms the value, 0 if there is none.
impl Serialize for ViewErrors {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(None)?;
        for (row, value) in TERMS.iter().zip(&self.0).filter(|(row, _)| row.is_of_views()) {
            if row.measures_errors() {
                map.serialize_entry(row.name, value)?;
            } else {
                map.serialize_entry(row.name, &value.map_or(0.0, |v| v.loss))?;
            }
        }
        map.end()
    }
}

/// One view before and after.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ViewReport {
    /// Its name.
    pub name: String,
    /// Its errors at the identity.
    pub before: ViewErrors,
    /// Its errors with the trained field.
    pub after: ViewErrors,
}

/// The results of stage 2.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// View by view, in the given order.
    pub views: Vec<ViewReport>,
    /// Number of views whose constants were kept in memory; the others were prepared again in each of their
    /// steps.
    pub views_in_memory: usize,
    /// Trained ratio of β_bs⁺ to β_bs and of β_attn⁺ to β_attn.
    pub transport_ratios: [f32; 2],
    /// Scene-global affine, rows `(A | b)`, the identity included.
    pub scene_affine: [[f32; 4]; 3],
    /// Number of rendered pixels of all views as a share of all their pixels.
    pub rendered_share: f64,
}

impl Report {
    /// Root-mean-square over views of the normalised error of the term with this name, before and after;
    /// `None` if it was not measured.
    pub fn errors(&self, term: &str) -> Option<(f64, f64)> {
        let rms = |pick: &dyn Fn(&ViewReport) -> ViewErrors| {
            let errors: Option<Vec<f64>> =
                self.views.iter().map(|v| pick(v).of(term).map(|r| r.error)).collect();
            let errors = errors.filter(|e| !e.is_empty())?;
            Some((errors.iter().map(|e| math::powi(*e, 2)).sum::<f64>() / errors.len() as f64).sqrt())
        };
        rms(&|v| v.before).zip(rms(&|v| v.after))
    }
}

/// The result of stage 2.
#[derive(Clone, Debug)]
pub struct EnhanceOutcome {
    /// The given scene with its enhancement.
    pub scene: Scene,
    /// One entry per window of steps.
    pub log: Vec<LogEntry>,
    /// The final errors and the trained values.
    pub report: Report,
    /// The time spent on the parts of a step.
    pub profile: Profile<StepPart>,
}

impl EnhanceOutcome {
    /// The log as JSON lines. Equal runs give equal bytes.
    pub fn log_lines(&self) -> String {
        self.log.iter().map(|entry| entry.to_json() + "\n").collect()
    }
}
