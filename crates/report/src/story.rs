//! The story of a scene in short and plain words: one sentence, three facts, and the next steps. The figures
//! behind it, one by one, are those of [`verdict`](crate::verdict).

use use3d_capture::flat_stem;
use use3d_judge::scores::{Method, SceneScores};
use use3d_metrics::LIKENESS;
use use3d_numerics::math;

use crate::verdict::{SceneFacts, Sentence, Tone, mean, steadiness};

/// A training of this many times the usual steps has little left to gain.
const LONGER: u64 = 3;

/// The story of a scene.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Story {
    /// One sentence: is it good? `None` for a scene without scores.
    pub headline: Option<Sentence>,
    /// Facts, each with its question.
    pub facts: Vec<(&'static str, String)>,
    /// The next steps, the most useful first.
    pub next: Vec<NextStep>,
}

/// A thing that the reader can do now.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum NextStep {
    /// Run again with these options: the name with what stands before the value, and the value.
    Again(Vec<(&'static str, u64)>),
    /// Find out what is wrong with the capture.
    Check,
}

/// The story of a scene whose enhanced look is `best`.
pub fn story(scores: &SceneScores, best: Method, facts: &SceneFacts) -> Story {
    let told = [
        ("How like the photographs?", likeness(scores)),
        ("How steady are the colours?", steadiness_in_words(scores, best)),
        ("Which water?", water(facts)),
    ];
    let known = |(question, answer): (&'static str, Option<String>)| Some((question, answer?));
    Story {
        headline: Some(headline(scores, best, facts)),
        facts: told.into_iter().filter_map(known).collect(),
        next: next(scores, facts),
    }
}

fn headline(scores: &SceneScores, best: Method, facts: &SceneFacts) -> Sentence {
    let hidden = scores.hidden_too_much().is_some();
    let (tone, scene) = match mean(scores, Method::Reconstruction, "psnr") {
        Some(_) if hidden => (Tone::Bad, "Masks hide most of the pictures, so the scene is hardly tested"),
        Some(psnr) if psnr >= LIKENESS[0] => {
            (Tone::Good, "Pictures of the scene look like real photographs from the same places")
        }
        Some(psnr) if psnr >= LIKENESS[1] => {
            (Tone::Plain, "Pictures of the scene can be recognised, but details are missing")
        }
        Some(_) => {
            (Tone::Bad, "Something went wrong: pictures of the scene do not look like the photographs")
        }
        None => (Tone::Plain, "The scene was not tested, because no photograph was kept back"),
    };
    let colours = match steadiness(scores, best) {
        _ if tone == Tone::Bad => "",
        _ if facts.unchanged => ", and it keeps their colours, because it has no water",
        Tone::Good => {
            ", and its colours change less from picture to picture than those of a program that corrects each picture \
             alone"
        }
        Tone::Bad => {
            ". Its colours change more from picture to picture than those of a program that corrects each picture alone"
        }
        Tone::Plain => "",
    };
    let usual = |steps: &Option<(u64, u64)>| steps.is_some_and(|(done, usual)| (1..usual).contains(&done));
    let short = if facts.steps.iter().any(usual) { " This was a short first look." } else { "" };
    Sentence { tone, text: format!("{scene}{colours}.{short}") }
}

fn likeness(scores: &SceneScores) -> Option<String> {
    let views = &scores.method(Method::Reconstruction)?.views;
    let psnr = mean(scores, Method::Reconstruction, "psnr")?;
    let each = views.iter().filter_map(|view| Some((view.scores.get("psnr")?.value()?, &view.view)));
    let weakest = each.min_by(|a, b| a.0.total_cmp(&b.0)).filter(|_| views.len() > 1);
    let weakest = weakest.map_or_else(String::new, |(value, name)| {
        format!(" The weakest view is {}, with {value:.1} dB.", flat_stem(name))
    });
    let kept_back = match views.len() {
        1 => "on the photograph that was kept back".to_string(),
        n => format!("on average over the {n} photographs that were kept back"),
    };
    Some(format!(
        "The score is {psnr:.1} dB (PSNR) {kept_back}. More is better; from {:.0} dB on, a difference is hard to \
         see.{weakest}",
        LIKENESS[0]
    ))
}

fn steadiness_in_words(scores: &SceneScores, best: Method) -> Option<String> {
    let of = |method| mean(scores, method, "w_delta_e");
    let ours = of(best)?;
    let others = [
        (Method::Captured, "in the photographs themselves"),
        (Method::Proposal, "with a filter on each photograph"),
        (Method::ProposalOfRender, "with the same filter on each picture of the scene"),
    ];
    let others = others.into_iter().filter_map(|(method, name)| Some(format!("{:.1} {name}", of(method)?)));
    let others: Vec<String> = others.collect();
    let others = if others.is_empty() { String::new() } else { format!(" It is {}.", others.join(", ")) };
    Some(format!(
        "From view to view the colour of a surface changes by {ours:.1} (ΔE); 1 can just be seen.{others}"
    ))
}

fn water(facts: &SceneFacts) -> Option<String> {
    const COLOURS: [&str; 3] = ["red", "green", "blue"];
    if let Some((attenuation, metric)) = facts.attenuation {
        if metric {
            let [red, green, blue] = attenuation.map(|a| 100.0 * (1.0 - math::exp(-a)));
            return Some(format!(
                "Along one metre, {red:.0} % of the red light, {green:.0} % of the green and {blue:.0} % of the \
                 blue are lost."
            ));
        }
        let by_loss = |a: &usize, b: &usize| attenuation[*b].total_cmp(&attenuation[*a]);
        let mut order = [0, 1, 2];
        order.sort_by(by_loss);
        let [first, second, third] = order;
        let times = |c: usize| attenuation[first] / attenuation[c].max(1e-6);
        return Some(format!(
            "It takes {} light most: {:.1} times as much as {} and {:.1} times as much as {}. How much along a \
             metre is not known, because the scene has no metres.",
            COLOURS[first],
            times(second),
            COLOURS[second],
            times(third),
            COLOURS[third]
        ));
    }
    (!facts.water.is_empty()).then(|| facts.water.clone())
}

fn next(scores: &SceneScores, facts: &SceneFacts) -> Vec<NextStep> {
    const ITERATIONS: &str = "--iterations ";
    let psnr = mean(scores, Method::Reconstruction, "psnr");
    let options = [ITERATIONS, "--set enhance.iterations="];
    let short = facts.steps.into_iter().zip(options).filter_map(|(steps, option)| {
        let (done, usual) = steps?;
        (1..usual).contains(&done).then_some((option, usual))
    });
    let mut again: Vec<(&str, u64)> = short.collect();
    if let [Some((done, usual)), _] = facts.steps
        && again.is_empty()
        && psnr.is_some_and(|psnr| (LIKENESS[1]..LIKENESS[0]).contains(&psnr))
        && done < LONGER * usual
    {
        again.push((ITERATIONS, LONGER * usual));
    }
    let check = psnr.is_some_and(|psnr| psnr < LIKENESS[1]).then_some(NextStep::Check);
    check.into_iter().chain((!again.is_empty()).then_some(NextStep::Again(again))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::verdict::tests::scene;

    fn told(scores: &SceneScores, facts: &SceneFacts) -> Story {
        story(scores, Method::Enhanced, facts)
    }

    #[test]
    fn it_says_in_one_sentence_if_the_scene_is_good() {
        let of = |psnr: f64, ours: f64| {
            let scores = scene(&[
                (Method::Reconstruction, &[("psnr", psnr)]),
                (Method::ProposalOfRender, &[("w_delta_e", 3.0)]),
                (Method::Enhanced, &[("w_delta_e", ours)]),
            ]);
            told(&scores, &SceneFacts::default()).headline.expect("a sentence")
        };
        let good = of(33.0, 2.0);
        assert_eq!(good.tone, Tone::Good);
        let said = "Pictures of the scene look like real photographs from the same places, and its colours";
        assert!(good.text.starts_with(said) && good.text.contains("change less from"), "{good:?}");
        assert!(of(33.0, 4.0).text.contains(". Its colours change more from"));
        assert!(of(25.0, 2.0).text.starts_with("Pictures of the scene can be recognised"));
        let bad = of(15.0, 2.0);
        assert!(bad.tone == Tone::Bad && !bad.text.contains("colours"), "{bad:?}");
        let untested = told(&scene(&[(Method::Reconstruction, &[])]), &SceneFacts::default());
        assert!(untested.headline.expect("a sentence").text.contains("no photograph was kept back"));
    }

    #[test]
    fn its_facts_are_those_of_the_tables() {
        let scores = scene(&[
            (Method::Captured, &[("w_delta_e", 1.7)]),
            (Method::Proposal, &[("w_delta_e", 3.9)]),
            (Method::Reconstruction, &[("psnr", 33.0)]),
            (Method::Enhanced, &[("w_delta_e", 1.2)]),
        ]);
        let facts = SceneFacts { attenuation: Some(([0.4, 0.14, 0.1], true)), ..SceneFacts::default() };
        let [(_, like), (_, steady), (_, water)] = &told(&scores, &facts).facts[..] else {
            panic!("three facts")
        };
        assert!(
            like.contains("33.0 dB (PSNR) on average over the 2 photographs")
                && like.contains("view is b, with 30.0")
        );
        assert!(
            steady.contains("by 1.2 (ΔE)") && steady.contains("3.9 with a filter on each photograph"),
            "{steady}"
        );
        assert!(water.contains("Along one metre, 33 % of the red light, 13 % of the green"), "{water}");
        let facts = SceneFacts { attenuation: Some(([0.4, 0.1, 0.2], false)), ..SceneFacts::default() };
        let water = &told(&scores, &facts).facts[2].1;
        assert!(
            water.contains("takes red light most: 2.0 times as much as blue and 4.0 times as much as green")
        );
        let facts = SceneFacts { water: "No water found.".into(), ..SceneFacts::default() };
        assert_eq!(told(&scores, &facts).facts[2].1, "No water found.");
    }

    #[test]
    fn it_says_what_to_do_next() {
        let of = |psnr: f64, steps: [Option<(u64, u64)>; 2]| {
            let scores = scene(&[(Method::Reconstruction, &[("psnr", psnr)])]);
            told(&scores, &SceneFacts { steps, ..SceneFacts::default() }).next
        };
        let short = [("--iterations ", 5000), ("--set enhance.iterations=", 1000)];
        let demo = [Some((3000, 5000)), Some((600, 1000))];
        assert_eq!(of(33.0, demo), [NextStep::Again(short.to_vec())]);
        let whole = [Some((5000, 5000)), Some((0, 1000))];
        assert_eq!(of(25.0, whole), [NextStep::Again(vec![("--iterations ", 15_000)])]);
        assert_eq!(of(25.0, [Some((15_000, 5000)), None]), []);
        assert_eq!(of(15.0, whole), [NextStep::Check]);
    }
}
