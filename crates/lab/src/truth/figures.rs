//! The results: every figure of every capture, as a mean over seeds with its spread.
//!
//! A figure is `x̄ ± s` over the n seeds that have one, `s² = Σ (x - x̄)² / (n - 1)`. It shows how far
//! another seed would move a single run, and is not the error of the mean. One seed has no spread. If a seed
//! has no figure, its reason is stored instead.
//!
//! The errors of the water are those of the coefficients that `evaluate` gives (means over all rays
//! of the held-out views, 1/metre) against the true ones, `|β / β* - 1|` per channel; the median of
//! three channels is the middle one.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use use3d_judge::scores::{Finite, Method, SceneScores, Score};
use use3d_judge::truth::WaterScores;

use super::captures::Capture;
use super::runs::{DEFAULT, ENHANCE_FIRST, PRIOR_OFF, PSEUDO_LABELS, Recipe, others};

/// The format name in `truth.json`.
pub const FORMAT: &str = "3d-use bench truth";

/// One figure over seeds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Figure {
    /// The mean over the seeds that have one; absent if none has.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mean: Option<Finite>,
    /// The standard deviation over these seeds; absent for fewer than two.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub spread: Option<Finite>,
    /// The score of each seed.
    pub of: BTreeMap<u64, Score>,
}

/// Figures by name: those of `scores.json`, and for stage 1 those of [`SceneFigures`].
pub type Figures = BTreeMap<String, Figure>;

impl Figure {
    /// The figure of these scores by seed.
    pub fn new(of: BTreeMap<u64, Score>) -> Self {
        let values: Vec<f64> = of.values().filter_map(Score::value).collect();
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let square: f64 = values.iter().map(|v| (v - mean) * (v - mean)).sum();
        let spread = (values.len() > 1).then(|| (square / (n - 1.0)).sqrt());
        Self { mean: Finite::new(mean), spread: spread.and_then(Finite::new), of }
    }

    /// The mean as a number.
    pub fn value(&self) -> Option<f64> {
        self.mean.map(Finite::get)
    }
}

/// One row of a capture's table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RowFigures {
    /// The name shown to readers.
    pub label: String,
    /// The variant it comes from.
    pub variant: String,
    /// The method that was scored.
    pub method: Method,
    /// Means over the held-out views, pairs of neighbours and pairs of path frames.
    pub figures: Figures,
}

/// The figures of a stage 1 of a capture: `held_out_psnr` (dB), `held_out_ssim`, `depth_error`, `holes`,
/// `gaussians`, and if the truth consists of coefficients `attenuation_error_{red,green,blue,median,worst}`,
/// `backscatter_error_…`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SceneFigures {
    /// The name shown to readers.
    pub label: String,
    /// The variant it comes from.
    pub variant: String,
    /// Its figures.
    pub figures: Figures,
}

/// Everything about one capture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CaptureFigures {
    /// Its name.
    pub name: String,
    /// A description of the capture.
    pub about: String,
    /// The compared methods; this program's own come last.
    pub rows: Vec<RowFigures>,
    /// The trainings of stage 1.
    pub scenes: Vec<SceneFigures>,
}

/// All results: the file `truth.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TruthFigures {
    /// Always [`FORMAT`].
    pub format: String,
    /// Always 1.
    pub version: u32,
    /// The program's version.
    pub program: String,
    /// The command that reproduces it.
    pub command: String,
    /// The settings that it was made with.
    pub recipe: Recipe,
    /// The seeds that are in it.
    pub seeds: Vec<u64>,
    /// The pipeline file of each seed.
    pub pipelines: BTreeMap<u64, String>,
    /// Messages about failed runs: the figures do not include these.
    pub failed: Vec<String>,
    /// The captures.
    pub captures: Vec<CaptureFigures>,
}

/// The scores of one capture in one variant with one seed.
#[derive(Clone, Debug)]
pub struct Scored {
    /// The seed.
    pub seed: u64,
    /// The capture's name.
    pub capture: String,
    /// The variant.
    pub variant: String,
    /// Its scores.
    pub scores: SceneScores,
}

/// The simple methods, each with its variant, in the order of tables.
const SIMPLE: [(&str, Method, &str); 5] = [
    (DEFAULT, Method::Captured, "photographs"),
    (DEFAULT, Method::Proposal, "2D enhancer on photographs"),
    (DEFAULT, Method::ProposalOfRender, "2D enhancer on stage-1 renders"),
    (ENHANCE_FIRST, Method::EnhanceThenReconstruct, "enhance, then reconstruct"),
    (PSEUDO_LABELS, Method::Enhanced, "pseudo-labels"),
];

/// The rows that a table may have: first the simple methods, then the clear views of other authors' methods
/// as these show them, then the looks of the scene itself without its water or enhanced, once with the
/// paper's start of the water and once with this program's default.
fn rows() -> Vec<(&'static str, Method, String)> {
    let shown = |method: &Method| {
        *method != Method::Reconstruction
            && !SIMPLE.iter().any(|(variant, m, _)| m == method && *variant != PSEUDO_LABELS)
    };
    let simple = SIMPLE.iter().map(|(variant, method, label)| (*variant, *method, (*label).to_string()));
    let theirs = others().map(|method| {
        // Without water, the picture itself is all that there is to show.
        let shown = if method == WITHOUT_WATER { Method::Clear } else { Method::PublishedClear };
        (method, shown, format!("`{method}`"))
    });
    let ours = [PRIOR_OFF, DEFAULT].into_iter().flat_map(|variant| {
        Method::ALL.into_iter().filter(shown).map(move |method| {
            let with = if variant == PRIOR_OFF { ", `medium_prior = \"off\"`" } else { "" };
            (variant, method, format!("`{}`{with}", method.name()))
        })
    });
    simple.chain(theirs).chain(ours).collect()
}

/// The method that knows no water.
const WITHOUT_WATER: &str = "3dgs";

/// Joins the scores of all seeds into figures.
fn over_seeds(of: BTreeMap<u64, BTreeMap<String, Score>>) -> Figures {
    let mut names: BTreeMap<String, BTreeMap<u64, Score>> = BTreeMap::new();
    for (seed, scores) in of {
        for (name, score) in scores {
            names.entry(name).or_default().insert(seed, score);
        }
    }
    names.into_iter().map(|(name, of)| (name, Figure::new(of))).collect()
}

/// Errors of one coefficient of the water.
fn coefficient(name: &str, found: [f64; 3], truth: [f64; 3]) -> Vec<(String, Score)> {
    let errors: [f64; 3] = std::array::from_fn(|c| (found[c] / truth[c] - 1.0).abs());
    let mut sorted = errors;
    sorted.sort_unstable_by(f64::total_cmp);
    let named = ["red", "green", "blue"].into_iter().zip(errors);
    let summary = [("median", sorted[1]), ("worst", sorted[2])];
    named.chain(summary).map(|(what, error)| (format!("{name}_error_{what}"), Score::of(error))).collect()
}

/// The figures of a stage 1.
fn scene(scores: &SceneScores) -> BTreeMap<String, Score> {
    let mut out = BTreeMap::from([("gaussians".to_string(), Score::of(scores.gaussians as f64))]);
    let mut take = |name: &str, method: Method, metric: &str| {
        if let Some(score) = scores.mean(method, metric) {
            out.insert(name.to_string(), score.clone());
        }
    };
    take("held_out_psnr", Method::Reconstruction, "psnr");
    take("held_out_ssim", Method::Reconstruction, "ssim");
    // For a scene that was learnt from proposals, only the geometry is comparable.
    for geometry in ["depth_error", "holes"] {
        take(geometry, Method::EnhanceThenReconstruct, geometry);
        take(geometry, Method::Reconstruction, geometry);
    }
    if let Some(WaterScores { attenuation, backscatter, true_attenuation, true_backscatter }) = scores.water {
        out.extend(coefficient("attenuation", attenuation, true_attenuation));
        out.extend(coefficient("backscatter", backscatter, true_backscatter));
    }
    out
}

/// All figures of a capture.
pub fn of_capture(capture: &Capture, scored: &[Scored]) -> CaptureFigures {
    let own = |variant: &'static str| {
        scored.iter().filter(move |s| s.capture == capture.name && s.variant == variant)
    };
    let rows = rows().into_iter().filter_map(|(variant, method, label)| {
        let of = own(variant).filter_map(|s| Some((s.seed, s.scores.method(method)?.mean.clone())));
        let figures = over_seeds(of.collect());
        (!figures.is_empty()).then(|| RowFigures { label, variant: variant.into(), method, figures })
    });
    let trained = [(ENHANCE_FIRST, "enhance, then reconstruct".to_string())].into_iter();
    let trained = trained.chain(others().map(|method| (method, format!("`{method}`"))));
    let trained = trained
        .chain([(PRIOR_OFF, "`medium_prior = \"off\"`".to_string()), (DEFAULT, "stage 1".to_string())]);
    let scenes = trained.filter_map(|(variant, label)| {
        let figures = over_seeds(own(variant).map(|s| (s.seed, scene(&s.scores))).collect());
        (!figures.is_empty()).then(|| SceneFigures { label, variant: variant.into(), figures })
    });
    CaptureFigures {
        name: capture.name.into(),
        about: capture.about.into(),
        rows: rows.collect(),
        scenes: scenes.collect(),
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::truth::captures::CAPTURES;
    use use3d_judge::scores::{self, MethodScores, ViewScores, Warp};

    /// Scores of one view per method.
    pub(crate) fn scored(
        (seed, capture, variant): (u64, &str, &str),
        water: Option<WaterScores>,
        methods: &[(Method, &[(&str, f64)])],
    ) -> Scored {
        let method = |(method, scores): &(Method, &[(&str, f64)])| {
            let scores = scores.iter().map(|(name, value)| ((*name).to_string(), Score::of(*value)));
            let view = ViewScores { view: "a.png".into(), scores: scores.collect() };
            MethodScores::new(*method, vec![view], vec![], vec![])
        };
        let scores = SceneScores {
            format: scores::FORMAT.into(),
            version: scores::VERSION,
            training_views: 7,
            held_out_views: 1,
            pixels: 1.0,
            size: (4, 3),
            gaussians: 10,
            warp: Warp::Reference,
            result: Method::Enhanced,
            water,
            methods: methods.iter().map(method).collect(),
        };
        Scored { seed, capture: capture.into(), variant: variant.into(), scores }
    }

    #[test]
    fn a_figure_is_a_mean_with_the_spread_of_single_runs_and_keeps_reasons() {
        let of = |values: &[f64]| {
            let of = values.iter().enumerate().map(|(i, v)| (i as u64, Score::of(*v)));
            Figure::new(of.collect())
        };
        let three = of(&[1.0, 2.0, 6.0]);
        assert_eq!(three.value(), Some(3.0));
        assert!((three.spread.unwrap().get() - 7f64.sqrt()).abs() < 1e-12);
        assert_eq!(of(&[4.0]).spread, None);
        let gap = of(&[4.0, f64::INFINITY, 6.0]);
        assert_eq!((gap.value(), gap.of.len()), (Some(5.0), 3));
        assert_eq!(of(&[]).value(), None);
        let text = serde_json::to_string(&gap).unwrap();
        assert!(!text.contains("null"), "{text}");
        assert_eq!(serde_json::from_str::<Figure>(&text).unwrap(), gap);
    }

    #[test]
    fn the_waters_errors_are_relative_and_per_channel() {
        let water = WaterScores {
            attenuation: [0.5, 0.1, 0.09],
            backscatter: [0.2, 0.2, 0.1],
            true_attenuation: [0.4, 0.1, 0.1],
            true_backscatter: [0.2, 0.1, 0.1],
        };
        let scored = scored((1, "air", DEFAULT), Some(water), &[]);
        let figures = scene(&scored.scores);
        let close = |name: &str, wanted: f64| {
            let value = figures[name].value().unwrap();
            assert!((value - wanted).abs() < 1e-12, "{name}: {value}");
        };
        close("attenuation_error_red", 0.25);
        close("attenuation_error_blue", 0.1);
        close("attenuation_error_median", 0.1);
        close("attenuation_error_worst", 0.25);
        close("backscatter_error_median", 0.0);
        close("backscatter_error_worst", 1.0);
        close("gaussians", 10.0);
    }

    #[test]
    fn rows_come_from_their_variants_ours_last_and_other_captures_stay_out() {
        let seeds = |capture: &str, by: f64| {
            [1, 2].map(|seed| {
                let psnr = [("truth_psnr_raw", by + seed as f64)];
                scored(
                    (seed, capture, DEFAULT),
                    None,
                    &[
                        (Method::Captured, &psnr),
                        (Method::Reconstruction, &[("psnr", 30.0), ("depth_error", 0.1)]),
                        (Method::Clear, &psnr),
                        (Method::Enhanced, &psnr),
                    ],
                )
            })
        };
        let mut all: Vec<Scored> = seeds("air", 10.0).into();
        all.extend(seeds("lamps", 100.0));
        all.push(scored(
            (1, "air", PSEUDO_LABELS),
            None,
            &[(Method::Enhanced, &[("truth_psnr_raw", 1.0)]), (Method::Clear, &[("truth_psnr_raw", 2.0)])],
        ));
        all.push(scored(
            (1, "air", ENHANCE_FIRST),
            None,
            &[(Method::EnhanceThenReconstruct, &[("depth_error", 0.3)])],
        ));
        let air = CAPTURES.iter().find(|c| c.name == "air").unwrap();
        let figures = of_capture(air, &all);
        let labels: Vec<&str> = figures.rows.iter().map(|r| r.label.as_str()).collect();
        assert_eq!(
            labels,
            ["photographs", "enhance, then reconstruct", "pseudo-labels", "`clear`", "`enhanced`"]
        );
        assert_eq!(figures.rows[0].figures["truth_psnr_raw"].value(), Some(11.5));
        assert_eq!(figures.rows[2].figures["truth_psnr_raw"].value(), Some(1.0));
        let stage1 = figures.scenes.last().unwrap();
        assert_eq!(stage1.figures["held_out_psnr"].value(), Some(30.0));
        assert_eq!(figures.scenes[0].figures["depth_error"].value(), Some(0.3));
        assert!(!figures.scenes[0].figures.contains_key("held_out_psnr"), "it never saw the photographs");
    }
}
