//! Sentences about a scene: its water, the length of its training, the comparisons between its methods, and
//! the scores that are missing. [`story`](crate::story) says the same in short and plain words.
//!
//! Every sentence is made from the figures in the tables and from the files of the stages. If a comparison
//! is unfavourable to the enhanced scene, the sentence says so.

use use3d_capture::flat_stem;
use use3d_metrics::{LIKENESS, Score};

use serde::{Deserialize, Serialize};
use use3d_judge::names::distinct;
use use3d_judge::scores::{Method, SceneScores, ViewScores};

/// The tone of a sentence.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Tone {
    /// Good news.
    Good,
    /// Bad news.
    Bad,
    /// Neither.
    Plain,
}

impl Tone {
    /// The class of a sentence on a page.
    pub(crate) fn class(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::Bad => "bad",
            Self::Plain => "plain",
        }
    }

    /// The mark before it.
    pub(crate) fn mark(self) -> &'static str {
        match self {
            Self::Good => "+",
            Self::Bad => "–",
            Self::Plain => "·",
        }
    }
}

/// One sentence.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Sentence {
    /// Its tone.
    pub tone: Tone,
    /// Its text.
    pub text: String,
}

/// Facts about a scene that its scores do not contain.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SceneFacts {
    /// Sentences on the water; empty if nothing is known.
    pub water: String,
    /// The attenuation of red, green and blue, and true if it is per metre, else per unit of the scene's
    /// length; `None` if the tracks do not tell it.
    pub attenuation: Option<([f64; 3], bool)>,
    /// Steps of stage 1 and of stage 2, each with the usual number; `None` for a stage that did not run.
    pub steps: [Option<(u64, u64)>; 2],
    /// True if stage 2 had nothing to learn, because the colours stay as photographed.
    pub unchanged: bool,
    /// True if a calibrator corrected the proposals.
    pub calibrated: bool,
    /// Number of pairs from which the calibrator was fitted, and the recommended number.
    pub pairs: Option<(usize, usize)>,
}

/// The weakest view is named if it is this many dB below the mean.
const WEAK: f64 = 2.0;

fn plain(text: String) -> Sentence {
    Sentence { tone: Tone::Plain, text }
}

pub(crate) fn mean(scores: &SceneScores, method: Method, metric: &str) -> Option<f64> {
    scores.mean(method, metric)?.value()
}

/// The sentences of a scene whose enhanced look is `best`.
pub fn verdict(scores: &SceneScores, best: Method, facts: &SceneFacts) -> Vec<Sentence> {
    let sentences = [
        reconstruction(scores),
        training(facts),
        (!facts.water.is_empty()).then(|| plain(facts.water.clone())),
        learning(facts),
        against_truth(scores, best),
        consistency(scores, best),
        without_reference(scores, best),
        not_measured(scores),
    ];
    sentences.into_iter().flatten().collect()
}

/// A sentence on a training that was shorter than usual.
fn training(facts: &SceneFacts) -> Option<Sentence> {
    let short = facts.steps.iter().zip(["stage 1", "stage 2"]).filter_map(|(steps, stage)| {
        let (done, usual) = (*steps)?;
        (done < usual && done > 0).then(|| format!("{done} of the usual {usual} steps in {stage}"))
    });
    let short: Vec<String> = short.collect();
    (!short.is_empty()).then(|| {
        plain(format!("Training: {}. This is a first look; a full run is sharper.", short.join(", ")))
    })
}

/// Sentences on the enhancement and on the pairs behind it.
fn learning(facts: &SceneFacts) -> Option<Sentence> {
    if facts.unchanged {
        let text = "Enhancement: none. The scene has no water, so its colours stay as photographed.";
        return Some(plain(text.into()));
    }
    let (pairs, recommended) = facts.pairs.filter(|(pairs, recommended)| pairs < recommended)?;
    Some(plain(format!(
        "Pairs: the enhancement was learnt from {pairs} pairs. {recommended} are recommended; with fewer it may \
         not fit your water."
    )))
}

fn reconstruction(scores: &SceneScores) -> Option<Sentence> {
    let views = &scores.method(Method::Reconstruction)?.views;
    let Some(psnr) = mean(scores, Method::Reconstruction, "psnr") else {
        let text = "No photograph was held out, so the quality of the reconstruction is not known. Hold some out \
             with `import.split.every`.";
        return Some(plain(text.into()));
    };
    let of = |view: &ViewScores| Some((view.scores.get("psnr")?.value()?, flat_stem(&view.view)));
    let worst = views.iter().filter_map(of).min_by(|a, b| a.0.total_cmp(&b.0));
    let ssim =
        mean(scores, Method::Reconstruction, "ssim").map_or_else(String::new, |v| format!(", SSIM {v:.3}"));
    let weak = worst.filter(|(value, _)| *value < psnr - WEAK && views.len() > 1);
    let weak = weak
        .map_or_else(String::new, |(value, name)| format!(" The weakest view is {name}, at {value:.1} dB."));
    let (tone, meaning) = if psnr >= LIKENESS[0] {
        (Tone::Good, "a difference that is hard to see")
    } else if psnr >= LIKENESS[1] {
        // Pictures with their water are reproduced well; that proves nothing about colours without water.
        (Tone::Plain, "recognisable, with details missing")
    } else {
        (Tone::Bad, "something is wrong: look at the weakest view first")
    };
    let count = match views.len() {
        1 => "the held-out photograph is".to_string(),
        n => format!("the {n} held-out photographs are"),
    };
    let (tone, meaning) = match scores.hidden_too_much() {
        Some(hidden) => (Tone::Bad, format!("; {hidden}")),
        None => (tone, format!(" ({meaning})")),
    };
    let on = scores.on_pixels();
    let text = format!("Reconstruction: {count} reproduced at {psnr:.1} dB PSNR{ssim}{on}{meaning}.{weak}");
    Some(Sentence { tone, text })
}

/// A comparison such as `1.2 dB more than the photographs`.
fn compared(ours: f64, other: f64, unit: &str, decimals: usize, whom: &str, words: [&str; 2]) -> String {
    let apart = format!("{:.decimals$}", (ours - other).abs());
    if apart.parse() == Ok(0.0) {
        return format!("the same as {whom}");
    }
    format!("{apart}{unit} {} than {whom}", words[usize::from(ours < other)])
}

/// The methods that an enhanced scene is compared with. The last is the fair rival in consistency: it sees
/// the same renders, one at a time.
const OTHERS: [(Method, &str); 3] = [
    (Method::Captured, "the photographs"),
    (Method::Proposal, "the 2D enhancer on each photograph"),
    (Method::ProposalOfRender, "the 2D enhancer on each render of stage 1"),
];

/// A mean score of each method of [`OTHERS`] that has one, with its name.
fn others(scores: &SceneScores, metric: &str) -> Vec<(f64, &'static str)> {
    OTHERS.iter().filter_map(|(method, name)| Some((mean(scores, *method, metric)?, *name))).collect()
}

fn against_truth(scores: &SceneScores, best: Method) -> Option<Sentence> {
    let metric = "truth_psnr";
    let ours = mean(scores, best, metric)?;
    let others = others(scores, metric);
    let texts: Vec<String> =
        others.iter().map(|(other, name)| compared(ours, *other, " dB", 1, name, ["more", "less"])).collect();
    let tone = if others.iter().any(|(other, _)| *other > ours) { Tone::Bad } else { Tone::Good };
    let looks = [Method::Clear, Method::Enhanced, Method::EnhancedClear];
    let better = looks.into_iter().filter(|look| *look != best);
    let better = better.filter_map(|look| Some((mean(scores, look, metric)?, look)));
    let better = better.filter(|(value, _)| *value > ours + 0.05).max_by(|a, b| a.0.total_cmp(&b.0));
    let better = better.map_or_else(String::new, |(value, look)| {
        format!(" Closer still is {}, with {value:.1} dB.", look.name())
    });
    let texts = if texts.is_empty() { String::new() } else { format!(" That is {}.", texts.join(", ")) };
    let text =
        format!("Against the true scene without water, {} reaches {ours:.1} dB.{texts}{better}", best.name());
    Some(Sentence { tone, text })
}

/// Good if the colours of a look change less between neighbouring views than those of the 2D enhancer.
pub(crate) fn steadiness(scores: &SceneScores, best: Method) -> Tone {
    let of = |method| mean(scores, method, "w_delta_e");
    // A picture with stronger colours also varies more; so the tone depends on the comparison with the 2D
    // enhancer, which sees one picture at a time. Photographs have noise that no render has, so its result
    // on renders counts where it is known.
    match (of(best), of(Method::ProposalOfRender).or(of(Method::Proposal))) {
        (Some(ours), Some(rival)) if ours > rival => Tone::Bad,
        (Some(_), Some(_)) => Tone::Good,
        _ => Tone::Plain,
    }
}

fn consistency(scores: &SceneScores, best: Method) -> Option<Sentence> {
    let metric = "w_delta_e";
    let ours = mean(scores, best, metric)?;
    let others = others(scores, metric);
    let texts: Vec<String> = others.iter().map(|(other, name)| format!("{other:.1} for {name}")).collect();
    let tone = steadiness(scores, best);
    let beside =
        if texts.is_empty() { String::new() } else { format!(" The figure is {}.", texts.join(" and ")) };
    let text = format!(
        "Consistency: between neighbouring views the colours of {} change by ΔE {ours:.1}; less is better.{beside}",
        best.name()
    );
    Some(Sentence { tone, text })
}

fn without_reference(scores: &SceneScores, best: Method) -> Option<Sentence> {
    let text = |metric: &str, name: &str| -> Option<String> {
        let ours = mean(scores, best, metric)?;
        let captured = mean(scores, Method::Captured, metric)?;
        Some(format!("{name} {ours:.2} (photographs: {captured:.2})"))
    };
    let both: Vec<String> = [text("uciqe", "UCIQE"), text("uiqm", "UIQM")].into_iter().flatten().collect();
    (!both.is_empty()).then(|| {
        plain(format!(
            "Scores without a reference: {}. They rise with contrast and saturation even when colours are wrong; do \
             not rank by them alone.",
            both.join(", ")
        ))
    })
}

fn not_measured(scores: &SceneScores) -> Option<Sentence> {
    let scores = scores.methods.iter().flat_map(|m| &m.mean);
    let missing = scores.filter_map(|(metric, score)| match score {
        Score::NotAvailable(why) => Some((metric.strip_prefix("path_").unwrap_or(metric), why)),
        _ => None,
    });
    let missing: Vec<(&str, &String)> = missing.collect();
    let (_, reason) = missing.first()?;
    let mut names = distinct(missing.iter().map(|(metric, _)| match *metric {
        // The share of pixels that flow covers is not a score by itself: it is missing together with wLPIPS.
        "flow_coverage" | "wlpips" => "wLPIPS",
        "lpips" => "LPIPS",
        "musiq" => "MUSIQ",
        "uranker" => "URanker",
        other => other,
    }));
    names.sort_unstable();
    let why = reason.strip_prefix("not available: ").unwrap_or(reason);
    Some(plain(format!("Not measured: {} ({why}).", names.join(", "))))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use use3d_judge::scores::{FORMAT, MethodScores, Scores, VERSION, Warp};

    pub(crate) fn scene(methods: &[(Method, &[(&str, f64)])]) -> SceneScores {
        let view = |name: &str, scores: &[(&str, f64)], off: f64| ViewScores {
            view: name.into(),
            scores: scores
                .iter()
                .map(|(metric, v)| ((*metric).to_string(), Score::of(v + off)))
                .collect::<Scores>(),
        };
        let of = |(method, scores): &(Method, &[(&str, f64)])| {
            MethodScores::new(
                *method,
                vec![view("a.png", scores, 3.0), view("b.png", scores, -3.0)],
                Vec::new(),
                Vec::new(),
            )
        };
        SceneScores {
            format: FORMAT.into(),
            version: VERSION,
            training_views: 8,
            held_out_views: 2,
            pixels: 1.0,
            size: (64, 48),
            gaussians: 10,
            warp: Warp::Own,
            result: Method::Enhanced,
            water: None,
            methods: methods.iter().map(of).collect(),
        }
    }

    fn texts(scores: &SceneScores) -> Vec<(Tone, String)> {
        verdict(scores, Method::EnhancedClear, &SceneFacts::default())
            .into_iter()
            .map(|s| (s.tone, s.text))
            .collect()
    }

    #[test]
    fn it_says_what_is_better_and_what_is_worse() {
        let good = scene(&[
            (Method::Captured, &[("truth_psnr", 14.0), ("w_delta_e", 8.0), ("uciqe", 4.5)]),
            (Method::Proposal, &[("truth_psnr", 19.5), ("w_delta_e", 9.0)]),
            (Method::Reconstruction, &[("psnr", 33.0), ("ssim", 5.0)]),
            (Method::EnhancedClear, &[("truth_psnr", 22.0), ("w_delta_e", 7.0), ("uciqe", 5.0)]),
        ]);
        let said = texts(&good);
        assert!(
            said[0].0 == Tone::Good
                && said[0].1.contains("33.0 dB")
                && said[0].1.contains("The weakest view is b, at 30.0 dB."),
            "{said:?}"
        );
        assert!(
            said[1].0 == Tone::Good
                && said[1].1.contains("8.0 dB more than the photographs, 2.5 dB more than the 2D enhancer"),
            "{said:?}"
        );
        assert!(said[2].0 == Tone::Good && said[2].1.contains("change by ΔE 7.0"), "{said:?}");
        assert!(said[3].1.contains("UCIQE 5.00 (photographs: 4.50"), "{said:?}");
        let middling = texts(&scene(&[(Method::Reconstruction, &[("psnr", 22.4)])]));
        assert!(
            middling[0].0 == Tone::Plain && middling[0].1.contains("(recognisable, with details missing)")
        );

        let mut hidden = good;
        hidden.pixels = 0.06;
        let said = texts(&hidden);
        assert!(
            said[0].0 == Tone::Bad
                && said[0].1.contains("SSIM 5.000 on 6.0 % of the pixels; masks hide 94 %"),
            "{said:?}"
        );

        let mut bad = scene(&[
            (Method::Proposal, &[("truth_psnr", 25.0), ("w_delta_e", 3.5)]),
            (Method::Reconstruction, &[("psnr", 15.0)]),
            (Method::Clear, &[("truth_psnr", 27.0)]),
            (Method::EnhancedClear, &[("truth_psnr", 22.0), ("w_delta_e", 7.0)]),
        ]);
        bad.methods[0]
            .mean
            .insert("lpips".into(), Score::NotAvailable("not available: no models folder".into()));
        let said = texts(&bad);
        assert!(said[0].0 == Tone::Bad && said[0].1.contains("something is wrong"), "{said:?}");
        assert!(
            said[1].0 == Tone::Bad
                && said[1].1.contains("3.0 dB less than the 2D enhancer")
                && said[1].1.contains("Closer still is clear"),
            "{said:?}"
        );
        assert!(said[2].0 == Tone::Bad, "{said:?}");
        assert_eq!(said[3].1, "Not measured: LPIPS (no models folder).");
        assert!(texts(&scene(&[(Method::Reconstruction, &[])]))[0].1.contains("No photograph was held out"));
    }

    #[test]
    fn the_rival_in_consistency_is_the_enhancer_that_sees_the_same_renders() {
        let rival = |of_renders: f64| {
            let scores = scene(&[
                (Method::Proposal, &[("w_delta_e", 9.0)]),
                (Method::ProposalOfRender, &[("w_delta_e", of_renders)]),
                (Method::EnhancedClear, &[("w_delta_e", 7.0)]),
            ]);
            texts(&scores).into_iter().find(|(_, text)| text.contains("Consistency")).unwrap()
        };
        assert_eq!(rival(6.0).0, Tone::Bad, "the enhancer of photographs is worse, but not the fair rival");
        let (tone, text) = rival(7.5);
        assert_eq!(tone, Tone::Good);
        assert!(text.contains("9.0 for the 2D enhancer on each photograph"), "{text}");
        assert!(text.contains("7.5 for the 2D enhancer on each render of stage 1"), "{text}");
    }

    #[test]
    fn it_says_how_long_was_trained_and_which_water_was_used() {
        let scores = scene(&[(Method::Reconstruction, &[("psnr", 25.0)])]);
        let facts = SceneFacts {
            water: "Water found: stage 1 starts from it.".into(),
            steps: [Some((300, 5000)), Some((1000, 1000))],
            calibrated: true,
            pairs: Some((60, 800)),
            ..SceneFacts::default()
        };
        let of = |facts: &SceneFacts| -> Vec<String> {
            verdict(&scores, Method::Enhanced, facts).into_iter().map(|s| s.text).collect()
        };
        let said = of(&facts);
        assert!(said[1].starts_with("Training: 300 of the usual 5000 steps in stage 1. "), "{said:?}");
        assert_eq!(said[2], "Water found: stage 1 starts from it.");
        assert!(said[3].starts_with("Pairs: the enhancement was learnt from 60 pairs. 800"), "{said:?}");
        let whole = SceneFacts {
            steps: [Some((5000, 5000)), Some((0, 1000))],
            unchanged: true,
            ..SceneFacts::default()
        };
        let said = of(&whole);
        assert!(said[1].starts_with("Enhancement: none."), "{said:?}");
    }
}
