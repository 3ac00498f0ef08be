//! The scores that `evaluate` writes and tables are made from: per view, per pair of neighbouring views, and
//! per scene.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use serde::{Deserialize, Serialize};
pub use use3d_metrics::{Finite, Score};

use crate::truth::WaterScores;

/// Scores by metric name (`psnr`, `ssim`, `lpips`, `edge_width`, `uciqe`, `uiqm`, `uranker`, `musiq`,
/// `wlpips`, `w_delta_e`, `w_ssim`, `coverage`, `path_wlpips`, …, `truth_psnr`, `truth_delta_e`,
/// `depth_error`, …).
pub type Scores = BTreeMap<String, Score>;

/// The methods whose images are scored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// The photograph itself.
    Captured,
    /// The 2D enhancer applied to each photograph on its own.
    Proposal,
    /// The photograph in the light and colours of the enhanced scene.
    Photograph,
    /// The 2D enhancer applied to each rendering of stage 1 on its own: possible at any camera without a
    /// second stage.
    ProposalOfRender,
    /// Stage 1 with its water.
    Reconstruction,
    /// Stage 1 without water.
    Clear,
    /// Stage 1 without water, as the authors of its method show it.
    PublishedClear,
    /// Stage 2 with its water.
    Enhanced,
    /// Stage 2 without water.
    EnhancedClear,
    /// A scene reconstructed from per-view proposals, for comparison.
    EnhanceThenReconstruct,
}

impl Method {
    /// All methods, in the order of tables.
    pub const ALL: [Self; 10] = [
        Self::Captured,
        Self::Proposal,
        Self::Photograph,
        Self::Reconstruction,
        Self::Clear,
        Self::PublishedClear,
        Self::ProposalOfRender,
        Self::EnhanceThenReconstruct,
        Self::Enhanced,
        Self::EnhancedClear,
    ];

    /// The name in tables.
    pub fn label(self) -> &'static str {
        self.names().1
    }

    /// The name of its folders and report pictures.
    pub fn name(self) -> &'static str {
        self.names().0
    }

    fn names(self) -> (&'static str, &'static str) {
        match self {
            Self::Captured => ("captured", "Captured (raw input)"),
            Self::Proposal => ("proposal", "2D enhancer on photographs"),
            Self::Photograph => ("photograph", "Photographs, enhanced by the scene"),
            Self::ProposalOfRender => ("proposal-of-render", "2D enhancer on stage-1 renders"),
            Self::Reconstruction => ("reconstruction", "Stage 1"),
            Self::Clear => ("clear", "Stage 1, clear render"),
            Self::PublishedClear => ("published-clear", "Stage 1, clear view of its authors"),
            Self::Enhanced => ("enhanced", "3D-USE, this program"),
            Self::EnhancedClear => ("enhanced-clear", "3D-USE, enhanced-clear"),
            Self::EnhanceThenReconstruct => ("enhance-then-reconstruct", "Enhance, then reconstruct"),
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
    /// The method.
    pub method: Method,
    /// Per held-out view.
    pub views: Vec<ViewScores>,
    /// Per pair of neighbouring captured views, in the capture's order.
    pub neighbours: Vec<PairScores>,
    /// Per pair of adjacent frames of the rendered path; the keys begin with `path_`.
    pub path: Vec<PairScores>,
    /// Means over views, neighbours and path, without the scores that are undefined.
    pub mean: Scores,
    /// Number of scores that each mean leaves out because they are undefined; metrics without such scores are
    /// absent.
    pub left_out: BTreeMap<String, usize>,
}

impl MethodScores {
    /// Gathers per-view and per-pair scores and their means.
    pub fn new(
        method: Method,
        views: Vec<ViewScores>,
        neighbours: Vec<PairScores>,
        path: Vec<PairScores>,
    ) -> Self {
        let lists: [Vec<&Scores>; 3] = [
            views.iter().map(|v| &v.scores).collect(),
            neighbours.iter().map(|p| &p.scores).collect(),
            path.iter().map(|p| &p.scores).collect(),
        ];
        let (mut mean, mut left_out) = (Scores::new(), BTreeMap::new());
        for list in &lists {
            for name in list.iter().flat_map(|s| s.keys()).collect::<BTreeSet<_>>() {
                let of: Vec<&Score> = list.iter().filter_map(|s| s.get(name)).collect();
                let undefined = of.iter().filter(|s| matches!(s, Score::Undefined(_))).count();
                if undefined > 0 {
                    left_out.insert(name.clone(), undefined);
                }
                mean.insert(name.clone(), Score::mean(of));
            }
        }
        Self { method, views, neighbours, path, mean, left_out }
    }

    /// Number of scores that a mean is over.
    pub fn counted(&self, metric: &str) -> usize {
        let views = self.views.iter().map(|v| &v.scores);
        let pairs = self.neighbours.iter().chain(&self.path).map(|p| &p.scores);
        views.chain(pairs).filter(|s| s.get(metric).is_some_and(|s| s.value().is_some())).count()
    }
}

/// The source of the depth and masks for comparing neighbouring views.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Warp {
    /// Those of the reference variant's stage 1: the same for all variants of a scene.
    Reference,
    /// The scene's own, if no reference was given: not comparable with another scene's.
    #[default]
    Own,
}

/// The format name in `scores.json`.
pub const FORMAT: &str = "3d-use scores";
/// Version of `scores.json`: 2 has finite scores or reasons, neighbouring captured views and the rendered
/// path.
pub const VERSION: u32 = 2;

/// All scores of one scene: the file `scores.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SceneScores {
    /// Always [`FORMAT`].
    pub format: String,
    /// Always [`VERSION`].
    pub version: u32,
    /// Number of training views.
    pub training_views: usize,
    /// Number of held-out views.
    pub held_out_views: usize,
    /// Image size of the first held-out view.
    pub size: (usize, usize),
    /// Share of the held-out views' pixels that the scores count, 0 to 1; masks hide the others.
    #[serde(default = "all")]
    pub pixels: f64,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// The source of the depth and masks for comparing neighbouring views.
    pub warp: Warp,
    /// The look that the enhancement was learnt in; it is the result: `enhanced` or `enhanced-clear`.
    #[serde(default = "enhanced")]
    pub result: Method,
    /// The recovered and the true water; only for scenes with water, of synthetic captures with their truth.
    pub water: Option<WaterScores>,
    /// The methods that were scored.
    pub methods: Vec<MethodScores>,
}

fn all() -> f64 {
    1.0
}

fn enhanced() -> Method {
    Method::Enhanced
}

/// A file `scores.json` that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ScoresError {
    /// The file is damaged.
    #[error(transparent)]
    Damaged(#[from] serde_json::Error),
    /// The file has this format and version instead.
    #[error("expected format \"{FORMAT}\", version {VERSION}, found {0} {1}; evaluate the scene again")]
    Version(serde_json::Value, serde_json::Value),
}

impl SceneScores {
    /// Reads `scores.json`.
    ///
    /// # Errors
    /// Fails if the file has another format or version, or is damaged.
    pub fn parse(bytes: &[u8]) -> Result<Self, ScoresError> {
        let value: serde_json::Value = serde_json::from_slice(bytes)?;
        let (format, version) = (value["format"].as_str(), value["version"].as_u64());
        if format != Some(FORMAT) || version != Some(u64::from(VERSION)) {
            return Err(ScoresError::Version(value["format"].clone(), value["version"].clone()));
        }
        Ok(serde_json::from_value(value)?)
    }

    /// All scores of a method.
    pub fn method(&self, method: Method) -> Option<&MethodScores> {
        self.methods.iter().find(|m| m.method == method)
    }

    /// The share of the pixels that the scores count, for the end of a sentence with a score: `" on 61 % of
    /// the pixels"`. Empty if all count.
    pub fn on_pixels(&self) -> String {
        let decimals = if self.pixels < 0.095 { 1 } else { 0 };
        match self.pixels > 0.995 {
            true => String::new(),
            false => format!(" on {:.decimals$} % of the pixels", 100.0 * self.pixels),
        }
    }

    /// True if masks hide more than half of the pixels, so that the scores say little about the scene.
    pub fn is_of_few_pixels(&self) -> bool {
        self.pixels < 0.5
    }

    /// A sentence on masks that hide more than half of the pixels.
    pub fn hidden_too_much(&self) -> Option<String> {
        self.is_of_few_pixels().then(|| {
            format!(
                "masks hide {:.0} % of the held-out photographs, too much to judge the scene: look at the masks \
                 (black is hidden)",
                100.0 * (1.0 - self.pixels)
            )
        })
    }

    /// A mean score of a method.
    pub fn mean(&self, method: Method, metric: &str) -> Option<&Score> {
        self.method(method)?.mean.get(metric)
    }
}

/// The speed of drawing a scene, and the processor or card.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SceneSpeed {
    /// Frames per second of `enhanced`, or of `reconstruction` if there is no enhanced scene.
    pub fps: Finite,
    /// Width and height, pixels.
    pub size: (usize, usize),
    /// The processor's name, or the graphics card's.
    pub processor: String,
    /// Threads of the processor; 0 if a graphics card draws.
    pub threads: usize,
}

/// Size and machine: `640×360 on NAME (2 threads)`.
impl fmt::Display for SceneSpeed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { size: (width, height), processor, threads, .. } = self;
        write!(f, "{width}×{height} on {processor}")?;
        if *threads > 0 { write!(f, " ({threads} threads)") } else { Ok(()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_leave_out_what_is_undefined_and_say_how_many() {
        let scores = |name: &str, score: Score| Scores::from([(name.to_string(), score)]);
        let view = |score| ViewScores { view: "a".into(), scores: scores("psnr", score) };
        let pair =
            |name, score| PairScores { first: "a".into(), second: "b".into(), scores: scores(name, score) };
        let nothing = || Score::Undefined("the two views see nothing in common".into());
        let method = MethodScores::new(
            Method::Enhanced,
            vec![view(Score::of(20.0)), view(Score::of(f64::INFINITY)), view(Score::of(30.0))],
            vec![pair("w_ssim", Score::of(0.5)), pair("w_ssim", nothing())],
            vec![pair("path_w_ssim", nothing())],
        );
        assert_eq!(method.mean["psnr"], Score::of(25.0));
        assert_eq!(
            method.mean["w_ssim"],
            Score::of(0.5),
            "a pair that shares nothing does not void the mean"
        );
        assert_eq!(method.mean["path_w_ssim"], nothing());
        let left_out = [("psnr", 1), ("w_ssim", 1), ("path_w_ssim", 1)].map(|(n, c)| (n.to_string(), c));
        assert_eq!(method.left_out, BTreeMap::from(left_out));
        assert_eq!((method.counted("psnr"), method.counted("w_ssim")), (2, 1));
    }

    fn scene(pixels: f64) -> SceneScores {
        SceneScores {
            format: FORMAT.into(),
            version: VERSION,
            training_views: 7,
            held_out_views: 1,
            size: (4, 3),
            pixels,
            gaussians: 10,
            warp: Warp::Reference,
            result: Method::Enhanced,
            water: None,
            methods: vec![],
        }
    }

    #[test]
    fn scores_say_on_which_share_of_the_pixels_they_were_taken() {
        assert_eq!(scene(1.0).on_pixels(), "");
        assert_eq!(scene(0.7).on_pixels(), " on 70 % of the pixels");
        assert_eq!(scene(0.06).on_pixels(), " on 6.0 % of the pixels");
        assert!(scene(0.06).hidden_too_much().unwrap().starts_with("masks hide 94 % of the held-out"));
        assert_eq!(scene(0.7).hidden_too_much(), None);
        assert!(scene(0.49).is_of_few_pixels() && !scene(0.5).is_of_few_pixels());
        let old = serde_json::to_string(&scene(0.3)).unwrap().replace("\"pixels\":0.3,", "");
        assert_eq!(SceneScores::parse(old.as_bytes()).unwrap().pixels, 1.0, "older files have none");
    }

    #[test]
    fn a_file_of_another_version_is_told_from_a_damaged_one() {
        let scores = scene(1.0);
        let text = serde_json::to_string(&scores).unwrap();
        assert_eq!(SceneScores::parse(text.as_bytes()).unwrap(), scores);
        let old = text.replace("\"version\":2", "\"version\":1");
        assert!(SceneScores::parse(old.as_bytes()).unwrap_err().to_string().contains("version 2"));
        let damaged = text.replace("\"gaussians\":10", "\"gaussians\":null");
        assert!(SceneScores::parse(damaged.as_bytes()).unwrap_err().to_string().contains("null"));
    }
}
