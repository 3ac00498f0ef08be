//! Self-contained HTML pages: the page of a result, the overview of a batch, and the comparison of two runs.
//! They need no network, work without scripts and on a phone, and have a dark scheme.
//!
//! This module only lays out what the stages measured and rendered; it computes nothing. Pictures are
//! embedded as JPEG at a bounded size, so that a page stays small enough to send.

use std::sync::LazyLock;

use askama::Template;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use use3d_capture::Image;
use use3d_io_image::{JpegError, jpeg_address, shrunk};

use crate::index::{Index, IndexView};
use crate::story::Story;
use crate::tables::{Cell, Column, Rank, Table, marked};
use crate::verdict::Sentence;
use use3d_judge::names::distinct;

/// Long side of embedded pictures, pixels.
pub const PICTURE_SIDE: usize = 960;
/// JPEG quality of embedded pictures.
const PICTURE_QUALITY: u8 = 86;

/// The most rows of a table on a page; longer tables are files only.
const MOST_ROWS: usize = 200;

/// A page.
#[derive(Clone, Debug, Default)]
pub struct Page {
    /// The run's name.
    pub title: String,
    /// One line below the title.
    pub subtitle: String,
    /// The address of the overview that this page belongs to; empty if there is none.
    pub overview: String,
    /// The verdict on the whole run, in sentences.
    pub verdict: Vec<Sentence>,
    /// The settings behind the results.
    pub settings: Vec<VariantSettings>,
    /// The tables, in order.
    pub tables: Vec<Table>,
    /// The overview of a batch.
    pub index: Option<Index>,
    /// The scenes that the page shows in full, in order.
    pub scenes: Vec<SceneSection>,
    /// The section on the calibrator, if one was trained.
    pub calibrator: Option<CalibratorSection>,
    /// Results that could not be made and are not on the page.
    pub missing: Vec<String>,
    /// The program, its version, and the place of date and command.
    pub made_with: String,
    /// The costs of the run.
    pub costs: Option<Costs>,
}

/// The settings of a variant, in parts: name and text. The part without a name is the base of all others, and
/// `steps` are the steps of the trainings.
#[derive(Clone, Debug, Default)]
pub struct VariantSettings {
    /// The variant; empty if there are no variants.
    pub variant: String,
    /// Name and text of each part.
    pub parts: Vec<(&'static str, String)>,
}

impl VariantSettings {
    fn value(&self, name: &str) -> &str {
        self.parts.iter().find(|(own, _)| *own == name).map_or("", |(_, text)| text)
    }

    fn base(&self) -> &str {
        self.value("")
    }

    fn steps(&self) -> &str {
        self.value("steps")
    }

    fn named(&self) -> impl Iterator<Item = &(&'static str, String)> {
        self.parts.iter().filter(|(name, _)| !name.is_empty())
    }
}

/// The costs of a run, known only after it.
#[derive(Clone, Debug, Default)]
pub struct Costs {
    /// The stages, in order.
    pub stages: Vec<StageRow>,
    /// One line about the run.
    pub made: String,
    /// The parameters of the stages, as text.
    pub parameters: String,
}

/// The section on one scene.
#[derive(Clone, Debug, Default)]
pub struct SceneSection {
    /// Its name.
    pub name: String,
    /// Its data set, or empty.
    pub group: String,
    /// The address of the scene's own page, from the place of this one; empty if it has none.
    pub page: String,
    /// One line: views, size, Gaussians.
    pub summary: String,
    /// Its story in plain words.
    pub story: Story,
    /// The next steps, each with its reason and its whole command.
    pub commands: Vec<(String, String)>,
    /// The verdict on its scores, in sentences.
    pub verdict: Vec<Sentence>,
    /// Further lines: skipped steps, results that are not available.
    pub notes: Vec<String>,
    /// True if the views show several methods, each with its place as its heading.
    pub compared: bool,
    /// Held-out views.
    pub views: Vec<ViewSection>,
    /// Plots.
    pub plots: Vec<PlotFigure>,
    /// Wide pictures, one below the other.
    pub sheets: Vec<Picture>,
}

impl SceneSection {
    /// The address of the folder with the scene's own page; empty if that is beside this page.
    fn folder(&self) -> &str {
        self.page.rsplit_once('/').map_or("", |(folder, _)| folder)
    }
}

/// One held-out view.
#[derive(Clone, Debug, Default)]
pub struct ViewSection {
    /// Its name.
    pub name: String,
    /// Its place among the held-out views; may be empty.
    pub place: &'static str,
    /// The pictures that come first, side by side: captured, enhanced photograph, `enhanced`, `clear`.
    pub lead: Vec<Picture>,
    /// The other pictures: 2D enhancer, `reconstruction`, `depth`, …
    pub images: Vec<Picture>,
    /// Short texts such as `PSNR 24.1`.
    pub scores: Vec<String>,
}

/// An embedded picture.
#[derive(Clone, Debug, Default)]
pub struct Picture {
    /// A short label.
    pub label: String,
    /// A longer explanation, may be empty.
    pub caption: String,
    /// A data URI.
    pub source: String,
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Left and top edge of a lower right corner without pictures, percent of width and height. The page cuts
    /// this corner off, because its white is too bright in the dark scheme.
    pub blank: Option<(f64, f64)>,
}

/// An embedded plot.
#[derive(Clone, Debug)]
pub struct PlotFigure {
    /// The SVG element.
    pub svg: String,
    /// The text below the plot.
    pub caption: String,
}

/// The calibrator's held-out errors.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct CalibratorSection {
    /// Pairs, proposer, form.
    pub summary: String,
    /// Name, error of the proposal, error after calibration, ratio.
    pub rows: Vec<(String, String, String, String)>,
}

/// The costs of one stage of one scene.
#[derive(Clone, Debug)]
pub struct StageRow {
    /// The scene with its variant, or `all scenes`.
    pub scene: String,
    /// The stage.
    pub stage: String,
    /// `computed` or `cached`.
    pub state: String,
    /// Wall-clock seconds of its computation.
    pub seconds: f64,
    /// Peak memory, MiB.
    pub memory: Option<f64>,
    /// Size of the artifact, MiB.
    pub size: f64,
    /// First characters of its key.
    pub key: String,
}

/// A page that could not be laid out.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// A picture could not be encoded.
    #[error("report picture `{label}`: {source}")]
    Picture {
        /// The label of the picture.
        label: String,
        /// The encoder's error.
        source: JpegError,
    },
    /// The template could not be filled.
    #[error("report page: {0}")]
    Template(#[from] askama::Error),
}

impl Picture {
    /// Embeds an image (clamped to the display range), scaled down by box means to at most [`PICTURE_SIDE`].
    pub fn embed(label: &str, caption: &str, image: &Image) -> Result<Self, ReportError> {
        Self::embed_wide(label, caption, image, PICTURE_SIDE)
    }

    /// As [`Picture::embed`] with another limit for the long side, for contact sheets.
    pub fn embed_wide(label: &str, caption: &str, image: &Image, side: usize) -> Result<Self, ReportError> {
        let small = shrunk(image, side);
        let (width, height) = (small.width(), small.height());
        let source = jpeg_address(&small, PICTURE_QUALITY)
            .map_err(|source| ReportError::Picture { label: label.into(), source })?;
        Ok(Self { label: label.into(), caption: caption.into(), source, width, height, blank: None })
    }
}

#[derive(Template)]
#[template(path = "report.html")]
struct PageTemplate<'a> {
    page: &'a Page,
    index: Option<IndexView<'a>>,
    policy: String,
    verdict: String,
    verdicts: Vec<String>,
    tables: Vec<TableView>,
    stages: Vec<StageView>,
}

/// Returns the page's content policy: it fetches nothing, and only its own script runs, whatever the names of
/// scenes and pictures contain.
fn policy() -> String {
    const TEMPLATE: &str = include_str!("../templates/report.html");
    let script = TEMPLATE.split("<script>").nth(1).and_then(|rest| rest.split("</script>").next());
    let digest = STANDARD.encode(Sha256::digest(script.unwrap_or_default().as_bytes()));
    format!(
        "default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src data:; \
         base-uri 'none'; form-action 'none'"
    )
}

struct TableView {
    caption: String,
    spans: Vec<(String, usize)>,
    heads: Vec<String>,
    rows: Vec<RowView>,
    made: Vec<(String, String)>,
    missing: Vec<String>,
}

struct RowView {
    label: String,
    mark: String,
    published: bool,
    cells: Vec<CellView>,
}

struct CellView {
    text: String,
    class: &'static str,
    title: String,
}

struct StageView {
    scene: String,
    stage: String,
    state: String,
    seconds: String,
    bar: u32,
    memory: String,
    size: String,
    key: String,
}

/// The table without the columns that contain no number; the reasons for their absence are listed below it.
fn measured(table: &Table) -> Table {
    let has = |k: usize| table.rows.iter().any(|row| matches!(row.cells.get(k), Some(Cell::Number { .. })));
    let kept: Vec<usize> = (0..table.columns.len()).filter(|k| has(*k)).collect();
    let mut out = table.clone();
    if !kept.is_empty() {
        out.columns = kept.iter().map(|k| table.columns[*k].clone()).collect();
        for row in &mut out.rows {
            row.cells = kept.iter().filter_map(|k| row.cells.get(*k).cloned()).collect();
        }
    }
    out
}

/// The columns without any number, and the reasons for empty cells.
fn not_measured(table: &Table) -> Vec<String> {
    fn plain(reason: &str) -> &str {
        reason.strip_prefix("not available: ").unwrap_or(reason)
    }
    let line = |reason: &str| {
        let is_reason =
            |cell: &Cell| matches!(cell, Cell::NotAvailable { reason: own } if plain(own) == reason);
        let lacks = |k: usize| table.rows.iter().any(|row| row.cells.get(k).is_some_and(is_reason));
        let columns = table.columns.iter().enumerate().filter(|(k, _)| lacks(*k));
        let names = distinct(columns.map(|(_, column)| column.name.as_str()));
        format!("{}: {reason}", names.join(", "))
    };
    distinct(table.missing().into_iter().map(plain)).into_iter().map(line).collect()
}

impl TableView {
    fn new(whole: &Table) -> Self {
        let table = &measured(whole);
        let cell = |cell: &Cell, rank: Rank, decimals: usize| match cell {
            Cell::Number { value, source } => CellView {
                text: format!("{value:.decimals$}"),
                class: match rank {
                    Rank::Best => "best",
                    Rank::Second => "second",
                    Rank::Other => "",
                },
                title: if source.is_empty() { String::new() } else { format!("from the scores of {source}") },
            },
            Cell::NotAvailable { reason } => {
                CellView { text: "n/a".into(), class: "missing", title: reason.clone() }
            }
            Cell::Blank => CellView { text: "–".into(), class: "missing", title: String::new() },
        };
        let made = table.made_by().into_iter().enumerate();
        let rows =
            table.rows.iter().zip(table.ranks()).zip(table.marks()).map(|((row, ranks), mark)| RowView {
                label: row.name(),
                mark,
                published: row.published,
                cells: (row.cells.iter().zip(ranks).zip(&table.columns))
                    .map(|((c, r), k)| cell(c, r, k.decimals))
                    .collect(),
            });
        Self {
            caption: table.caption.clone(),
            spans: table.spans().into_iter().map(|(group, count)| (group.to_string(), count)).collect(),
            heads: table.columns.iter().map(Column::head).collect(),
            rows: rows.collect(),
            made: made.map(|(place, text)| (marked(place), text.to_string())).collect(),
            missing: not_measured(whole),
        }
    }
}

impl StageView {
    /// The rows of a table of costs; their bars compare the times.
    fn all(stages: &[StageRow]) -> Vec<Self> {
        let longest = stages.iter().map(|s| s.seconds).fold(1e-9, f64::max);
        let view = |s: &StageRow| Self {
            scene: s.scene.clone(),
            stage: s.stage.clone(),
            state: s.state.clone(),
            seconds: format!("{:.1}", s.seconds),
            bar: (120.0 * s.seconds / longest).round().max(1.0) as u32,
            memory: s.memory.map_or_else(|| "–".into(), |m| format!("{m:.0}")),
            size: format!("{:.1}", s.size),
            key: shortened(&s.key),
        };
        stages.iter().map(view).collect()
    }
}

impl Page {
    /// The page as HTML.
    ///
    /// # Errors
    /// A template could not be filled.
    pub fn html(&self) -> Result<String, ReportError> {
        let shown = self.tables.iter().filter(|table| table.rows.len() <= MOST_ROWS);
        let template = PageTemplate {
            page: self,
            index: self.index.as_ref().map(IndexView::new),
            policy: policy(),
            verdict: verdict(&self.verdict)?,
            verdicts: self.scenes.iter().map(|scene| verdict(&scene.verdict)).collect::<Result<_, _>>()?,
            tables: shown.map(TableView::new).collect(),
            stages: self.costs.as_ref().map_or_else(Vec::new, |costs| StageView::all(&costs.stages)),
        };
        Ok(template.render()?)
    }
}

#[derive(Template)]
#[template(path = "verdict.html")]
struct VerdictTemplate<'a> {
    sentences: Vec<SentenceView<'a>>,
}

struct SentenceView<'a> {
    class: &'static str,
    mark: &'static str,
    /// Pieces of the text; true for commands and names of files.
    pieces: Vec<(bool, &'a str)>,
}

/// Sentences as a list; empty without sentences. Text between backticks is shown as code.
fn verdict(sentences: &[Sentence]) -> Result<String, askama::Error> {
    let marked = sentences.iter().map(|sentence| {
        let pieces = sentence.text.split('`').enumerate().map(|(k, piece)| (k % 2 == 1, piece));
        SentenceView { class: sentence.tone.class(), mark: sentence.tone.mark(), pieces: pieces.collect() }
    });
    VerdictTemplate { sentences: marked.collect() }.render()
}

/// A digest of the templates; a page that another version made has another one.
pub fn digest() -> &'static str {
    static DIGEST: LazyLock<String> = LazyLock::new(templates);
    &DIGEST
}

fn templates() -> String {
    let templates = [
        include_str!("../templates/report.html"),
        include_str!("../templates/index.html"),
        include_str!("../templates/tables.html"),
        include_str!("../templates/costs.html"),
        include_str!("../templates/made-by.html"),
        include_str!("../templates/verdict.html"),
    ];
    shortened(&STANDARD.encode(Sha256::digest(templates.concat().as_bytes())))
}

/// The first characters of a key, enough to distinguish it from others.
pub fn shortened(key: &str) -> String {
    key.chars().take(12).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::index::{FailedStage, ResultRow, SceneBlock};
    use crate::tables::{Better, Row};
    use crate::verdict::Tone;

    #[test]
    fn no_script_runs_but_the_page_s_own() {
        let html = Page { title: "<script>alert(1)</script>".into(), ..Page::default() }.html().unwrap();
        let policy = html.split("http-equiv=\"Content-Security-Policy\" content=\"").nth(1).unwrap();
        let policy = policy.split('"').next().unwrap();
        let scripts: Vec<&str> =
            html.split("<script>").skip(1).map(|rest| rest.split("</script>").next().unwrap()).collect();
        assert_eq!(scripts.len(), 1);
        let digest = STANDARD.encode(Sha256::digest(scripts[0].as_bytes()));
        assert!(policy.contains("default-src 'none'"), "{policy}");
        assert!(policy.contains(&format!("script-src 'sha256-{digest}';")), "{policy}");
    }

    #[test]
    fn a_page_is_one_file_that_escapes_what_it_shows() {
        let picture = Picture::embed("captured", "", &Image::filled(2000, 10, 0.5)).unwrap();
        assert_eq!((picture.width, picture.height), (666, 3));
        let cell = Cell::Number { value: 1.0, source: "abc".into() };
        let page = Page {
            title: "a <b> & c".into(),
            tables: vec![Table {
                name: "t".into(),
                caption: "caption".into(),
                columns: vec![Column::new("G", "PSNR", Better::Higher, 2)],
                rows: vec![Row::published("x", vec![cell])],
            }],
            scenes: vec![SceneSection {
                name: "reef".into(),
                views: vec![ViewSection {
                    name: "v".into(),
                    place: "the middle one",
                    lead: vec![picture.clone()],
                    images: vec![Picture { label: "depth".into(), ..picture }],
                    scores: vec!["PSNR 1".into()],
                }],
                ..SceneSection::default()
            }],
            ..Page::default()
        };
        let html = page.html().unwrap();
        assert!(!html.contains("<b>") && html.contains("data:image/jpeg;base64,"));
        let at = |text: &str| html.find(text).unwrap_or_else(|| panic!("{text}"));
        assert!(at("class=\"lead\"") < at("alt=\"v: captured\""), "the leading pictures stand first");
        assert!(!html.contains("More views that") && html.matches("data-view>").count() == 1);
        // Fifteen words or fewer stand before the first picture.
        let before = html[at("<h1>")..at("alt=\"v: captured\"")].replace('<', " <");
        let words = before.split_whitespace().filter(|word| !word.contains(['<', '>', '=', '"'])).count();
        assert!(words <= 15, "{words}: {before}");
        assert!(
            at("alt=\"v: captured\"") < at("class=\"strip\"")
                && at("class=\"strip\"") < at("alt=\"v: depth\"")
        );
        assert!(
            !html.contains("http://")
                || html.matches("http://").count() == html.matches("http://www.w3.org").count()
        );
        assert!(html.contains("(published)"));
        let row = StageRow {
            scene: "reef".into(),
            stage: "import".into(),
            state: "cached".into(),
            seconds: 1.5,
            memory: None,
            size: 2.0,
            key: "0123456789abcdef".into(),
        };
        assert!(!html.contains("<code>") && !html.contains("settings:") && !html.contains("Walk through"));
        let parts =
            [("", "preset paper, changed: a = <b>"), ("proposer", "fusion"), ("steps", "5000 + 1000")];
        let parts = parts.map(|(name, text)| (name, text.to_string())).to_vec();
        let mut page = page;
        page.scenes[0].page = "reef/view.html".into();
        let headline = Some(Sentence { tone: Tone::Bad, text: "a <poor> scene".into() });
        page.scenes[0].story = Story { headline, facts: vec![("Why?", "<fog>".into())], next: Vec::new() };
        page.scenes[0].commands = vec![("Look & see".into(), "use3d view 'a <b>'".into())];
        page.settings = vec![VariantSettings { variant: "reef".into(), parts }];
        page.tables[0].rows.push(Row {
            made_by: "preset paper; seed: 42".into(),
            ..Row::own("y".into(), vec![Cell::Number { value: 12.34, source: "hardware".into() }])
        });
        page.costs = Some(Costs {
            stages: vec![row],
            made: "by `use3d run <a>`".into(),
            parameters: "reef: evaluate\n{ \"path_pairs\": 8 } <&>".into(),
        });
        let whole = page.html().unwrap();
        assert!(whole.contains("href=\"reef/view.html\"") && whole.contains("href=\"reef\""));
        assert!(whole.contains("<code>0123456789ab</code>") && whole.contains("path_pairs"));
        assert!(!whole.contains("<&>") && whole.contains("by `use3d run &#60;a&#62;`"));
        assert!(whole.contains("12.34") && whole.contains("<sup>a</sup>"));
        for part in [
            "<p class=\"headline bad\">a &#60;poor&#62; scene</p>",
            "<dt>Why?</dt><dd>&#60;fog&#62;</dd>",
            "<dt>Look &#38; see</dt><dd><code>use3d view &#39;a &#60;b&#62;&#39;</code></dd>",
        ] {
            assert!(whole.contains(part), "{part}");
        }
        assert!(whole.contains("preset paper; seed: 42"), "{whole}");
        let at = |text: &str| whole.find(text).unwrap_or_else(|| panic!("{text}"));
        let line = "reef · settings: preset paper, changed: a = &#60;b&#62;; 5000 + 1000 steps</summary>";
        assert!(at("id=\"scene-1\"") < at(line), "below the story");
        assert!(at(line) < at("<dt>proposer</dt><dd>fusion</dd>"));
    }

    #[test]
    fn the_overview_has_a_row_for_each_result_with_its_reason_and_escapes_all_of_it() {
        let failed = FailedStage {
            stage: "import".into(),
            reason: "no <model>".into(),
            log: "/cache/logs/reef.log".into(),
        };
        let row = |variant: &str, failed: Vec<FailedStage>| ResultRow {
            variant: variant.into(),
            page: format!("reef%40{variant}/report.html"),
            ..ResultRow::new(&[], None, failed, &[])
        };
        let block = SceneBlock {
            name: "<reef>".into(),
            group: "Tiny & small".into(),
            thumbnail: Picture::embed("", "", &Image::filled(48, 32, 0.5)).unwrap().source,
            methods: String::new(),
            rows: vec![row("full", vec![failed]), row("mlp", Vec::new())],
        };
        let page = Page { index: Some(Index { scenes: vec![block] }), ..Page::default() };
        let html = page.html().unwrap();
        assert_eq!((html.matches("<tbody>").count(), html.matches("<img loading").count()), (1, 1), "{html}");
        assert!(html.contains("import: no &#60;model&#62;<br><code>/cache/logs/reef.log</code>"), "{html}");
        assert!(html.contains("&#60;reef&#62;") && html.contains("Tiny &#38; small"));
        assert!(html.contains("<option>mlp</option>") && html.contains("href=\"reef%40mlp/report.html\""));
        assert!(!html.contains("<model>") && !html.contains("<reef>"));
    }

    #[test]
    fn a_long_table_is_a_file_only() {
        let number = Cell::Number { value: 1.0, source: String::new() };
        let table = |rows: usize| Table {
            name: "t".into(),
            caption: "a long one".into(),
            columns: vec![Column::new("", "PSNR", Better::Higher, 2)],
            rows: vec![Row::own("x".into(), vec![number.clone()]); rows],
        };
        let shown = |rows: usize| Page { tables: vec![table(rows)], ..Page::default() }.html().unwrap();
        assert!(shown(MOST_ROWS).contains("a long one") && !shown(MOST_ROWS + 1).contains("a long one"));
    }
}
