//! The scores of one result as tables need them: means over views and pairs, in the order of `METRICS`. Ten
//! thousand of them fit into 50 MB, where the scores of all their views would take some gigabytes.

use std::collections::BTreeMap;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use use3d_judge::configuration::Configuration;
use use3d_judge::names::in_variant;
use use3d_judge::scores::{Method, SceneScores, SceneSpeed, Score, Scores, Warp};
use use3d_judge::truth::WaterScores;

/// The metrics that any table shows.
const METRICS: [&str; 19] = [
    "psnr",
    "ssim",
    "lpips",
    "edge_width",
    "uciqe",
    "uranker",
    "musiq",
    "uiqm",
    "wlpips",
    "w_delta_e",
    "w_ssim",
    "path_wlpips",
    "path_w_delta_e",
    "path_w_ssim",
    "coverage",
    "path_coverage",
    "truth_psnr",
    "truth_delta_e",
    "depth_error",
];

/// The place of a metric in [`METRICS`].
pub(super) fn place(metric: &str) -> Option<usize> {
    METRICS.iter().position(|known| *known == metric)
}

/// The scores of a scene in a variant.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct MeanScores {
    /// The scene's name.
    pub scene: String,
    /// Its data set, or empty.
    pub group: String,
    /// The variant; empty for the main run.
    pub variant: String,
    /// The artifact that the scores came from.
    pub source: String,
    /// Number of training views.
    pub training_views: usize,
    /// Number of held-out views.
    pub held_out_views: usize,
    /// Image size of the first held-out view.
    pub size: (usize, usize),
    /// Share of the held-out views' pixels that the scores count, 0 to 1.
    pub pixels: f64,
    /// Number of its Gaussians.
    #[serde(default)]
    pub gaussians: usize,
    /// Seconds of the processor that stage 1 took, if they are known.
    #[serde(default)]
    pub processor_seconds: Option<f64>,
    /// The source of the depth for comparing neighbouring views.
    pub warp: Warp,
    /// The look that the enhancement was learnt in.
    pub result: Method,
    /// The recovered and the true water, if the truth is known.
    pub water: Option<WaterScores>,
    /// The largest number of pairs of captured views that a method was compared on; `None` without methods.
    pub compared: Option<usize>,
    /// The configuration behind the scores; its file has it elsewhere.
    #[serde(skip)]
    pub configuration: Option<Arc<Configuration>>,
    /// The speed of drawing the scene on the machine that evaluated it.
    pub speed: Option<SceneSpeed>,
    /// The means by method and metric.
    pub means: Means,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Mean {
    Absent,
    Value,
    /// The place of the reason.
    NotAvailable(u8),
    Undefined(u8),
}

/// The means of one method. Values stand apart from their kinds, which takes half of the memory.
#[derive(Clone, Debug)]
struct MethodMeans {
    method: Method,
    kinds: [Mean; METRICS.len()],
    values: [f64; METRICS.len()],
}

/// Mean scores by method and metric. Reasons for missing scores repeat, so each is stored once.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(from = "BTreeMap<Method, Scores>", into = "BTreeMap<Method, Scores>")]
pub struct Means {
    methods: Vec<MethodMeans>,
    reasons: Vec<String>,
}

impl Means {
    fn add<'s>(&mut self, method: Method, scores: impl Iterator<Item = (&'s String, &'s Score)>) {
        let mut kinds = [Mean::Absent; METRICS.len()];
        let mut values = [0.0; METRICS.len()];
        for (metric, score) in scores {
            let Some(at) = place(metric) else { continue };
            values[at] = score.value().unwrap_or_default();
            kinds[at] = match score {
                Score::Value(_) => Mean::Value,
                Score::NotAvailable(reason) => Mean::NotAvailable(self.reason(reason)),
                Score::Undefined(reason) => Mean::Undefined(self.reason(reason)),
            };
        }
        self.methods.push(MethodMeans { method, kinds, values });
    }

    /// The place of a reason. A result has a few; those beyond 255 count as the last one.
    fn reason(&mut self, reason: &str) -> u8 {
        let known = self.reasons.iter().position(|own| own == reason);
        let at = known.unwrap_or_else(|| {
            if self.reasons.len() <= usize::from(u8::MAX) {
                self.reasons.push(reason.to_string());
            }
            self.reasons.len() - 1
        });
        at as u8
    }

    fn score(&self, means: &MethodMeans, place: usize) -> Option<Score> {
        let reason = |at: u8| self.reasons.get(usize::from(at)).cloned().unwrap_or_default();
        match means.kinds[place] {
            Mean::Absent => None,
            Mean::Value => Some(Score::of(means.values[place])),
            Mean::NotAvailable(at) => Some(Score::NotAvailable(reason(at))),
            Mean::Undefined(at) => Some(Score::Undefined(reason(at))),
        }
    }

    /// The mean score of a method, by the place of its metric.
    pub(super) fn at(&self, method: Method, place: usize) -> Option<Score> {
        self.score(self.methods.iter().find(|means| means.method == method)?, place)
    }
}

impl From<BTreeMap<Method, Scores>> for Means {
    fn from(given: BTreeMap<Method, Scores>) -> Self {
        let mut means = Self::default();
        given.iter().for_each(|(method, scores)| means.add(*method, scores.iter()));
        means
    }
}

impl From<Means> for BTreeMap<Method, Scores> {
    fn from(means: Means) -> Self {
        let scores = |own: &MethodMeans| -> Scores {
            let named = METRICS.iter().enumerate();
            named.filter_map(|(at, metric)| Some(((*metric).to_string(), means.score(own, at)?))).collect()
        };
        means.methods.iter().map(|own| (own.method, scores(own))).collect()
    }
}

impl MeanScores {
    /// The means of a result's scores.
    pub fn new([scene, group, variant]: [&str; 3], scores: &SceneScores) -> Self {
        let mut means = Means::default();
        scores.methods.iter().for_each(|m| means.add(m.method, m.mean.iter()));
        Self {
            scene: scene.into(),
            group: group.into(),
            variant: variant.into(),
            source: in_variant(scene, variant),
            training_views: scores.training_views,
            held_out_views: scores.held_out_views,
            size: scores.size,
            pixels: scores.pixels,
            gaussians: scores.gaussians,
            processor_seconds: None,
            warp: scores.warp,
            result: scores.result,
            water: scores.water,
            compared: scores.methods.iter().map(|m| m.neighbours.len()).max(),
            configuration: None,
            speed: None,
            means,
        }
    }

    /// A mean score of a method.
    pub fn mean(&self, method: Method, metric: &str) -> Option<Score> {
        self.means.at(method, place(metric)?)
    }

    /// True if the method was scored by one of these metrics.
    pub(super) fn has(&self, method: Method, metrics: impl Iterator<Item = &'static str>) -> bool {
        metrics.into_iter().any(|metric| self.mean(method, metric).is_some())
    }
}
