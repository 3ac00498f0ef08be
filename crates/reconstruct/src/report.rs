//! The written results of a run: log lines, held-out scores, and a plot.

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
        Self { views, psnr, ssim, fitted }
    }
}

/// Draws loss, PSNR (a line for training, dots for held-out views) and number of Gaussians over the steps,
/// as an SVG document.
pub fn plot(log: &[LogEntry]) -> String {
    let mut series: [Vec<(f64, f64)>; 3] = Default::default();
    let mut held_out = Vec::new();
    for entry in log {
        match entry {
            LogEntry::Steps { step, loss, psnr, gaussians, .. } => {
                for (line, value) in series.iter_mut().zip([Some(*loss), *psnr, Some(*gaussians as f64)]) {
                    line.extend(value.map(|v| (*step as f64, v)));
                }
            }
            LogEntry::Evaluation { step, psnr, .. } => held_out.extend(psnr.map(|v| (*step as f64, v))),
            LogEntry::Refine { .. } | LogEntry::Ceiling { .. } => {}
        }
    }
    const WIDTH: f64 = 760.0;
    const PANEL: f64 = 170.0;
    const LEFT: f64 = 70.0;
    const TOP: f64 = 26.0;
    let steps = series[0].iter().chain(&held_out).fold(1.0f64, |m, p| m.max(p.0));
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {height}\" font-family=\"sans-serif\" font-size=\"12\">\n<rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n",
        height = 3.0 * PANEL + 30.0
    );
    let titles = ["loss", "PSNR, dB (line: training views, dots: held out)", "Gaussians"];
    for (panel, (points, title)) in series.iter().zip(titles).enumerate() {
        let dots: &[(f64, f64)] = if panel == 1 { &held_out } else { &[] };
        let finite = || points.iter().chain(dots).map(|p| p.1).filter(|v| v.is_finite());
        let (mut low, mut high) =
            (finite().fold(f64::INFINITY, f64::min), finite().fold(f64::NEG_INFINITY, f64::max));
        if low > high {
            (low, high) = (0.0, 1.0);
        }
        if high - low < 1e-9 {
            (low, high) = (low - 0.5, high + 0.5);
        }
        let top = panel as f64 * PANEL + TOP;
        let height = PANEL - 44.0;
        let x = |step: f64| LEFT + (WIDTH - LEFT - 20.0) * step / steps;
        let y = |value: f64| top + height * (high - value) / (high - low);
        svg += &format!("<text x=\"{LEFT}\" y=\"{:.1}\" font-weight=\"bold\">{title}</text>\n", top - 8.0);
        for share in [0.0, 0.5, 1.0] {
            let value = low + share * (high - low);
            let text = if high - low > 50.0 { format!("{value:.0}") } else { format!("{value:.3}") };
            svg += &format!(
                "<line x1=\"{LEFT}\" x2=\"{:.1}\" y1=\"{at:.1}\" y2=\"{at:.1}\" stroke=\"#dddddd\"/><text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{text}</text>\n",
                WIDTH - 20.0,
                LEFT - 6.0,
                y(value) + 4.0,
                at = y(value),
            );
        }
        let drawn: Vec<String> = points
            .iter()
            .filter(|p| p.1.is_finite())
            .map(|(s, v)| format!("{:.1},{:.1}", x(*s), y(*v)))
            .collect();
        svg += &format!(
            "<polyline points=\"{}\" fill=\"none\" stroke=\"#0b6e99\" stroke-width=\"1.5\"/>\n",
            drawn.join(" ")
        );
        for (s, v) in dots.iter().filter(|p| p.1.is_finite()) {
            svg += &format!("<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"3.5\" fill=\"#c2410c\"/>\n", x(*s), y(*v));
        }
    }
    svg += &format!(
        "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">step {steps:.0}</text>\n</svg>\n",
        WIDTH - 20.0,
        3.0 * PANEL + 18.0
    );
    svg
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn log_lines_are_flat_json_and_the_plot_is_whole() {
        let steps = |step, loss| LogEntry::Steps {
            step,
            loss,
            terms: vec![("reg_l1".into(), Some(0.1)), ("depth_loss".into(), None)],
            psnr: Some(20.0),
            gaussians: 10,
            divisor: 4,
            degree: 0,
        };
        let entries = [
            steps(100, 0.5),
            steps(200, f64::NAN),
            LogEntry::Evaluation { step: 200, psnr: Some(19.0), ssim: None, gaussians: 10 },
        ];
        let line: serde_json::Value = serde_json::from_str(&entries[0].to_json()).unwrap();
        assert_eq!((line["event"].as_str(), line["step"].as_u64()), (Some("steps"), Some(100)));
        assert_eq!((line["reg_l1"].as_f64(), line["depth_loss"].is_null()), (Some(0.1), true));
        assert!(line.get("terms").is_none(), "{line}");
        let svg = plot(&entries);
        assert!(svg.starts_with("<svg") && svg.ends_with("</svg>\n") && !svg.contains("NaN"));
        assert_eq!(svg.matches("<circle").count(), 1);
        assert!(plot(&[]).contains("</svg>"));
    }
}
