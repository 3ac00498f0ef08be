//! The report in the results folder. A batch of one result has one page with everything. Otherwise the page
//! at the top is the overview, and every result has a page and a file of data in its own folder. These are
//! written when a scene is finished, and only if something behind them has changed. The overview is made from
//! the files of data alone, so a change of one scene costs one page and the overview.

use std::collections::HashMap;
use std::fs;
use std::io;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use use3d_judge::configuration::Configuration;
use use3d_judge::names::in_variant;
use use3d_judge::scores::SceneSpeed;
use use3d_report::index::{FailedStage, Index, ResultRow, SceneBlock};
use use3d_report::page::{self, Page, SceneSection, shortened};
use use3d_report::tables::means::MeanScores;
use use3d_report::tables::methods::ahead;
use use3d_report::tables::paper::FailedScene;
use use3d_report::tables::{self, paper};
use use3d_report::verdict::{Sentence, Tone};
use use3d_report::{BatchReport, ResultData};
use use3d_stages::report::{ResultFolders, section};
use use3d_stages::{BATCH, SPEED};
use use3d_workflow::delivered::Sources;
use use3d_workflow::place::{self, PlaceError, at};
use use3d_workflow::run::NodeResult;
use use3d_workflow::{Artifact, Digest, Graph, Summary};

use super::{
    DATA, Delivered, DeliveredCell, OVER_ALL, PAGE, Results, SEALED, STAMPED, TABLES, advice, folder_of,
    lineage, made_by_program, methods, put, relative, sources_of,
};

/// The most bytes of sections that are kept for results with the same artifacts.
const MEMO_BYTES: usize = 32 << 20;

/// The settings of a batch's report.
pub(super) struct ReportSettings {
    pipeline: String,
    title: String,
    views: usize,
    /// The groups of the scenes that have one.
    groups: HashMap<String, String>,
    /// True if the batch has one result, whose page is the page at the top.
    pub(super) single: bool,
}

impl ReportSettings {
    /// The settings of a batch up to `until`; `None` if it has no report.
    pub(super) fn of(graph: &Graph, until: Option<&[String]>) -> Option<Self> {
        let wanted = graph.wanted(until);
        let mut nodes = graph.nodes.iter().zip(wanted);
        let (report, _) = nodes.find(|(node, wanted)| *wanted && node.stage_name == "report")?;
        let parameters = report.parameters.json();
        let mut results = graph.nodes.iter().filter(|node| !node.scene.is_empty());
        let first = results.next().map(|node| (&node.scene, &node.variant));
        let groups = graph.groups().into_iter().map(|(scene, group)| (scene.into(), group.into()));
        Some(Self {
            pipeline: graph.name.clone(),
            title: parameters["title"].as_str().unwrap_or_default().into(),
            views: parameters["views"].as_u64().unwrap_or_default() as usize,
            single: results.all(|node| Some((&node.scene, &node.variant)) == first),
            groups: groups.collect(),
        })
    }

    fn group(&self, scene: &str) -> &str {
        self.groups.get(scene).map_or("", String::as_str)
    }

    /// A digest of everything that a result's page follows from. `alone` is true if the scene stays in the
    /// cache.
    pub(super) fn source(&self, own: &DeliveredCell<'_>, alone: bool) -> String {
        let mut sources = sources_of(own.all());
        for node in own.nodes.iter().filter(|node| node.artifact.is_none()) {
            sources.update(format!("{} {:?} {:?}\n", node.label, node.result, node.failure).as_bytes());
        }
        let Self { title, views, .. } = self;
        let settings = (title, views, alone, self.group(own.scene), made_by_program(), page::digest());
        sources.update(format!("{settings:?}").as_bytes());
        Digest::from(sources.finalize()).short()
    }
}

/// A result as its artifacts tell it, without its names.
struct Made {
    section: SceneSection,
    scores: Option<MeanScores>,
    thumbnail: String,
    configuration: Option<Arc<Configuration>>,
}

/// Results by a digest of their artifacts: scenes and variants may share all of them. The second part is the
/// size of the sections in bytes.
#[derive(Default)]
pub(super) struct Memo(Mutex<(HashMap<Digest, Arc<Made>>, usize)>);

impl Made {
    fn new(own: &DeliveredCell<'_>, views: usize) -> io::Result<Self> {
        let folders =
            own.nodes.iter().filter_map(|node| Some((node.stage, node.artifact.as_deref()?.path.as_path())));
        let folders =
            ResultFolders { scene: own.scene, group: "", variant: own.variant, folders: folders.collect() };
        let made = section(&folders, views).map_err(|error| io::Error::other(error.to_string()))?;
        let names = [own.scene, "", own.variant];
        let trained = own.nodes.iter().any(|node| node.stage == "reconstruct");
        Ok(Self {
            section: made.section,
            scores: made.scores.map(|scores| MeanScores::new(names, &scores)),
            thumbnail: made.thumbnail.map(|picture| picture.source).unwrap_or_default(),
            configuration: if trained { own.configuration().map(Arc::new) } else { None },
        })
    }

    fn bytes(&self) -> usize {
        let views = self.section.views.iter().flat_map(|view| view.lead.iter().chain(&view.images));
        let pictures = views.chain(&self.section.sheets).map(|picture| picture.source.len());
        pictures.sum::<usize>() + self.section.plots.iter().map(|plot| plot.svg.len()).sum::<usize>()
    }
}

impl Memo {
    fn get(&self, own: &DeliveredCell<'_>, views: usize) -> io::Result<Arc<Made>> {
        let mut key = blake3::Hasher::new();
        for node in own.all() {
            let artifact = node.artifact.as_ref().map(|artifact| artifact.manifest.key);
            key.update(format!("{} {} {artifact:?}\n", node.stage, node.preset).as_bytes());
        }
        let key = Digest::from(key.finalize());
        if let Some(made) = self.0.lock().unwrap_or_else(PoisonError::into_inner).0.get(&key) {
            return Ok(made.clone());
        }
        let made = Arc::new(Made::new(own, views)?);
        let mut memo = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        memo.1 += made.bytes();
        if memo.1 <= MEMO_BYTES {
            memo.0.insert(key, made.clone());
        } else {
            *memo = Default::default();
        }
        Ok(made)
    }
}

/// The scores of a result with the data that belong to no artifact: its names, its configuration, the drawing
/// speed from the note of the evaluation, and the key of the scores.
fn scored(settings: &ReportSettings, own: &DeliveredCell<'_>, made: &Made) -> Option<MeanScores> {
    let evaluated = own.artifact("evaluate")?;
    let note = evaluated.manifest.notes.get(SPEED).cloned();
    let name = in_variant(own.scene, own.variant);
    Some(MeanScores {
        scene: own.scene.into(),
        group: settings.group(own.scene).into(),
        variant: own.variant.into(),
        source: format!("{name} {}", shortened(&evaluated.manifest.key.to_string())),
        configuration: made.configuration.clone(),
        processor_seconds: own
            .artifact("reconstruct")
            .and_then(|made| made.manifest.full_processor_seconds()),
        speed: note.and_then(|note| serde_json::from_value::<SceneSpeed>(note).ok()),
        ..made.scores.clone()?
    })
}

/// The stages of a result that failed, now or in an earlier run.
fn failed(own: &DeliveredCell<'_>) -> Vec<FailedStage> {
    let all = own.all().filter_map(|node| {
        let (reason, log) = match (&node.result, &node.failure) {
            (NodeResult::Failed { reason, log, .. }, _) => (reason, log),
            (NodeResult::Missing, Some((reason, log))) => (reason, log),
            _ => return None,
        };
        Some(FailedStage { stage: node.stage.into(), reason: reason.clone(), log: log.display().to_string() })
    });
    all.collect()
}

/// The results of a batch without scores, and the failures of each scene.
#[derive(Default)]
struct Scored<'a> {
    without: Vec<(&'a str, &'a str)>,
    failures: HashMap<&'a str, HashMap<&'a str, String>>,
}

impl<'a> Scored<'a> {
    fn add(&mut self, own: &DeliveredCell<'a>, has_scores: bool) {
        if let Some(FailedStage { stage, reason, .. }) = failed(own).into_iter().next() {
            let reason = reason.lines().next().unwrap_or_default();
            let words = format!("`{stage}` failed: {reason}");
            self.failures.entry(own.scene).or_default().insert(own.variant, words);
        }
        if !has_scores {
            self.without.push((own.scene, own.variant));
        }
    }

    /// The scenes that failed. A stage that variants share fails for one of them, and the others wait for it.
    fn without(&self, settings: &ReportSettings) -> Vec<FailedScene> {
        let each = self.without.iter().filter_map(|(scene, variant)| {
            let failures = self.failures.get(scene)?;
            let reason = failures.get(variant).or_else(|| failures.values().min())?.clone();
            let (group, variant) = (settings.group(scene).to_string(), variant.to_string());
            Some(FailedScene { scene: scene.to_string(), group, variant, reason })
        });
        each.collect()
    }
}

/// The stages of a result that were not made.
fn unmade<'n>(own: &DeliveredCell<'n>) -> Vec<&'n str> {
    let open = own.nodes.iter().filter(|node| {
        use NodeResult::{Blocked, Elsewhere, Missing, NotRun};
        matches!(node.result, Blocked(_) | NotRun | Missing | Elsewhere(_))
    });
    open.map(|node| node.stage).collect()
}

/// A result's page, without what only the page at the top has. `view` is the address of its page in 3D.
fn page_of(
    settings: &ReportSettings,
    own: &DeliveredCell<'_>,
    (made, scores): (&Made, &Option<MeanScores>),
    view: String,
    (command, results): (&str, &Path),
) -> Page {
    let name = in_variant(own.scene, own.variant);
    let mut scene = made.section.clone();
    // A scene that stays in the cache has no page in 3D, and no folder that commands could name.
    scene.commands = advice::commands(&scene.story.next, command, (!view.is_empty()).then_some(results));
    (scene.name, scene.group, scene.page) = (name.clone(), settings.group(own.scene).into(), view);
    let has = |stages: &[&str]| own.nodes.iter().any(|node| stages.contains(&node.stage));
    if has(&["evaluate"]) && !has(&["targets", "propose"]) {
        scene
            .notes
            .push("Stage 2 was left out (`stage2 = false`), so the scene has no enhanced look.".into());
    }
    let failure = |failed: FailedStage| Sentence {
        tone: Tone::Bad,
        text: format!("`{}` failed: {} Its log: `{}`", failed.stage, failed.reason, failed.log),
    };
    let mut verdict: Vec<Sentence> = failed(own).into_iter().map(failure).collect();
    let unmade = unmade(own);
    if !unmade.is_empty() {
        let text = format!("These stages were not made, so this page lacks them: {}.", unmade.join(", "));
        verdict.push(Sentence { tone: Tone::Bad, text });
    }
    Page {
        title: in_variant(&name, &settings.title),
        subtitle: made.section.summary.clone(),
        verdict,
        settings: lineage::settings(made.configuration.iter().map(|made| (own.variant, &**made))),
        tables: scores
            .as_ref()
            .map_or_else(Vec::new, |scores| paper::tables(std::slice::from_ref(scores), &[])),
        scenes: vec![scene],
        costs: Some(lineage::costs(&own.all().collect::<Vec<_>>(), &settings.pipeline, command)),
        ..Page::default()
    }
}

impl Results {
    /// Writes the page and the data of a result, unless they follow from `source` already. `view` is true if
    /// its page in 3D is there.
    pub(super) fn write_page(
        &self,
        settings: &ReportSettings,
        own: &DeliveredCell<'_>,
        (source, view): (&str, bool),
        command: &str,
    ) -> Result<(), PlaceError> {
        let folder = self.out.join(folder_of(own.scene, own.variant));
        let (page, data) = (folder.join(PAGE), folder.join(DATA));
        STAMPED.check(&page)?;
        SEALED.check(&data)?;
        if page.is_file() && ResultData::read(&data).is_some_and(|data| data.source == source) {
            return Ok(());
        }
        at(&folder, "create", fs::create_dir_all(&folder))?;
        let made = at(&page, "write", self.memo.get(own, settings.views))?;
        let scores = scored(settings, own, &made);
        let view = if view { super::VIEW.to_string() } else { String::new() };
        let html = Page {
            overview: format!("../{PAGE}"),
            ..page_of(settings, own, (&made, &scores), view, (command, &folder))
        };
        STAMPED.write(&page, &at(&page, "write", html.html().map_err(io::Error::other))?)?;
        let written = ResultData {
            source: source.into(),
            verdict: made.section.verdict.clone(),
            seconds: lineage::seconds(&own.nodes),
            configuration: made.configuration.as_deref().cloned(),
            scores,
            thumbnail: made.thumbnail.clone(),
            ..ResultData::default()
        };
        let written = written.json();
        let written = at(&data, "write", written.map_err(io::Error::other))?;
        SEALED.write(&data, written.strip_suffix('}').unwrap_or(&written))
    }

    /// Writes the page and the tables over all scenes, unless nothing was computed since they were written.
    pub(super) fn deliver_report(
        &self,
        (summary, cells): (&Summary, &[DeliveredCell<'_>]),
        report: &Artifact,
        views: &[Delivered],
        command: &str,
    ) -> Result<Vec<Delivered>, PlaceError> {
        let (page, tables) = (self.out.join(PAGE), self.out.join(TABLES));
        let Some(settings) = &self.report else { return Ok(Vec::new()) };
        let mut sources = sources_of(summary.nodes.iter());
        sources.update(format!("{} {}", made_by_program(), page::digest()).as_bytes());
        for view in views {
            sources.update(view.path.as_os_str().as_encoded_bytes());
        }
        let wanted = Sources::from([(PAGE.to_string(), Digest::from(sources.finalize()).to_string())]);
        let computed = summary.nodes.iter().any(|n| matches!(n.result, NodeResult::Done));
        let stands = !computed && self.sources(OVER_ALL) == wanted;
        let mut delivered = vec![Delivered::new("report", "", "", &page)];
        if stands {
            delivered.extend(tables.is_dir().then(|| Delivered::new("tables", "", "", &tables)));
            return Ok(delivered);
        }
        let file = report.path.join(BATCH);
        let read = at(&file, "read", fs::read(&file))?;
        let parsed = serde_json::from_slice::<BatchReport>(&read).map_err(io::Error::other);
        let head = at(&file, "read", parsed)?;
        let (made, all) = match cells {
            [own] if settings.single => {
                (self.whole_page(settings, own, views, (&head, command))?, Vec::new())
            }
            _ => self.overview(settings, (summary, cells), views, command),
        };
        let made = Page { title: head.title, calibrator: head.calibrator, made_with: head.made_with, ..made };
        STAMPED.write(&page, &at(&page, "write", made.html().map_err(io::Error::other))?)?;
        if !made.tables.is_empty() {
            delivered.push(Delivered::new("tables", "", "", &tables));
            // Drawing speeds do not follow from a key, so the tables are written with every new page.
            put(None, &tables, |folder| {
                at(folder, "write", tables::write(folder, &made.tables))?;
                let blocks = made.index.iter().flat_map(|index| &index.scenes);
                for block in blocks.filter(|block| !block.methods.is_empty()) {
                    let page = at(folder, "write", methods::page(&block.name, &all, cells))?;
                    let page = Page { made_with: made.made_with.clone(), ..page };
                    let file = folder.join(methods::file(&block.name));
                    let html = at(&file, "write", page.html().map_err(io::Error::other))?;
                    at(&file, "write", fs::write(&file, html))?;
                }
                place::record(folder, None)
            })?;
        }
        self.keep(OVER_ALL, wanted);
        Ok(delivered)
    }

    /// The page of the only result of a batch, with everything.
    fn whole_page(
        &self,
        settings: &ReportSettings,
        own: &DeliveredCell<'_>,
        views: &[Delivered],
        (head, command): (&BatchReport, &str),
    ) -> Result<Page, PlaceError> {
        let made = at(&self.out.join(PAGE), "write", self.memo.get(own, settings.views))?;
        let view = views.first().map_or_else(String::new, |view| relative(&view.path, &self.out));
        let page = page_of(settings, own, (&made, &scored(settings, own, &made)), view, (command, &self.out));
        Ok(Page { missing: head.missing.clone(), ..page })
    }

    /// The overview of a batch, from the data beside the pages of its results.
    fn overview(
        &self,
        settings: &ReportSettings,
        (summary, cells): (&Summary, &[DeliveredCell<'_>]),
        views: &[Delivered],
        command: &str,
    ) -> (Page, Vec<MeanScores>) {
        let views: HashMap<(&str, &str), &Delivered> =
            views.iter().map(|view| ((view.scene.as_str(), view.variant.as_str()), view)).collect();
        let (mut index, mut all) = (Index::default(), Vec::new());
        let mut scored = Scored::default();
        // The results of a variant often share their configuration, which is kept once.
        let mut configurations: Vec<(&str, Arc<Configuration>)> = Vec::new();
        let mut last: HashMap<&str, Arc<Configuration>> = HashMap::new();
        for own in cells {
            let folder = self.out.join(folder_of(own.scene, own.variant));
            let data = ResultData::read(&folder.join(DATA)).unwrap_or_default();
            let configuration = data.configuration.map(|made| {
                let known = last.entry(own.variant).or_default();
                if **known != made {
                    *known = Arc::new(made);
                }
                known.clone()
            });
            let scores =
                data.scores.map(|scores| MeanScores { configuration: configuration.clone(), ..scores });
            configurations.extend(configuration.map(|made| (own.variant, made)));
            let row = ResultRow {
                variant: own.variant.into(),
                page: relative(&folder.join(PAGE), &self.out),
                view: views
                    .get(&(own.scene, own.variant))
                    .map_or_else(String::new, |view| relative(&view.path, &self.out)),
                seconds: lineage::seconds(&own.nodes),
                ..ResultRow::new(&data.verdict, scores.as_ref(), failed(own), &unmade(own))
            };
            scored.add(own, scores.is_some());
            all.extend(scores);
            if index.scenes.last().is_none_or(|last| last.name != own.scene) {
                let group = settings.group(own.scene).into();
                index.scenes.push(SceneBlock { name: own.scene.into(), group, ..SceneBlock::default() });
            }
            if let Some(block) = index.scenes.last_mut() {
                if block.thumbnail.is_empty() {
                    block.thumbnail = data.thumbnail;
                }
                block.rows.push(row);
            }
        }
        let compared = methods::scenes(&all);
        for block in &mut index.scenes {
            if compared.contains(&block.name.as_str()) {
                block.methods = format!("{TABLES}/{}", methods::file(&block.name));
            }
        }
        let page = Page {
            subtitle: index.head(),
            verdict: ahead(&all).into_iter().chain(index.verdict()).collect(),
            settings: lineage::settings(configurations.iter().map(|(variant, made)| (*variant, &**made))),
            tables: paper::tables(&all, &scored.without(settings)),
            index: Some(index),
            costs: Some(lineage::costs_by_stage(&summary.nodes, &settings.pipeline, command)),
            ..Page::default()
        };
        (page, all)
    }
}
