//! The results folder: the report with its costs, the tables, the scenes, and a page per scene to walk
//! through it in a browser, out of the cache and under names for people.
//!
//! An artifact holds nothing that depends on the clock or the machine. Times, memory, keys and how fast
//! scenes are drawn are kept beside artifacts; they are added to the page and the tables here.

use std::collections::{BTreeMap, HashMap};
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use serde::Serialize;
use use3d_build::delivered::{MadeOf, Notes};
use use3d_build::place::{self, Look, PlaceError, Standing};
use use3d_build::run::{Became, RanNode};
use use3d_build::{Artifact, Cache, Digest, Graph, Summary};
use use3d_files::write_atomically;

use crate::judge::report::{StageRow, shortened, with_costs, with_tables, with_views};
use crate::judge::scores::ScoredScene;
use crate::judge::tables::{Table, paper};
use crate::scene_page;
use crate::stages::evaluate::SPEED;
use crate::stages::report::write_tables;

/// The page and the tables over all scenes.
const PAGE: &str = "report.html";
const TABLES: &str = "tables";
/// The page of a scene beside its folders, and the folder of that page's parts,
/// should it be too large for one file.
const VIEW: &str = "view.html";
const VIEW_PARTS: &str = "view_files";
/// Before the digest in the last line of a page.
const STAMP: &str = "<!-- written by use3d, blake3 ";

/// Where a stage's result goes below the results folder; `None` for stages whose results stay in the cache.
fn place_of(stage: &str, scene: &str, variant: &str) -> Option<PathBuf> {
    let folder = match stage {
        "reconstruct" => "scene",
        "enhance" => "enhanced-scene",
        "render" => "renders",
        "targets" => "targets",
        "evaluate" => "scores",
        _ => return None,
    };
    if scene.is_empty() {
        return None;
    }
    Some(folder_of(scene, variant).join(folder))
}

/// Where everything of a scene in a variant goes below the results folder.
fn folder_of(scene: &str, variant: &str) -> PathBuf {
    if variant.is_empty() { scene.into() } else { format!("{scene}@{variant}").into() }
}

/// A results folder, with what is known of it.
pub struct Results {
    out: PathBuf,
    notes: Notes,
    /// What each part is made of that stands as it was delivered, by part.
    standing: Mutex<BTreeMap<String, MadeOf>>,
}

/// The part of a results folder that is over all scenes.
const OVER_ALL: &str = "";

/// The files and folders of a part.
fn paths_of(part: &str) -> Vec<PathBuf> {
    if part == OVER_ALL { vec![PAGE.into(), TABLES.into()] } else { vec![part.into()] }
}

impl Results {
    /// The folder `out` for what a cache holds.
    pub fn new(out: &Path, cache: &Cache) -> Self {
        Self { out: out.to_path_buf(), notes: Notes::of(cache, out), standing: Mutex::default() }
    }

    /// Where it is.
    pub fn folder(&self) -> &Path {
        &self.out
    }

    fn standing(&self) -> MutexGuard<'_, BTreeMap<String, MadeOf>> {
        self.standing.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether a part stands as it was delivered; it is looked at once.
    fn stands(&self, part: &str) -> bool {
        let mut standing = self.standing();
        if !standing.contains_key(part) {
            standing.insert(part.to_string(), self.notes.standing(part, &paths_of(part)));
        }
        !standing[part].is_empty()
    }

    /// What a part is made of, as far as it is known to stand so.
    fn made_of(&self, part: &str) -> MadeOf {
        self.standing().get(part).cloned().unwrap_or_default()
    }

    /// Remembers what a part is made of now.
    fn keep(&self, part: &str, made_of: MadeOf) {
        if let Err(error) = self.notes.keep(part, &paths_of(part), made_of.clone()) {
            tracing::debug!("{error}");
        }
        self.standing().insert(part.to_string(), made_of);
    }

    /// Looks, before anything is computed, whether the results of `until` (all where `None`) may go to the
    /// folder: whether it can be written, and whether everything that stands in their places is ours.
    ///
    /// # Errors
    /// The first place that is taken, or that cannot be written. Nothing is touched.
    pub fn check(&self, graph: &Graph, until: Option<&[String]>) -> Result<(), PlaceError> {
        let out = &self.out;
        place::check_writable(out)?;
        place::sweep(out);
        let mut places: BTreeMap<PathBuf, String> = BTreeMap::new();
        // A part that stands as it was delivered is ours.
        let mut looked_at: BTreeMap<PathBuf, bool> = BTreeMap::new();
        for (node, _) in graph.nodes.iter().zip(graph.wanted(until)).filter(|(_, wanted)| *wanted) {
            if let Some(place) = place_of(node.stage_name, &node.scene, &node.variant)
                && let Some(other) = places.insert(place.clone(), node.label())
            {
                let reason = format!(
                    "the results of `{other}` and `{}` would both go there; rename a scene or a variant",
                    node.label()
                );
                return Err(PlaceError::Occupied { path: out.join(place), reason });
            }
            let (part, page) = match node.stage_name {
                "reconstruct" => {
                    let folder = folder_of(&node.scene, &node.variant);
                    (folder.clone(), folder.join(VIEW))
                }
                "report" => {
                    places.insert(TABLES.into(), node.label());
                    (PathBuf::from(OVER_ALL), PathBuf::from(PAGE))
                }
                _ => continue,
            };
            let stands = self.stands(&part.to_string_lossy());
            looked_at.insert(part, stands);
            if !stands {
                check_page(&out.join(page))?;
            }
        }
        let part_of = |place: &Path| match place.parent() {
            Some(folder) if place != Path::new(TABLES) => folder.to_path_buf(),
            _ => PathBuf::from(OVER_ALL),
        };
        let unknown = places.keys().filter(|place| looked_at.get(&part_of(place)) != Some(&true));
        for place in unknown {
            let place = out.join(place);
            place::sweep(place::parent(&place));
            place::check(&place, true)?;
        }
        Ok(())
    }

    /// Fills the folder and says what is where: `report`, `tables`, and the folders of every scene. `command`:
    /// what was typed, which the report names.
    ///
    /// # Errors
    /// A place that is taken by something that is not ours, or that cannot be written;
    /// what was delivered before stays.
    pub fn deliver(&self, summary: &Summary, command: &str) -> Result<Vec<Delivered>, PlaceError> {
        let out = &self.out;
        at(out, "create", fs::create_dir_all(out))?;
        let mut delivered = Vec::new();
        let mut scenes: Vec<SceneNodes<'_>> = Vec::new();
        let mut places: HashMap<(&str, &str), usize> = HashMap::new();
        for node in summary.nodes.iter().filter(|node| !node.scene.is_empty()) {
            let place = *places.entry((&node.scene, &node.variant)).or_insert(scenes.len());
            if place == scenes.len() {
                scenes.push(SceneNodes { scene: &node.scene, variant: &node.variant, nodes: Vec::new() });
            }
            scenes[place].nodes.push(node);
        }
        let mut views = Vec::new();
        for scene in &scenes {
            let own = self.deliver_scene(scene)?;
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

    /// Puts the results of a scene in their places, unless they are there.
    fn deliver_scene(&self, own: &SceneNodes<'_>) -> Result<Vec<Delivered>, PlaceError> {
        let (scene, variant) = (own.scene, own.variant);
        let part = folder_of(scene, variant).to_string_lossy().into_owned();
        let mut wanted = MadeOf::new();
        let mut delivered = Vec::new();
        for node in &own.nodes {
            let Some(artifact) = &node.artifact else { continue };
            let Some(place) = place_of(node.stage, scene, variant) else { continue };
            wanted.insert(node.stage.to_string(), artifact.manifest.key.to_string());
            let (scene, variant, path) = (scene.into(), variant.into(), self.out.join(place));
            delivered.push(Delivered { what: node.stage.to_string(), scene, variant, path });
        }
        let shown = own.artifact("reconstruct").and_then(|scene| own.artifact("enhance").or(Some(scene)));
        let view = shown.map(|shown| {
            // The page says which scene it was made of, and by what; made of the same one by the same, it is the
            // same.
            let source = format!("<!-- of {} by {} -->\n", shown.manifest.key, use3d_web::page::digest());
            wanted.insert(VIEW.to_string(), source.clone());
            (shown, source)
        });
        let page = self.out.join(&part).join(VIEW);
        let page =
            Delivered { what: "view".into(), scene: scene.into(), variant: variant.into(), path: page };
        let standing = if self.stands(&part) { self.made_of(&part) } else { MadeOf::new() };
        if wanted.iter().all(|(place, source)| standing.get(place) == Some(source)) {
            delivered.extend(view.map(|_| page));
            return Ok(delivered);
        }
        for node in &own.nodes {
            let Some(artifact) = &node.artifact else { continue };
            let Some(place) = place_of(node.stage, scene, variant) else { continue };
            // Its manifest is the record.
            let fill = |made: &Path| place::copy_folder(&artifact.path, made);
            put(Some(artifact.manifest.key), &self.out.join(place), fill)?;
        }
        if let Some((shown, source)) = view {
            if write_view(own, shown, &source, &page.path)? {
                delivered.push(page);
            } else {
                wanted.remove(VIEW);
            }
        }
        // What else stands there is still what it was.
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
        let has_tables = report.manifest.files.iter().any(|file| file.path.starts_with("tables/"));
        let mut delivered = vec![Delivered::over_all("report", page.clone())];
        delivered.extend(has_tables.then(|| Delivered::over_all("tables", tables.clone())));
        let mut sources = blake3::Hasher::new();
        for node in &summary.nodes {
            let key = node.artifact.as_ref().map(|a| (a.manifest.key, &a.manifest.finished));
            sources.update(format!("{} {key:?}\n", node.label).as_bytes());
        }
        for view in views {
            sources.update(view.path.as_os_str().as_encoded_bytes());
        }
        let wanted = MadeOf::from([(PAGE.to_string(), Digest::from(sources.finalize()).to_string())]);
        let computed = summary.nodes.iter().any(|n| matches!(n.result, Became::Done));
        if !computed && self.stands(OVER_ALL) && self.made_of(OVER_ALL) == wanted {
            return Ok(delivered);
        }
        let source = report.path.join("index.html");
        let html = at(&source, "read", fs::read_to_string(&source))?;
        check_page(&page)?;
        let timed = timed_tables(summary, &report.path);
        let html = timed.as_ref().map_or_else(|| html.clone(), |tables| with_tables(&html, tables));
        let html = with_costs(&html, &rows(summary), &made(summary, command), &parameters(summary));
        let links =
            views.iter().map(|view| (view.scene.as_str(), view.variant.as_str(), view.path.as_path()));
        let html = with_views(
            &html,
            links.map(|(scene, variant, path)| (scene, variant, relative(path, &self.out))),
        );
        write(&page, stamped(&html).as_bytes())?;
        if has_tables {
            // How fast scenes are drawn follows from no key: they are written anew each time.
            put(None, &tables, |made| {
                place::copy_folder(&report.path.join(TABLES), made)?;
                if let Some(timed) = &timed {
                    at(
                        made,
                        "write",
                        write_tables(made, timed).map_err(|e| io::Error::other(e.to_string())),
                    )?;
                }
                place::record(made, None)
            })?;
        }
        self.keep(OVER_ALL, wanted);
        Ok(delivered)
    }
}

/// The nodes of a scene in a variant.
struct SceneNodes<'s> {
    scene: &'s str,
    variant: &'s str,
    nodes: Vec<&'s RanNode>,
}

impl SceneNodes<'_> {
    fn artifact(&self, stage: &str) -> Option<&Artifact> {
        self.nodes.iter().find(|node| node.stage == stage)?.artifact.as_deref()
    }
}

/// A result that stands in the results folder.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Delivered {
    /// `report`, `tables`, or the stage that made it.
    pub what: String,
    /// The scene; empty for what is over all scenes.
    pub scene: String,
    /// The variant; empty where there are none.
    pub variant: String,
    /// The file or folder.
    pub path: PathBuf,
}

impl Delivered {
    fn over_all(what: &str, path: PathBuf) -> Self {
        Self { what: what.into(), scene: String::new(), variant: String::new(), path }
    }
}

/// Writes a scene's page, unless it was made of the same scene by the same program; whether it is there.
fn write_view(own: &SceneNodes<'_>, shown: &Artifact, source: &str, page: &Path) -> Result<bool, PlaceError> {
    check_page(page)?;
    if fs::read_to_string(page).is_ok_and(|text| text.contains(source)) {
        return Ok(true);
    }
    let capture = own.artifact("import").map(|import| import.path.as_path());
    let made = match scene_page::write(own.scene, &shown.path, capture, VIEW_PARTS) {
        Ok(made) => made,
        Err(error) => {
            // The results are whole without it.
            tracing::warn!("{}: no page for a browser: {error}", own.scene);
            return Ok(false);
        }
    };
    let folder = place::parent(page);
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
    write(page, stamped(&format!("{}{source}", made.html)).as_bytes())?;
    Ok(true)
}

/// A path below the results folder as an address in its pages.
fn relative(path: &Path, out: &Path) -> String {
    let parts = path.strip_prefix(out).unwrap_or(path).components();
    let parts = parts.map(|part| use3d_web::page::address(&part.as_os_str().to_string_lossy()));
    parts.collect::<Vec<_>>().join("/")
}

/// The report's tables with what belongs to no artifact: how fast the scenes are drawn, which their
/// evaluations noted, and under which keys their scores lie in the cache. `None` of a report without scores.
fn timed_tables(summary: &Summary, report: &Path) -> Option<Vec<Table>> {
    let mut scored: Vec<ScoredScene> =
        serde_json::from_slice(&fs::read(report.join("scores.json")).ok()?).ok()?;
    let evaluated: HashMap<(&str, &str), &RanNode> = summary
        .nodes
        .iter()
        .filter(|n| n.stage == "evaluate")
        .map(|n| ((n.scene.as_str(), n.variant.as_str()), n))
        .collect();
    for scene in &mut scored {
        let node = evaluated.get(&(scene.scene.as_str(), scene.variant.as_str()));
        let artifact = node.and_then(|n| n.artifact.as_deref());
        let note = artifact.and_then(|a| a.manifest.notes.get(SPEED).cloned());
        scene.speed = note.and_then(|note| serde_json::from_value(note).ok());
        if let Some(artifact) = artifact {
            // The key that stands in the table of costs, as far as it is shown there.
            let name = scene.source.rsplit_once(' ').map_or("", |(name, _)| name);
            scene.source = format!("{name} {}", shortened(&artifact.manifest.key.to_string()));
        }
    }
    (!scored.is_empty()).then(|| paper::tables(&scored))
}

/// What made the results, when and where, in a line.
fn made(summary: &Summary, command: &str) -> String {
    let manifests = || summary.nodes.iter().filter_map(|n| Some(&n.artifact.as_ref()?.manifest));
    let mut machines: Vec<String> = manifests()
        .map(|m| format!("{} ({}, {} cores)", m.machine.host, m.machine.system, m.machine.cores))
        .collect();
    machines.sort();
    machines.dedup();
    let last = manifests().map(|m| m.finished.as_str()).max().unwrap_or("?");
    format!(
        "Pipeline {}. The last stage was finished at {last}; computed on {}. This page was written by {command}",
        summary.pipeline,
        machines.join(", ")
    )
}

/// The parameters of every stage of the run, equal ones once, as text.
fn parameters(summary: &Summary) -> String {
    let mut groups: Vec<(String, Vec<String>)> = Vec::new();
    let mut known: HashMap<String, usize> = HashMap::new();
    for node in summary.nodes.iter().filter(|n| !n.shared) {
        let Some(artifact) = &node.artifact else { continue };
        let ingredients = &artifact.manifest.ingredients;
        let seed = ingredients.seed.map_or_else(String::new, |seed| format!(" (seed {seed})"));
        let values = serde_json::to_string_pretty(&ingredients.parameters).unwrap_or_default();
        let text = format!("{}{seed} {values}", node.stage);
        let place = [node.scene.as_str(), node.variant.as_str()];
        let place: Vec<&str> = place.into_iter().filter(|p| !p.is_empty()).collect();
        let place = if place.is_empty() { "all scenes".to_string() } else { place.join(" · ") };
        let at = *known.entry(text.clone()).or_insert(groups.len());
        if at == groups.len() {
            groups.push((text, Vec::new()));
        }
        groups[at].1.push(place);
    }
    let groups = groups.into_iter().map(|(text, places)| format!("{}:\n{text}\n", places.join(", ")));
    groups.collect::<Vec<_>>().join("\n")
}

/// What every stage of the run cost when it was computed.
fn rows(summary: &Summary) -> Vec<StageRow> {
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    let rows = summary.nodes.iter().filter(|n| !n.shared).filter_map(|node| {
        let manifest = &node.artifact.as_ref()?.manifest;
        let scene = match (node.scene.is_empty(), node.variant.is_empty()) {
            (true, _) => "all scenes".to_string(),
            (false, true) => node.scene.clone(),
            (false, false) => format!("{} · {}", node.scene, node.variant),
        };
        Some(StageRow {
            scene,
            stage: node.stage.to_string(),
            state: if matches!(node.result, use3d_build::run::Became::Done) { "computed" } else { "cached" }
                .into(),
            seconds: manifest.full_seconds(),
            memory: (manifest.peak_memory > 0).then(|| mib(manifest.peak_memory)),
            size: mib(manifest.bytes()),
            key: manifest.key.to_string(),
        })
    });
    rows.collect()
}

/// Puts what `fill` makes in the place of `target`, unless what stands there follows from `key` already.
/// Always a copy: nobody's edits may reach the cache.
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
    let made = place::sibling(target);
    let placed = fill(&made).and_then(|()| place::put(&made, target, true));
    if placed.is_err() {
        // Ours alone, and of no use to anybody.
        let _ = fs::remove_dir_all(&made);
    }
    placed
}

/// A page with its digest in a last line, by which it is known to be ours and unchanged.
fn stamped(html: &str) -> String {
    format!("{html}{STAMP}{} -->\n", Digest::of(html.as_bytes()))
}

/// Refuses to replace a page that is not ours, or that somebody changed.
fn check_page(page: &Path) -> Result<(), PlaceError> {
    let found = match fs::symlink_metadata(page) {
        Err(e) if matches!(e.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => return Ok(()),
        found => at(page, "look at", found)?,
    };
    let ours = |text: &str| text.rfind(STAMP).is_some_and(|end| stamped(&text[..end]) == *text);
    if found.is_file()
        && ours(&at(page, "read", fs::read(page).map(|b| String::from_utf8_lossy(&b).into_owned()))?)
    {
        return Ok(());
    }
    let reason = "this page was not written by this program, or was changed since; move it away, or choose another --out";
    Err(PlaceError::Occupied { path: page.to_path_buf(), reason: reason.into() })
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), PlaceError> {
    at(path, "write", write_atomically(path, |writer| writer.write_all(bytes)))
}

fn at<T>(path: &Path, doing: &'static str, result: io::Result<T>) -> Result<T, PlaceError> {
    result.map_err(|source| PlaceError::Io { path: path.to_path_buf(), doing, source })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_is_replaced_only_as_it_was_written() {
        let dir = tempfile::tempdir().unwrap();
        let page = dir.path().join(PAGE);
        check_page(&page).unwrap();
        for (text, ours) in [
            (stamped("<html>"), true),
            (stamped(&stamped("<html>")), true),
            (stamped("<html>").replace("<html>", "<html>my notes"), false),
            (format!("{}my notes", stamped("<html>")), false),
            ("<html>my own page".to_string(), false),
        ] {
            fs::write(&page, &text).unwrap();
            assert_eq!(check_page(&page).is_ok(), ours, "{text}");
        }
        fs::remove_file(&page).unwrap();
        fs::create_dir(&page).unwrap();
        assert!(check_page(&page).is_err());
    }
}
