//! Words on a whole batch: the line below the title, and the verdict on all of its scenes and variants.

use std::collections::BTreeSet;

use crate::page::SceneSection;
use crate::verdict::{Sentence, Tone};

/// One line with the number of scenes, variants and scores. A result is a scene with its variant.
pub fn head(results: &[(&str, &str)], scored: usize) -> String {
    let scenes = different(results.iter().map(|(scene, _)| *scene));
    let variants = different(results.iter().map(|(_, variant)| *variant));
    let cells = results.len();
    let scenes = if scenes == 1 { "one scene".to_string() } else { format!("{scenes} scenes") };
    let variants = if variants == 1 { String::new() } else { format!(" in {variants} variants") };
    let scored = if scored == cells { String::new() } else { format!(", {scored} of {cells} scored") };
    format!("{scenes}{variants}{scored}")
}

/// The number of different names.
fn different<'a>(names: impl Iterator<Item = &'a str>) -> usize {
    names.collect::<BTreeSet<_>>().len()
}

/// The verdict on a batch: the sentences of a single scene, else the numbers of scored results and of bad
/// ones; and the list of what is missing. `sections` are those of `results`, in the same order.
pub fn overall(results: &[(&str, &str)], sections: &[SceneSection], missing: &[String]) -> Vec<Sentence> {
    let mut out = Vec::new();
    let variants = different(results.iter().map(|(_, variant)| *variant)) > 1;
    let results = if variants { "results" } else { "scenes" };
    if sections.len() > 1 {
        let judged = sections.iter().filter(|scene| !scene.verdict.is_empty()).count();
        let is_bad = |scene: &&SceneSection| scene.verdict.iter().any(|sentence| sentence.tone == Tone::Bad);
        let bad: Vec<&str> = sections.iter().filter(is_bad).map(|scene| scene.name.as_str()).collect();
        let (tone, text) = match (judged, bad.len()) {
            (0, _) => (Tone::Plain, format!("None of the {results} was scored.")),
            (n, 0) => {
                let text = "No comparison is unfavourable to the method in any of them.";
                (Tone::Good, format!("{n} {results} were scored. {text}"))
            }
            (n, k) => (
                Tone::Bad,
                format!(
                    "{n} {results} were scored. In {k} of them a comparison is unfavourable to the method: {}. The \
                     sections below give the details.",
                    bad.join(", ")
                ),
            ),
        };
        out.push(Sentence { tone, text });
    }
    if !missing.is_empty() {
        let text = format!(
            "These parts failed or were not made, so this report does not have them: {}.",
            missing.join(", ")
        );
        out.push(Sentence { tone: Tone::Bad, text });
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_head_and_the_verdict_count_scenes_and_variants_apart() {
        let one = [("reef", "full"), ("reef", "mlp"), ("reef", "rbf"), ("reef", "none")];
        assert_eq!(head(&one, 4), "one scene in 4 variants");
        assert_eq!(head(&one, 3), "one scene in 4 variants, 3 of 4 scored");
        let two = [("reef", ""), ("vent", "")];
        assert_eq!(head(&two, 2), "2 scenes");
        let section = |name: &str, tone| SceneSection {
            name: name.into(),
            verdict: vec![Sentence { tone, text: "a sentence".into() }],
            ..SceneSection::default()
        };
        let sections = [section("reef · full", Tone::Good), section("reef · mlp", Tone::Bad)];
        let text = |results: &[(&str, &str)]| overall(results, &sections, &[])[0].text.clone();
        assert!(text(&one[..2]).starts_with("2 results were scored. In 1 of them"), "{}", text(&one[..2]));
        assert!(text(&two).starts_with("2 scenes were scored."), "{}", text(&two));
        assert!(text(&two).contains("reef · mlp"), "{}", text(&two));
    }
}
