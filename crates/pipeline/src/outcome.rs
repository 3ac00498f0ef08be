//! The results that a run left in its folder, as lines for people or as one JSON document for programs.

use std::path::PathBuf;

use serde::Serialize;
use use3d_judge::scores::{Method, MethodScores, SceneScores, Scores};
use use3d_metrics::likeness_in_words;
use use3d_stages::{SCORES, read_json, report::best_method};
use use3d_workflow::Summary;
use use3d_workflow::place::PlaceError;

use crate::destination::{absolute, word};
use crate::results::Delivered;

/// The document of `run --json`.
#[derive(Serialize)]
pub struct Outcome<'a> {
    #[serde(flatten)]
    summary: &'a Summary,
    /// All results in the results folder; empty if the run was interrupted.
    results: Vec<Delivered>,
    /// The mean scores of every scene that was evaluated.
    scores: Vec<SceneMeans>,
    /// The reason why results could not be delivered.
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
}

/// The mean scores of a scene.
#[derive(Serialize)]
struct SceneMeans {
    scene: String,
    variant: String,
    /// The file with all of its scores.
    file: PathBuf,
    /// Share of the pixels that the scores count.
    pixels: f64,
    methods: Vec<MethodMeans>,
}

/// The mean scores of one method.
#[derive(Serialize)]
struct MethodMeans {
    method: Method,
    mean: Scores,
}

impl<'a> Outcome<'a> {
    /// Creates it from a run and the result of delivering its results.
    pub fn new(summary: &'a Summary, delivered: &Result<Vec<Delivered>, PlaceError>) -> Self {
        let all = delivered.as_deref().unwrap_or_default();
        let scores = all.iter().filter_map(|result| {
            let scores = scores(result)?;
            let means = |m: MethodScores| MethodMeans { method: m.method, mean: m.mean };
            Some(SceneMeans {
                scene: result.scene.clone(),
                variant: result.variant.clone(),
                file: absolute(&result.path.join(SCORES)),
                pixels: scores.pixels,
                methods: scores.methods.into_iter().map(means).collect(),
            })
        });
        let results = all.iter().map(|r| Delivered { path: absolute(&r.path), ..r.clone() });
        Self {
            summary,
            results: results.collect(),
            scores: scores.collect(),
            error: delivered.as_ref().err().map(ToString::to_string),
        }
    }
}

/// The scores in a result, if it is one of an evaluation.
fn scores(result: &Delivered) -> Option<SceneScores> {
    (result.what == "evaluate").then(|| read_json(&result.path.join(SCORES)).ok()).flatten()
}

/// More results of scenes than this are counted and not listed.
const LISTED: usize = 1000;

/// The paths of the results, and the quality of the reconstructions, in lines.
pub fn lines(delivered: &[Delivered]) -> Vec<String> {
    let path = |Delivered { what, path, .. }: &Delivered| format!("{what:<12} {}", path.display());
    let (of_scenes, of_all): (Vec<_>, Vec<_>) = delivered.iter().partition(|result| !result.scene.is_empty());
    if of_scenes.len() > LISTED {
        let count = format!("{} results of scenes are in the same folder", of_scenes.len());
        return of_all.iter().copied().map(path).chain([count]).chain(next(&of_all)).collect();
    }
    let mut lines: Vec<String> = delivered.iter().map(path).collect();
    for result in delivered {
        let Some(scores) = scores(result) else { continue };
        let named = [result.scene.as_str(), result.variant.as_str()];
        let of = named.into_iter().filter(|name| !name.is_empty()).collect::<Vec<_>>().join(" · ");
        let mean = |method, metric| scores.mean(method, metric).and_then(|s| s.value());
        if let Some(psnr) = mean(Method::Reconstruction, "psnr") {
            let on = scores.on_pixels();
            lines.push(format!("{of}: {}", likeness_in_words(psnr, &on)));
            lines.extend(scores.hidden_too_much().map(|hidden| format!("{of}: {hidden}")));
        }
        // The look that leads the report is printed too.
        let enhanced = delivered
            .iter()
            .find(|r| r.what == "enhance" && (&r.scene, &r.variant) == (&result.scene, &result.variant));
        let best = best_method(enhanced.map(|r| r.path.as_path())).unwrap_or(Method::EnhancedClear);
        let against_truth: Vec<String> = [
            (Method::Captured, "photographs"),
            (Method::Proposal, "a usual filter on each photograph"),
            (best, best.name()),
        ]
        .into_iter()
        .filter_map(|(method, name)| Some(format!("{name} {:.2} dB", mean(method, "truth_psnr")?)))
        .collect();
        if !against_truth.is_empty() {
            let truth = against_truth.join(", ");
            lines.push(format!("{of}: likeness to the true scene without water, more is better: {truth}"));
        }
    }
    lines.extend(next(&of_all));
    lines
}

/// The sentence on the page to open first; `None` without a report.
fn next(of_all: &[&Delivered]) -> Option<String> {
    let report = of_all.iter().find(|result| result.what == "report")?;
    let folder = report.path.parent().filter(|folder| !folder.as_os_str().is_empty())?;
    let (page, folder) = (report.path.display(), word(folder));
    Some(format!("Open {page} in a browser. `use3d view {folder}` shows the scene itself."))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_that_could_not_be_delivered_are_said_in_the_same_document() {
        let summary = Summary::of_scene(&[], "", "");
        let failed = Err(PlaceError::Occupied { path: "out/reef".into(), reason: "somebody's".into() });
        let told = serde_json::to_value(Outcome::new(&summary, &failed)).unwrap();
        assert_eq!(told["error"], "out/reef: somebody's");
        assert_eq!((&told["results"], &told["interrupted"]), (&serde_json::json!([]), &false.into()));
        let none = serde_json::to_value(Outcome::new(&summary, &Ok(Vec::new()))).unwrap();
        assert!(none.get("error").is_none(), "{none}");
    }
}
