//! The results folder: the report with its costs, the tables, and the scenes, out of the cache and under names for people.
//!
//! An artifact holds nothing that depends on the clock or the machine. Times, memory, keys and how fast scenes are drawn are kept beside
//! artifacts; they are added to the page and the tables here.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use crate::engine::run::RanNode;
use crate::engine::{Artifact, Summary};
use crate::report::{StageRow, with_costs, with_tables};
use crate::scores::ScoredScene;
use crate::stages::evaluate::SPEED;
use crate::stages::report::write_tables;
use crate::tables::{Table, paper};

/// Fills `out` and says what is where: `report`, `tables`, one line per scene.
pub fn deliver(summary: &Summary, out: &Path) -> io::Result<Vec<(String, PathBuf)>> {
    let mut delivered = Vec::new();
    fs::create_dir_all(out)?;
    if let Some(report) = summary.artifact("", "", "report") {
        let html = fs::read_to_string(report.path.join("index.html"))?;
        let page = out.join("report.html");
        let timed = timed_tables(summary, &report.path);
        let html = timed.as_ref().map_or_else(|| html.clone(), |tables| with_tables(&html, tables));
        write(&page, with_costs(&html, &rows(summary), &parameters(summary)).as_bytes())?;
        delivered.push(("report".to_string(), page));
        let tables = out.join("tables");
        if report.path.join("tables").is_dir() {
            copy_folder(&report.path.join("tables"), &tables)?;
            if let Some(timed) = &timed {
                write_tables(&tables, timed).map_err(|e| io::Error::other(e.to_string()))?;
            }
            delivered.push(("tables".to_string(), tables));
        }
    }
    for node in summary.nodes.iter().filter(|n| !n.scene.is_empty()) {
        let Some(artifact) = &node.artifact else { continue };
        let name = if node.variant.is_empty() {
            node.scene.clone()
        } else {
            format!("{}@{}", node.scene, node.variant)
        };
        let target = match node.stage {
            "reconstruct" => out.join(&name).join("scene"),
            "enhance" => out.join(&name).join("enhanced-scene"),
            "render" => out.join(&name).join("renders"),
            "targets" => out.join(&name).join("targets"),
            "evaluate" => out.join(&name).join("scores"),
            _ => continue,
        };
        place(artifact, &target)?;
        delivered.push((node.stage.to_string(), target));
    }
    Ok(delivered)
}

/// The report's tables with how fast the scenes are drawn, which their evaluations noted beside their artifacts; `None` where nobody did.
fn timed_tables(summary: &Summary, report: &Path) -> Option<Vec<Table>> {
    let mut scored: Vec<ScoredScene> =
        serde_json::from_slice(&fs::read(report.join("scores.json")).ok()?).ok()?;
    for scene in &mut scored {
        let evaluated =
            |n: &&RanNode| n.stage == "evaluate" && n.scene == scene.scene && n.variant == scene.variant;
        let artifact = summary.nodes.iter().find(evaluated).and_then(|n| n.artifact.as_ref());
        let note = artifact.and_then(|a| a.manifest.notes.get(SPEED).cloned());
        scene.speed = note.and_then(|note| serde_json::from_value(note).ok());
    }
    scored.iter().any(|s| s.speed.is_some()).then(|| paper::tables(&scored))
}

/// The parameters of every stage of the run, equal ones once, as text.
fn parameters(summary: &Summary) -> String {
    let mut groups: Vec<(String, Vec<String>)> = Vec::new();
    for node in summary.nodes.iter().filter(|n| !n.shared) {
        let Some(artifact) = &node.artifact else { continue };
        let ingredients = &artifact.manifest.ingredients;
        let seed = ingredients.seed.map_or_else(String::new, |seed| format!(" (seed {seed})"));
        let values = serde_json::to_string_pretty(&ingredients.parameters).unwrap_or_default();
        let text = format!("{}{seed} {values}", node.stage);
        let place = [node.scene.as_str(), node.variant.as_str()];
        let place: Vec<&str> = place.into_iter().filter(|p| !p.is_empty()).collect();
        let place = if place.is_empty() { "all scenes".to_string() } else { place.join(" · ") };
        match groups.iter_mut().find(|(t, _)| *t == text) {
            Some((_, places)) => places.push(place),
            None => groups.push((text, vec![place])),
        }
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
            state: if matches!(node.result, crate::engine::run::Became::Done) {
                "computed"
            } else {
                "cached"
            }
            .into(),
            seconds: manifest.full_seconds(),
            memory: (manifest.peak_memory > 0).then(|| mib(manifest.peak_memory)),
            size: mib(manifest.bytes()),
            key: manifest.key.to_string(),
        })
    });
    rows.collect()
}

/// Makes `target` a copy of an artifact, unless it is one already. A copy: nobody's edits may reach the cache.
fn place(artifact: &Artifact, target: &Path) -> io::Result<()> {
    let stamp = target.join(".key");
    let key = artifact.manifest.key.to_string();
    if fs::read_to_string(&stamp).is_ok_and(|k| k == key) {
        return Ok(());
    }
    match fs::remove_dir_all(target) {
        Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
        _ => {}
    }
    copy_folder(&artifact.path, target)?;
    write(&stamp, key.as_bytes())
}

fn copy_folder(from: &Path, to: &Path) -> io::Result<()> {
    fs::create_dir_all(to)?;
    for entry in fs::read_dir(from)? {
        let entry = entry?;
        let (source, target) = (entry.path(), to.join(entry.file_name()));
        if entry.file_type()?.is_dir() {
            copy_folder(&source, &target)?;
        } else {
            fs::copy(&source, &target)?;
        }
    }
    Ok(())
}

fn write(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let part = path.with_extension("part");
    fs::write(&part, bytes)?;
    fs::rename(&part, path)
}
