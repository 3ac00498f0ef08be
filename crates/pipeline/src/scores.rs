//! What `evaluate` writes and tables are made from: scores per view, per pair of neighbouring views, per scene.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::truth::WaterScores;

/// A number, or why there is none. Never zero for "unknown", never silently absent.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Score {
    /// Measured.
    Value(f64),
    /// What to do to get it, e.g. `put lpips_alex.pth into models/`.
    NotAvailable(String),
}

impl Score {
    /// The number, if there is one.
    pub fn value(&self) -> Option<f64> {
        match self {
            Self::Value(value) => Some(*value),
            Self::NotAvailable(_) => None,
        }
    }

    /// The mean of scores: a number if every one is a number, else the first reason. Of none: a reason.
    pub fn mean<'a>(scores: impl IntoIterator<Item = &'a Score>) -> Self {
        let (mut sum, mut count) = (0.0, 0usize);
        for score in scores {
            match score {
                Self::Value(value) => {
                    sum += value;
                    count += 1;
                }
                Self::NotAvailable(_) => return score.clone(),
            }
        }
        if count == 0 {
            return Self::NotAvailable("nothing to measure: no held-out views".into());
        }
        Self::Value(sum / count as f64)
    }
}

/// Scores by metric name (`psnr`, `ssim`, `lpips`, `uciqe`, `uiqm`, `uranker`, `musiq`, `wlpips`, `w_delta_e`, `w_ssim`,
/// `truth_psnr`, `truth_delta_e`, `depth_error`, …).
pub type Scores = BTreeMap<String, Score>;

/// What is scored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// The photograph itself.
    Captured,
    /// The 2D proposer applied to each photograph on its own.
    Proposal,
    /// Stage 1 with its water.
    Reconstruction,
    /// Stage 1 without water.
    Clear,
    /// Stage 2.
    Enhanced,
    /// A scene reconstructed from per-view proposals, for comparison.
    EnhanceThenReconstruct,
}

impl Method {
    /// All, in the order of tables.
    pub const ALL: [Self; 6] = [
        Self::Captured,
        Self::Proposal,
        Self::Reconstruction,
        Self::Clear,
        Self::EnhanceThenReconstruct,
        Self::Enhanced,
    ];

    /// As tables call it.
    pub fn label(self) -> &'static str {
        match self {
            Self::Captured => "Captured (raw input)",
            Self::Proposal => "Per-view proposal",
            Self::Reconstruction => "Stage 1",
            Self::Clear => "Stage 1, clear render",
            Self::Enhanced => "3D-USE, this program",
            Self::EnhanceThenReconstruct => "Enhance, then reconstruct",
        }
    }

    /// As folders and report pictures call it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Captured => "captured",
            Self::Proposal => "proposal",
            Self::Reconstruction => "reconstruction",
            Self::Clear => "clear",
            Self::Enhanced => "enhanced",
            Self::EnhanceThenReconstruct => "enhance-then-reconstruct",
        }
    }
}

/// One image's scores.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewScores {
    /// The view's name.
    pub view: String,
    /// Its scores.
    pub scores: Scores,
}

/// The consistency of two neighbouring views.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PairScores {
    /// The earlier view.
    pub first: String,
    /// The later view.
    pub second: String,
    /// Its scores.
    pub scores: Scores,
}

/// All scores of one method on one scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MethodScores {
    /// What was scored.
    pub method: Method,
    /// Per held-out view.
    pub views: Vec<ViewScores>,
    /// Per pair of neighbouring views.
    pub pairs: Vec<PairScores>,
    /// Means over views and over pairs.
    pub mean: Scores,
}

impl MethodScores {
    /// Gathers per-view and per-pair scores and their means.
    pub fn new(method: Method, views: Vec<ViewScores>, pairs: Vec<PairScores>) -> Self {
        let mut mean = Scores::new();
        for lists in
            [views.iter().map(|v| &v.scores).collect::<Vec<_>>(), pairs.iter().map(|p| &p.scores).collect()]
        {
            let mut names: Vec<&String> = lists.iter().flat_map(|s| s.keys()).collect();
            names.sort();
            names.dedup();
            for name in names {
                mean.insert(name.clone(), Score::mean(lists.iter().filter_map(|s| s.get(name))));
            }
        }
        Self { method, views, pairs, mean }
    }
}

/// All scores of one scene: the file `scores.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SceneScores {
    /// Number of training views.
    pub training_views: usize,
    /// Number of held-out views.
    pub held_out_views: usize,
    /// Image size of the first held-out view.
    pub size: (usize, usize),
    /// Number of Gaussians.
    pub gaussians: usize,
    /// The recovered water beside the true one; only for synthetic captures with their truth, and scenes with water.
    pub water: Option<WaterScores>,
    /// The methods that were scored.
    pub methods: Vec<MethodScores>,
}

impl SceneScores {
    /// A mean score of a method.
    pub fn mean(&self, method: Method, metric: &str) -> Option<&Score> {
        self.methods.iter().find(|m| m.method == method)?.mean.get(metric)
    }
}

/// A scene's scores with what a batch knows about the scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScoredScene {
    /// The scene's name.
    pub scene: String,
    /// Its data set, or empty.
    pub group: String,
    /// The variant, empty for the main run.
    pub variant: String,
    /// The artifact the scores came from.
    pub source: String,
    /// The scores.
    pub scores: SceneScores,
    /// Frames per second of `enhanced` (or `reconstruction` where there is no enhanced scene), measured on this machine.
    pub fps: Option<f64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_missing_score_makes_the_mean_missing() {
        let missing = Score::NotAvailable("put x into y".into());
        assert_eq!(Score::mean([&Score::Value(1.0), &Score::Value(3.0)]), Score::Value(2.0));
        assert_eq!(Score::mean([&Score::Value(1.0), &missing]), missing);
        assert!(Score::mean([]).value().is_none());
    }

    #[test]
    fn means_are_over_views_and_over_pairs() {
        let scores = |name: &str, v| Scores::from([(name.to_string(), Score::Value(v))]);
        let view = |v| ViewScores { view: "a".into(), scores: scores("psnr", v) };
        let pair = PairScores { first: "a".into(), second: "b".into(), scores: scores("w_ssim", 0.5) };
        let method = MethodScores::new(Method::Enhanced, vec![view(20.0), view(30.0)], vec![pair]);
        assert_eq!(method.mean["psnr"], Score::Value(25.0));
        assert_eq!(method.mean["w_ssim"], Score::Value(0.5));
    }
}
