//! The written results of a run: log lines and held-out scores.

use serde::{Deserialize, Serialize};
use use3d_metrics::Score;

/// One line of the training log. It contains no wall time, so that the log of a resumed run equals that of
/// an uninterrupted one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum LogEntry {
    /// Averages over the steps since the last such line.
    Steps {
        /// Number of steps done.
        step: u64,
        /// The whole loss.
        loss: f64,
        /// Values of the [terms](crate::losses::TERMS) before their weights, by name, each averaged over
        /// the views that have a value for it; `None` if no view has.
        terms: Vec<(String, Option<f64>)>,
        /// PSNR of the training views over the pixels that count, dB; null if no step had a finite one.
        psnr: Option<f64>,
        /// Number of Gaussians.
        gaussians: usize,
        /// Image divisor.
        divisor: usize,
        /// Active spherical-harmonics degree.
        degree: usize,
    },
    /// A refinement.
    Refine {
        /// Number of steps done.
        step: u64,
        /// Number of Gaussians split.
        split: usize,
        /// Number of Gaussians duplicated.
        duplicated: usize,
        /// Number of Gaussians removed.
        culled: usize,
        /// Number of Gaussians kept because of the floor.
        spared: usize,
        /// Number of Gaussians that did not grow because of the cap.
        held_back: usize,
        /// Number of Gaussians afterwards.
        gaussians: usize,
    },
    /// An opacity ceiling.
    Ceiling {
        /// Number of steps done.
        step: u64,
    },
    /// A held-out evaluation.
    Evaluation {
        /// Number of steps done.
        step: u64,
        /// Mean over views, dB; null if there is none (`evaluation.json` has the reason).
        psnr: Option<f64>,
        /// Mean over views; null as for `psnr`.
        ssim: Option<f64>,
        /// Number of Gaussians.
        gaussians: usize,
    },
}

impl LogEntry {
    /// One line of JSON: the kind under `event`, then its fields.
    pub fn to_json(&self) -> String {
        // The externally tagged form is the one that bincode can read back; in JSON the object is flat.
        let (event, fields) = match serde_json::to_value(self) {
            Ok(serde_json::Value::Object(map)) => map.into_iter().next().unwrap_or_default(),
            _ => Default::default(),
        };
        let mut line = serde_json::Map::new();
        line.insert("event".into(), event.to_lowercase().into());
        if let serde_json::Value::Object(fields) = fields {
            for (name, value) in fields {
                // Each term has a field of its own.
                match (self, name.as_str()) {
                    (LogEntry::Steps { terms, .. }, "terms") => {
                        line.extend(terms.iter().map(|(name, value)| (name.clone(), (*value).into())));
                    }
                    _ => line.extend([(name, value)]),
                }
            }
        }
        serde_json::Value::Object(line).to_string()
    }
}

/// Scores of one held-out view.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewScore {
    /// The view.
    pub view: String,
    /// PSNR of the clamped reconstruction over the pixels that count, dB.
    pub psnr: Score,
    /// SSIM with an 11-tap window, over the windows in which all pixels count.
    pub ssim: Score,
    /// Share of the pixels that count, 0 to 1; masks hide the others.
    pub pixels: f64,
    /// Both scores after gains that were fitted on the other half of the view, if views have gains.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fitted: Option<FittedScore>,
}

/// Scores of an image in which each half has the gains per channel that fit the other half best.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FittedScore {
    /// See [`ViewScore::psnr`].
    pub psnr: Score,
    /// See [`ViewScore::ssim`].
    pub ssim: Score,
}

/// Held-out scores: per view, and their means.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// Every held-out view, in order.
    pub views: Vec<ViewScore>,
    /// Mean PSNR over the views that have one, dB.
    pub psnr: Score,
    /// Mean SSIM over the views that have one.
    pub ssim: Score,
    /// Share of all views' pixels that count, 0 to 1.
    pub pixels: f64,
    /// Means of the views' fitted scores, if views have gains.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fitted: Option<FittedScore>,
}

impl Evaluation {
    /// The evaluation with means over `views`.
    pub fn of(views: Vec<ViewScore>) -> Self {
        let psnr = Score::mean(views.iter().map(|v| &v.psnr));
        let ssim = Score::mean(views.iter().map(|v| &v.ssim));
        let fitted: Vec<&FittedScore> = views.iter().filter_map(|v| v.fitted.as_ref()).collect();
        let fitted = (!fitted.is_empty()).then(|| FittedScore {
            psnr: Score::mean(fitted.iter().map(|f| &f.psnr)),
            ssim: Score::mean(fitted.iter().map(|f| &f.ssim)),
        });
        let pixels = views.iter().map(|v| v.pixels).sum::<f64>() / views.len().max(1) as f64;
        Self { views, psnr, ssim, pixels, fitted }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn log_lines_are_flat_json() {
        let entry = LogEntry::Steps {
            step: 100,
            loss: 0.5,
            terms: vec![("reg_l1".into(), Some(0.1)), ("depth_loss".into(), None)],
            psnr: Some(20.0),
            gaussians: 10,
            divisor: 4,
            degree: 0,
        };
        let line: serde_json::Value = serde_json::from_str(&entry.to_json()).unwrap();
        assert_eq!((line["event"].as_str(), line["step"].as_u64()), (Some("steps"), Some(100)));
        assert_eq!((line["reg_l1"].as_f64(), line["depth_loss"].is_null()), (Some(0.1), true));
        assert!(line.get("terms").is_none(), "{line}");
    }
}
