//! The results folder: the report with its costs, the tables, the scenes, and a page per scene to view it in
//! a browser. All are copied out of the cache and get readable names.
//!
//! An artifact holds nothing that depends on the clock or the machine. Times, memory, keys and drawing speeds
//! are stored next to artifacts; the files `report.rs` and `lineage.rs` add them to the pages and the tables.

mod advice;
mod lineage;
mod methods;
mod report;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, LazyLock, Mutex, MutexGuard, PoisonError};

use serde::Serialize;
use use3d_scene::White;
use use3d_workflow::delivered::{Notes, Sources};
use use3d_workflow::graph::cell_name;
use use3d_workflow::place::{self, Look, PlaceError, Standing, at};
use use3d_workflow::run::RanNode;
use use3d_workflow::{Artifact, Cache, Digest, Event, Graph, Listener, Summary};

use crate::made_by;
use crate::scene_page;
use crate::written::Sealed;
use use3d_judge::configuration::Configuration;
use use3d_stages::SCORES;

use report::{Memo, ReportSettings};

/// The page and the tables over all scenes. Each result has a page of this name in its folder, too.
const PAGE: &str = "report.html";
const TABLES: &str = "tables";
/// The page of a scene next to its folders, and the folder for that page's parts if it is too large for one
/// file.
pub(crate) const VIEW: &str = "view.html";
const VIEW_PARTS: &str = "view_files";
/// The verdict and the mean scores of a result next to its page, as data.
const DATA: &str = "report.json";
/// A page has its digest in its last line.
pub(crate) const STAMPED: Sealed =
    Sealed { around: ["<!-- written by use3d, blake3 ", " -->\n"], words: ["page", "program"] };

/// A file of data has its digest in its last field.
const SEALED: Sealed = Sealed { around: [",\n\"blake3\": \"", "\"}\n"], words: ["file", "program"] };

/// The folder of all results of a scene in a variant, below the results folder.
fn folder_of(scene: &str, variant: &str) -> PathBuf {
    cell_name(scene, variant).into()
}

/// A results folder and the notes about its parts. A part is the folder of a scene, or the page and the
/// tables.
pub struct Results {
    /// The path of the folder.
    pub out: PathBuf,
    notes: Notes,
    /// The sources of each part that is as it was delivered.
    standing: Mutex<BTreeMap<String, Sources>>,
    /// The settings of the report; `None` if it is not requested.
    report: Option<ReportSettings>,
    /// True if the scenes themselves stay in the cache.
    only_report: bool,
    memo: Memo,
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
    /// The folder `out` for the results of a batch up to `until` (all stages if `None`) in a cache.
    pub fn new(out: &Path, cache: &Cache, graph: &Graph, until: Option<&[String]>) -> Self {
        Self {
            out: out.to_path_buf(),
            notes: Notes::of(cache, out),
            standing: Mutex::default(),
            report: ReportSettings::of(graph, until),
            only_report: false,
            memo: Memo::default(),
        }
    }

    /// With `true`, only the report with its pages and tables is delivered, and no scene.
    #[must_use]
    pub fn only_report(self, only_report: bool) -> Self {
        Self { only_report, ..self }
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
        let paged = self.report.as_ref().is_some_and(|report| !report.single);
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
            if let Some(place) = node.delivered.filter(|_| !self.only_report).map(|own| folder.join(own))
                && let Some(other) = places.insert(place.clone(), node.label())
            {
                let own = node.label();
                let reason = format!(
                    "the results of `{other}` and `{own}` would both go there; rename a scene or a variant"
                );
                return Err(PlaceError::Occupied { path: out.join(place), reason });
            }
            let (part, pages) = match node.stage_name {
                "reconstruct" => {
                    let page = paged.then(|| folder.join(PAGE));
                    (folder.clone(), [folder.join(VIEW)].into_iter().chain(page).collect())
                }
                "report" => {
                    places.insert(TABLES.into(), node.label());
                    (OVER_ALL.into(), vec![PAGE.into()])
                }
                _ => continue,
            };
            let stands = !self.sources(&part.to_string_lossy()).is_empty();
            examined.insert(part, stands);
            if !stands {
                pages.iter().try_for_each(|page| STAMPED.check(&out.join(page)))?;
                if paged {
                    SEALED.check(&out.join(folder).join(DATA))?;
                }
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
        let cells = cells(summary);
        for cell in &cells {
            let own = self.deliver_cell(cell, command)?;
            let (view, folders): (Vec<_>, Vec<_>) = own.into_iter().partition(|d| d.what == "view");
            delivered.extend(folders);
            views.extend(view);
        }
        if let Some(report) = summary.artifact("", "", "report") {
            delivered.extend(self.deliver_report((summary, &cells), report, &views, command)?);
        }
        delivered.extend(views);
        Ok(delivered)
    }

    /// Writes the results of a scene in a variant to their places, unless they are there already.
    fn deliver_cell(&self, own: &DeliveredCell<'_>, command: &str) -> Result<Vec<Delivered>, PlaceError> {
        let (scene, variant) = (own.scene, own.variant);
        let folder = folder_of(scene, variant);
        let part = folder.to_string_lossy().into_owned();
        let mut wanted = Sources::new();
        let placed = own.nodes.iter().filter(|_| !self.only_report).filter_map(|node| {
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
        let shown = shown.filter(|_| !self.only_report);
        let page = Delivered::new("view", scene, variant, &self.out.join(&folder).join(VIEW));
        if let Some(shown) = shown {
            wanted.insert(VIEW.to_string(), view_of(shown));
        }
        let settings = self.report.as_ref().filter(|report| !report.single);
        let source = settings.map(|report| report.source(own, self.only_report));
        wanted.extend(source.iter().map(|source| (PAGE.to_string(), source.clone())));
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
        if let (Some(settings), Some(source)) = (settings, source) {
            let view = delivered.last().is_some_and(|last| last.what == "view");
            self.write_page(settings, own, (&source, view), command)?;
        }
        // The other results in the part are unchanged.
        self.keep(&part, standing.into_iter().chain(wanted).collect());
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
fn made_by_program() -> &'static str {
    static PROGRAM: LazyLock<String> =
        LazyLock::new(|| format!("{} {}", env!("CARGO_PKG_VERSION"), use3d_web::page::digest()));
    &PROGRAM
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
