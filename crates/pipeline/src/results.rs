//! The results folder: the report with its costs, the tables, the scenes, and a page per scene to view it in
//! a browser. All are copied out of the cache and get readable names.
//!
//! An artifact holds nothing that depends on the clock or the machine. Times, memory, keys and drawing speeds
//! are stored next to artifacts; this module adds them to the page and the tables.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde::Serialize;
use use3d_scene::White;
use use3d_workflow::delivered::{Notes, Sources};
use use3d_workflow::place::{self, Look, PlaceError, Standing, at};
use use3d_workflow::run::{NodeResult, RanNode};
use use3d_workflow::{Artifact, Cache, Digest, Event, Graph, Listener, Summary};

use crate::made_by;
use crate::scene_page;
use crate::written::Sealed;
use use3d_judge::configuration::Configuration;
use use3d_judge::names::in_variant;
use use3d_judge::scores::ScoredScene;
use use3d_report::BatchReport;
use use3d_report::page::{Costs, StageRow, VariantSettings, shortened};
use use3d_report::tables::{self, paper};
use use3d_stages::{BATCH, SCORES, SPEED};

/// The page and the tables over all scenes.
const PAGE: &str = "report.html";
const TABLES: &str = "tables";
/// The page of a scene next to its folders, and the folder for that page's parts if it is too large for one
/// file.
const VIEW: &str = "view.html";
const VIEW_PARTS: &str = "view_files";
/// A page has its digest in its last line.
pub(crate) const STAMPED: Sealed =
    Sealed { around: ["<!-- written by use3d, blake3 ", " -->\n"], words: ["page", "program"] };

/// The folder of all results of a scene in a variant, below the results folder.
fn folder_of(scene: &str, variant: &str) -> PathBuf {
    if variant.is_empty() { scene.into() } else { format!("{scene}@{variant}").into() }
}

/// A results folder and the notes about its parts. A part is the folder of a scene, or the page and the
/// tables.
pub struct Results {
    /// The path of the folder.
    pub out: PathBuf,
    notes: Notes,
    /// The sources of each part that is as it was delivered.
    standing: Mutex<BTreeMap<String, Sources>>,
}

/// The part over all scenes.
const OVER_ALL: &str = "";

/// The files and folders of a part.
fn paths_of(part: &str) -> Vec<PathBuf> {
    if part == OVER_ALL { vec![PAGE.into(), TABLES.into()] } else { vec![part.into()] }
}

/// The scenes in the results: the enhanced ones if there are two.
pub fn scenes_of(delivered: &[Delivered]) -> impl Iterator<Item = &Delivered> {
    let scene = |what: &'static str| delivered.iter().filter(move |result| result.what == what);
    let enhanced = move |result: &Delivered| {
        scene("enhance").any(|other| (&other.scene, &other.variant) == (&result.scene, &result.variant))
    };
    scene("enhance").chain(scene("reconstruct").filter(move |result| !enhanced(result)))
}

impl Results {
    /// The folder `out` for the results of a cache.
    pub fn new(out: &Path, cache: &Cache) -> Self {
        Self { out: out.to_path_buf(), notes: Notes::of(cache, out), standing: Mutex::default() }
    }

    fn standing(&self) -> MutexGuard<'_, BTreeMap<String, Sources>> {
        self.standing.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The sources of a part that is as it was delivered; empty if it is not. Its files are examined once.
    fn sources(&self, part: &str) -> Sources {
        let examine = || self.notes.standing(part, &paths_of(part));
        self.standing().entry(part.to_string()).or_insert_with(examine).clone()
    }

    /// Notes the sources of a part that was just delivered.
    fn keep(&self, part: &str, sources: Sources) {
        if let Err(error) = self.notes.keep(part, &paths_of(part), sources.clone()) {
            tracing::debug!("{error}");
        }
        self.standing().insert(part.to_string(), sources);
    }

    /// Forgets what is known of the parts, because another part of the program has written into the folder.
    pub fn look_again(&self) {
        self.standing().clear();
    }

    /// A listener that also delivers the results of every scene as soon as it is finished: the batch may run
    /// for days or fail. `inner` gets all events; `command` is the command line of the run.
    pub fn delivering(self: &Arc<Self>, inner: Arc<dyn Listener>, command: String) -> Arc<dyn Listener> {
        let out = self.clone();
        Arc::new(move |event: &Event<'_>| {
            inner.event(event);
            if let Event::SceneOver { scene, variant, nodes } = event
                && let Err(error) = out.deliver(&Summary::of_scene(nodes, scene, variant), &command)
            {
                // Delivery is tried again at the end, where a failure counts.
                let text = format!("its results could not be delivered yet: {error}");
                inner.event(&Event::Warning { label: scene, text: &text });
            }
        })
    }

    /// Checks, before anything is computed, that the results of `until` (all stages if `None`) can be written
    /// to the folder: that it is writable, and that everything at their places was written by this program.
    ///
    /// # Errors
    /// Returns the first place that is occupied, or that cannot be written. Nothing is changed.
    pub fn check(&self, graph: &Graph, until: Option<&[String]>) -> Result<(), PlaceError> {
        let out = &self.out;
        place::check_writable(out)?;
        place::sweep(out);
        let mut places: BTreeMap<PathBuf, String> = BTreeMap::new();
        // A part that is as it was delivered is ours.
        let mut examined: BTreeMap<PathBuf, bool> = BTreeMap::new();
        for (node, _) in graph.nodes.iter().zip(graph.wanted(until)).filter(|(_, wanted)| *wanted) {
            let folder = folder_of(&node.scene, &node.variant);
            if [PAGE, TABLES].iter().any(|own| folder == Path::new(own)) {
                let reason = format!(
                    "the results of the scene `{}` would go there, beside those of all scenes; rename the scene",
                    node.scene
                );
                return Err(PlaceError::Occupied { path: out.join(folder), reason });
            }
            if let Some(place) = node.delivered.map(|own| folder.join(own))
                && let Some(other) = places.insert(place.clone(), node.label())
            {
                let own = node.label();
                let reason = format!(
                    "the results of `{other}` and `{own}` would both go there; rename a scene or a variant"
                );
                return Err(PlaceError::Occupied { path: out.join(place), reason });
            }
            let (part, page) = match node.stage_name {
                "reconstruct" => (folder.clone(), folder.join(VIEW)),
                "report" => {
                    places.insert(TABLES.into(), node.label());
                    (OVER_ALL.into(), PAGE.into())
                }
                _ => continue,
            };
            let stands = !self.sources(&part.to_string_lossy()).is_empty();
            examined.insert(part, stands);
            if !stands {
                STAMPED.check(&out.join(page))?;
            }
        }
        let part_of = |place: &Path| match place.parent() {
            Some(folder) if place != Path::new(TABLES) => folder.to_path_buf(),
            _ => OVER_ALL.into(),
        };
        let unknown = places.keys().filter(|place| examined.get(&part_of(place)) != Some(&true));
        let mut swept = BTreeSet::new();
        for place in unknown {
            let place = out.join(place);
            let folder = place::parent(&place);
            if swept.insert(folder.to_path_buf()) {
                place::sweep(folder);
            }
            place::check(&place, true)?;
        }
        Ok(())
    }

    /// Fills the folder and returns the list of results: `report`, `tables`, and the folders of every scene.
    /// `command` is the command line that was typed; the report shows it.
    ///
    /// # Errors
    /// A place is occupied by something that this program did not write, or cannot be written; results that
    /// were delivered before it stay.
    pub fn deliver(&self, summary: &Summary, command: &str) -> Result<Vec<Delivered>, PlaceError> {
        let out = &self.out;
        at(out, "create", fs::create_dir_all(out))?;
        let mut delivered = Vec::new();
        let mut views = Vec::new();
        for cell in &cells(summary) {
            let own = self.deliver_cell(cell)?;
            let (view, folders): (Vec<_>, Vec<_>) = own.into_iter().partition(|d| d.what == "view");
            delivered.extend(folders);
            views.extend(view);
        }
        if let Some(report) = summary.artifact("", "", "report") {
            delivered.extend(self.deliver_report(summary, report, &views, command)?);
        }
        delivered.extend(views);
        Ok(delivered)
    }

    /// Writes the results of a scene in a variant to their places, unless they are there already.
    fn deliver_cell(&self, own: &DeliveredCell<'_>) -> Result<Vec<Delivered>, PlaceError> {
        let (scene, variant) = (own.scene, own.variant);
        let folder = folder_of(scene, variant);
        let part = folder.to_string_lossy().into_owned();
        let mut wanted = Sources::new();
        let placed = own.nodes.iter().filter_map(|node| {
            Some((node.stage, node.artifact.as_deref()?, self.out.join(&folder).join(node.delivered?)))
        });
        let placed: Vec<(&str, &Artifact, PathBuf)> = placed.collect();
        for (stage, artifact, _) in &placed {
            let key = artifact.manifest.key;
            // The scores also name the configuration, which follows from all nodes of the scene.
            let source =
                if *stage == "evaluate" { format!("{key} {}", own.sources()) } else { key.to_string() };
            wanted.insert((*stage).to_string(), source);
        }
        let delivered = placed.iter().map(|(stage, _, path)| Delivered::new(stage, scene, variant, path));
        let mut delivered: Vec<Delivered> = delivered.collect();
        let shown = own.artifact("reconstruct").and_then(|scene| own.artifact("enhance").or(Some(scene)));
        let page = Delivered::new("view", scene, variant, &self.out.join(&folder).join(VIEW));
        if let Some(shown) = shown {
            wanted.insert(VIEW.to_string(), view_of(shown));
        }
        let standing = self.sources(&part);
        if wanted.iter().all(|(place, source)| standing.get(place) == Some(source)) {
            delivered.extend(shown.map(|_| page));
            return Ok(delivered);
        }
        for (stage, artifact, target) in &placed {
            let configuration = if *stage == "evaluate" { own.configuration() } else { None };
            match configuration {
                Some(configuration) => scores(artifact, &configuration, target)?,
                // The artifact's manifest is the record of the folder.
                None => {
                    let fill = |made: &Path| place::copy_folder(&artifact.path, made);
                    put(Some(artifact.manifest.key), target, fill)?;
                }
            }
        }
        if let Some(shown) = shown {
            if write_view(own, shown, &page.path)? {
                delivered.push(page);
            } else {
                wanted.remove(VIEW);
            }
        }
        // The other results in the part are unchanged.
        self.keep(&part, standing.into_iter().chain(wanted).collect());
        Ok(delivered)
    }

    /// Writes the page and the tables over all scenes, unless nothing was computed since they were written.
    fn deliver_report(
        &self,
        summary: &Summary,
        report: &Artifact,
        views: &[Delivered],
        command: &str,
    ) -> Result<Vec<Delivered>, PlaceError> {
        let (page, tables) = (self.out.join(PAGE), self.out.join(TABLES));
        let file = report.path.join(BATCH);
        let read = at(&file, "read", fs::read(&file))?;
        let parsed = serde_json::from_slice::<BatchReport>(&read).map_err(io::Error::other);
        let BatchReport { page: mut made, scored } = at(&file, "read", parsed)?;
        let has_tables = !scored.is_empty();
        let mut delivered = vec![Delivered::new("report", "", "", &page)];
        delivered.extend(has_tables.then(|| Delivered::new("tables", "", "", &tables)));
        let mut sources = sources_of(summary.nodes.iter());
        sources.update(made_by_program().as_bytes());
        for view in views {
            sources.update(view.path.as_os_str().as_encoded_bytes());
        }
        let wanted = Sources::from([(PAGE.to_string(), Digest::from(sources.finalize()).to_string())]);
        let computed = summary.nodes.iter().any(|n| matches!(n.result, NodeResult::Done));
        if !computed && self.sources(OVER_ALL) == wanted {
            return Ok(delivered);
        }
        let configurations = configurations(summary);
        made.tables = paper::tables(&timed(summary, &configurations, scored));
        made.settings = settings(&configurations);
        made.costs = Some(Costs {
            stages: rows(summary),
            made: written(summary, command),
            parameters: parameters(summary),
        });
        for view in views {
            let name = in_variant(&view.scene, &view.variant);
            if let Some(section) = made.scenes.iter_mut().find(|section| section.name == name) {
                section.page = relative(&view.path, &self.out);
            }
        }
        STAMPED.write(&page, &at(&page, "write", made.html().map_err(io::Error::other))?)?;
        if has_tables {
            // Drawing speeds do not follow from a key, so the tables are written with every new page.
            put(None, &tables, |folder| {
                at(folder, "write", tables::write(folder, &made.tables))?;
                place::record(folder, None)
            })?;
        }
        self.keep(OVER_ALL, wanted);
        Ok(delivered)
    }
}

/// A scene in a variant: its own nodes, and those that serve all scenes of the variant.
struct DeliveredCell<'s> {
    scene: &'s str,
    variant: &'s str,
    nodes: Vec<&'s RanNode>,
    shared: Vec<&'s RanNode>,
}

/// The scenes and variants of a summary, in its order.
fn cells(summary: &Summary) -> Vec<DeliveredCell<'_>> {
    let mut cells: Vec<DeliveredCell<'_>> = Vec::new();
    let mut places: HashMap<(&str, &str), usize> = HashMap::new();
    let mut shared: HashMap<&str, Vec<&RanNode>> = HashMap::new();
    for node in &summary.nodes {
        if node.scene.is_empty() {
            shared.entry(&node.variant).or_default().push(node);
            continue;
        }
        let place = *places.entry((&node.scene, &node.variant)).or_insert(cells.len());
        if place == cells.len() {
            let (scene, variant) = (&node.scene, &node.variant);
            cells.push(DeliveredCell { scene, variant, nodes: Vec::new(), shared: Vec::new() });
        }
        cells[place].nodes.push(node);
    }
    for cell in &mut cells {
        let stages = shared.get(cell.variant).into_iter().flatten();
        cell.shared = stages.filter(|node| node.stage != "report").copied().collect();
    }
    cells
}

impl DeliveredCell<'_> {
    fn artifact(&self, stage: &str) -> Option<&Artifact> {
        self.nodes.iter().find(|node| node.stage == stage)?.artifact.as_deref()
    }

    fn all(&self) -> impl Iterator<Item = &RanNode> {
        self.nodes.iter().chain(&self.shared).copied()
    }

    /// A digest of everything that the configuration follows from.
    fn sources(&self) -> String {
        let mut sources = sources_of(self.all());
        sources.update(made_by_program().as_bytes());
        Digest::from(sources.finalize()).short()
    }

    fn configuration(&self) -> Option<Configuration> {
        made_by::configuration(&Summary::of_nodes(self.all().cloned().collect()), self.scene, self.variant)
    }
}

/// The program that writes the pages, in words.
fn made_by_program() -> String {
    format!("{} {}", env!("CARGO_PKG_VERSION"), use3d_web::page::digest())
}

/// Starts a digest with the keys, presets and times of nodes.
fn sources_of<'n>(nodes: impl Iterator<Item = &'n RanNode>) -> blake3::Hasher {
    let mut sources = blake3::Hasher::new();
    for node in nodes {
        let key = node.artifact.as_ref().map(|a| (a.manifest.key, &a.manifest.finished));
        sources.update(format!("{} {} {key:?}\n", node.label, node.preset).as_bytes());
    }
    sources
}

/// The record of a page for a scene's artifact. A page without white balance has exactly this record.
fn view_of(shown: &Artifact) -> String {
    format!("of {} by {}", shown.manifest.key, use3d_web::page::digest())
}

/// A result that is in the results folder.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Delivered {
    /// `report`, `tables`, or the stage that made it.
    pub what: String,
    /// The scene; empty for a result over all scenes.
    pub scene: String,
    /// The variant; empty if there are no variants.
    pub variant: String,
    /// The file or folder.
    pub path: PathBuf,
}

impl Delivered {
    fn new(what: &str, scene: &str, variant: &str, path: &Path) -> Self {
        Self { what: what.into(), scene: scene.into(), variant: variant.into(), path: path.into() }
    }
}

/// Writes a scene's page, unless it was made from the same scene by the same program and with the same white
/// balance. Returns true if the page is there.
fn write_view(own: &DeliveredCell<'_>, shown: &Artifact, page: &Path) -> Result<bool, PlaceError> {
    let folder = place::parent(page);
    // The page records its scene, its program and its white balance. A page with the same record is up to
    // date.
    let white = white_of(folder, shown.manifest.key);
    let balanced = white.as_ref().map_or_else(String::new, |(_, digest)| format!(", white {digest}"));
    let enhanced = own.artifact("photographs");
    let photographs =
        enhanced.map_or_else(String::new, |made| format!(", photographs {}", made.manifest.key));
    let source = format!("<!-- {}{balanced}{photographs} -->\n", view_of(shown));
    STAMPED.check(page)?;
    if fs::read_to_string(page).is_ok_and(|text| text.contains(&source)) {
        return Ok(true);
    }
    let capture = own.artifact("import").map(|import| import.path.as_path());
    let white = white.as_ref().map(|(white, _)| white);
    let made = match scene_page::write(
        own.scene,
        &shown.path,
        (capture, enhanced.map(|made| made.path.as_path())),
        VIEW_PARTS,
        white,
    ) {
        Ok(made) => made,
        Err(error) => {
            // The results are complete without this page.
            tracing::warn!("{}: no page for a browser: {error}", own.scene);
            return Ok(false);
        }
    };
    at(folder, "create", fs::create_dir_all(folder))?;
    if !made.parts.is_empty() {
        put(None, &folder.join(VIEW_PARTS), |parts| {
            at(parts, "create", fs::create_dir_all(parts))?;
            for (name, text) in &made.parts {
                let part = parts.join(name);
                at(&part, "write", fs::write(&part, text))?;
            }
            place::record(parts, None)
        })?;
    }
    STAMPED.write(page, &format!("{}{source}", made.html))?;
    Ok(true)
}

/// The white balance that was stored among the results for a scene of this key, and its digest.
fn white_of(folder: &Path, key: Digest) -> Option<(White, Digest)> {
    for name in ["enhanced-scene", "scene"] {
        let scene = folder.join(name);
        match place::look(&scene, Look::Quick) {
            Ok(Standing::Ours(ours)) if ours.key == Some(key) => {}
            _ => continue,
        }
        match White::beside(&scene) {
            Ok(Some(white)) if !white.is_outdated(&scene) => {
                let text = serde_json::to_vec(&white).unwrap_or_default();
                return Some((white, Digest::of(&text)));
            }
            Ok(_) => {}
            Err(error) => tracing::warn!("{error}; the page opens without it"),
        }
    }
    None
}

/// A path below the results folder as a link in its pages.
fn relative(path: &Path, out: &Path) -> String {
    let parts = path.strip_prefix(out).unwrap_or(path).components();
    let parts = parts.map(|part| use3d_web::page::address(&part.as_os_str().to_string_lossy()));
    parts.collect::<Vec<_>>().join("/")
}

/// The scores with the data that belong to no artifact: the drawing speeds from the notes of the evaluations,
/// the configurations behind the numbers, and the keys of the scores in the cache.
fn timed(
    summary: &Summary,
    made: &BTreeMap<(&str, &str), Configuration>,
    mut scored: Vec<ScoredScene>,
) -> Vec<ScoredScene> {
    let evaluated = summary.nodes.iter().filter(|n| n.stage == "evaluate");
    let evaluated: HashMap<(&str, &str), &RanNode> =
        evaluated.map(|n| ((&*n.scene, &*n.variant), n)).collect();
    for scene in &mut scored {
        let place = (&*scene.scene, &*scene.variant);
        let artifact = evaluated.get(&place).and_then(|node| node.artifact.as_deref());
        let note = artifact.and_then(|a| a.manifest.notes.get(SPEED).cloned());
        scene.configuration = made.get(&place).cloned();
        scene.speed = note.and_then(|note| serde_json::from_value(note).ok());
        if let Some(artifact) = artifact {
            // The key as the table of costs shows it, shortened.
            let name = scene.source.rsplit_once(' ').map_or("", |(name, _)| name);
            scene.source = format!("{name} {}", shortened(&artifact.manifest.key.to_string()));
        }
    }
    scored
}

/// The configuration of every scene in every variant of a run.
fn configurations(summary: &Summary) -> BTreeMap<(&str, &str), Configuration> {
    let cells = cells(summary);
    let trained = cells.iter().filter(|cell| cell.nodes.iter().any(|node| node.stage == "reconstruct"));
    trained.filter_map(|cell| Some(((cell.scene, cell.variant), cell.configuration()?))).collect()
}

/// The configurations as the top of the report shows them: the parts for all scenes of a variant.
fn settings(made: &BTreeMap<(&str, &str), Configuration>) -> Vec<VariantSettings> {
    let mut variants: BTreeMap<&str, Vec<&Configuration>> = BTreeMap::new();
    for ((_, variant), configuration) in made {
        variants.entry(variant).or_default().push(configuration);
    }
    let parts = |(variant, all): (&str, Vec<&Configuration>)| VariantSettings {
        variant: variant.to_string(),
        parts: Configuration::parts(&all),
    };
    variants.into_iter().map(parts).collect()
}

/// Delivers the scores of a scene, with the configuration behind them.
fn scores(artifact: &Artifact, configuration: &Configuration, target: &Path) -> Result<(), PlaceError> {
    let text = serde_json::to_string(configuration).unwrap_or_default();
    let key = Digest::of(format!("{} {text}", artifact.manifest.key).as_bytes());
    put(Some(key), target, |made| {
        place::copy_folder(&artifact.path, made)?;
        let file = made.join(SCORES);
        let read = at(&file, "read", fs::read(&file))?;
        let told = serde_json::from_slice::<serde_json::Value>(&read).and_then(|mut scores| {
            scores["configuration"] = serde_json::to_value(configuration)?;
            serde_json::to_string_pretty(&scores)
        });
        let text = at(&file, "read", told.map_err(io::Error::other))?;
        at(&file, "write", fs::write(&file, text + "\n"))?;
        place::record(made, Some(key))
    })
}

/// One line with the pipeline, the time, the machines and the command that wrote the results.
fn written(summary: &Summary, command: &str) -> String {
    let manifests = || summary.nodes.iter().filter_map(|n| Some(&n.artifact.as_ref()?.manifest));
    let machines: BTreeSet<String> = manifests()
        .map(|m| format!("{} ({}, {} cores)", m.machine.host, m.machine.system, m.machine.cores))
        .collect();
    let last = manifests().map(|m| m.finished.as_str()).max().unwrap_or("?");
    format!(
        "Pipeline {}. The last stage was finished at {last}; computed on {}. This page was written by {command}",
        summary.pipeline,
        Vec::from_iter(machines).join(", ")
    )
}

/// The parameters of every stage of the run, as text; equal ones are listed once.
fn parameters(summary: &Summary) -> String {
    let mut groups: Vec<(String, Vec<String>)> = Vec::new();
    let mut known: HashMap<String, usize> = HashMap::new();
    for node in summary.nodes.iter().filter(|n| !n.shared) {
        let Some(artifact) = &node.artifact else { continue };
        let ingredients = &artifact.manifest.ingredients;
        let seed = ingredients.seed.map_or_else(String::new, |seed| format!(" (seed {seed})"));
        let values = serde_json::to_string_pretty(&ingredients.parameters).unwrap_or_default();
        let text = format!("{}{seed} {values}", node.stage);
        let place = [&*node.scene, &*node.variant].into_iter().filter(|p| !p.is_empty());
        let place = place.collect::<Vec<_>>().join(" · ");
        let place = if place.is_empty() { "all scenes".into() } else { place };
        let at = *known.entry(text.clone()).or_insert(groups.len());
        if at == groups.len() {
            groups.push((text, Vec::new()));
        }
        groups[at].1.push(place);
    }
    let groups = groups.into_iter().map(|(text, places)| format!("{}:\n{text}\n", places.join(", ")));
    groups.collect::<Vec<_>>().join("\n")
}

/// The costs of every stage of the run when it was computed.
fn rows(summary: &Summary) -> Vec<StageRow> {
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    let rows = summary.nodes.iter().filter(|n| !n.shared).filter_map(|node| {
        let manifest = &node.artifact.as_ref()?.manifest;
        let scene = match &*node.scene {
            "" => "all scenes".into(),
            scene => in_variant(scene, &node.variant),
        };
        let state = if matches!(node.result, NodeResult::Done) { "computed" } else { "cached" };
        Some(StageRow {
            scene,
            stage: node.stage.to_string(),
            state: state.into(),
            seconds: manifest.full_seconds(),
            memory: (manifest.peak_memory > 0).then(|| mib(manifest.peak_memory)),
            size: mib(manifest.bytes()),
            key: manifest.key.to_string(),
        })
    });
    rows.collect()
}

/// Puts the output of `fill` at `target`, unless the folder there already follows from `key`. The output is
/// always a copy, so that an edit of the results cannot change the cache.
fn put(
    key: Option<Digest>,
    target: &Path,
    fill: impl FnOnce(&Path) -> Result<(), PlaceError>,
) -> Result<(), PlaceError> {
    if let Standing::Ours(ours) = place::look(target, Look::Quick)?
        && ours.whole
        && key.is_some()
        && ours.key == key
    {
        return Ok(());
    }
    let folder = place::parent(target);
    at(folder, "create", fs::create_dir_all(folder))?;
    place::put_folder(target, true, fill, |error| error)
}
