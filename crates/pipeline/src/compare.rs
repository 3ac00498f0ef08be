//! Two runs side by side in one page, with their scores and the parameters that differ.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde_json::Value;
use use3d_io_image::read_image;
use use3d_judge::scores::{Method, SceneScores};
use use3d_render::Mode;
use use3d_report::page::{Page, Picture, SceneSection, ViewSection};
use use3d_report::tables::{Better, Cell, Column, Row, Table};
use use3d_report::verdict::{Sentence, Tone};
use use3d_stages::report::{best_method, caption};
use use3d_stages::{SCORES, read_json, stems};
use use3d_workflow::canonical;
use use3d_workflow::manifest::MANIFEST;

use crate::WorkError;
use crate::destination::{OUT, check_file, entries, write_text};
use crate::history;
use crate::loaded::stages;
use crate::made_by::text;
use crate::results::STAMPED;

/// Most views of a scene that the page shows.
const VIEWS: usize = 12;
/// The compared scores: metric, column head, better direction, decimals.
const METRICS: [(&str, &str, Better, usize); 8] = [
    ("psnr", "PSNR", Better::Higher, 2),
    ("ssim", "SSIM", Better::Higher, 3),
    ("lpips", "LPIPS", Better::Lower, 3),
    ("edge_width", "edge width", Better::Lower, 2),
    ("w_delta_e", "ΔE between neighbours", Better::Lower, 2),
    ("uciqe", "UCIQE", Better::Neither, 3),
    ("truth_psnr", "PSNR against the truth", Better::Higher, 2),
    ("truth_delta_e", "ΔE against the truth", Better::Lower, 2),
];

/// The folders of a scene's results, by stage.
type Folders = BTreeMap<String, PathBuf>;

/// One of the two runs: its folders for every scene.
struct Side {
    name: String,
    scenes: BTreeMap<String, Folders>,
}

/// The results named by `given`: a results folder or its name, and `:N` for its run N.
fn side(given: &str) -> Result<Side, WorkError> {
    let numbered = given.rsplit_once(':').and_then(|(name, n)| Some((name, n.parse::<usize>().ok()?)));
    let mut scenes: BTreeMap<String, Folders> = BTreeMap::new();
    if let Some((name, number)) = numbered {
        let folder = history::folder(Path::new(name))?;
        let records = history::records(&folder);
        let Some((_, record)) = records.iter().find(|(known, _)| *known == number) else {
            let what = format!("there is no run {number}; `use3d results {name}` lists them");
            return Err(WorkError::Input(format!("{given}: {what}")));
        };
        for made in &record.artifacts {
            if let Some(path) = record.folder_of(made) {
                let scene = [made.scene.as_str(), made.variant.as_str()];
                let scene: Vec<&str> = scene.into_iter().filter(|part| !part.is_empty()).collect();
                scenes.entry(scene.join("@")).or_default().insert(made.stage.clone(), path);
            }
        }
        scenes.retain(|_, stages| stages.contains_key("render"));
        if scenes.is_empty() {
            let what = format!("the pictures of run {number} are not in the cache any more; run it again");
            return Err(WorkError::Input(format!("{given}: {what}: {}", record.command)));
        }
    } else {
        let registry = stages()?;
        // A capture often has the name of its results below ./use3d-out.
        for folder in [PathBuf::from(given), Path::new(OUT).join(given)] {
            if !scenes.is_empty() {
                break;
            }
            let folders = entries(&folder).filter(|path| path.is_dir()).chain([folder]);
            for path in folders.filter(|path| path.join("renders").is_dir()) {
                let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
                let there = registry.stages().iter().filter_map(|stage| Some((stage, stage.delivered?)));
                let there = there.map(|(stage, folder)| (stage.name().to_string(), path.join(folder)));
                scenes.insert(name, there.filter(|(_, path)| path.is_dir()).collect());
            }
        }
        if scenes.is_empty() {
            return Err(WorkError::Input(format!(
                "{given}: expected the results folder of a run (`use3d results` lists those in ./use3d-out)"
            )));
        }
    }
    Ok(Side { name: given.to_string(), scenes })
}

/// The parameters of a stage's result, by name.
fn parameters(folder: &Path) -> BTreeMap<String, String> {
    let manifest: Value = read_json(&folder.join(MANIFEST)).unwrap_or_default();
    let ingredients = &manifest["ingredients"];
    let named =
        canonical::leaves(&ingredients["parameters"]).into_iter().filter(|(name, _)| !name.is_empty());
    let seed = ingredients["seed"].as_u64().map(|seed| ("seed".to_string(), seed.to_string()));
    named.map(|(name, value)| (name, text(value))).chain(seed).collect()
}

/// The parameters that differ between two results, for display.
fn differing(a: &Folders, b: &Folders) -> Vec<String> {
    let mut lines = Vec::new();
    for (stage, of_a) in a {
        let Some(of_b) = b.get(stage) else { continue };
        let (a, b) = (parameters(of_a), parameters(of_b));
        for key in a.keys().chain(b.keys()).collect::<BTreeSet<_>>() {
            let [a, b] = [&a, &b].map(|all| all.get(key).map_or("not set", String::as_str));
            if a != b {
                lines.push(format!("{stage}.{key}: {a} in A, {b} in B"));
            }
        }
    }
    lines
}

fn scores(stages: &Folders) -> Option<SceneScores> {
    read_json(&stages.get("evaluate")?.join(SCORES)).ok()
}

/// The look that leads a result's report, among the scored ones.
fn look(stages: &Folders) -> Method {
    best_method(stages.get("enhance").map(PathBuf::as_path)).unwrap_or(Method::Clear)
}

/// A row of scores.
fn row(label: String, scores: Option<&SceneScores>, method: Method) -> Row {
    let cell = |metric: &str| {
        let value = scores.and_then(|scores| scores.mean(method, metric)?.value());
        value.map_or(Cell::Blank, |value| Cell::Number { value, source: String::new() })
    };
    Row::own(label, METRICS.iter().map(|(metric, ..)| cell(metric)).collect())
}

/// The table of scores of both runs, without columns that are empty in both.
fn table(name: &str, sides: [&Folders; 2]) -> Option<Table> {
    let all = sides.map(scores);
    let mut rows = Vec::new();
    for (letter, (stages, scores)) in ["A", "B"].into_iter().zip(sides.into_iter().zip(&all)) {
        let best = look(stages);
        rows.push(row(format!("{letter}: reconstruction"), scores.as_ref(), Method::Reconstruction));
        rows.push(row(format!("{letter}: {}", best.name()), scores.as_ref(), best));
    }
    let there: Vec<usize> =
        (0..METRICS.len()).filter(|k| rows.iter().any(|row| row.cells[*k].value().is_some())).collect();
    for row in &mut rows {
        row.cells = there.iter().map(|k| row.cells[*k].clone()).collect();
    }
    let column = |k: &usize| Column::new("", METRICS[*k].1, METRICS[*k].2, METRICS[*k].3);
    let caption = format!("{name}: mean scores over the held-out views");
    let columns: Vec<Column> = there.iter().map(column).collect();
    (!columns.is_empty()).then(|| Table { name: "comparison".into(), caption, columns, rows })
}

/// The names of the held-out photographs in a folder of pictures, in order; none without the folder.
fn held_out(renders: &Path) -> Vec<String> {
    let mut stems = stems(&renders.join("captured")).unwrap_or_default();
    stems.sort();
    stems
}

/// The reason why the scores of two results say nothing about each other; `None` if they were measured on the
/// same pictures.
fn unlike(renders: [&Path; 2], stems: [&[String]; 2]) -> Result<Option<String>, WorkError> {
    let [a, b] = stems;
    if a != b {
        let named = |all: &[String]| match all {
            [] => "no photograph".to_string(),
            [one] => one.clone(),
            [first, .., last] => format!("{} photographs ({first} to {last})", all.len()),
        };
        return Ok(Some(format!("A was tested on {}, and B on {}", named(a), named(b))));
    }
    for stem in a {
        let [a, b] = renders.map(|folder| folder.join("captured").join(format!("{stem}.png")));
        let read = |path: &Path| read_image(path).map_err(WorkError::input);
        if std::fs::read(&a).ok() == std::fs::read(&b).ok() {
            continue;
        }
        let (a, b) = (read(&a)?, read(&b)?);
        let [of_a, of_b] = [&a, &b].map(|image| format!("{} × {}", image.width(), image.height()));
        if of_a != of_b {
            return Ok(Some(format!(
                "the pictures of A have {of_a} pixels, and those of B {of_b}; run both with the same --max-side"
            )));
        }
        if a != b {
            return Ok(Some(format!("the test photograph {stem} is another picture in A than in B")));
        }
    }
    Ok(None)
}

/// The comparison in one sentence. With a reason why the two are unlike, there is no winner.
fn sentence(sides: [&Folders; 2], unlike: Option<&str>) -> Option<Sentence> {
    if let Some(reason) = unlike {
        let text =
            format!("Not comparable: {reason}. So the scores are left out, and neither is called better.");
        return Some(Sentence { tone: Tone::Plain, text });
    }
    let psnr = |stages| scores(stages)?.mean(Method::Reconstruction, "psnr")?.value();
    let [a, b] = [psnr(sides[0])?, psnr(sides[1])?];
    let (better, by) = if a >= b { ("A", a - b) } else { ("B", b - a) };
    let which = if by < 0.05 { "they are alike".into() } else { format!("{better} is better by {by:.1} dB") };
    let text =
        format!("Likeness to the photographs that were kept back: A {a:.1} dB, B {b:.1} dB (PSNR): {which}.");
    Some(Sentence { tone: Tone::Plain, text })
}

/// The differing parameters in one line: the first ones, and the number of others.
fn in_short(differing: &[String]) -> String {
    const NAMED: usize = 3;
    let named = differing.iter().take(NAMED).map(String::as_str).collect::<Vec<_>>().join("; ");
    match differing.len() {
        0 => "No setting differs.".into(),
        n @ 1..=NAMED => {
            format!("{n} {}: {named}.", if n == 1 { "setting differs" } else { "settings differ" })
        }
        n => format!("{n} settings differ: {named}; and {} more.", n - NAMED),
    }
}

/// The pictures of a scene in both runs, and their scores if they can be compared.
fn section(name: &str, sides: [&Folders; 2]) -> Result<(SceneSection, Option<Table>), WorkError> {
    let renders = sides.map(|stages| stages["render"].clone());
    let [a, b] = renders.each_ref().map(|folder| held_out(folder));
    let unlike = unlike([&renders[0], &renders[1]], [&a, &b])?;
    let common: Vec<&String> = a.iter().filter(|stem| b.contains(stem)).collect();
    let count = common.len().min(VIEWS);
    let mut section = SceneSection { name: name.into(), ..SceneSection::default() };
    section.verdict.extend(sentence(sides, unlike.as_deref()));
    section.notes = differing(sides[0], sides[1]);
    section.summary = in_short(&section.notes);
    for k in 0..count {
        let stem = common[k * common.len() / count];
        let picture = |of: &str, folder: &Path, mode: Option<Mode>| -> Result<Option<Picture>, WorkError> {
            let (name, words) =
                mode.map_or(("captured", "the photograph"), |mode| (mode.name(), caption(mode)));
            let file = folder.join(name).join(format!("{stem}.png"));
            if !file.is_file() {
                return Ok(None);
            }
            let image = read_image(&file).map_err(WorkError::input)?;
            let label = format!("{of}{words}");
            Picture::embed(&label, "", &image).map(Some).map_err(WorkError::failed)
        };
        let (mut lead, mut images) = (Vec::new(), Vec::new());
        for (letter, (folder, stages)) in ["A: ", "B: "].into_iter().zip(renders.iter().zip(sides)) {
            let best = look(stages).name();
            for mode in [Mode::Reconstruction, Mode::Clear, Mode::Enhanced, Mode::EnhancedClear] {
                let list = if mode.name() == best { &mut lead } else { &mut images };
                list.extend(picture(letter, folder, Some(mode))?);
            }
        }
        images.extend(picture("", &renders[0], None)?);
        section.views.push(ViewSection { name: stem.clone(), lead, images, ..ViewSection::default() });
    }
    let table = unlike.is_none().then(|| table(name, sides)).flatten();
    Ok((section, table))
}

/// The place of the page of two runs, if none is given: a name of its own for every pair.
fn place_of(a: &str, b: &str) -> PathBuf {
    let word = |given: &str| {
        let short = given.trim_start_matches("./").trim_start_matches(OUT).trim_matches('/');
        short.replace(|c: char| !(c.is_alphanumeric() || "._".contains(c)), "-")
    };
    format!("compare-{}-{}.html", word(a), word(b)).into()
}

/// Writes the page at `out`, or at a place of its own for these two, where an earlier page of them is
/// replaced. Returns the place.
///
/// # Errors
/// The place is occupied by something else, or cannot be written.
pub fn write(
    page: &Page,
    (a, b): (&str, &str),
    (out, force): (Option<&Path>, bool),
) -> Result<PathBuf, WorkError> {
    let html = page.html().map_err(WorkError::failed)?;
    let Some(out) = out else {
        let own = place_of(a, b);
        STAMPED.write(&own, &html)?;
        return Ok(own);
    };
    check_file("--out", out, force, &["html"])?;
    write_text("--out", out, &html)?;
    Ok(out.to_path_buf())
}

/// The page that compares two runs. Each is a results folder, its name below `./use3d-out`, or `NAME:N` for
/// its run N. `made_with` names the program.
///
/// # Errors
/// There is no such run, the two have no scene in common, or a picture cannot be read.
pub fn page(a: &str, b: &str, made_with: String) -> Result<Page, WorkError> {
    let (a, b) = (side(a)?, side(b)?);
    // If each run has one scene, the two are compared even with different names.
    let pairs: Vec<(&String, [&Folders; 2])> = if a.scenes.len() == 1 && b.scenes.len() == 1 {
        a.scenes.iter().zip(b.scenes.values()).map(|((name, a), b)| (name, [a, b])).collect()
    } else {
        a.scenes.iter().filter_map(|(name, of_a)| Some((name, [of_a, b.scenes.get(name)?]))).collect()
    };
    if pairs.is_empty() {
        let names = |side: &Side| side.scenes.keys().cloned().collect::<Vec<_>>().join(", ");
        let [has_a, has_b] = [&a, &b].map(|side| format!("{} has {}", side.name, names(side)));
        return Err(WorkError::Input(format!("the two have no scene in common: {has_a}, {has_b}")));
    }
    let mut page = Page {
        title: format!("{} and {}", a.name, b.name),
        subtitle: format!("A is {}, B is {}", a.name, b.name),
        made_with,
        ..Page::default()
    };
    for (name, sides) in pairs {
        let (section, table) = section(name, sides)?;
        if section.views.is_empty() {
            page.missing.push(format!("{name}: the two runs held out no view in common"));
        }
        page.tables.extend(table);
        page.scenes.push(section);
    }
    Ok(page)
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::Image;
    use use3d_io_image::write_png;

    #[test]
    fn runs_that_were_tested_on_other_pictures_have_no_winner() {
        let dir = tempfile::tempdir().unwrap();
        let run = |name: &str, stem: &str, width: usize, value: f32| {
            let renders = dir.path().join(name);
            std::fs::create_dir_all(renders.join("captured")).unwrap();
            let file = renders.join("captured").join(format!("{stem}.png"));
            write_png(&file, &Image::filled(width, 4, value)).unwrap();
            renders
        };
        let a = run("a", "f_1", 8, 0.2);
        let against = |b: &Path| unlike([&a, b], [&held_out(&a), &held_out(b)]).unwrap();
        assert_eq!(against(&run("same", "f_1", 8, 0.2)), None);
        let told =
            |b: &Path| sentence([&Folders::new(), &Folders::new()], against(b).as_deref()).unwrap().text;
        for (b, reason) in [
            (run("size", "f_1", 4, 0.2), "the pictures of A have 8 × 4 pixels, and those of B 4 × 4"),
            (run("photograph", "f_1", 8, 0.6), "the test photograph f_1 is another picture in A than in B"),
            (run("view", "g_1", 8, 0.2), "A was tested on f_1, and B on g_1"),
        ] {
            let told = told(&b);
            assert!(
                told.starts_with(&format!("Not comparable: {reason}")) && !told.contains("is better"),
                "{told}"
            );
        }
    }

    #[test]
    fn every_pair_has_a_page_and_differing_settings_have_names() {
        assert_eq!(place_of("use3d-out/reef", "./2025/reef:2"), Path::new("compare-reef-2025-reef-2.html"));
        let lines: Vec<String> = (1..=5).map(|i| format!("import.p{i}: 1 in A, 2 in B")).collect();
        assert_eq!(in_short(&lines[..1]), "1 setting differs: import.p1: 1 in A, 2 in B.");
        assert!(
            in_short(&lines).starts_with("5 settings differ: import.p1")
                && in_short(&lines).ends_with("and 2 more.")
        );
    }
}
