//! The overview of a batch: a block for each scene with a thumbnail, and in it a row for each variant with
//! its verdict, its scores, its time, and its failures. Filters and sorting work in the browser, without a
//! server.
//!
//! Pictures beyond the thumbnail, curves and lists of views are on the pages of the results. So the overview
//! of a thousand scenes in ten variants stays below 6 MB.

use std::collections::BTreeSet;

use use3d_judge::names::distinct;
use use3d_judge::scores::Method;

use crate::tables::means::MeanScores;
use crate::tables::{Better, Column};
use crate::verdict::{Sentence, Tone};

/// The long side of a thumbnail, pixels.
pub const THUMBNAIL_SIDE: usize = 112;
/// A batch of more results than this opens with its first variant alone.
const MANY: usize = 300;
/// The most results whose names a sentence lists.
const NAMED: usize = 10;

/// The scores of a row: the metric, its column, and true if it is of stage 1; the others are of the result.
fn columns() -> [(&'static str, Column, bool); 7] {
    let column = |name, better, decimals| Column::new("", name, better, decimals);
    [
        ("psnr", column("PSNR", Better::Higher, 2), true),
        ("ssim", column("SSIM", Better::Higher, 3), true),
        ("lpips", column("LPIPS", Better::Lower, 3), true),
        ("uciqe", column("UCIQE", Better::Neither, 3), false),
        ("w_delta_e", column("wΔE", Better::Lower, 2), false),
        ("wlpips", column("wLPIPS", Better::Lower, 3), false),
        ("truth_psnr", column("PSNR to truth", Better::Higher, 2), false),
    ]
}

/// The state of a result, from the best to the worst.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RowState {
    /// It was scored, and no comparison is unfavourable.
    Good,
    /// It is complete without scores.
    Plain,
    /// A comparison is unfavourable.
    Bad,
    /// Some of its stages were not made.
    Incomplete,
    /// A stage failed.
    Failed,
}

impl RowState {
    /// The class of the row, the mark before its words, and its first word.
    fn looks(self) -> (&'static str, &'static str, &'static str) {
        match self {
            Self::Good => ("good", "+", "good"),
            Self::Plain => ("plain", "·", "not scored"),
            Self::Bad => ("bad", "–", "unfavourable"),
            Self::Incomplete => ("incomplete", "…", "incomplete"),
            Self::Failed => ("failed", "×", "failed"),
        }
    }
}

/// A stage that failed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FailedStage {
    /// The stage.
    pub stage: String,
    /// The reason.
    pub reason: String,
    /// The path of its log.
    pub log: String,
}

/// The state of a scene in one variant.
#[derive(Clone, Debug)]
pub struct ResultRow {
    /// The variant; empty if there are no variants.
    pub variant: String,
    /// The address of the result's page.
    pub page: String,
    /// The address of the scene's page in 3D; empty if there is none.
    pub view: String,
    /// Its state.
    pub state: RowState,
    /// The subjects of unfavourable comparisons, or the stages that were not made.
    pub words: String,
    /// The stages that failed.
    pub failed: Vec<FailedStage>,
    /// Its scores, in the order of the columns.
    pub scores: Vec<Option<f64>>,
    /// Seconds of computation.
    pub seconds: f64,
}

impl ResultRow {
    /// The row of a result with this verdict and these scores. `unmade` names the stages that were not made.
    pub fn new(
        verdict: &[Sentence],
        scores: Option<&MeanScores>,
        failed: Vec<FailedStage>,
        unmade: &[&str],
    ) -> Self {
        let bad: Vec<&Sentence> = verdict.iter().filter(|sentence| sentence.tone == Tone::Bad).collect();
        let subject = |sentence: &&Sentence| -> String {
            sentence.text.split([':', ',']).next().unwrap_or_default().to_string()
        };
        let (state, words) = match (failed.is_empty(), unmade, &bad[..]) {
            (false, ..) => (RowState::Failed, String::new()),
            (true, [_, ..], _) => (RowState::Incomplete, format!("without {}", unmade.join(", "))),
            (true, [], [_, ..]) => (RowState::Bad, bad.iter().map(subject).collect::<Vec<_>>().join(", ")),
            _ if scores.is_none() => (RowState::Plain, String::new()),
            _ => (RowState::Good, String::new()),
        };
        let score = |(metric, _, of_stage_1): (&str, Column, bool)| {
            let scores = scores?;
            let looks = if of_stage_1 { [Method::Reconstruction; 2] } else { [scores.result, Method::Clear] };
            looks.into_iter().find_map(|look| scores.mean(look, metric)?.value())
        };
        Self {
            variant: String::new(),
            page: String::new(),
            view: String::new(),
            state,
            words,
            failed,
            scores: columns().map(score).to_vec(),
            seconds: 0.0,
        }
    }
}

/// A scene in the overview.
#[derive(Clone, Debug, Default)]
pub struct SceneBlock {
    /// Its name.
    pub name: String,
    /// Its data set, or empty.
    pub group: String,
    /// A small picture as a data address; empty if there is none.
    pub thumbnail: String,
    /// The address of the page with its methods side by side; empty if there is none.
    pub methods: String,
    /// Its results.
    pub rows: Vec<ResultRow>,
}

/// The overview of a batch.
#[derive(Clone, Debug, Default)]
pub struct Index {
    /// The scenes, in order.
    pub scenes: Vec<SceneBlock>,
}

impl Index {
    fn rows(&self) -> impl Iterator<Item = (&SceneBlock, &ResultRow)> {
        self.scenes.iter().flat_map(|scene| scene.rows.iter().map(move |row| (scene, row)))
    }

    fn variants(&self) -> Vec<&str> {
        let all: BTreeSet<&str> = self.rows().map(|(_, row)| row.variant.as_str()).collect();
        let first = self.scenes.iter().max_by_key(|scene| scene.rows.len());
        let ordered = first.into_iter().flat_map(|scene| scene.rows.iter().map(|row| row.variant.as_str()));
        distinct(ordered.chain(all))
    }

    /// One line with the number of scenes, variants and scores.
    pub fn head(&self) -> String {
        let (results, variants) = (self.rows().count(), self.variants().len());
        let scored = self.rows().filter(|(_, row)| row.scores.iter().any(Option::is_some)).count();
        let scenes = match self.scenes.len() {
            1 => "one scene".to_string(),
            n => format!("{n} scenes"),
        };
        let variants = if variants < 2 { String::new() } else { format!(" in {variants} variants") };
        let scored =
            if scored == results { String::new() } else { format!(", {scored} of {results} scored") };
        format!("{scenes}{variants}{scored}")
    }

    /// The verdict on the batch: the numbers of scored results and of bad ones, and the results that failed
    /// or are incomplete.
    pub fn verdict(&self) -> Vec<Sentence> {
        let kind = if self.variants().len() > 1 { "result" } else { "scene" };
        let noun = format!("{kind}s");
        let counted = |n: usize, one: &str, more: &str| match n {
            1 => format!("1 {kind} {one}"),
            n => format!("{n} {kind}s {more}"),
        };
        let named = |states: &[RowState]| -> (usize, String) {
            let all = self.rows().filter(|(_, row)| states.contains(&row.state));
            let names: Vec<String> =
                all.map(|(scene, row)| use3d_judge::names::in_variant(&scene.name, &row.variant)).collect();
            match names.len() {
                0..=NAMED => (names.len(), format!(": {}", names.join(", "))),
                n => (n, String::new()),
            }
        };
        let scored = self.rows().filter(|(_, row)| row.scores.iter().any(Option::is_some)).count();
        let (bad, names) = named(&[RowState::Bad]);
        let (tone, text) = match (scored, bad) {
            (0, _) => (Tone::Plain, format!("None of the {noun} was scored.")),
            (n, 0) => {
                let text = "No comparison is unfavourable to the method in any of them.";
                (Tone::Good, format!("{}. {text}", counted(n, "was scored", "were scored")))
            }
            (n, k) => {
                let text = "of them a comparison is unfavourable to the method";
                (Tone::Bad, format!("{}. In {k} {text}{names}.", counted(n, "was scored", "were scored")))
            }
        };
        let mut out = vec![Sentence { tone, text }];
        let (count, names) = named(&[RowState::Failed, RowState::Incomplete]);
        if count > 0 {
            let text = counted(count, "failed or is not complete", "failed or are not complete");
            let text = format!("{text}{names}. The list below has the reasons.");
            out.push(Sentence { tone: Tone::Bad, text });
        }
        out
    }
}

/// The overview as the template shows it, without columns that have no number.
pub(crate) struct IndexView<'a> {
    pub(crate) heads: Vec<String>,
    pub(crate) variants: Vec<&'a str>,
    /// True if the page opens with the first variant alone.
    pub(crate) many: bool,
    pub(crate) scenes: Vec<SceneView<'a>>,
}

pub(crate) struct SceneView<'a> {
    pub(crate) block: &'a SceneBlock,
    pub(crate) rows: Vec<RowView<'a>>,
}

pub(crate) struct RowView<'a> {
    pub(crate) row: &'a ResultRow,
    /// True if a script has to show the row first; without scripts all rows are shown.
    pub(crate) hidden: bool,
    pub(crate) class: &'static str,
    pub(crate) mark: &'static str,
    pub(crate) word: &'static str,
    pub(crate) scores: Vec<String>,
    pub(crate) minutes: String,
}

impl<'a> IndexView<'a> {
    pub(crate) fn new(index: &'a Index) -> Self {
        let columns = columns();
        let kept: Vec<usize> =
            (0..columns.len()).filter(|k| index.rows().any(|(_, row)| row.scores[*k].is_some())).collect();
        let variants = index.variants();
        let many = variants.len() > 1 && index.rows().count() > MANY;
        let row = |row: &'a ResultRow| {
            let hidden = many && row.variant != variants[0];
            let (class, mark, word) = row.state.looks();
            let score = |k: &usize| match row.scores[*k] {
                Some(value) => format!("{value:.*}", columns[*k].1.decimals),
                None => "–".into(),
            };
            let minutes = format!("{:.1}", row.seconds / 60.0);
            RowView { row, hidden, class, mark, word, scores: kept.iter().map(score).collect(), minutes }
        };
        let scenes =
            index.scenes.iter().map(|block| SceneView { block, rows: block.rows.iter().map(row).collect() });
        Self {
            heads: kept.iter().map(|k| columns[*k].1.head()).collect(),
            scenes: scenes.collect(),
            many,
            variants: if variants.len() > 1 { variants } else { Vec::new() },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(variant: &str, tones: &[Tone], failed: &[&str], unmade: &[&str]) -> ResultRow {
        let subject = |tone: &Tone| Sentence { tone: *tone, text: "Consistency: text, and more.".into() };
        let verdict: Vec<Sentence> = tones.iter().map(subject).collect();
        let failed = failed.iter().map(|stage| FailedStage {
            stage: (*stage).to_string(),
            reason: "no <such> file".into(),
            log: "/cache/logs/x.log".into(),
        });
        let mut row = ResultRow::new(&verdict, None, failed.collect(), unmade);
        row.variant = variant.into();
        if !tones.is_empty() {
            row.scores[0] = Some(24.125);
            row.state = if row.state == RowState::Plain { RowState::Good } else { row.state };
        }
        row
    }

    fn index(scenes: Vec<Vec<ResultRow>>) -> Index {
        let block = |(k, rows)| SceneBlock { name: format!("s{k}"), rows, ..SceneBlock::default() };
        Index { scenes: scenes.into_iter().enumerate().map(block).collect() }
    }

    #[test]
    fn the_head_and_the_verdict_count_scenes_and_variants_apart() {
        use Tone::{Bad, Good};
        let texts = |index: &Index| -> Vec<String> { index.verdict().into_iter().map(|s| s.text).collect() };
        let one = index(vec![vec![row("full", &[Good], &[], &[]), row("mlp", &[Bad], &[], &[])]]);
        assert_eq!(one.head(), "one scene in 2 variants");
        assert!(texts(&one)[0].starts_with("2 results were scored. In 1 of them"), "{:?}", texts(&one));
        assert!(texts(&one)[0].ends_with("the method: s0 · mlp."), "{:?}", texts(&one));
        let two =
            index(vec![vec![row("", &[Good], &[], &[])], vec![row("", &[], &["import"], &["enhance"])]]);
        assert_eq!(two.head(), "2 scenes, 1 of 2 scored");
        assert!(texts(&two)[0].starts_with("1 scene was scored. No comparison"), "{:?}", texts(&two));
        assert_eq!(texts(&two)[1], "1 scene failed or is not complete: s1. The list below has the reasons.");
        let many = index(vec![vec![row("", &[Bad], &[], &[])]; 11]);
        assert!(texts(&many)[0].ends_with("In 11 of them a comparison is unfavourable to the method."));
    }

    #[test]
    fn a_row_says_what_is_unfavourable_failed_or_missing() {
        let bad = row("", &[Tone::Good, Tone::Bad], &[], &[]);
        assert_eq!((bad.state, bad.words.as_str()), (RowState::Bad, "Consistency"));
        assert_eq!(row("", &[Tone::Bad], &["render"], &["evaluate"]).state, RowState::Failed);
        let open = row("", &[], &[], &["render", "evaluate"]);
        assert_eq!((open.state, open.words.as_str()), (RowState::Incomplete, "without render, evaluate"));
        let view = index(vec![vec![bad]]);
        let view = IndexView::new(&view);
        assert_eq!(view.heads, ["PSNR↑"], "columns without a number are left out");
        assert_eq!(view.scenes[0].rows[0].scores, ["24.12"]);
        let two = || vec![row("v0", &[], &[], &[]), row("v1", &[], &[], &[])];
        for (scenes, many) in [(150, false), (151, true)] {
            let index = index(vec![two(); scenes]);
            let view = IndexView::new(&index);
            let hidden = [0, 1].map(|k| view.scenes[9].rows[k].hidden);
            assert_eq!((view.many, hidden), (many, [false, many]), "{scenes} scenes");
        }
    }
}
